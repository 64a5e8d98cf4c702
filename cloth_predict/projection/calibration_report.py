"""A calibration of a projector as text and as numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from cloth_predict.projection.calibration import Calibration

DEGREES = 180 / math.pi


def summary(calibration: Calibration, lines: tuple[int, ...]) -> dict[str, Any]:
    """Return what `calibrate-projector --json` prints; lines: of the pairs in their file.

    The values of the rotation are its rotation vector [rad]; a sigma is null where it has none.
    """
    parameters = zip(calibration.names, calibration.values, calibration.sigma, strict=True)
    return {
        'pairs': len(lines),
        'rms_px': calibration.rms,
        'max_px': calibration.max,
        'worst_line': lines[int(np.argmax(calibration.misfits))],
        'converged': calibration.converged,
        'mistyped_lines': [lines[pair] for pair in calibration.suspects],
        'parameters': {
            name: {
                'value': float(value),
                'sigma': float(sigma) if math.isfinite(sigma) else None,
                'unit': _unit(name),
            }
            for name, value, sigma in parameters
        },
        'undetermined': list(calibration.undetermined()),
    }


def text(calibration: Calibration, lines: tuple[int, ...]) -> str:
    """Return the parameters with their sigmas, and the reprojection error, as text."""
    worst = int(np.argmax(calibration.misfits))
    rows = [f'{"parameter":14} {"value":>12} {"sigma":>10} unit']
    for name, value, sigma in zip(
        calibration.names, calibration.values, calibration.sigma, strict=True
    ):
        unit = _unit(name)
        factor, unit = (DEGREES, 'deg') if unit == 'rad' else (1.0, unit)
        rows.append(f'{name:14} {factor * value:12.5g} {factor * sigma:10.2g} {unit}'.rstrip())
    return '\n'.join(
        [
            *rows,
            'rotation: its rotation vector; sigma: of a turn about this axis of the projector',
            f'reprojection error of {len(lines)} pairs: RMS {calibration.rms:.3g} px, '
            f'max {calibration.max:.3g} px, the worst pair is in line {lines[worst]}',
        ]
    )


def complaints(calibration: Calibration, lines: tuple[int, ...]) -> Iterator[str]:
    """Yield a line for each pair that seems mistyped, and what the pairs do not tell."""
    usual = float(np.median(calibration.misfits))
    for pair in calibration.suspects:
        off = calibration.misfits[pair]
        found = f'is off by {off:.3g} px' if math.isfinite(off) else 'cannot be lit'
        yield f'line {lines[pair]}: seems mistyped: it {found}, half of the pairs by {usual:.2g}'
    if not calibration.converged:
        yield 'the search for the parameters came to no end: they are not those of the least error'
    unknown = ', '.join(calibration.undetermined())
    if unknown:
        yield (
            f'the pairs hardly determine {unknown}: take more of them, at several depths and over '
            f'the whole frame, or fit fewer parameters'
        )


def _unit(name: str) -> str:
    kind = name.split('_')[0]
    return {'rotation': 'rad', 'translation': 'm'}.get(kind, '' if name[0] in 'kp' else 'px')
