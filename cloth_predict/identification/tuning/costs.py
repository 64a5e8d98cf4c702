"""What the search for noise makes small, as one number over several recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan, sqrt

import numpy as np

from cloth_predict.config import Config
from cloth_predict.evaluation.cases import Case
from cloth_predict.evaluation.judging import FEWEST
from cloth_predict.evaluation.predictors import Hold, Tracked
from cloth_predict.evaluation.runs import follow
from cloth_predict.identification.failing import or_none
from cloth_predict.identification.objectives.horizon import asked_of
from cloth_predict.identification.tuning.likelihood import Fitness, fitness
from cloth_predict.metrics import distances


@dataclass(frozen=True)
class Errors:
    """Sum of squares [m^2] of the errors of the free markers, and their number.

    predicted: how many of them are errors of predictions, and not of what was seen last;
    normalised: sum over these of their squares by the predicted variance of a distance.
    """

    squares: float
    count: int
    predicted: int
    normalised: float


def prediction_errors(case: Case, config: Config, horizon: float) -> Errors:
    """Errors of the configured filter `horizon` [s] ahead, over all that was asked.

    What it does not predict counts as the marker last seen, which is what is shown then: a filter
    does not look better for what it refuses. Raises FormatError where nothing is asked.
    """
    stamps = case.markers.stamps[case.ahead]
    (held,) = follow(Hold(config), case, [horizon])
    actual, asked = asked_of(case, config, horizon, stamps, held.position)
    (run,) = follow(Tracked(config), case, [horizon])
    known = np.asarray(np.isfinite(run.position).all(axis=-1))
    position = np.where(known[..., None], run.position, held.position)
    squares, known = np.square(distances(position, actual)), asked & known
    variance = 3.0 * (np.square(run.sigma) + case.reference.noise**2)
    normalised = float((squares[known] / variance[known]).sum())
    return Errors(float(squares[asked].sum()), int(asked.sum()), int(known.sum()), normalised)


def horizon_error(cases: Sequence[Case], config: Config, horizon: float) -> float:
    """RMS error [mm] `horizon` [s] ahead over all recordings, of the free markers.

    NaN of a filter that fails, or predicts less than 95 % of what was asked.
    """
    found = or_none(lambda: [prediction_errors(case, config, horizon) for case in cases])
    if found is None:
        return nan
    count = sum(one.count for one in found)
    if sum(one.predicted for one in found) < FEWEST * count:
        return nan
    return 1e3 * sqrt(sum(one.squares for one in found) / count)


def normalised_error(cases: Sequence[Case], config: Config, horizon: float) -> float:
    """Mean over all predictions of e' e / 3 sigma^2: 1 where errors are as large as predicted.

    Scaling every covariance of the filter by it makes the errors most likely, and changes none.
    """
    found = [prediction_errors(case, config, horizon) for case in cases]
    predicted = sum(one.predicted for one in found)
    return sum(one.normalised for one in found) / predicted if predicted else nan


def total_fitness(cases: Sequence[Case], config: Config) -> Fitness:
    """How likely all measurements of the recordings are; see `fitness`."""
    found = or_none(lambda: [fitness(case.markers, config, case.name) for case in cases])
    return Fitness(nan, 0) if found is None else sum(found[1:], found[0])
