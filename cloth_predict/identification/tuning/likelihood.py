"""How likely the measurements are, given the model and its noise: the innovations' likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log, nan, pi

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FormatError
from cloth_predict.evaluation.cases import Case, relabelled
from cloth_predict.evaluation.judging import WARM_UP
from cloth_predict.filters.linear import root
from cloth_predict.identification.failing import or_none
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import Innovation, MarkerSequence

FEWEST_KEPT = 0.99
"""Share of the samples that the association must keep, so that its labels are taken."""


def log_likelihood(innovation: Innovation) -> float:
    """Logarithm of the density of a residual r of m coordinates with covariance S.

    -1/2 (r' S^-1 r + log det S + m log 2 pi); lengths are in metres. Raises FloatingPointError
    where S is not positive definite.
    """
    lower = root(innovation.cov, 'innovation covariance')
    log_det = 2.0 * float(np.log(np.diagonal(lower)).sum())
    return -0.5 * (innovation.nis + log_det + len(innovation.residual) * log(2.0 * pi))


def measurements(case: Case, config: Config) -> MarkerSequence:
    """Return what every candidate is given: the markers with their labels put right, once.

    Were each candidate to choose its own measurements, the best one would be that which leaves
    out the most. The labels are those that the configured tracker finds, unless it fails or loses
    markers.
    """
    markers = case.markers
    if not config.association.check_labels or not case.labelled.all():
        return markers
    found = or_none(lambda: relabelled(markers, case.points, config, case.name))
    if found is None:
        return markers
    kept = float(found.visible.sum() / max(markers.visible.sum(), 1))
    return found if kept >= FEWEST_KEPT else markers


def believing(config: Config) -> Config:
    """Return the configuration that takes every measurement as it is given, in its order."""
    trusting = replace(config.association, check_labels=False)
    return replace(config, association=trusting, filter=replace(config.filter, rewind=0.0))


@dataclass(frozen=True)
class Fitness:
    """Sum of log likelihoods over a recording, and the number of coordinates measured."""

    log_likelihood: float
    count: int

    def __add__(self, other: Fitness) -> Fitness:
        return Fitness(self.log_likelihood + other.log_likelihood, self.count + other.count)

    @property
    def cost(self) -> float:
        """Minus the log likelihood of a coordinate, in nats, of lengths in metres."""
        return -self.log_likelihood / self.count if self.count else nan


def fitness(markers: MarkerSequence, config: Config, source: str = '') -> Fitness:
    """How likely the measurements of a recording are, but for its first second.

    NaN where the filter fails on the way: no frame may be missing from the sum. Raises
    FormatError where there is nothing to sum up.
    """
    tracker, total = Tracker(believing(config)), Fitness(0.0, 0)
    begin = int(markers.stamps[0]) + WARM_UP * NANOSECONDS if len(markers) else 0.0
    for k, stamp in enumerate(markers.stamps.tolist()):
        learnt = tracker.step(stamp, markers.positions[k], markers.visible[k]).innovation
        if tracker.counts['diverged'] or tracker.counts['lost']:
            return Fitness(nan, 0)
        if learnt is not None and learnt.residual.size and stamp >= begin:
            total += Fitness(log_likelihood(learnt), len(learnt.residual))
    if not total.count:
        raise FormatError(
            f'{source}: no innovation after the first {WARM_UP:g} s: the recording is too short, '
            f'or the surface never starts'
        )
    return total
