"""The simulated bodies: their truth converges in the time step, and they are what they say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from references import order_of
from scipy.spatial.transform import Rotation

from cloth_predict.formats.bag import read_recording, write_recording
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.constraints import Articulated
from cloth_predict.models.superquadric import Superquadric
from cloth_predict.simulation.bodies import (
    INSECT,
    UPRIGHT,
    Elastic,
    Moved,
    Pull,
    Tether,
    balloon,
    gripped,
    insect,
    insect_at_rest,
)
from cloth_predict.simulation.filming import film
from cloth_predict.simulation.recordings import simulate

SHAPE = np.array([0.2, 0.6, 0.8, 1.0, 1.0, 1.0, 0.2, 0.0, 0.0, 0.0, 0.5])


def no_progress(seconds):
    pass


def still(nodes=40, **settings):
    """A body at rest with all that moves it, and its state with the time."""
    mesh = ClosedMesh.even(nodes)
    body = Superquadric(mesh, mass=0.1, reference=SHAPE, free=SHAPE > 0.7, **settings)
    start = body.state(np.zeros(3), UPRIGHT, SHAPE)
    return body, start


def energy(body, state, elastic):
    """Of the motion of the nodes, and of their springs [J]."""
    velocity, position = body.velocity(state), body.position(state)
    off = elastic(position, 0.0) / (elastic.stiffness / len(position))
    moving = 0.5 * body.node_mass @ np.square(velocity).sum(axis=1)
    return moving + 0.5 * elastic.stiffness / len(position) * np.square(off).sum()


# --- convergence


@pytest.mark.parametrize(
    ('scenario', 'duration', 'bound'),
    [(balloon, 0.6, 4e-7), (insect, 0.1, 6e-7)],  # m; 4e-8 and 6e-8 when written
)
def test_half_the_step_gives_the_same_motion(scenario, duration, bound):
    whole = scenario(np.random.default_rng(2026), duration, no_progress)
    half = scenario(np.random.default_rng(2026), duration, no_progress, step=2.5e-3)
    moved = np.abs(whole.surface[-1] - whole.surface[0]).max()
    assert moved > 1e-3  # m; there was a motion
    assert np.abs(half.surface - whole.surface).max() < bound


def test_the_motion_converges_with_the_order_of_the_method():
    # a pull whose time is a state, and a quaternion that keeps its length: an error in either
    # would lower the order
    body, start = still()
    pull = Pull.draw(
        np.random.default_rng(2), gripped(body.mesh, (0.0, 0.0, 1.0)), (0.2, 0.2, 0.2)
    )
    forces = [(Elastic(body.position(start), 20.0), pull)]
    scene = Moved(Articulated([body], [], 0.0), forces)
    steps = np.array([2e-2, 1e-2, 5e-3])
    times, x = np.array([0.0, 0.2]), np.append(start, 0.0)
    ends = [film(scene, x, times, dt, no_progress)[-1] for dt in (*steps, 1e-3)]
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert order_of(errors, steps) == pytest.approx(4, abs=0.2)  # house rule


# --- forces


def test_springs_of_a_body_make_no_force_no_torque_and_hold_no_rigid_motion():
    rng = np.random.default_rng(4)
    rest = rng.normal(0.0, 0.1, (20, 3))
    elastic = Elastic(rest, 30.0)
    turn = Rotation.from_rotvec([0.3, -2.0, 0.5])
    moved = turn.apply(rest) + np.array([1.0, 2.0, 3.0])
    # N: rounding of 30 N/m times 3 m
    np.testing.assert_allclose(elastic(moved, 0.0), 0.0, atol=1e-13)
    bent = moved + rng.normal(0.0, 0.02, (20, 3))
    force = elastic(bent, 0.0)
    assert np.abs(force).max() > 1e-2
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-13)
    np.testing.assert_allclose(np.cross(bent, force).sum(axis=0), 0.0, atol=1e-13)


def test_springs_of_a_body_are_the_gradient_of_their_energy():
    rng = np.random.default_rng(5)
    rest = rng.normal(0.0, 0.1, (6, 3))
    elastic = Elastic(rest, 30.0)
    position = rest + rng.normal(0.0, 0.05, (6, 3))

    def stored(position):
        off = elastic(position, 0.0) / 5.0  # 30 N/m of six springs
        return 2.5 * np.square(off).sum()

    slope = np.empty((6, 3))
    for place in np.ndindex(6, 3):
        change = np.zeros((6, 3))
        change[place] = 1e-6
        slope[place] = (stored(position + change) - stored(position - change)) / 2e-6
    # central differences: 1e-12 of curvature, rounding 1e-16 / 1e-6
    np.testing.assert_allclose(elastic(position, 0.0), -slope, atol=1e-8)


def test_a_tether_draws_back_to_the_start_and_a_pull_begins_at_nothing():
    start = np.random.default_rng(6).normal(size=(5, 3))
    np.testing.assert_allclose(
        Tether(start, 10.0)(start + np.array([0.0, 0.1, 0.0]), 3.0), [[0, -0.2, 0]] * 5, atol=1e-14
    )
    share = gripped(ClosedMesh.even(300), (0.0, 0.0, -1.0))
    assert share.sum() == pytest.approx(1.0, abs=1e-12)
    assert ClosedMesh.even(300).directions[share > 0.1 * share.max(), 2].max() < -0.6
    pull = Pull.draw(np.random.default_rng(7), share, (0.3, 0.0, 0.1))
    np.testing.assert_array_equal(pull(np.zeros((300, 3)), 0.0), np.zeros((300, 3)))
    late = 1000 + np.linspace(0, 2000, 4001)  # s: many periods of the slowest wave
    total = np.array([pull(np.zeros((300, 3)), t).sum(axis=0) for t in late])
    np.testing.assert_allclose(np.sqrt(np.mean(total**2, axis=0)), [0.3, 0.0, 0.1], atol=0.01)


# --- what is kept


def test_a_body_that_spins_freely_keeps_its_energy_and_its_momenta():
    body, start = still(alpha=0.0)
    start[body.dim_q + 3 : body.dim_q + 7] = 1.5 * np.array([0.0, 1.0, 0.0, 0.0])  # 3 rad/s
    start[body.dim_q : body.dim_q + 3] = [0.3, 0.0, -0.1]
    start[body.dim_q + 3 : body.dim_q + 7] -= UPRIGHT * (
        UPRIGHT @ start[body.dim_q + 3 : body.dim_q + 7]
    )
    elastic = Elastic(body.position(start), 50.0)
    scene = Moved(Articulated([body], [], 0.0), [(elastic,)])
    states = []
    film(_Watched(scene, states), np.append(start, 0.0), np.linspace(0, 1, 5), 5e-3, no_progress)
    told = [_kept(body, state, elastic) for state in states]
    # the nodes move as the lumped coordinates do, which keep what a rigid body keeps; what is not
    # rigid here is some 1e-3 of the motion
    np.testing.assert_allclose(told, np.tile(told[0], (5, 1)), rtol=0.01, atol=1e-4)
    lengths = [np.linalg.norm(state[3:7]) for state in states]
    np.testing.assert_allclose(lengths, 1.0, atol=1e-8)  # that of the method


class _Watched:
    """A scene of which the states at the frames are kept."""

    def __init__(self, scene, states):
        self._scene, self._states = scene, states
        self.hung, self.f, self.input_after = scene.hung, scene.f, scene.input_after

    def positions(self, x):
        self._states.append(x[:-1])
        return self._scene.positions(x)


def _kept(body, state, elastic):
    velocity, mass = body.velocity(state), body.node_mass[:, None]
    turning = np.cross(body.position(state), mass * velocity).sum(axis=0)
    return np.concatenate([[energy(body, state, elastic)], (mass * velocity).sum(axis=0), turning])


# --- the insect


def test_the_joints_of_the_insect_hold():
    bodies, starts = insect_at_rest(ClosedMesh.even(60))
    assert len(bodies.parts) == len(INSECT) == 5
    np.testing.assert_allclose(bodies.violation(bodies.join(starts)), 0.0, atol=1e-15)
    surface = insect(np.random.default_rng(1), 0.2, no_progress).surface[:, 0]
    apart = np.empty((len(surface), 4, 3))
    for k, joint in enumerate(bodies.joints.joints):
        apart[:, k] = (
            surface[:, 60 * joint.part_a + joint.node_a]
            - surface[:, 60 * joint.part_b + joint.node_b]
        )
    assert np.abs(surface[-1] - surface[0]).max() > 3e-3
    assert np.abs(apart).max() < 1e-6 * 0.24  # m: of the length of the body


def test_the_insect_is_seen_by_its_parts():
    recording = simulate('insect', 3, 0.05, no_progress)
    labels = recording.markers.labels
    assert len(labels) == 150
    assert (labels[0], labels[-1]) == ('body/0', 'wing_right/29')
    truth = recording.truth.markers(recording.markers)
    off = recording.markers.positions - truth.positions
    assert np.nanstd(off) == pytest.approx(3e-4, rel=0.1)
    left = [k for k, label in enumerate(labels) if label.startswith('wing_left/')]
    assert truth.positions[0, left, 2].max() < 0  # left of what flies along x, with y up


# --- the recording


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path):
    bags = []
    for name, seed in (('a', 5), ('b', 5), ('c', 6)):
        write_recording(tmp_path / name, simulate('balloon', seed, 0.1, no_progress, False))
        bags.append((tmp_path / name / 'bag.mcap').read_bytes())
    assert bags[0] == bags[1]
    assert bags[0] != bags[2]


def test_the_shipped_recording_is_what_the_simulator_makes():
    shipped = read_recording(Path(__file__).parents[1] / 'bags/balloon')
    made = simulate('balloon', 2026, 0.3, no_progress, labelled=False)
    frames = len(made.truth.stamps)
    np.testing.assert_array_equal(shipped.truth.ids, made.truth.ids)
    # m; float32 resolves 1.2e-7 at 1.5 m
    np.testing.assert_allclose(shipped.truth.surface[:frames], made.truth.surface, atol=1e-6)
    assert shipped.markers.labels == made.markers.labels
    assert np.isnan(shipped.markers.positions[..., 0]).mean() == pytest.approx(0.02, abs=4e-3)
    assert len(shipped.markers) == 301


def test_a_balloon_without_labels(tmp_path):
    with_labels = simulate('balloon', 5, 0.1, no_progress)
    without = simulate('balloon', 5, 0.1, no_progress, labelled=False)
    assert not with_labels.markers.unlabelled.any()
    assert without.markers.unlabelled.all()
    assert len(without.markers.labels) == 67
    np.testing.assert_array_equal(without.markers.positions, with_labels.markers.positions)
    write_recording(tmp_path / 'bag', without)
    read = read_recording(tmp_path / 'bag')
    assert read.markers.unlabelled.all()
    # float32 of 1.5 m
    np.testing.assert_allclose(read.truth.surface, without.truth.surface, atol=1e-7)
    seen = replace(read.markers, positions=np.nan_to_num(read.markers.positions))
    np.testing.assert_array_equal(seen.visible, without.markers.visible)
