"""The experiments on deformable superquadrics: their pieces, and that each table is there."""

import json

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from cloth_predict.cli import main
from cloth_predict.experiments.metaxas1993 import EXPERIMENTS, arms, insect, tables
from cloth_predict.experiments.metaxas1993.errors import Errors, least_position_error
from cloth_predict.experiments.metaxas1993.joined import JoinedFilter, closed
from cloth_predict.experiments.metaxas1993.judging import apart
from cloth_predict.experiments.metaxas1993.object import (
    INTERVAL,
    NODES,
    first_state,
    measured,
    model,
    moved,
    thinned,
)
from cloth_predict.experiments.metaxas1993.ours import Ours
from cloth_predict.experiments.metaxas1993.recipe import Recipe
from cloth_predict.models.constraints import Articulated
from cloth_predict.models.superquadric import GLOBAL


@pytest.fixture(scope='module')
def motion():
    return moved(tables.SEED)


def test_every_table_and_figure_has_a_row():
    names = [experiment.name for experiment in EXPERIMENTS]
    assert names == ['6', '7', 'I', 'II', 'III', 'IV', '8', '9', '10', '11', 'alpha']


def test_errors_of_a_shift_and_of_the_other_quaternion(motion):
    off = motion.q.copy()
    off[:, :3] += [3.0, 4.0, 0.0]
    off[:, 3:7] *= -1.0  # the same rotation
    found = Errors.of(motion.body, off, motion.q, motion.positions)
    # rounding
    np.testing.assert_allclose(found.means(), [5.0, 0.0, 0.0, 0.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(found.whole, 5.0 * np.sqrt(NODES), rtol=1e-12)


def test_data_are_as_dense_and_as_noisy_as_asked_for(motion):
    rng = np.random.default_rng(0)
    assert [len(thinned(rng, d)) for d in tables.DENSITIES.values()] == [123, 92, 62, 31]
    off = measured(rng, motion.positions, 5.0) - motion.positions
    assert off.var() == pytest.approx(5.0, rel=0.1)  # of 7380 draws
    np.testing.assert_array_equal(measured(rng, motion.positions, 0.0), motion.positions)


def test_the_bound_goes_with_the_root_of_little_noise(motion):
    body, seen = model(), np.arange(NODES)
    small, large = (least_position_error(body, motion.q, seen, v) for v in (1e-8, 4e-8))
    assert large / small == pytest.approx(2.0, rel=1e-3)  # the prior counts for next to nothing
    every = [least_position_error(body, motion.q, seen[::k], 1.0) for k in (1, 2, 4)]
    assert every == sorted(every)


def test_longer_steps_fit_the_first_frame_as_those_of_the_paper(motion):
    body, places = model(), motion.positions[:1]
    q, ends = first_state(body)[: body.dim_q], []
    for exact in (True, False):
        ((belief, _),) = Recipe(exact=exact).frames(body, q, list(places), [np.arange(NODES)])
        ends.append(np.linalg.norm(body.position(belief.mean) - places[0], axis=1).mean())
    before = np.linalg.norm(body.position(q) - places[0], axis=1).mean()
    assert max(ends) < 0.1 * before
    assert ends[0] == pytest.approx(ends[1], abs=0.01 * before)


def test_ours_finds_the_nodes_of_exact_data(motion):
    body, places = model(), motion.positions[:3]
    found = Ours(0.0, INTERVAL).frames(
        body, first_state(body), list(places), [np.arange(NODES)] * len(places)
    )
    errors = [np.abs(body.position(b.mean) - p).max() for b, p in zip(found, places, strict=True)]
    assert errors[-1] < 0.01


@pytest.mark.parametrize(('few', 'seed'), [(insect.NODES, 0), (insect.FEW, 0), (insect.FEW, 8)])
def test_joints_of_ours_hold(few, seed):
    rng = np.random.default_rng(seed)
    chosen = [rng.permutation(insect.NODES)[:few] for _ in insect.INSECT]
    points = [
        [own[at] for own, at in zip(frame, chosen, strict=True)] for frame in insect.flown(2)
    ]
    models = insect.first_models(points[0])
    ours = JoinedFilter(models.joined, Ours(insect.SIGMA, INTERVAL))
    for q in ours.frames(models.states, points):
        gaps = models.joined.violation(np.concatenate(q))
        assert np.abs(gaps).max() < 1e-6 * 8.4  # of the size of the body


def test_parts_are_joined_without_a_change_of_their_shapes():
    models = insect.first_models(list(insect.flown(1)[0]))
    model = Articulated(models.parts, [], 0.0)
    x = closed(model, models.joined, model.join(models.states))
    before = np.abs(models.joined.violation(np.concatenate(models.coordinates))).max()
    assert before > 0.5
    assert np.abs(models.joined.violation(x[: model.dim_q])).max() < 1e-12  # rounding
    for state, first in zip(model.split(x), models.states, strict=True):
        np.testing.assert_array_equal(state[GLOBAL], first[GLOBAL])


def test_arms_hang_from_where_they_are_held():
    for share in (0.0, 0.5, 1.0):
        torso, left, right, *forearms = arms.man(share)
        for upper, fore in zip((left, right), forearms, strict=True):
            assert 0.0 < cdist(torso, upper).min() < 4.0  # the nodes that are joined lie between
            assert cdist(upper, fore).min() < 4.0
    fallen = np.array([arms.man(share)[3].mean(axis=0)[2] for share in (0.0, 0.5, 1.0)])
    assert np.all(np.diff(fallen) > 5.0)  # raised


def test_first_models_point_to_where_they_are_held():
    models = arms.first_models(arms.seen(1).points[0])
    q = np.concatenate(models.coordinates)
    gaps = np.linalg.norm(models.joined.violation(q).reshape(-1, 3), axis=1)
    assert gaps.max() < 15.0  # the length of half an arm: none points the wrong way


def test_labelled_points_keep_their_places_on_arms():
    truth = arms.seen(3)
    models = arms.first_models(truth.points[0])
    ours = JoinedFilter(models.joined, Ours(arms.SIGMA, arms.INTERVAL, arms.SETTINGS), True)
    for places, q in zip(truth.places, ours.frames(models.states, truth.points), strict=True):
        assert apart(places, models.parts, q) < 1.0  # cm; the first models err by 2.4
        assert np.abs(models.joined.violation(np.concatenate(q))).max() < 1e-6


def test_a_figure_from_end_to_end(tmp_path):
    arguments = ['reproduce', 'metaxas1993', '--only', '7', '--quick', '-o', str(tmp_path)]
    assert main(arguments) == 0
    (row,) = json.loads((tmp_path / 'table.json').read_text())
    errors = [row['numbers'][f'ours: position error, frame {k}'] for k in (1, 20)]
    assert errors[1] < errors[0]
    assert (tmp_path / 'figure_7.png').exists()
