"""Every number of the ruler's paper: what it says, its filter here, ours, and why.

Goeller, Dion, Soriano & Roux (2015), Real time dynamic system stochastic identification in video
capture for data compression, image interpolation, prediction, and augmented reality.
"""

from cloth_predict.experiments.goeller2015 import (
    friction,
    identified,
    robustness,
    stiffness,
    stops,
)
from cloth_predict.experiments.rows import Experiment

EXPERIMENTS: tuple[Experiment, ...] = (
    *identified.EXPERIMENTS,
    *stops.EXPERIMENTS,
    *friction.EXPERIMENTS,
    *stiffness.EXPERIMENTS,
    *robustness.EXPERIMENTS,
)
"""A new experiment is one entry; the rows come in this order."""
