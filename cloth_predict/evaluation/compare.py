"""Compares predictors on recordings: the same frames and markers for every method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isfinite, nan
from typing import Any

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import ConfigError
from cloth_predict.evaluation.baselines import best_noise
from cloth_predict.evaluation.bodies import methods_of
from cloth_predict.evaluation.cases import Case, labelled_case
from cloth_predict.evaluation.judging import Judged, judge
from cloth_predict.evaluation.predictors import Make
from cloth_predict.evaluation.runs import Progress, follow
from cloth_predict.metrics import (
    Details,
    Ratio,
    Score,
    by_speed,
    coverage,
    mean,
    ratio,
    score,
)
from cloth_predict.surface.layout import free_markers
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

SEED = 0
"""Of the bootstrap; the same frames are drawn for every method."""
KINEMATIC = ('kf_cv', 'kf_ca', 'rigid')
"""What a method has to beat: the better of these."""
POOLED = 'all'


@dataclass(frozen=True)
class Evaluation:
    """The comparison at one horizon, by method; `bag` names the recording, or is `all` of them.

    best: the kinematic filter of the smaller error, or None; noise: the spectral densities of the
    kinematic filters, where they were searched for.
    """

    horizon: float
    judged: Judged
    scores: dict[str, Score]
    details: dict[str, Details]
    ratios: dict[str, Ratio]
    best: str | None
    noise: dict[str, float]
    bag: str

    @property
    def us_per_frame(self) -> dict[str, float]:
        """What a frame took [us]: the update and the prediction."""
        given = self.judged.given
        return {name: 1e6 * a.seconds / given for name, a in self.judged.answers.items()}

    @property
    def targets(self) -> IntArray:
        """The times predicted for [ns], shape (frames,)."""
        return self.judged.targets

    @property
    def errors(self) -> dict[str, FloatArray]:
        """Errors [m], shape (frames, markers), NaN where not counted."""
        return {name: answers.errors for name, answers in self.judged.answers.items()}

    def summary(self) -> dict[str, Any]:
        """Return the numbers as `evaluate --json` prints them."""
        return {
            'horizon_s': self.horizon,
            'frames': len(self.targets),
            'methods': {name: self._summary(name) for name in self.scores},
            'best_kinematic': self.best,
        }

    def _summary(self, name: str) -> dict[str, Any]:
        found: dict[str, Any] = {
            **asdict(self.scores[name]),
            'us_per_frame': self.us_per_frame[name],
            **asdict(self.details[name]),
            **asdict(self.ratios[name]),
            'predicted': self.judged.share(name),
            'counts': dict(self.judged.answers[name].counts),
        }
        if name in self.noise:
            found['noise'] = self.noise[name]
        return {key: _plain(value) for key, value in found.items()}


def _plain(value: Any) -> Any:
    """Return what JSON can hold: what is not finite becomes None, a tuple a list."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def evaluate(
    markers: MarkerSequence,
    config: Config,
    horizon: float,
    truth: MarkerSequence | None = None,
    makers: Mapping[str, Make] | None = None,
    progress: Progress = lambda frames: None,
    source: str = 'the recording',
) -> Evaluation:
    """Compare methods at one horizon [s] on markers in node order, by the truth if given."""
    return compare(
        labelled_case(markers, config, source, truth), config, [horizon], makers, progress=progress
    )[0]


def compare(
    case: Case,
    config: Config,
    horizons: Sequence[float],
    makers: Mapping[str, Make] | None = None,
    search: bool = False,
    progress: Progress = lambda frames: None,
) -> list[Evaluation]:
    """Run every method over a recording and judge its predictions at each horizon [s].

    Without makers, the methods are the baselines and the tracker of the configuration. search:
    whether the kinematic filters get the noise that serves them best. Raises ConfigError where
    there are none of them.
    """
    if search and case.reference.surface:
        raise ConfigError(
            f'{case.name}: no kinematic filter follows a body without markers at its nodes'
        )
    makers = methods_of(config, [config.filter.kind]) if makers is None else makers
    choices = best_noise(case, config, horizons) if search else {}
    runs = {
        name: [choice.run for choice in choices[name]]
        if name in choices
        else follow(make(config), case, horizons, progress)
        for name, make in makers.items()
    }
    stamps = case.markers.stamps[case.ahead]
    found = []
    for i, horizon in enumerate(horizons):
        of_horizon = {name: run[i] for name, run in runs.items()}
        judged = judge(stamps, horizon, case.reference, of_horizon, case.name)
        noise = {name: of_name[i].noise for name, of_name in choices.items()}
        found.append(summed(horizon, judged, config, case.name, noise))
    return found


def pooled(evaluations: Sequence[Evaluation], config: Config) -> Evaluation:
    """Return the comparison over several recordings at the same horizon."""
    judged = Judged.joined([one.judged for one in evaluations])
    return summed(evaluations[0].horizon, judged, config, POOLED)


def summed(
    horizon: float,
    judged: Judged,
    config: Config,
    bag: str = '',
    noise: Mapping[str, float] | None = None,
) -> Evaluation:
    """Sum up what was counted."""
    free = np.ones(judged.speed.shape[1], bool) if judged.surface else free_markers(config)
    parts = {name: judged.parts(name) for name in judged.answers}
    scores = {name: score(part, free, np.random.default_rng(SEED)) for name, part in parts.items()}
    of_free = {name: [(e[:, free], block) for e, block in part] for name, part in parts.items()}
    kinematic = [name for name in KINEMATIC if name in scores]
    best = min(kinematic, key=lambda name: scores[name].rmse_free_mm, default=None)
    ratios = {
        name: ratio(part, of_free[best], np.random.default_rng(SEED))
        if best
        else Ratio(nan, (nan, nan))
        for name, part in of_free.items()
    }
    details = {name: _details(judged, name, free) for name in scores}
    return Evaluation(horizon, judged, scores, details, ratios, best, dict(noise or {}), bag)


def _details(judged: Judged, name: str, free: BoolArray) -> Details:
    """Judge what a method says of its own errors."""
    said = judged.answers[name]
    error = said.errors[:, free]
    sigma = np.hypot(said.sigma[:, free], judged.noise[:, None])
    sigma = np.where(np.isfinite(error), sigma, nan)
    off = said.errors[..., None] if judged.surface else said.predicted - judged.actual
    return Details(
        coverage(off[:, free], sigma),
        mean(said.nis),
        mean(said.nees[:, free]),
        by_speed(error, judged.speed[:, free]),
    )
