"""How far ahead is predicted: as configured, or for the delay of the pipeline as it is."""

from __future__ import annotations

from collections import deque
from dataclasses import fields

import numpy as np

from cloth_predict.config import Config
from cloth_predict.projection.vsync import moved_on

FRAMES = 101
"""Frames over which the delay is the median."""
FEWEST = 10
"""Frames before which nothing is said."""
EARLIEST, LATEST = -0.1, 1.0
"""Age [s] of a frame at its arrival that a clock can show: one that stands still between the
frames of a replay, or is set less exactly than frames are fast, shows a little less than none.
What is beyond compares two clocks that have nothing in common."""

BACKLOG, FRESH = 0.05, 0.01
"""Seconds by which a frame is older at its arrival than the freshest ones, from which on it has
waited in a queue at least (others follow at once), and below which the queue is empty again."""
DRIFT = 1e-6
"""Seconds by which two clocks drift apart from frame to frame at most: 0.1 ms in a second. The age
of the freshest frames follows that, and not a queue that stays."""

PREDICTION = 'cloth/prediction'
"""Topic of the prediction that the projector uses."""
NEXT_FRAME = 'projector/next_frame'
"""Topic on which the projector asks for it: the start of the frame that comes next."""


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
        if config.horizon_mode != 'auto' or measured is None:
            return config.horizon
        limits = next(field.metadata for field in fields(config) if field.name == 'horizon')
        return float(np.clip(measured + config.projector.delay, limits['low'], limits['high']))

    @property
    def warning(self) -> str:
        """What keeps the delay from being measured where it is needed, or nothing."""
        if self._config.horizon_mode != 'auto' or self._implausible < FEWEST:
            return ''
        return (
            f'horizon_mode auto: frames are {self._age:.3g} s old by the clock of this node, so '
            f'the horizon stays at {1e3 * self.horizon:.0f} ms; are the clocks synchronised, or '
            f'is use_sim_time missing?'
        )


class Backlog:
    """From which frames of markers is predicted, where they wait in a queue.

    To predict from all of these would keep the queue from getting shorter. From one that is late
    on, by its age at its arrival, every other one is left out until the queue is empty again, and
    more of them the later they are; so there are predictions at any load. With a fixed horizon a
    frame is late by half of it, and where the horizon follows the delay by `BACKLOG`.
    """

    def __init__(self, config: Config) -> None:
        """Prepare; nothing has waited yet."""
        fixed = config.horizon_mode == 'fixed'
        self._patience = max(BACKLOG, 0.5 * config.horizon) if fixed else BACKLOG
        self._freshest = np.inf
        self._behind = False
        self._left_out = 0

    def leaves_out(self, age: float) -> bool:
        """Whether a frame of this age [s] at its arrival is one that is not predicted from."""
        if not EARLIEST <= age <= LATEST:  # of a clock that tells nothing
            return False
        self._freshest = min(age, self._freshest + DRIFT)
        late = age - self._freshest
        self._behind = late > (FRESH if self._behind else self._patience)
        if self._behind and self._left_out < max(1, int(late / self._patience)):
            self._left_out += 1
            return True
        self._left_out = 0
        return False


class FrameRequests:
    """The frame of the projector for which is predicted, as it was asked for last."""

    def __init__(self, config: Config) -> None:
        """Prepare; nothing is asked for yet."""
        projector = config.projector
        self._horizon, self._fps = config.horizon, projector.fps
        self._before = projector.delay + projector.lead
        self._farthest = LATEST + self._before + 1.0 / projector.fps
        self._frame: int | None = None
        self._off = 0.0
        self._took: deque[float] = deque([0.0], maxlen=FRAMES)

    def add(self, processing: float) -> None:
        """Take how long [s] it took from the arrival of a frame to its prediction."""
        self._took.append(processing)

    def ask(self, start: int) -> None:
        """Take the start [ns] of the frame that comes next."""
        self._frame = start

    def horizon(self, capture: int, age: float) -> float:
        """How far [s] to predict from a frame of markers at `capture` [ns], `age` [s] old.

        To the frame that was asked for, or, where it is past, to the first one after it that can
        still be reached: one that is not made before nine of ten predictions are there.
        `config.horizon` where no frame is in reach.
        """
        self._off = 0.0
        if self._frame is None:
            return self._horizon
        reach = 0.0
        if EARLIEST <= age <= LATEST:
            reach = max(age, 0.0) + float(np.percentile(self._took, 90)) + self._before
        self._off = 1e-9 * (self._frame - capture)
        if abs(self._off) > self._farthest:
            return self._horizon
        self._off = 0.0
        return 1e-9 * (moved_on(self._frame, capture + round(1e9 * reach), self._fps) - capture)

    @property
    def warning(self) -> str:
        """What keeps the frame from being met, or nothing."""
        if not self._off:
            return ''
        return (
            f'horizon_mode vsync: the frame that {NEXT_FRAME} asks for is {self._off:.3g} s after '
            f'the markers, so the horizon stays at {1e3 * self._horizon:.0f} ms; is the projector '
            f'node gone, or use_sim_time missing?'
        )
