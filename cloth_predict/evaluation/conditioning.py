"""How well conditioned the covariance of the state is over a recording (Gomes 2016, fig. 6.16)."""

from __future__ import annotations

from math import inf, nan

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import ClothPredictError
from cloth_predict.evaluation.cases import Case
from cloth_predict.evaluation.runs import Progress
from cloth_predict.tracker import Tracker
from cloth_predict.types import FloatArray, Gaussian


def condition_number(cov: FloatArray) -> float:
    """Return |λ max| / |λ min| of a covariance, shape (n, n) (Gomes 2016, eq. 6.20).

    The largest and smallest modulus are meant; infinite where one eigenvalue is 0, NaN where a
    number is not finite. Above 1e16 the smallest eigenvalue is rounding, so that only the order
    counts. No symmetry is taken for granted: the recursion of the thesis loses it.
    """
    if not np.isfinite(cov).all():
        return nan
    symmetric = np.array_equal(cov, cov.T)
    values = np.abs(np.linalg.eigvalsh(cov) if symmetric else np.linalg.eigvals(cov))
    return float(values.max() / values.min()) if values.min() > 0 else inf


def condition_numbers(
    case: Case, config: Config, progress: Progress = lambda frames: None
) -> FloatArray:
    """Condition number of P_k|k after each frame of a recording, shape (frames,).

    NaN where the surface has not started, or starts anew because the filter has failed. Raises
    ClothPredictError for a filter that keeps no such covariance.
    """
    tracker = Tracker(config)
    found = np.full(len(case.markers), nan)
    for k, stamp in enumerate(case.markers.stamps.tolist()):
        step = tracker.step(stamp, *case.frame(k, associates=True))
        if step.outcome in ('updated', 'rewound'):
            belief = tracker.belief
            if not isinstance(belief, Gaussian):
                raise ClothPredictError(f'filter.kind {config.filter.kind} keeps no full P')
            found[k] = condition_number(belief.cov)
        progress(1)
    return found
