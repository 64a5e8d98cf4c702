"""A breathing chest, which is no grid: the shipped parameters on what they were not found on."""

from pathlib import Path

import numpy as np
import pytest

from cloth_predict.config import load
from cloth_predict.evaluation.cases import labelled_case
from cloth_predict.evaluation.compare import compare
from cloth_predict.evaluation.degrade import Degradation, degraded
from cloth_predict.types import MarkerSequence

ROOT = Path(__file__).parents[1]
FOUND_ON = 1154
"""Frames: the first half of the recording, on which the parameters were found."""


@pytest.mark.parametrize('name', ['chest', 'chest_body'])
@pytest.mark.parametrize(
    ('how', 'most'),
    # of the error of the better kinematic filter, at the noise that serves it best on these very
    # frames; the whole second half has 0.93 and 0.72
    [(Degradation(), 1.0), (Degradation(drop=0.3, burst=0.3), 0.85)],
    ids=['all markers', 'bursts'],
)
def test_neighbours_tell_of_hidden_markers(real, name, how, most):
    positions = np.load(real('chest/chest.npz'))['X'][FOUND_ON : FOUND_ON + 450]
    stamps = np.arange(len(positions)) * 10**7  # 100 Hz
    labels = tuple(f'm{k}' for k in range(30))
    config = load(ROOT / 'config' / f'{name}.yaml')
    seen = np.ones(positions.shape[:2], bool)
    markers = MarkerSequence(stamps, labels, positions, seen, config.frame)
    case = degraded(labelled_case(markers, config, 'chest', None), how)
    (found,) = compare(case, config, [config.horizon], search=True)
    assert found.ratios[config.filter.kind].ratio < most
    assert 0.85 < found.details[config.filter.kind].coverage[1] < 0.99  # of 2 sigma
