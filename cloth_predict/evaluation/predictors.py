"""What `evaluate` compares: the tracker, and the simple methods that it has to beat."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from math import nan
from typing import NamedTuple, Protocol

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.filters.kinematic import POLYNOMIALS
from cloth_predict.filters.kinematic_bank import KinematicBank
from cloth_predict.surface.topology import NO_TRIANGLES
from cloth_predict.tracker import NANOSECONDS, NO_POINTS, Tracker
from cloth_predict.types import BoolArray, FloatArray, IntArray, Surface


class Predicted(NamedTuple):
    """Where markers will be: position [m], shape (markers, 3), NaN where unknown.

    sigma [m], shape (markers,): standard deviation of a coordinate, NaN where the method has none.
    triangles, shape (t, 3), between them, where they are nodes of a surface.
    """

    position: FloatArray
    sigma: FloatArray
    triangles: IntArray = NO_TRIANGLES

    @classmethod
    def unknown(cls, markers: int) -> Predicted:
        """Nothing is known of any marker."""
        return cls(np.full((markers, 3), nan), np.full(markers, nan))


class Estimated(NamedTuple):
    """Where markers are: position [m], shape (markers, 3), covariance [m^2], (markers, 3, 3).

    NaN where unknown.
    """

    position: FloatArray
    covariance: FloatArray

    @classmethod
    def unknown(cls, markers: int) -> Estimated:
        """Nothing is known of any marker."""
        return cls(np.full((markers, 3), nan), np.full((markers, 3, 3), nan))


class Predictor(Protocol):
    """Something that follows markers and says where they will be."""

    @property
    def associates(self) -> bool:
        """Whether it finds out by itself which marker is which node; others need labels."""

    @property
    def counts(self) -> Mapping[str, int]:
        """What became of the frames, where it tells."""

    @property
    def reason(self) -> str:
        """Why its latest prediction is unknown, in a line, where it tells."""

    def step(
        self,
        stamp: int,
        positions: FloatArray,
        visible: BoolArray,
        points: FloatArray = NO_POINTS,
    ) -> float:
        """Take a frame: stamp [ns], positions [m], shape (markers, 3), visible, (markers,).

        points [m], shape (m, 3): markers without a label. Frames may come out of order.
        Returns the normalised innovation squared per degree of freedom, or NaN.
        """

    def predict(self, horizon: float) -> Predicted:
        """Return the markers `horizon` [s] after the latest frame."""

    def estimate(self) -> Estimated:
        """Return the markers at the latest frame."""


class Hold:
    """The last position seen of each marker."""

    associates = False
    counts: Mapping[str, int] = {}
    reason = ''

    def __init__(self, config: Config) -> None:
        nodes = config.model.count
        self._last, self._stamps = Predicted.unknown(nodes), np.full(nodes, np.iinfo(np.int64).min)

    def step(
        self,
        stamp: int,
        positions: FloatArray,
        visible: BoolArray,
        points: FloatArray = NO_POINTS,
    ) -> float:
        """Take a frame; a late one tells of the markers that no later one has shown."""
        newer = visible & (stamp > self._stamps)
        self._stamps = np.where(newer, stamp, self._stamps)
        latest = np.where(newer[:, None], positions, self._last.position)
        self._last = self._last._replace(position=latest)
        return nan

    def predict(self, horizon: float) -> Predicted:
        """Return the positions last seen."""
        return self._last

    def estimate(self) -> Estimated:
        """Return the positions last seen."""
        return Estimated.unknown(len(self._stamps))._replace(position=self._last.position)


class _Frame(NamedTuple):
    stamp: int
    positions: FloatArray
    visible: BoolArray
    after: KinematicBank


class Kinematic:
    """One kinematic Kalman filter per marker; a late frame is put where it belongs.

    Of several spectral densities each has filters of its own, one density after the other.
    """

    associates = False
    counts: Mapping[str, int] = {}
    reason = ''
    reason = ''

    def __init__(self, config: Config, motion: str, density: float | FloatArray) -> None:
        self._copies = np.size(density)
        densities = np.repeat(density, config.model.count)
        sigma = config.filter.measurement_noise
        self._unseen = KinematicBank.unseen(POLYNOMIALS[motion], densities, sigma, len(densities))
        self._memory = config.filter.max_backstep * NANOSECONDS
        self._frames: deque[_Frame] = deque()

    def step(
        self,
        stamp: int,
        positions: FloatArray,
        visible: BoolArray,
        points: FloatArray = NO_POINTS,
    ) -> float:
        """Take a frame; nothing is learnt of one whose stamp was there before."""
        if self._copies > 1:
            positions, visible = (
                np.tile(positions, (self._copies, 1)),
                np.tile(visible, self._copies),
            )
        later: list[_Frame] = []
        while self._frames and self._frames[-1].stamp > stamp:
            later.append(self._frames.pop())
        nis = nan
        if not self._frames or self._frames[-1].stamp < stamp:
            nis = self._take(stamp, positions, visible)
        for frame in reversed(later):
            self._take(frame.stamp, frame.positions, frame.visible)
        return nan if later else nis

    def _take(self, stamp: int, positions: FloatArray, visible: BoolArray) -> float:
        bank = self._unseen
        if self._frames:
            bank = self._bank.moved((stamp - self._frames[-1].stamp) / NANOSECONDS)
        bank, nis = bank.updated(positions, visible)
        self._frames.append(_Frame(stamp, positions, visible, bank))
        # one frame older than the memory stays: a late frame needs what was believed before it
        while len(self._frames) > 2 and self._frames[1].stamp < stamp - self._memory:
            self._frames.popleft()
        return nis

    @property
    def _bank(self) -> KinematicBank:
        return self._frames[-1].after if self._frames else self._unseen

    def predict(self, horizon: float) -> Predicted:
        """Extrapolate each marker that was ever seen."""
        position, variance = self._bank.ahead(horizon)
        return Predicted(position, np.sqrt(variance))

    def estimate(self) -> Estimated:
        """Return each marker that was ever seen."""
        position, variance = self._bank.ahead(0.0)
        return Estimated(position, variance[:, None, None] * np.eye(3))


class Tracked:
    """The tracker, with the filter of the configuration or one of another kind.

    ahead: what it says of the time to come, in place of its prediction.
    """

    associates = True

    def __init__(
        self,
        config: Config,
        kind: str | None = None,
        ahead: Callable[[Tracker, float], Surface] = Tracker.predict,
    ) -> None:
        if kind is not None:
            config = replace(config, filter=replace(config.filter, kind=kind))
        self._tracker, self._ahead = Tracker(config), ahead
        self.reason = ''

    @property
    def counts(self) -> Counter[str]:
        """What became of the frames."""
        return self._tracker.counts

    def step(
        self,
        stamp: int,
        positions: FloatArray,
        visible: BoolArray,
        points: FloatArray = NO_POINTS,
    ) -> float:
        """Take a frame; markers beyond the nodes are no nodes."""
        nodes = self._tracker.nodes
        learnt = self._tracker.step(stamp, positions[:nodes], visible[:nodes], points).innovation
        if learnt is None or not learnt.residual.size:
            return nan
        return learnt.nis / len(learnt.residual)

    def predict(self, horizon: float) -> Predicted:
        """Return what the tracker predicts; unknown where it does not."""
        try:
            surface = self._ahead(self._tracker, horizon)
        except FrameError as error:
            self.reason = str(error)
            return Predicted.unknown(self._tracker.nodes)
        return Predicted(surface.position, surface.sigma, self._tracker.triangles)

    def estimate(self) -> Estimated:
        """Return what the tracker estimates; unknown where it does not."""
        try:
            surface = self._tracker.estimate()
        except FrameError:
            return Estimated.unknown(self._tracker.nodes)
        return Estimated(surface.position, surface.covariance)


Make = Callable[[Config], Predictor]

BASELINES: dict[str, Make] = {
    'hold': Hold,
    'kf_cv': lambda c: Kinematic(c, 'constant_velocity', c.baseline.cv_noise),
    'kf_ca': lambda c: Kinematic(c, 'constant_acceleration', c.baseline.ca_noise),
}
"""What every filter is compared with; a new method is one entry."""


def methods(kinds: Iterable[str], baselines: Mapping[str, Make] = BASELINES) -> dict[str, Make]:
    """Return the baselines, and the tracker with each of these kinds of filter by its name."""

    def tracked(kind: str) -> Make:
        return lambda config: Tracked(config, kind)

    return {**baselines, **{kind: tracked(kind) for kind in kinds}}


METHODS = methods(['ekf'])
"""The usual comparison."""
