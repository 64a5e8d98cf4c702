"""What a video told of a bar, as text and as numbers."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.video.following import Seen

UNITS = {'mu': '', 'L': ' m', 'L1': ' m', 'L2': ' m'}


@dataclass
class RulerReport:
    """Collects what is seen, frame by frame, until all of it is told.

    told: the first frame from which the stop was known well enough; faults: of the video, a line
    each.
    """

    frames: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    told: Seen | None = None
    last: Seen | None = None

    def add(self, seen: Seen) -> None:
        """Take what is known after the next frame."""
        self.frames += 1
        self.outcomes[seen.outcome] += 1
        self.faults += seen.sighting.faults
        if seen.outcome == 'restarted':
            self.faults.append(f'frame {seen.frame.number}: the motion begins anew')
            self.told = None
        if seen.certain_rest and self.told is None:
            self.told = seen
        if seen.belief is not None:
            self.last = seen

    def summary(self) -> dict[str, Any]:
        """All of it, for programs; lengths in m, times in s, angles in rad."""
        values = self.last.values if self.last else {}
        return {
            'frames': self.frames,
            'outcomes': dict(sorted(self.outcomes.items())),
            'identified': {
                name: {'value': value, 'sigma': sigma} for name, (value, sigma) in values.items()
            },
            'stop': _stop(self.told),
            'last_stop': _stop(self.last),
            'faults': self.faults,
        }

    def text(self) -> str:
        """The same as a table, and the faults a line each."""
        lines = ['| | value | sigma |', '|---|---|---|']
        for name, (value, sigma) in (self.last.values if self.last else {}).items():
            lines.append(f'| {name} | {value:.4f}{UNITS[name]} | {sigma:.2g}{UNITS[name]} |')
        lines.append('')
        if self.told is None:
            lines.append('The stop was never known as well as is asked for.')
        else:
            lines.append(f'Known from frame {self.told.frame.number} on: {_words(self.told)}')
        if self.last is not None and self.last.rest is not None:
            lines.append(f'At the end: {_words(self.last)}')
        counts = ', '.join(f'{n} {what}' for what, n in sorted(self.outcomes.items()))
        lines.append(f'{self.frames} frames: {counts}')
        return '\n'.join([*lines, *self.faults])


def _stop(seen: Seen | None) -> dict[str, Any] | None:
    if seen is None or seen.rest is None:
        return None
    rest = seen.rest
    return {
        'told_at': rest.since / NANOSECONDS,
        'time': rest.time,
        'time_sigma': rest.stop.time_sigma,
        'pose': rest.stop.mean.tolist(),
        'cov': rest.stop.cov.tolist(),
    }


def _words(seen: Seen) -> str:
    assert seen.rest is not None
    rest = seen.rest
    x, y, angle = rest.stop.mean
    place, turn = rest.stop.place_sigma, rest.stop.angle_sigma
    return (
        f'at {rest.since / NANOSECONDS:.2f} s: rests at {rest.time:.2f} s, '
        f'x = {x:.3f} m, y = {y:.3f} m (+- {1e3 * place:.1f} mm), '
        f'angle {np.degrees(angle):.1f} degrees (+- {np.degrees(turn):.2f})'
    )
