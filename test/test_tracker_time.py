"""Frames that come late, twice or out of order: the same surface as if they had not."""

from dataclasses import replace

import numpy as np
import pytest
from test_tracker import EVERY, MS, content, moving, settings

from cloth_predict.filters.family import FILTERS
from cloth_predict.tracker import Tracker

REACH = 50
"""Default of `filter.rewind` [ms]."""


def recording(config, frames=60, seed=3):
    """Stamps [ns], markers, which are visible, and points without a label, of each frame."""
    rng, stamps = np.random.default_rng(seed), (np.arange(frames) * 10 * MS).tolist()
    positions, visible = moving(config, stamps), rng.random((frames, 9)) < 0.8
    visible[0] = True
    hidden = ~visible & (rng.random((frames, 9)) < 0.5)
    points = [
        np.vstack([positions[k][hidden[k]], rng.normal(0, 1, (1, 3))]) for k in range(frames)
    ]
    return list(zip(stamps, positions, visible, points, strict=True))


def run(config, frames):
    tracker = Tracker(config)
    steps = [tracker.step(*frame) for frame in frames]
    return tracker, steps


def changing_hands():
    """Settings with driven nodes that move, so that all that is carried along matters."""
    return settings(anchors={'motion': 'constant_velocity', 'process_noise': 2.0})


@pytest.mark.parametrize('back', [1, 2, 3, 4])
@pytest.mark.parametrize('motion', ['fixed', 'constant_velocity'])
def test_a_late_frame_is_put_in_its_place(back, motion):
    noise = 0.0 if motion == 'fixed' else 2.0
    config = settings(anchors={'motion': motion, 'process_noise': noise})
    frames = recording(config)
    order = list(range(60))
    order.insert(40 + back, order.pop(40))
    late, steps = run(config, [frames[k] for k in order])
    ordered, expected = run(config, frames)
    assert content(late.estimate()) == content(ordered.estimate())
    assert content(late.predict(0.1)) == content(ordered.predict(0.1))
    assert [step.outcome for step in steps].index('rewound') == 40 + back
    assert late.counts == {'started': 1, 'updated': 58, 'rewound': 1}
    assert late.markers == ordered.markers
    # what is said of the late frame is what would have been said in its place
    found = steps[40 + back]
    assert found.taken
    np.testing.assert_array_equal(found.positions, expected[40].positions)
    np.testing.assert_array_equal(found.innovation.residual, expected[40].innovation.residual)


@pytest.mark.parametrize('kind', FILTERS)
def test_every_filter_can_be_gone_back_in(kind):
    config = settings(filter={'kind': kind})
    config = replace(config, limits=replace(config.limits, sigma_error=1e9))  # gomes2016 is lost
    frames = recording(config, 16)
    late, _ = run(config, [frames[k] for k in [*range(10), 12, 13, 10, 14, 11, 15]])
    ordered, _ = run(config, frames)
    assert (late.counts['updated'], late.counts['rewound']) == (13, 2)
    assert late.counts['repaired'] == ordered.counts['repaired']  # gomes2016 needs it
    assert content(late.estimate()) == content(ordered.estimate())
    assert content(late.predict(0.05)) == content(ordered.predict(0.05))


def test_frames_that_overtake_each_other_all_the_time():
    config = changing_hands()
    frames, rng = recording(config), np.random.default_rng(1)
    arrival = np.arange(60) * 10 + rng.uniform(0, 40, 60)
    arrival[0] = -1.0
    mixed, _ = run(config, [frames[k] for k in np.argsort(arrival)])
    ordered, _ = run(config, frames)
    assert mixed.counts['rewound'] > 15
    assert mixed.counts['late'] == 0
    assert content(mixed.estimate()) == content(ordered.estimate())
    assert mixed.markers == ordered.markers


@pytest.mark.parametrize('back', [0, 1, 4, 5])
def test_a_frame_is_never_taken_twice(back):
    config = changing_hands()
    frames = recording(config)
    tracker, _ = run(config, frames[:50])
    before, counts = content(tracker.estimate()), tracker.markers.copy()
    stamp, positions, _, points = frames[49 - back]
    step = tracker.step(stamp, positions + 1e-3, EVERY, points)
    assert (step.outcome, step.taken, step.visible.any()) == ('duplicate', False, False)
    assert np.isnan(step.positions).all()
    assert content(tracker.estimate()) == before
    assert tracker.markers == counts
    assert tracker.counts == {'started': 1, 'updated': 49, 'duplicate': 1}


def test_a_late_frame_that_was_put_in_its_place_is_not_taken_again():
    config = changing_hands()
    frames = recording(config)
    tracker, _ = run(config, [*frames[:40], *frames[41:44]])
    outcomes = [tracker.step(*frames[40]).outcome for _ in range(2)]
    assert outcomes == ['rewound', 'duplicate']
    ordered, _ = run(config, frames[:44])
    assert content(tracker.estimate()) == content(ordered.estimate())


@pytest.mark.parametrize(('late', 'outcome'), [(REACH, 'rewound'), (REACH + 1, 'late')])
def test_how_late_a_frame_may_be(late, outcome):
    config = changing_hands()
    frames = recording(config)
    tracker, _ = run(config, frames[:50])
    at = frames[49][0] - late * MS + (5 * MS if outcome == 'rewound' else 0)
    assert tracker.step(at, *frames[30][1:]).outcome == outcome
    boundary = Tracker(config)
    for k in range(0, 50, 2):  # the last frames are 0, 20, 40 and 60 ms old
        boundary.step(*frames[k])
    at = frames[48][0] - late * MS
    assert boundary.step(at, *frames[43][1:]).outcome == outcome


def test_what_is_older_than_the_start_is_late():
    config = changing_hands()
    frames = recording(config)
    tracker, _ = run(config, frames[10:12])
    assert tracker.step(*frames[9]).outcome == 'late'
    again = frames[11][0] + 2000 * MS  # a gap: the surface starts anew
    assert tracker.step(again, *frames[12][1:]).outcome == 'restarted'
    assert tracker.step(again - 5 * MS, *frames[13][1:]).outcome == 'late'
    assert tracker.step(again, *frames[13][1:]).outcome == 'duplicate'


def test_only_a_few_frames_are_kept():
    config = changing_hands()
    tracker, _ = run(config, recording(config))
    assert len(tracker._memory._entries) == 1 + REACH // 10
    config = settings(filter={'rewind': 0.0})
    tracker, _ = run(config, recording(config))
    assert len(tracker._memory._entries) == 1


def test_the_caller_may_reuse_its_arrays():
    config = changing_hands()
    frames = recording(config)
    tracker, (positions, visible, points) = (
        Tracker(config),
        (frames[0][k].copy() for k in (1, 2, 3)),
    )
    for k in [*range(40), *range(41, 43), 40]:
        positions[:], visible[:] = frames[k][1:3]
        points = np.resize(points, frames[k][3].shape)
        points[:] = frames[k][3]
        tracker.step(frames[k][0], positions, visible, points)
        positions[:], visible[:], points[:] = 0.0, True, 0.0
    ordered, _ = run(config, frames[:43])
    assert content(tracker.estimate()) == content(ordered.estimate())
