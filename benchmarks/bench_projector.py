"""Cost of what is computed for a frame of the projector: processor time on one core.

The surface fills some 60 % of a frame of 1280 x 720 and waves as it moves on. Vertices and
scanlines: from the motion of the surface to their packed records. Warp map: from the key lines
to the texture coordinate of each pixel, of colours for one of them; at 30 Hz it has 33 ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cloth_predict.config import Config, build
from cloth_predict.performance import one_core
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.scanout import KeyRows
from cloth_predict.projection.warp import Warper
from cloth_predict.projection.warp_map import warp_map
from cloth_predict.types import FloatArray

SIZES = ((5, 4), (21, 21))
SCANS = (
    ('progressive', 'down'),
    ('interlaced', 'down'),
    ('colour_sequential', 'down'),
    ('progressive', 'right'),
)
WARM_UP, REPEATS = 10, 200
CENTRE = np.array([0.255, 1.1, 0.0])
"""Of the view of the default projector, 2.2 m before it [m]."""
WIDE, HIGH = 1.55, 0.87
"""Of the surface [m]: some 60 % of the view."""


def main() -> None:
    """Print the tables."""
    print(f'{"[ms]":58} {"median":>7} {"99 %":>7}')
    for rows, cols in SIZES:
        for mode, direction in SCANS:
            config = settings(rows, cols, mode, direction)
            name = f'{rows}x{cols} {mode} {direction}'
            frame(name, config, flat(rows, cols))
        frame(f'{rows}x{cols} folded over', settings(rows, cols), folded(rows, cols))


def settings(rows: int, cols: int, scan: str = 'progressive', direction: str = 'down') -> Config:
    """The default projector before a surface of so many nodes."""
    model = {'rows': rows, 'cols': cols, 'width': WIDE, 'height': HIGH}
    return build(
        {'model': model, 'projector': {'scan': scan, 'direction': direction}}, 'benchmark'
    )


def flat(rows: int, cols: int) -> FloatArray:
    """Nodes of a sheet with waves of 5 cm [m], shape (nodes, 3)."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, cols), np.linspace(0.5, -0.5, rows))
    z = 0.05 * np.sin(7 * x + 4 * y)
    return CENTRE + np.stack([WIDE * x, HIGH * y, z], axis=-1).reshape(-1, 3)


def folded(rows: int, cols: int) -> FloatArray:
    """A sheet of which the right third lies behind the rest: two spans over most pixels."""
    position = flat(rows, cols)
    over = position[:, 0] - (CENTRE[0] + WIDE / 6)
    position[:, 0] -= 2 * np.maximum(over, 0)
    position[:, 2] -= 0.2 * np.maximum(over, 0) + 0.1 * (over > 0)
    return position


def frame(name: str, config: Config, position: FloatArray) -> None:
    """Print what the parts of a frame cost."""
    velocity = np.column_stack([0.5 + position[:, 1], 0.2 * position[:, 0], -position[:, 1]])
    motion = Motion.constant_acceleration(position, velocity, -5 * velocity)
    warper = Warper.of(config, position)

    def records() -> None:
        warped = warper.warp(motion)
        warper.vertices(warped)
        warper.scanlines(warped)

    keys = warper.warp(motion).keys
    lit = np.isfinite(picture(warper, keys)[..., 0]).mean()
    report(f'{name}: vertices and scanlines', records)
    report(f'{name}: warp map, {lit:.0%} lit', lambda: picture(warper, keys))


def picture(warper: Warper, keys: tuple[KeyRows, ...]) -> NDArray[np.float32]:
    """The map of a frame; of colours, the one of the first."""
    scan, image = warper.scan, None
    for field, key in enumerate(keys[:1] if scan.instant else keys):
        image = warp_map(
            key.pixels,
            warper.pinhole.depth(key.position),
            key.lines,
            warper.skin.texture,
            warper.skin.triangles,
            (scan.width, scan.height),
            columns=scan.columns,
            drawn=slice(field, None, scan.fields) if not scan.instant else slice(None),
            out=image,
        )
    assert image is not None
    return image


def report(name: str, work: Callable[[], object]) -> None:
    """Print median and 99th percentile [ms] of many calls, without what else the core did."""
    taken = []
    for _ in range(WARM_UP + REPEATS):
        begin = time.process_time()
        work()
        taken.append(1e3 * (time.process_time() - begin))
    median, late = np.percentile(taken[WARM_UP:], [50, 99])
    print(f'{name:58} {median:7.2f} {late:7.2f}')


if __name__ == '__main__':
    with one_core():
        main()
