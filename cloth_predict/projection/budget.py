"""Where the time goes between the capture of the markers and the light that falls on them."""

from __future__ import annotations

from collections import deque

import numpy as np

STAGES = ('capture_to_receive', 'receive_to_filter', 'filter_to_publish', 'publish_to_vsync',
          'vsync_to_row')  # fmt: skip
"""Each begins where the one before it ends."""
FRAMES = 600
"""Frames over which medians are taken: ten seconds at 60 Hz."""
PLAUSIBLE = 10.0
"""Seconds from capture to light beyond which two clocks have nothing in common."""


class Budget:
    """Times of the latest frames, stage by stage."""

    def __init__(self) -> None:
        """Prepare; no frame yet."""
        self._stages: deque[list[float]] = deque(maxlen=FRAMES)

    def add(self, moments: list[float]) -> None:
        """Take the moments [s] between which the stages lie, from the capture to the row.

        They are left out where one is not known, or of another clock.
        """
        stages = np.diff(moments)
        if len(stages) == len(STAGES) and (np.abs(stages) < PLAUSIBLE).all():
            self._stages.append(stages.tolist())

    def values(self) -> dict[str, str]:
        """Median and 99th percentile [ms] of each stage and of all of them together."""
        names = [*STAGES, 'total']
        if not self._stages:
            return {f'{name}_ms': 'unknown' for name in names}
        stages = 1e3 * np.array(self._stages)
        table = np.column_stack([stages, stages.sum(axis=1)])
        found: dict[str, str] = {}
        for end, percent in (('ms', 50), ('p99_ms', 99)):
            values = np.percentile(table, percent, axis=0)
            found |= {f'{k}_{end}': f'{v:.2f}' for k, v in zip(names, values, strict=True)}
        return found
