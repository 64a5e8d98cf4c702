"""A bar on dry friction: forces, closed forms of how it stops, order, and adaptive references."""

from dataclasses import replace

import numpy as np
import pytest
from references import central_differences, order_of
from scipy.integrate import solve_ivp

from cloth_predict.experiments.goeller2015.friction import Rounded
from cloth_predict.formats.bag import read_recording, write_recording
from cloth_predict.integrators.runge_kutta import RungeKutta
from cloth_predict.integrators.sliding import Sliding
from cloth_predict.models.ruler import Ruler
from cloth_predict.simulation.recordings import simulate
from cloth_predict.simulation.ruler import ANNEX_A, Shot, measured, random_shot, slide

NO_INPUT = np.zeros(0)
G = 9.81


def printed(ruler, mass, x):
    """Accelerations by the equations of section 2.1 as printed, with the mass in them."""
    _, _, alpha, vx, vy, spin = x
    cos, sin = np.cos(alpha), np.sin(alpha)
    weight = mass * ruler.g
    on_a = weight * (ruler.L2 / (ruler.L1 + ruler.L2) if ruler.share is None else ruler.share)
    a = np.array([vx + ruler.L1 * spin * sin, vy - ruler.L1 * spin * cos])
    b = np.array([vx - ruler.L2 * spin * sin, vy + ruler.L2 * spin * cos])
    ta = -ruler.mu * on_a * a / np.linalg.norm(a)
    tb = -ruler.mu * (weight - on_a) * b / np.linalg.norm(b)
    moment = ruler.L1 * (ta[0] * sin - ta[1] * cos) - ruler.L2 * (tb[0] * sin - tb[1] * cos)
    return np.append((ta + tb) / mass, moment / (mass * ruler.L**2 / 12))


def some_state(rng):
    return rng.normal(0, [1, 1, 2, 2, 2, 5])


def stopped(ruler, x, step=0.005, steps=4000):
    """Pose at rest, and the states on the way."""
    method, states = Sliding(step), [x]
    while not ruler.resting(states[-1]):
        states.append(method.step(ruler, states[-1], NO_INPUT, step))
        assert len(states) < steps
    return states[-1][:3], np.array(states)


def moved(ruler, x):
    return Sliding(0.005).step(ruler, x, NO_INPUT, 0.02)


# --- forces


@pytest.mark.parametrize('share', [None, 0.3])
@pytest.mark.parametrize('mass', [0.01, 1.0, 50.0])
def test_accelerations_are_those_of_the_paper_whatever_the_mass(mass, share):
    rng = np.random.default_rng(1)
    ruler = Ruler(0.8, 0.15, 0.3, 0.25, share=share)
    for _ in range(10):
        x = some_state(rng)
        found = ruler.f(x, NO_INPUT)
        np.testing.assert_array_equal(found[:3], x[3:])
        np.testing.assert_allclose(found[3:], printed(ruler, mass, x), rtol=1e-12)  # rounding


def test_many_bars_at_once_are_those_one_by_one():
    rng = np.random.default_rng(2)
    x = np.array([some_state(rng) for _ in range(7)])
    x[0, 3:], x[1, 3:] = 0.0, [0.01, 0.0, 0.01]
    L1, mu = rng.uniform(0.1, 0.4, 7), rng.uniform(0.1, 0.5, 7)
    together = Ruler(np.ones(7), L1, np.full(7, 0.2), mu)
    slopes, after = together.f(x, NO_INPUT), moved(together, x)
    for k in range(7):
        alone = Ruler(1.0, L1[k], 0.2, mu[k])
        np.testing.assert_allclose(slopes[k], alone.f(x[k], NO_INPUT), atol=1e-13)  # rounding
        np.testing.assert_allclose(after[k], moved(alone, x[k]), atol=1e-13)  # rounding


def test_jacobian_is_that_of_central_differences():
    ruler, rng = Ruler(0.8, 0.15, 0.3, 0.25), np.random.default_rng(3)
    for _ in range(5):
        x = some_state(rng)
        differences = central_differences(lambda x: ruler.f(x, NO_INPUT), x, 1e-6)
        found = ruler.jac(x, NO_INPUT).toarray()
        np.testing.assert_allclose(found, differences, atol=1e-7)  # 1e-12 of the curvature
    assert ruler.jac(np.zeros(6), NO_INPUT).toarray()[3:].any() == np.False_
    assert ruler.jac_input(x, NO_INPUT).shape == (6, 0)


def test_contacts_and_friction_are_where_the_equations_have_them():
    ruler, x = Ruler(1.0, 0.1, 0.3, 0.2), np.array([1.0, 2.0, np.pi / 2, 0.0, 0.0, 2.0])
    np.testing.assert_allclose(ruler.contacts(x), [1 + 1.9j, 1 + 2.3j], atol=1e-15)  # rounding
    # it spins anticlockwise: A, below, moves to the right, B to the left; statics loads A more
    np.testing.assert_allclose(ruler.friction(x), [-0.2 * G * 0.75, 0.2 * G * 0.25], atol=1e-14)
    np.testing.assert_allclose(ruler.slip(x), [0.2, 0.6], atol=1e-15)  # rounding


# --- closed forms


@pytest.mark.parametrize('mu', [0.05, 0.3])
@pytest.mark.parametrize('heading', [0.0, 1.1, -2.5])
def test_a_bar_that_only_translates_stops_after_v_squared_by_2_mu_g(mu, heading):
    speed, ruler = 1.7, Ruler(1.0, 0.1, 0.35, mu)
    along = np.array([np.cos(heading), np.sin(heading)])
    pose, states = stopped(ruler, np.array([0.2, 0.3, 0.4, *speed * along, 0.0]))
    expected = [0.2, 0.3] + along * speed**2 / (2 * mu * G)
    np.testing.assert_allclose(pose, [*expected, 0.4], rtol=1e-12)  # rounding of 700 steps
    assert (len(states) - 1) * 0.005 == pytest.approx(speed / (mu * G), abs=0.005)


@pytest.mark.parametrize('spin', [4.0, -9.0])
def test_a_bar_that_only_spins_stops_after_omega_squared_by_twice_its_slowing(spin):
    ruler = Ruler(0.9, 0.2, 0.2, 0.3)
    slowing = 12 * 0.3 * G * 0.2 / 0.9**2  # 12 mu g L1 / L^2
    pose, _ = stopped(ruler, np.array([0.2, 0.3, 0.4, 0.0, 0.0, spin]))
    expected = 0.4 + np.sign(spin) * spin**2 / (2 * slowing)
    np.testing.assert_allclose(pose, [0.2, 0.3, expected], rtol=1e-10)  # rounding, which grows


@pytest.mark.parametrize('spin', [1.2, -1.2])
def test_a_contact_that_stands_is_held_and_the_bar_turns_about_it(spin):
    ruler, angle = Ruler(1.0, 0.4, 0.3, 0.3), 0.7
    about = np.array([0.2, 0.3])
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    x = np.array([*about + 0.4 * along, angle, *0.4 * spin * across, spin])
    slowing = 0.7 * 0.3 * G * (0.4 / 0.7) / (1 / 12 + 0.4**2)  # B's friction about A
    pose, states = stopped(ruler, x)
    turned = angle + np.sign(spin) * spin**2 / (2 * slowing)
    end = about + 0.4 * np.array([np.cos(turned), np.sin(turned)])
    # the last step takes its friction to be constant in direction
    np.testing.assert_allclose(pose, [*end, turned], atol=2e-6)
    np.testing.assert_allclose(ruler.contacts(states)[:-1, 0], 0.2 + 0.3j, atol=1e-14)  # rounding


def test_a_contact_that_spins_too_fast_to_be_held_slides_away():
    ruler, spin = Ruler(1.0, 0.4, 0.3, 0.3), 6.0  # 0.4 spin^2 is far above 0.3 g
    x = np.array([0.4, 0.0, 0.0, 0.0, 0.4 * spin, spin])
    _, held = ruler.arrested(x, 1e-3)
    assert not held


# --- the step


def test_order_is_four_while_both_contacts_slide():
    shot = ANNEX_A[3]
    exact = slide(shot).at(np.array([1.0]))[0]
    steps = np.array([0.02, 0.01, 0.005])
    errors = []
    for step in steps:
        x = shot.start
        for _ in range(round(1.0 / step)):
            x = Sliding(1.0).step(shot.ruler, x, NO_INPUT, step)
        errors.append(np.abs(x - exact).max())
    assert order_of(errors, steps) == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize('version', [3, 4, 5])
def test_where_it_rests_is_that_of_an_adaptive_solver_with_events(version):
    shot = ANNEX_A[version]
    exact = slide(shot)
    rest = exact.at(np.array([exact.duration]))[0, :3]
    errors = [
        np.abs(stopped(shot.ruler, shot.start, step)[0] - rest).max() for step in (0.01, 0.002)
    ]
    # a contact passes through small speeds: a step of 10 ms sees its friction turn late
    assert errors[0] < 4e-4
    assert errors[1] < 1e-6


def test_random_motions_end_where_an_adaptive_solver_has_them():
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(6):
        shot = random_shot(rng)
        exact = slide(shot, tolerance=1e-9)
        rest = exact.at(np.array([exact.duration]))[0, :3]
        errors.append(np.abs(stopped(shot.ruler, shot.start)[0] - rest).max())
    assert max(errors) < 1e-3  # m and rad, at 5 ms: the noise of one frame is no less


def test_the_events_are_those_of_friction_that_is_rounded_off_ever_so_little():
    # an implicit solver that knows of no event, with friction mu N v / sqrt(v^2 + eps^2)
    eps, shot = 1e-5, ANNEX_A[4]

    rounded = Rounded.like(shot.ruler, eps)
    found = solve_ivp(
        lambda t, x: rounded.f(x, NO_INPUT), (0, 3.2), shot.start, method='LSODA', rtol=1e-9,
        atol=1e-11,
    )  # fmt: skip
    exact = slide(shot).at(np.array([3.2]))[0, :3]
    # it creeps on by eps for the half second in which a contact stands or hardly moves
    np.testing.assert_allclose(found.y[:3, -1], exact, atol=5e-5)


@pytest.mark.parametrize('seed', range(6))
def test_energy_only_falls_and_rest_is_rest(seed):
    shot = random_shot(np.random.default_rng(seed))
    _, states = stopped(shot.ruler, shot.start, 0.01)
    assert (np.diff(shot.ruler.energy(states)) < 0).all()
    rest = Sliding(0.01).step(shot.ruler, states[-1], NO_INPUT, 5.0)
    np.testing.assert_array_equal(rest, states[-1])  # to the last bit
    np.testing.assert_array_equal(shot.ruler.friction(rest), [0.0, 0.0])


def test_a_slow_bar_stops_within_the_step_and_a_frictionless_one_never():
    x = np.array([0.0, 0.0, 0.0, 1e-3, 1e-3, 2e-3])
    after = Sliding(0.01).step(Ruler(1.0, 0.2, 0.2, 0.3), x, NO_INPUT, 0.01)
    np.testing.assert_array_equal(after[3:], 0.0)
    assert np.abs(after[:3]).max() < 1e-6  # v^2 / (2 mu g)
    on_ice = Sliding(0.01).step(Ruler(1.0, 0.2, 0.2, 0.0), x, NO_INPUT, 1.0)
    np.testing.assert_allclose(
        on_ice, [1e-3, 1e-3, 2e-3, 1e-3, 1e-3, 2e-3], rtol=1e-12
    )  # rounding


def test_derivative_of_a_step_is_that_of_runge_kutta_while_it_slides():
    shot = ANNEX_A[3]
    after, tangent = Sliding(0.01).step_tangent(shot.ruler, shot.start, NO_INPUT, 0.02)
    np.testing.assert_array_equal(
        after, Sliding(0.01).step(shot.ruler, shot.start, NO_INPUT, 0.02)
    )
    x, F = shot.start, np.eye(6)
    for _ in range(2):
        x, part = RungeKutta().step_jac(shot.ruler, x, NO_INPUT, 0.01)
        F = part @ F
    np.testing.assert_allclose(tangent.push(np.eye(6)), F, atol=1e-9)  # of the differences


# --- recordings


def test_a_slide_is_of_one_piece():
    exact = slide(ANNEX_A[4])
    for start in exact.since[1:]:
        before, after = exact.at(np.array([start - 1e-9, start + 1e-9]))
        np.testing.assert_allclose(before, after, atol=3e-7)  # NEAR, and a nanosecond
    assert len(exact.pieces) == 3  # slides, turns about a contact, rests
    np.testing.assert_array_equal(exact.at(np.array([9.0]))[0, 3:], 0.0)


def test_a_bar_at_rest_stays_where_it_is():
    still = slide(replace(ANNEX_A[3], start=np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])))
    assert still.duration == 0.0
    np.testing.assert_array_equal(still.at(np.array([0.0, 1.0]))[:, :3], [[1, 2, 3]] * 2)


def test_measurements_have_the_noise_that_is_asked_for():
    states = np.zeros((4000, 6))
    z = measured(states, 0.7, np.random.default_rng(5), 2e-3, 0.01)
    np.testing.assert_allclose(z.mean(axis=0), [0, 0, 0.7, 0], atol=5 * 0.01 / 4000**0.5)
    np.testing.assert_allclose(z.std(axis=0), [2e-3, 2e-3, 2e-3, 0.01], rtol=0.06)  # 5 sigma


def test_random_shots_stay_in_their_ranges_and_differ():
    shots = [random_shot(np.random.default_rng(k)) for k in range(50)]
    values = np.array(
        [
            [s.ruler.mu, s.ruler.L1, s.ruler.L2, np.hypot(*s.start[3:5]), abs(s.start[5])]
            for s in shots
        ]
    )
    low, high = [0.1, 0.05, 0.05, 1.0, 1.0], [0.4, 0.45, 0.45, 4.0, 10.0]
    assert ((values >= low) & (values <= high)).all()
    assert (np.ptp(values, axis=0) > 0.7 * np.subtract(high, low)).all()
    assert isinstance(shots[0], Shot)


def test_a_recording_has_both_ends_of_the_bar_that_was_shot(tmp_path):
    write_recording(tmp_path / 'bar', simulate('ruler', 3, 0.5, lambda seconds: None))
    recording = read_recording(tmp_path / 'bar')
    assert recording.markers.labels == ('ruler:0', 'ruler:1')
    surface = recording.truth.surface[:, 0]
    apart = surface[:, 1] - surface[:, 0]
    np.testing.assert_allclose(np.linalg.norm(apart, axis=1), 1.0, atol=1e-6)  # float32
    shot = random_shot(np.random.default_rng(3).spawn(2)[0])
    poses = slide(shot).at(np.arange(51) / 100)
    np.testing.assert_allclose(surface.mean(axis=1)[:, :2], poses[:, :2], atol=1e-6)  # float32
    angle = np.arctan2(apart[:, 1], apart[:, 0])
    np.testing.assert_allclose(np.exp(1j * angle), np.exp(1j * poses[:, 2]), atol=1e-6)
    errors = recording.markers.positions - recording.truth.surface.reshape(51, 2, 3)
    assert np.nanstd(errors) == pytest.approx(3e-4, rel=0.2)  # 300 draws
