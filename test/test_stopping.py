"""Where and when motions end: a bar against closed forms and draws; bad frames."""

from dataclasses import replace

import numpy as np
import pytest

from cloth_predict.config.ruler import RulerConfig
from cloth_predict.errors import ConfigError, FrameError, UncertainError
from cloth_predict.integrators.sliding import Sliding
from cloth_predict.simulation.ruler import ANNEX_A, measured, slide
from cloth_predict.tracking.ruler import RulerTracker
from cloth_predict.tracking.ruler_assembly import first_belief, joint_model
from cloth_predict.tracking.stopping import Stop, at_rest
from cloth_predict.types import Gaussian

CONFIG = RulerConfig(g=10.0)
MS = 10**6
FRAME = 20 * MS


def shot(version=4, seed=0, frames=None):
    """States and measurements at 50 Hz until it rests, and when and where that is."""
    exact = slide(ANNEX_A[version], tolerance=1e-9)
    count = int(exact.duration * 50) + 4 if frames is None else frames
    states = exact.at(np.arange(count) / 50)
    z = measured(states, 1.0, np.random.default_rng(seed))
    return states, z, exact.duration, exact.at(np.array([exact.duration]))[0, :3]


def followed(z, config=CONFIG, **changes):
    """Tracker after the frames, and what became of each; changes: other measurements by frame."""
    tracker, outcomes = RulerTracker(config), []
    for frame, seen in enumerate(z):
        seen = changes.get(f'at_{frame}', seen)
        outcomes.append(tracker.step(frame * FRAME, seen).outcome)
    return tracker, outcomes


def believing(own, sigma):
    """Tracker that has seen one frame of a bar in this state, (6,), known to sigmas, (10,)."""
    model = joint_model(CONFIG)
    x = model.joint(np.array(own), np.array([1.0, 0.2, 0.2, 0.3]))
    tracker = RulerTracker(CONFIG, Gaussian(x, np.diag(np.square(sigma))))
    tracker.step(0, x[:4])
    return tracker


# --- the end of a motion


def test_points_come_to_rest_one_by_one():
    speeds = np.array([[0.0], [1.0], [2.5]])
    times, ends = at_rest(
        speeds, lambda x: np.maximum(x - 0.5, 0.0), lambda x: x[:, 0] == 0.0, 0.1, 1.0
    )
    np.testing.assert_allclose(times, [0.0, 0.2, 0.5], atol=1e-15)  # rounding
    np.testing.assert_array_equal(ends, np.zeros((3, 1)))


def test_an_end_that_is_not_in_sight_is_none():
    with pytest.raises(UncertainError, match=r'^no end of the motion within 2 s$'):
        at_rest(np.ones((1, 1)), lambda x: x, lambda x: x[:, 0] == 0.0, 0.1, 2.0)


def test_a_bar_that_translates_stops_where_and_when_the_closed_form_says():
    sigma = np.array([1e-3, 1e-3, 1e-3, 1e-3, 0.02, 1e-6, 1e-6, 1e-6, 1e-6, 0.003])
    tracker = believing([0.5, 0.0, 0.0, 2.0, 0.0, 0.0], sigma)
    stop, seen = tracker.stop(), 1e-3 / 2**0.5  # the place, after one frame
    assert stop.mean == pytest.approx([0.5 + 4.0 / 6.0, 0.0, 0.0], abs=1e-3)  # of second order
    # x = v^2 / (2 mu g): dx = v / (mu g) dv - x / mu dmu, and t = v / (mu g) likewise
    place = np.linalg.norm([2 / 3 * 0.02, 2 / 3 * 0.003 / 0.3, seen])
    assert np.sqrt(stop.cov[0, 0]) == pytest.approx(place, rel=0.02)  # of second order
    assert stop.time == pytest.approx(2 / 3, abs=0.01)  # a step
    assert stop.time_sigma == pytest.approx(np.hypot(0.02 / 3.0, 2 / 3 * 0.01), rel=0.2)  # steps


def test_a_stop_is_that_of_draws_from_the_belief():
    _, z, _, _ = shot(4)
    tracker, _ = followed(z[:80])
    stop, rng = tracker.stop(), np.random.default_rng(1)
    draws = rng.multivariate_normal(tracker.belief.mean, tracker.belief.cov, 400)
    bars, x = tracker.model.model_at(draws), draws[:, tracker.model.own]
    method = Sliding(CONFIG.step)
    while not bars.resting(x).all():
        x = method.step(bars, x, np.zeros(0), 0.02)
    spread = x[:, :3].std(axis=0)
    np.testing.assert_allclose(stop.mean, x[:, :3].mean(axis=0), atol=4 * spread.max() / 20)
    np.testing.assert_allclose(np.sqrt(np.diag(stop.cov)), spread, rtol=0.25)  # 400 draws: 4 %


def test_the_stop_is_told_once_it_is_certain_and_is_right_then():
    _, z, duration, where = shot(4)
    tracker, told = RulerTracker(CONFIG), None
    for frame, seen in enumerate(z):
        tracker.step(frame * FRAME, seen)
        if frame >= 50 and frame % 10 == 0 and told is None:
            stop = tracker.stop()
            told = (frame / 50, stop) if tracker.certain(stop) else None
    when, stop = told
    assert when < 0.75 * duration
    error = stop.mean - where
    assert np.hypot(*error[:2]) < 3 * stop.place_sigma
    assert abs(error[2]) < 3 * stop.angle_sigma
    assert when + stop.time == pytest.approx(duration, abs=0.02)  # two steps
    assert tracker.resting
    assert tracker.stop().time < 0.02
    assert Stop(0.0, 0.0, error, np.eye(3)).certain(0.01, 0.02) is False


@pytest.mark.parametrize('version', [3, 4, 5])
def test_friction_is_found_from_the_first_guess_of_the_paper(version):
    _, z, _, _ = shot(version, seed=1, frames=101)
    tracker, _ = followed(z)
    truth = ANNEX_A[version].ruler
    assert tracker.ruler.mu == pytest.approx(truth.mu, rel=0.02)
    sigma = np.sqrt(tracker.belief.cov.diagonal())
    assert abs(tracker.ruler.L1 - truth.L1) < 4 * sigma[7]
    assert abs(tracker.ruler.L2 - truth.L2) < 4 * sigma[8]
    assert tracker.health().level == 'OK'


def test_a_prediction_between_frames_follows_the_bar():
    states, z, _, _ = shot(3, frames=90)
    tracker, _ = followed(z[:80])
    ahead = tracker.predict(0.18)
    error = ahead.mean[tracker.model.own] - states[88]
    sigma = np.sqrt(ahead.cov.diagonal()[tracker.model.own])
    assert (np.abs(error) < 4 * sigma).all()
    assert np.abs(error[:2]).max() < 0.005


# --- frames that are not as they should be


def test_before_the_first_bar_there_is_nothing_to_say():
    tracker, outcomes = followed([None, None])
    assert outcomes == ['hidden', 'hidden']
    assert not tracker.started
    assert tracker.health().text == 'no bar yet: no frame has shown one'
    with pytest.raises(FrameError, match=r'^no bar yet'):
        tracker.stop()


def test_a_bar_that_leaves_is_carried_on_and_comes_back():
    states, z, _, _ = shot(4)
    frames = [None if 60 <= k < 75 else seen for k, seen in enumerate(z)]
    tracker, outcomes = followed(frames[:75])
    assert outcomes[60:] == ['hidden'] * 15
    assert tracker.health().text.startswith('no believable bar in the last 15 frames; L 1')
    assert np.abs(tracker.state[:2] - states[74, :2]).max() < 0.02
    _, outcomes = followed(frames)
    assert set(outcomes[75:]) == {'updated'}


def test_a_frozen_picture_is_not_believed_and_the_bar_is_kept():
    _, z, _, _ = shot(4)
    frames = [z[39] if 40 <= k < 44 else seen for k, seen in enumerate(z)]
    tracker, outcomes = followed(frames)
    assert outcomes[41:44] == ['rejected'] * 3
    assert set(outcomes[44:]) == {'updated'}
    assert tracker.ruler.mu == pytest.approx(0.3, rel=0.02)


def test_one_wrong_bar_is_refused_and_one_that_stays_is_taken():
    _, z, _, _ = shot(4)
    tracker, outcomes = followed(z[:60], at_50=z[50] + [1.0, 0.0, 0.0, 0.0])
    assert outcomes[50:52] == ['rejected', 'updated']
    elsewhere = z.copy()
    elsewhere[50:, 0] += 1.0
    tracker, outcomes = followed(elsewhere[:60])
    assert outcomes[50:] == ['rejected'] * 5 + ['restarted'] + ['updated'] * 4
    assert tracker.state[0] == pytest.approx(elsewhere[59][0], abs=0.005)


def test_a_bar_at_rest_tells_no_friction():
    rng, still = np.random.default_rng(2), np.zeros((40, 6))
    tracker, _ = followed(measured(still, 1.0, rng))
    health = tracker.health()
    assert health.level == 'WARN'
    assert health.text == 'the bar lies still and has not slid: no friction can be told'
    stop = tracker.stop()
    assert stop.time < 0.02
    assert np.abs(stop.mean).max() < 5 * CONFIG.angle_noise / 40**0.5


def test_late_frames_change_nothing_and_a_gap_starts_anew():
    _, z, _, _ = shot(4)
    tracker, _ = followed(z[:20])
    before = tracker.belief
    assert tracker.step(5 * FRAME, z[5]).outcome == 'late'
    assert tracker.belief is before
    assert tracker.step(19 * FRAME + 1001 * MS, z[0]).outcome == 'restarted'
    assert tracker.step(0, z[0]).outcome == 'restarted'  # a recording that plays again
    assert tracker.step(5000 * MS, None).outcome == 'hidden'
    assert not tracker.started


@pytest.mark.parametrize('bad', [np.array([1.0, 2.0, np.nan, 0.0]), np.zeros(3)])
def test_a_measurement_that_is_none_is_named_and_changes_nothing(bad):
    tracker, _ = followed(shot(4, frames=3)[1])
    before = tracker.belief
    with pytest.raises(FrameError, match=r'^a bar is centre, length and angle, four finite'):
        tracker.step(10 * FRAME, bad)
    assert tracker.belief is before


def test_a_first_guess_out_of_bounds_is_named():
    with pytest.raises(ConfigError, match=r'^L1: 0\.25 is not within its bounds 0\.3 to 0\.5$'):
        RulerTracker(replace(CONFIG, contact_low=0.3))


def test_half_turns_of_a_bar_without_ends_are_no_jumps():
    _, z, _, _ = shot(3, frames=60)
    wrapped = z.copy()
    wrapped[:, 3] = np.mod(z[:, 3], np.pi)
    plain, _ = followed(z)
    tracker, _ = followed(wrapped)
    apart = tracker.state - plain.state
    apart[2] -= np.pi * np.round(apart[2] / np.pi)
    np.testing.assert_allclose(apart, np.zeros(6), atol=1e-9)  # rounding, along the run
    _, outcomes = followed(wrapped, replace(CONFIG, ends=True))
    assert 'rejected' in outcomes  # where the ends are told apart a half turn is a fault


def test_the_first_frames_are_filtered_again_from_what_they_told():
    _, z, _, _ = shot(3, frames=32)
    tracker, _ = followed(z[:31])
    assert tracker.counts['again'] == 1
    once, _ = followed(z[:31], replace(CONFIG, again=0.0))
    model = joint_model(CONFIG)
    prior = first_belief(CONFIG, model, z[0])
    guess = model.joint(prior.mean[model.own], once.belief.mean[model.at])
    other = RulerTracker(replace(CONFIG, again=0.0), Gaussian(guess, prior.cov))
    for frame, seen in enumerate(z[:31]):
        other.step(frame * FRAME, seen)
    np.testing.assert_array_equal(tracker.belief.mean, other.belief.mean)
    np.testing.assert_array_equal(tracker.belief.cov, other.belief.cov)
