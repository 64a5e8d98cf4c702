"""What happens where a model or a filter fails with the values that a search tries."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from cloth_predict.errors import ClothPredictError

R = TypeVar('R')


def or_none(compute: Callable[[], R]) -> R | None:
    """Return what is computed, or None where numbers run away on the way to it.

    A ClothPredictError passes: it is of the recording or the configuration, and not of the values.
    """
    try:
        with np.errstate(all='ignore'):
            return compute()
    except ClothPredictError:
        raise
    except (FloatingPointError, np.linalg.LinAlgError, ValueError):  # SciPy's for NaN
        return None
