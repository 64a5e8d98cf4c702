"""Recordings made worse on purpose: how much is hidden, and what stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cloth_predict.config import build
from cloth_predict.evaluation.cases import Case, labelled_case
from cloth_predict.evaluation.degrade import Degradation, degraded, drops, long_gaps, swapped
from cloth_predict.types import MarkerSequence

CONFIG = build({'model': {'rows': 2, 'cols': 3}}, 'test')
FRAMES = 400  # 4 s at 100 Hz


def still(frames: int = FRAMES) -> MarkerSequence:
    """Six markers that can be told apart by where they are."""
    positions = np.tile(np.arange(18.0).reshape(6, 3), (frames, 1, 1))
    stamps = np.arange(frames) * 10_000_000
    return MarkerSequence(stamps, tuple('abcdef'), positions, np.ones((frames, 6), bool))


@pytest.fixture
def case() -> Case:
    return labelled_case(still(), CONFIG, 'test')


@pytest.mark.parametrize('share', [0.1, 0.5])
@pytest.mark.parametrize('length', [1, 10])
def test_share_and_bursts_of_drops(share: float, length: int) -> None:
    shape = (20_000, 20)
    lost = drops(shape, share, length, np.random.default_rng(1))
    # bursts, of which there are `count`, are independent; four deviations of their number
    count = lost.size * share / length
    assert lost.mean() == pytest.approx(share, rel=4 * np.sqrt((1 - share) / count) + 1e-3)
    edges = np.diff(lost.astype(int), axis=0, prepend=0, append=0)
    for marker in range(shape[1]):
        begin, end = (np.flatnonzero(edges[:, marker] == side) for side in (1, -1))
        runs = (end - begin)[:-1]  # the last may go on beyond the end
        assert (runs % length == 0).all()
    begins = share / (share + length * (1 - share))
    follows = np.mean((end - begin)[:-1] > length)  # another burst at once
    assert follows == pytest.approx(begins, abs=4 * np.sqrt(begins / len(begin)))


def test_no_and_all_drops() -> None:
    rng = np.random.default_rng(0)
    assert not drops((50, 3), 0.0, 1, rng).any()
    assert drops((50, 3), 1.0, 7, rng).all()


def test_long_gaps_and_as_long_pauses() -> None:
    lost = long_gaps((100, 6), 2, 10, np.random.default_rng(1))
    hidden = lost.sum(axis=1).reshape(10, 10)
    assert (hidden[::2] == 2).all()
    assert (hidden[1::2] == 0).all()
    gaps = lost.reshape(10, 10, 6)[::2]
    assert (gaps == gaps[:, :1]).all()  # the same markers throughout
    assert len({tuple(gap[0]) for gap in gaps}) > 1
    assert long_gaps((100, 6), 9, 10, np.random.default_rng(1))[:10].all()
    assert not long_gaps((100, 6), 0, 10, np.random.default_rng(1)).any()


def test_swaps_exchange_two() -> None:
    before = still(2000)
    after = swapped(before, 0.2, np.random.default_rng(3))
    moved = (after.positions != before.positions).any(axis=2).sum(axis=1)
    assert set(moved.tolist()) == {0, 2}
    assert (moved[:100] == 0).all()
    # four deviations of 1900 frames
    assert (moved[100:] == 2).mean() == pytest.approx(0.2, abs=4 * np.sqrt(0.2 * 0.8 / 1900))
    np.testing.assert_array_equal(np.sort(after.positions, axis=1), before.positions)


def test_the_reference_and_the_first_second_stay(case: Case) -> None:
    how = Degradation(drop=0.5, gone=2, gone_for=0.2, swap=0.5, seed=1)
    found = degraded(case, how)
    assert found.reference is case.reference
    np.testing.assert_array_equal(found.markers.positions[:100], case.markers.positions[:100])
    assert found.markers.visible[:100].all()
    assert 0.3 < found.markers.visible[100:].mean() < 0.5
    assert np.isnan(found.markers.positions[~found.markers.visible]).all()
    again, other = degraded(case, how), degraded(case, replace(how, seed=2))
    np.testing.assert_array_equal(again.markers.positions, found.markers.positions)
    assert (other.markers.visible != found.markers.visible).any()


def test_nothing_is_done_by_default(case: Case) -> None:
    found = degraded(case, Degradation())
    assert found.markers is case.markers
    assert found.labelled.all()


def test_labels_taken_away(case: Case) -> None:
    found = degraded(case, Degradation(drop=0.3, unlabelled=True))
    orders = set()
    for k in range(FRAMES):
        positions, visible, points = found.frame(k, associates=True)
        assert not visible.any()
        assert np.isnan(positions).all()
        kept, seen, none = found.frame(k, associates=False)
        assert len(none) == 0
        assert sorted(points.tolist()) == kept[seen].tolist()
        orders.add(tuple((points[:, 0] / 3).tolist()))
    assert len(orders) > 100


def test_points_without_labels_are_made_worse_too(case: Case) -> None:
    points = tuple(frame + 0.0 for frame in case.markers.positions)
    bare = replace(case, labelled=np.zeros((FRAMES, 6), bool), points=points)
    found = degraded(bare, Degradation(gone=2, gone_for=0.5))
    assert {len(frame) for frame in found.points} == {4, 6}
    assert degraded(bare, Degradation()).points is points
