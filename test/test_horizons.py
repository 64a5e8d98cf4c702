"""How far ahead is predicted, and on which topic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cloth_predict.config import Config, ProjectorConfig, build
from cloth_predict.errors import ConfigError
from cloth_predict.tracking.horizons import FEWEST, FRAMES, PipelineDelay, topics

AUTO = Config(horizon=0.1, horizon_mode='auto', projector=ProjectorConfig(delay=0.02))


def measured(config: Config, ages: list[float], processing: float = 0.004) -> PipelineDelay:
    delay = PipelineDelay(config)
    for age in ages:
        delay.add(age, processing)
    return delay


@pytest.mark.parametrize(
    ('horizons', 'expected'),
    [
        ((), {}),
        ((0.05, 0.2), {'cloth/prediction_50ms': 0.05, 'cloth/prediction_200ms': 0.2}),
        ((0.1, 0.0125), {'cloth/prediction_12_5ms': 0.0125}),
        ((0.001, 10.0), {'cloth/prediction_1ms': 0.001, 'cloth/prediction_10000ms': 10.0}),
    ],
)
def test_topics(horizons: tuple[float, ...], expected: dict[str, float]) -> None:
    found = topics(Config(horizon=0.1, horizons=horizons))
    assert found == {'cloth/prediction': 0.1, **expected}
    assert next(iter(found)) == 'cloth/prediction'


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'horizons': [0.05, 0.05]}, 'horizons: a horizon is listed twice'),
        ({'horizons': [0.0]}, 'horizons: 0.0 is out of range'),
        ({'horizon_mode': 'some'}, "horizon_mode: 'some' is not one of fixed, auto"),
        ({'projector': {'delay': -0.1}}, 'projector.delay: -0.1 is out of range'),
    ],
)
def test_what_cannot_be_is_refused(values: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        build(values, 'test')


def test_the_horizon_is_the_median_delay_and_that_of_the_projector() -> None:
    ages = (0.010 + 0.001 * np.arange(FEWEST)).tolist()
    assert measured(AUTO, ages[:-1]).horizon == 0.1  # not measured yet
    assert measured(AUTO, ages).horizon == pytest.approx(np.median(ages) + 0.004 + 0.02)
    assert measured(replace(AUTO, horizon_mode='fixed'), ages).horizon == 0.1


def test_a_few_slow_frames_change_nothing() -> None:
    ages = [0.9] * 4 + [0.005] * 6
    assert measured(AUTO, ages).median == pytest.approx(0.009)


def test_the_window_forgets() -> None:
    assert measured(AUTO, [0.5] * 1000 + [0.01] * FRAMES).median == pytest.approx(0.014)


def test_a_clock_that_stands_still_between_frames_shows_no_age() -> None:
    ages = [0.0, -0.01, 0.0, -0.01, -0.01] * 4  # the clock of a replay at 100 Hz, a frame behind
    found = measured(AUTO, ages)
    assert found.horizon == pytest.approx(0.004 + 0.02)
    assert found.warning == ''


@pytest.mark.parametrize('age', [1.7e9, -3.0, 1.5])
def test_clocks_with_nothing_in_common_leave_the_horizon_and_are_told(age: float) -> None:
    found = measured(AUTO, [age] * FEWEST)
    assert (found.median, found.horizon) == (None, 0.1)
    assert f'frames are {age:.3g} s old' in found.warning
    assert 'stays at 100 ms' in found.warning
    assert measured(AUTO, [age] * (FEWEST - 1)).warning == ''
    assert measured(replace(AUTO, horizon_mode='fixed'), [age] * FEWEST).warning == ''


def test_a_clock_that_is_set_later_is_used_from_then_on() -> None:
    found = measured(AUTO, [1.7e9] * 50 + [0.03] * FEWEST)
    assert (found.horizon, found.warning) == (pytest.approx(0.054), '')


def test_the_horizon_keeps_to_the_limits_of_the_parameter() -> None:
    assert measured(AUTO, [0.5] * FEWEST, processing=60.0).horizon == 10.0
