"""The optimisers by name."""

from __future__ import annotations

from cloth_predict.identification.optimisers.annealing import anneal
from cloth_predict.identification.optimisers.cma_es import evolve
from cloth_predict.identification.optimisers.gradient import descend
from cloth_predict.identification.optimisers.result import Optimiser

OPTIMISERS: dict[str, Optimiser] = {'annealing': anneal, 'cma': evolve, 'gradient': descend}
BUDGETS = {'annealing': 5000, 'cma': 500, 'gradient': 1000}
"""Evaluations of each, where none are given."""
