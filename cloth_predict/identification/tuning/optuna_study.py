"""Noise proposed by Optuna, whose storage lets a study be continued, or shared by machines."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import isfinite
from typing import TYPE_CHECKING, Any

from cloth_predict.errors import ClothPredictError
from cloth_predict.identification.tuning.noise import Range
from cloth_predict.identification.tuning.proposals import Best, Values

if TYPE_CHECKING:
    from optuna import Study, Trial

FACTS, RANGES = 'cloth_predict', 'ranges'
"""Attributes of a study: what it is of, and where it searches."""


class OptunaProposals:
    """Asks the tree-structured Parzen estimator of a study (Bergstra 2011).

    The first to be tried are the given values. Raises ClothPredictError where the study is of
    something else, and names what differs.
    """

    def __init__(
        self,
        ranges: Mapping[str, Range],
        facts: Mapping[str, str],
        seed: int = 0,
        storage: str | None = None,
        name: str = 'tune',
    ) -> None:
        """Open a study, or begin it.

        facts: what its results depend on; storage: a URL of Optuna, or a file (SQLite), or None.
        """
        self._study = _opened(seed, storage, name)
        self._asked: list[Trial] = []
        first = {key: around.centre for key, around in ranges.items()}
        wanted = {key: [around.low, around.high] for key, around in ranges.items()}
        with _failures(storage, name):
            if not (self._study.user_attrs or self.tried):
                self._study.set_user_attr(FACTS, dict(facts))
                self._study.set_user_attr(RANGES, wanted)
                self._study.enqueue_trial(first)
            _require_same(self._study.user_attrs.get(FACTS, {}), facts, f'{name} in {storage}')
            self._ranges: dict[str, list[float]] = self._study.user_attrs[RANGES]
            """Of the first configuration: one that goes on may begin with what was found."""

    @property
    def best(self) -> Best | None:
        """The best so far, of all who share the study."""
        try:
            trial = self._study.best_trial
        except ValueError:  # none is complete
            return None
        return Best(dict(trial.params), float(trial.value or 0.0))

    @property
    def tried(self) -> int:
        """Number of trials so far, of all who share the study."""
        return len(self._study.get_trials(deepcopy=False))

    def ask(self, count: int) -> list[Values]:
        """Return what the sampler proposes."""
        self._asked = [self._study.ask() for _ in range(count)]
        return [
            {name: t.suggest_float(name, *ends, log=True) for name, ends in self._ranges.items()}
            for t in self._asked
        ]

    def tell(self, costs: Sequence[float]) -> None:
        """Give the costs to the study; one that is not finite, or missing, is a failed trial."""
        from optuna.trial import TrialState

        for k, trial in enumerate(self._asked):
            if k < len(costs) and isfinite(costs[k]):
                self._study.tell(trial, costs[k])
            else:
                self._study.tell(trial, state=TrialState.FAIL)


def _opened(seed: int, storage: str | None, name: str) -> Study:
    optuna = _library()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    url = storage if storage is None or '://' in storage else f'sqlite:///{storage}'
    with _failures(storage, name), warnings.catch_warnings():
        warnings.simplefilter('ignore')  # of what Optuna calls experimental
        study: Study = optuna.create_study(storage=url, study_name=name, load_if_exists=True)
        # a study that goes on must not draw again what it drew at first
        drawn = seed + len(study.get_trials(deepcopy=False))
        study.sampler = optuna.samplers.TPESampler(
            seed=drawn, multivariate=True, constant_liar=True
        )
    return study


def _library() -> Any:
    try:
        import optuna
    except ImportError:
        raise ClothPredictError(
            'this method needs the package optuna: pip install optuna'
        ) from None
    return optuna


@contextmanager
def _failures(storage: str | None, name: str) -> Iterator[None]:
    """Turn what a storage may complain of into one line."""
    from optuna.exceptions import OptunaError
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (OptunaError, SQLAlchemyError, ImportError, RuntimeError) as error:
        why = re.split(r'\[SQL|\(Background', str(error))[0].rstrip()
        raise ClothPredictError(f'study {name} in {storage}: {why}') from None


def _require_same(there: Mapping[str, Any], here: Mapping[str, str], study: str) -> None:
    """Raise ClothPredictError where a study is of something else than what is searched here."""
    for fact in dict.fromkeys([*here, *there]):
        if there.get(fact) != here.get(fact):
            raise ClothPredictError(
                f'study {study} is of something else: {fact} is {there.get(fact)} there, and '
                f'{here.get(fact)} here; choose another --study'
            )
