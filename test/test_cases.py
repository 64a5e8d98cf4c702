"""What the methods are given of a recording: nodes with labels, and points without."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_predict.config import Config, build
from cloth_predict.errors import FormatError
from cloth_predict.evaluation.cases import case_of, points_of, split
from cloth_predict.formats.bag import Recording, Truth
from cloth_predict.types import FloatArray, MarkerSequence

FRAMES = 40
MODEL = {'rows': 2, 'cols': 3, 'width': 0.2, 'height': 0.1}


def config(**values: object) -> Config:
    return build({'model': MODEL, 'anchors': {'nodes': [0, 1, 2]}, **values}, 'test')


def cloth() -> FloatArray:
    """Positions [m], shape (frames, 6, 3), whose lower row swings."""
    positions = np.zeros((FRAMES, 2, 3, 3))
    positions[..., 0] = [0.0, 0.1, 0.2]
    angle = 0.3 * np.sin(2 * np.pi * np.arange(FRAMES) / 100)[:, None]
    positions[:, 1, :, 1], positions[:, 1, :, 2] = -0.1 * np.cos(angle), 0.1 * np.sin(angle)
    return positions.reshape(FRAMES, 6, 3)


def sequence(positions: FloatArray, labels: tuple[str, ...]) -> MarkerSequence:
    visible = np.isfinite(positions).all(axis=2)
    return MarkerSequence(np.arange(FRAMES) * 10_000_000, labels, positions, visible)


def test_identified_markers_are_nodes_and_the_others_points() -> None:
    rng = np.random.default_rng(1)
    others = rng.normal(size=(FRAMES, 2, 3))
    others[5:20, 1] = np.nan
    labels = ('Unlabeled 7', *'abcdef', 'unlabelled 9')
    mixed = np.concatenate([others[:, :1], cloth(), others[:, 1:]], axis=1)
    nodes, strangers = split(sequence(mixed, labels), config(), 'here')
    assert nodes.labels == tuple('abcdef')
    assert strangers.labels == ('Unlabeled 7', 'unlabelled 9')
    case = case_of(Recording(sequence(mixed, labels)), config(), 'here')
    assert [len(points) for points in case.points] == [2] * 5 + [1] * 15 + [2] * 20
    positions, visible, points = case.frame(30, associates=True)
    np.testing.assert_array_equal(positions, cloth()[30])
    assert visible.all()
    np.testing.assert_array_equal(points, others[30])
    assert len(case.frame(30, associates=False)[2]) == 0


def test_a_chosen_marker_is_a_node_whatever_its_name() -> None:
    labels = ('Unlabeled 7', *'bcdef', 'hand', 'Unlabeled 8')
    wide = np.concatenate([cloth(), cloth()[:, :2] + 1.0], axis=1)
    chosen = config(labels=['Unlabeled 7', *'bcdef'])
    nodes, strangers = split(sequence(wide, labels), chosen, 'here')
    assert nodes.labels == chosen.labels
    assert strangers.labels == ('Unlabeled 8',)  # a hand that has a name is no point


def test_sizes_that_do_not_fit() -> None:
    five = cloth()[:, :5]
    with pytest.raises(FormatError, match=r'here: 5 markers \(a, b, c, d, \.\.\. e\) do not fit'):
        split(sequence(five, tuple('abcde')), config(), 'here')
    named = MarkerSequence(*vars(sequence(cloth(), tuple('uvwxyz'))).values())
    wrong = MarkerSequence(named.stamps, named.labels, named.positions, named.visible, 'map')
    with pytest.raises(FormatError, match="frame 'map'"):
        split(wrong, config(), 'here')


def test_markers_that_nobody_identified_are_found_by_the_tracker() -> None:
    positions = cloth()
    positions[10:14, 4] = np.nan
    order = np.random.default_rng(2).permutation(6)
    names = tuple(f'Unlabeled {i}' for i in range(6))
    recording = Recording(sequence(positions[:, order], names))
    case = case_of(recording, config(), 'here')
    assert not case.labelled.any()
    assert sorted(case.points[3].tolist()) == sorted(positions[3].tolist())
    seen, visible, points = case.frame(20, associates=True)
    assert not visible.any()
    assert np.isnan(seen).all()
    assert len(points) == 6
    # the cloth may be taken for its mirror image, whose columns run the other way
    mirrored = positions.reshape(FRAMES, 2, 3, 3)[:, :, ::-1].reshape(FRAMES, 6, 3)
    found = case.markers.positions
    expected = positions if np.allclose(found[20], positions[20]) else mirrored
    np.testing.assert_array_equal(found, expected)
    assert case.reference.markers is case.markers
    assert not case.reference.true


def test_of_points_that_are_no_surface_nothing_is_found() -> None:
    names = tuple(f'Unlabeled {i}' for i in range(6))
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(FRAMES, 2, 3))
    recording = Recording(sequence(noise, names[:2]))
    with pytest.raises(FormatError) as caught:
        case_of(recording, config(), 'here')
    assert str(caught.value) == (
        'here: no marker has a label, and the tracker finds no surface in the points (at most 2 '
        'in a frame for 6 nodes)'
    )


def test_truth_of_markers_without_labels_is_in_the_order_of_the_nodes() -> None:
    positions, ids = cloth(), np.arange(6).reshape(2, 3)
    surface = positions.reshape(FRAMES, 2, 3, 3) + 0.001
    names = tuple(f'Unlabeled {i}' for i in range(6))
    truth = Truth(np.arange(FRAMES) * 10_000_000, surface, ids)
    order = np.random.default_rng(4).permutation(6)
    case = case_of(Recording(sequence(positions[:, order], names), truth), config(), 'here')
    assert case.reference.true
    np.testing.assert_array_equal(case.reference.markers.positions, positions + 0.001)
    few = Truth(truth.stamps, surface, np.where(ids == 5, 7, ids))
    with pytest.raises(FormatError, match='here: the truth has no marker 5'):
        case_of(Recording(sequence(positions, names), few), config(), 'here')


def test_points_are_what_is_visible() -> None:
    positions = cloth()
    positions[3, 1] = np.nan
    points = points_of(sequence(positions, tuple('abcdef')))
    assert [len(frame) for frame in points] == [6] * 3 + [5] + [6] * 36
    np.testing.assert_array_equal(points[3], positions[3][[0, 2, 3, 4, 5]])
