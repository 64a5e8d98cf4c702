"""Runs a method over a recording, once for all horizons."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import nan

import numpy as np

from cloth_predict.evaluation.bodies import on_surface
from cloth_predict.evaluation.cases import Case, Reference
from cloth_predict.evaluation.predictors import Predictor
from cloth_predict.metrics import at_times, normalised
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.types import FloatArray, IntArray

Progress = Callable[[int], None]


@dataclass(frozen=True)
class Run:
    """What a method said of a whole recording, after each frame that is later than all before.

    position [m], shape (frames, markers, 3); sigma [m], shape (frames, markers); nis, shape
    (frames,), per degree of freedom; nees, shape (frames, markers), of the estimate by the truth,
    per degree of freedom; NaN where unknown. seconds: what it took; counts: what became of the
    frames, and reason: why the last prediction that is unknown is so, where the method tells.
    """

    position: FloatArray
    sigma: FloatArray
    nis: FloatArray
    nees: FloatArray
    seconds: float
    counts: Mapping[str, int] = field(default_factory=dict)
    reason: str = ''


def follow(
    predictor: Predictor,
    case: Case,
    horizons: Sequence[float],
    progress: Progress = lambda frames: None,
) -> list[Run]:
    """Let a method follow the markers and predict after each frame; a run for each horizon."""
    rows = {int(k): row for row, k in enumerate(np.flatnonzero(case.ahead))}
    stamps = case.markers.stamps[case.ahead]
    aims = [aimed_at(case.reference, stamps, horizon) for horizon in horizons]
    size, nodes = (len(horizons), len(rows)), case.reference.markers.visible.shape[1]
    position, sigma = np.empty((*size, nodes, 3)), np.empty((*size, nodes))
    nis, nees = np.full(size[1], nan), np.full((size[1], nodes), nan)
    truth, seconds = _truth(case), np.zeros(len(horizons))
    for k, stamp in enumerate(case.markers.stamps.tolist()):
        frame = case.frame(k, predictor.associates)
        begin = time.perf_counter()
        learnt = predictor.step(stamp, *frame)
        seconds += time.perf_counter() - begin
        progress(1)
        if (row := rows.get(k)) is None:
            continue
        nis[row] = learnt
        for i, horizon in enumerate(horizons):
            begin = time.perf_counter()
            predicted = predictor.predict(horizon)
            seconds[i] += time.perf_counter() - begin
            if case.reference.surface:
                predicted = on_surface(predicted, aims[i][row])
            position[i, row], sigma[i, row] = predicted.position, predicted.sigma
        if truth is not None:
            now = predictor.estimate()
            nees[row] = normalised(now.position - truth[k], now.covariance)
    counts = Counter(predictor.counts)
    return [
        Run(position[i], sigma[i], nis, nees, float(seconds[i]), counts, predictor.reason)
        for i in range(len(horizons))
    ]


def _truth(case: Case) -> FloatArray | None:
    """Return the true positions [m] at each frame, NaN where not known; None without the truth.

    What is known of a surface that moves along itself is not where each point of it is.
    """
    if case.reference.surface or not case.reference.true:
        return None
    return aimed_at(case.reference, case.markers.stamps, 0.0)


def aimed_at(reference: Reference, stamps: IntArray, horizon: float) -> FloatArray:
    """Where the reference is [m] `horizon` [s] after each stamp [ns], NaN where not known.

    Shape (frames, markers, 3).
    """
    positions, known = at_times(reference.markers, stamps + round(horizon * NANOSECONDS))
    return np.where(known[..., None], positions, nan)
