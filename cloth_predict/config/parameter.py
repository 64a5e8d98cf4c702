"""How a parameter is declared: default, meaning, unit, and the values that it may take."""

from __future__ import annotations

from dataclasses import field
from typing import Any


def param(
    default: Any,
    doc: str,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] = (),
    length: int | None = None,
) -> Any:
    """Declare a parameter: default, meaning, unit, and the values that it may take."""
    limits = {
        'doc': doc,
        'unit': unit,
        'low': low,
        'high': high,
        'above': above,
        'choices': choices,
        'length': length,
    }
    return field(default=default, metadata=limits)
