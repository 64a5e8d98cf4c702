"""The other objective: how wrong the configured filter is, a time ahead, over a recording."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import ClothPredictError, FormatError
from cloth_predict.evaluation.cases import Case
from cloth_predict.evaluation.judging import BLOCK, WARM_UP, asked_at
from cloth_predict.evaluation.predictors import Hold, Predictor, Tracked
from cloth_predict.identification.failing import or_none
from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.surface.layout import free_markers
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.types import BoolArray, FloatArray, IntArray

FARTHEST = 1.0
"""Length [m] of the longest error that is told from longer ones, so that one wild prediction does
not decide a search; of a filter that fails it is that of every prediction."""

STEP = 0.01
"""Step of differences, on the scale of the search: 1 % of a positive parameter. A gate or a spring
that turns slack makes the errors rough on a smaller scale."""


@dataclass(frozen=True)
class Horizon:
    """Sum of squared errors [m^2] of the free markers, `horizon` [s] ahead of frames.

    What is not predicted, or has no finite prediction, counts as the marker last seen, which is
    what would be shown then. every: how many frames lie from one prediction to the next; those of
    frames after each other tell nearly the same, and a prediction takes longer than an update.
    """

    space: Space
    case: Case
    horizon: float
    every: int = 1

    gradient_price = 1
    parts = 1

    def part(self, k: int, vector: FloatArray) -> float:
        """Cost; NaN where all errors are the longest: then the filter fails with this vector."""
        cost = float(np.square(self.residuals(k, vector)).sum())
        return cost if cost < (1.0 - 1e-9) * FARTHEST**2 * self.weight else float('nan')

    def part_gradient(self, k: int, vector: FloatArray) -> tuple[float, FloatArray]:
        """Not offered: the filter is no smooth function of all parameters."""
        raise ClothPredictError(
            'the horizon objective has no gradient; use the optimiser cma or annealing'
        )

    @property
    def weight(self) -> float:
        """Number of errors."""
        return float(self._asked.sum())

    @property
    def blocks(self) -> IntArray:
        """Number of the block of 0.5 s that each residual is from, shape (residuals,)."""
        stamps = self._stamps
        block = (stamps - stamps[0]) // round(BLOCK * NANOSECONDS)
        return np.broadcast_to(block[:, None, None], (*self._asked.shape, 3))[self._asked].ravel()

    def residuals(self, k: int, vector: FloatArray) -> FloatArray:
        """Errors of each coordinate [m], shape (residuals,)."""
        actual, held = self._actual[self._asked], self._held[self._asked]
        predicted = self._predicted(self.space.apply(vector))
        if predicted is None:
            return np.full(actual.size, FARTHEST / np.sqrt(3.0))
        found = predicted[self._asked]
        known = np.isfinite(found).all(axis=-1, keepdims=True)
        off = np.where(known, found, held) - actual
        length = np.linalg.norm(off, axis=-1, keepdims=True)
        return np.asarray(off * (FARTHEST / np.maximum(length, FARTHEST))).ravel()

    def sensitivity(self, k: int, vector: FloatArray) -> FloatArray:
        """Derivative of the residuals, shape (residuals, n), by central differences."""
        shift = STEP * np.eye(len(vector))
        columns = [
            (self.residuals(k, vector + by) - self.residuals(k, vector - by)) / (2.0 * STEP)
            for by in shift
        ]
        return np.stack(columns, axis=1)

    def _predicted(self, config: Config) -> FloatArray | None:
        """Predictions [m], shape (frames, markers, 3); None where the filter fails altogether."""
        return or_none(lambda: self._followed(Tracked(config)))

    def _followed(self, predictor: Predictor) -> FloatArray:
        """Predictions [m] of a method after the frames chosen, shape (frames, markers, 3)."""
        chosen, found = set(self._frames.tolist()), []
        for k, stamp in enumerate(self.case.markers.stamps.tolist()):
            predictor.step(stamp, *self.case.frame(k, predictor.associates))
            if k in chosen:
                found.append(predictor.predict(self.horizon).position)
        return np.array(found)

    @cached_property
    def _frames(self) -> IntArray:
        """Frames after which is predicted."""
        return np.flatnonzero(self.case.ahead)[:: self.every]

    @cached_property
    def _stamps(self) -> IntArray:
        return self.case.markers.stamps[self._frames]

    @cached_property
    def _held(self) -> FloatArray:
        return self._followed(Hold(self.space.config))

    @cached_property
    def _actual(self) -> FloatArray:
        return self._reference[0]

    @cached_property
    def _asked(self) -> BoolArray:
        return self._reference[1]

    @cached_property
    def _reference(self) -> tuple[FloatArray, BoolArray]:
        return asked_of(self.case, self.space.config, self.horizon, self._stamps, self._held)


def asked_of(
    case: Case, config: Config, horizon: float, stamps: IntArray, held: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Where the markers are `horizon` [s] after frames [m], and which of them are asked for.

    stamps [ns], shape (frames,); held [m], shape (frames, markers, 3): the markers last seen then.
    Asked for, shape (frames, markers), are the free ones that were seen before. Raises FormatError
    where there is none.
    """
    actual, asked = asked_at(stamps, horizon, case.reference)
    asked = np.asarray(asked & free_markers(config) & np.isfinite(held).all(axis=-1))
    if not asked.any():
        raise FormatError(
            f'{case.name}: nothing to judge {horizon:g} s ahead after the first {WARM_UP:g} s: '
            f'the recording is too short, or too gappy'
        )
    return actual, asked
