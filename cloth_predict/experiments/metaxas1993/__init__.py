"""The experiments of the paper on deformable superquadrics: what it says, its recipe here, ours.

Metaxas, D. and Terzopoulos, D. (1993), Shape and nonrigid motion estimation through physics-based
synthesis.
"""

from cloth_predict.experiments.metaxas1993 import arms, insect, joints, perturbed, tables, tracking
from cloth_predict.experiments.rows import Experiment

EXPERIMENTS: tuple[Experiment, ...] = (
    *tracking.EXPERIMENTS,
    *tables.EXPERIMENTS,
    *perturbed.EXPERIMENTS,
    *insect.EXPERIMENTS,
    *arms.EXPERIMENTS,
    *joints.EXPERIMENTS,
)
"""A new experiment is one entry; the rows come in this order."""
