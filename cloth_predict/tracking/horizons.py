"""How far ahead is predicted: as configured, or for the delay of the pipeline as it is."""

from __future__ import annotations

from collections import deque
from dataclasses import fields

import numpy as np

from cloth_predict.config import Config

FRAMES = 101
"""Frames over which the delay is the median."""
FEWEST = 10
"""Frames before which nothing is said."""
EARLIEST, LATEST = -0.1, 1.0
"""Age [s] of a frame at its arrival that a clock can show: one that stands still between the
frames of a replay, or is set less exactly than frames are fast, shows a little less than none.
What is beyond compares two clocks that have nothing in common."""

PREDICTION = 'cloth/prediction'
"""Topic of the prediction that the projector uses."""


def topics(config: Config) -> dict[str, float]:
    """Topic of every prediction and its horizon [s], the projector's first."""
    first, *further = config.every_horizon
    # a topic's name takes no point: 12.5 ms is 12_5ms
    names = [f'{PREDICTION}_{1e3 * horizon:g}ms'.replace('.', '_') for horizon in further]
    return {PREDICTION: first, **dict(zip(names, further, strict=True))}


class PipelineDelay:
    """Median time from the capture of a frame to the publication of its prediction."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._delays: deque[float] = deque(maxlen=FRAMES)
        self._implausible = 0
        self._age = 0.0

    def add(self, age: float, processing: float) -> None:
        """Take a frame: its age [s] at its arrival by the node's clock, and its processing [s].

        The processing is timed by a clock of its own, as the node's may stand still meanwhile.
        """
        self._age = age
        if EARLIEST <= age <= LATEST:
            self._delays.append(max(age, 0.0) + processing)
            self._implausible = 0
        else:
            self._implausible += 1

    @property
    def median(self) -> float | None:
        """Delay [s], or None while it is not known."""
        return float(np.median(self._delays)) if len(self._delays) >= FEWEST else None

    @property
    def horizon(self) -> float:
        """How far to predict [s] for the projector, within the limits of the parameter."""
        measured, config = self.median, self._config
        if config.horizon_mode == 'fixed' or measured is None:
            return config.horizon
        limits = next(field.metadata for field in fields(config) if field.name == 'horizon')
        return float(np.clip(measured + config.projector.delay, limits['low'], limits['high']))

    @property
    def warning(self) -> str:
        """What keeps the delay from being measured where it is needed, or nothing."""
        if self._config.horizon_mode == 'fixed' or self._implausible < FEWEST:
            return ''
        return (
            f'horizon_mode auto: frames are {self._age:.3g} s old by the clock of this node, so '
            f'the horizon stays at {1e3 * self.horizon:.0f} ms; are the clocks synchronised, or '
            f'is use_sim_time missing?'
        )
