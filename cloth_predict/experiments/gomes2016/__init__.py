"""Every figure with a number in the thesis: what it says, its recipe here, ours, and why.

Gomes, A. (2016), Time-varying surface prediction.
"""

from __future__ import annotations

from cloth_predict.experiments.gomes2016 import (
    between,
    compressed,
    dropped,
    grids,
    integration,
    simulated,
    stiff,
    towel,
)
from cloth_predict.experiments.rows import Experiment

EXPERIMENTS: tuple[Experiment, ...] = (
    *integration.EXPERIMENTS,
    *compressed.EXPERIMENTS,
    *simulated.EXPERIMENTS,
    *grids.EXPERIMENTS,
    *towel.EXPERIMENTS,
    *stiff.EXPERIMENTS,
    *dropped.EXPERIMENTS,
    *between.EXPERIMENTS,
)
"""A new experiment is one entry; the rows come in this order."""
