"""Surfaces held to a few shapes: the whole model with all shapes, closed forms of vibrations."""

import numpy as np
import pytest
from references import central_differences, flat_grid, order_of, random_surface

from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.modes import linear_modes, motion_modes
from cloth_predict.models.reduced import Reduced
from cloth_predict.models.springs import Springs, grid_pairs
from cloth_predict.observations import LinearObservation, VisiblePositions
from cloth_predict.types import Gaussian

STEP = ImplicitEuler()
DT = 0.01


def reduced_surface(rng, modes=None, air=True):
    """A random surface far from rest, held to random shapes about a random rest; x and u."""
    model, x, u = random_surface(rng, 4, 3, driven=(0, 2), air=air)
    size = 3 * len(model.free)
    modes = size if modes is None else modes
    reduced = Reduced(model, x[:size] + rng.normal(0, 0.02, size), rng.normal(size=(size, modes)))
    return reduced, reduced.project(x), u


# --- with all shapes it is the model


@pytest.fixture
def whole():
    reduced, x, u = reduced_surface(np.random.default_rng(1))
    return reduced, x, u, reduced.lift(x)


def test_all_shapes_hold_any_state(whole):
    reduced, x, _, state = whole
    # rounding times the condition of a random basis of 30 shapes
    np.testing.assert_allclose(reduced.project(state), x, atol=1e-10)


def test_with_all_shapes_the_rates_are_those_of_the_model(whole):
    reduced, x, u, state = whole
    # as above; accelerations are some 100 m/s^2
    np.testing.assert_allclose(
        reduced.lifted(reduced.f(x, u)), reduced.model.f(state, u), atol=1e-8
    )
    there = reduced.lifted(reduced.jac(x, u).toarray())
    back = reduced.model.jac(state, u) @ reduced.lifted(np.eye(reduced.dim_x))
    np.testing.assert_allclose(there, back, atol=1e-10 * np.abs(back).max())  # rounding
    by_input = reduced.lifted(reduced.jac_input(x, u).toarray())
    expected = reduced.model.jac_input(state, u).toarray()
    np.testing.assert_allclose(by_input, expected, atol=1e-10 * np.abs(expected).max())  # the same


def test_with_all_shapes_the_steps_are_those_of_the_model(whole):
    reduced, x, u, state = whole
    for _ in range(5):
        x, tangent = STEP.step_tangent(reduced, x, u, DT)
        state, expected = STEP.step_tangent(reduced.model, state, u, DT)
        u = reduced.input_after(u, DT)
    np.testing.assert_allclose(reduced.lift(x), state, atol=1e-9)  # rounding of five solves
    pushed = reduced.lifted(tangent.push(np.eye(reduced.dim_x)))
    other = expected.push(reduced.lifted(np.eye(reduced.dim_x)))
    np.testing.assert_allclose(pushed, other, atol=1e-9 * np.abs(other).max())  # the same
    driven = reduced.lifted(tangent.drive(np.eye(reduced.dim_u)))
    np.testing.assert_allclose(
        driven, expected.drive(np.eye(reduced.dim_u)), atol=1e-9
    )  # the same


def test_with_all_shapes_a_filter_says_the_same():
    rng = np.random.default_rng(2)
    reduced, x, u = reduced_surface(rng, air=False)
    n, model = len(reduced.rest), reduced.model
    lift = reduced.lifted(np.eye(reduced.dim_x))
    few, all_ = Gaussian(x, 1e-4 * np.eye(2 * n)), Gaussian(reduced.lift(x), 1e-4 * lift @ lift.T)
    rows = np.arange(6)
    seen = LinearObservation(*reduced.seen(rows), np.full(6, 1e-6))
    ekf, z = ExtendedKalmanFilter(STEP), reduced.lift(x)[rows] + rng.normal(0, 1e-3, 6)
    few = ekf.update(ekf.predict(few, reduced, u, np.zeros(2 * n), DT), seen, z)[0]
    all_ = ekf.predict(all_, model, u, np.zeros(2 * n), DT)
    all_ = ekf.update(all_, VisiblePositions(rows, np.full(6, 1e-6)), z)[0]
    np.testing.assert_allclose(reduced.lift(few.mean), all_.mean, atol=1e-8)  # rounding, as above
    np.testing.assert_allclose(lift @ few.cov @ lift.T, all_.cov, atol=1e-8 * all_.cov.max())


# --- with a few


@pytest.fixture
def few():
    return reduced_surface(np.random.default_rng(3), modes=5)


def test_jacobians_are_the_slopes_of_the_rates(few):
    reduced, x, u = few
    numeric = central_differences(lambda x: reduced.f(x, u), x, 1e-5)
    # rounding 1e-16 / 1e-5 of rates up to 1e3, and the error of the differences
    np.testing.assert_allclose(
        reduced.jac(x, u).toarray(), numeric, atol=1e-6 * np.abs(numeric).max()
    )
    numeric = central_differences(lambda u: reduced.f(x, u), u, 1e-5)
    exact = reduced.jac_input(x, u).toarray()
    np.testing.assert_allclose(exact, numeric, atol=1e-6 * np.abs(numeric).max())  # the same


def test_tangent_is_the_derivative_of_the_step(few):
    reduced, x, u = few
    _, tangent = STEP.step_tangent(reduced, x, u, DT)
    exact = tangent.push(np.eye(reduced.dim_x))
    numeric = central_differences(lambda x: STEP.step(reduced, x, u, DT), x, 1e-6)
    np.testing.assert_allclose(exact, numeric, atol=1e-6 * np.abs(numeric).max())  # differences
    driven = central_differences(lambda u: STEP.step(reduced, x, u, DT), u, 1e-6)
    np.testing.assert_allclose(tangent.drive(np.eye(reduced.dim_u)), driven, atol=1e-6)  # the same
    rows = np.random.default_rng(4).normal(size=(3, reduced.dim_x))
    np.testing.assert_allclose(tangent.pull(rows), rows @ exact, atol=1e-10)  # rounding
    cov = rows.T @ rows
    np.testing.assert_allclose(tangent.sandwich(cov), exact @ cov @ exact.T, atol=1e-9)  # rounding


def test_unknown_forces_act_on_it_as_on_any_model(few):
    reduced, x, u = few
    model = Disturbed(reduced, 0.3)
    x = np.concatenate([x, np.random.default_rng(5).normal(0, 0.1, reduced.dim_load)])
    _, tangent = STEP.step_tangent(model, x, u, DT)
    exact = tangent.push(np.eye(model.dim_x))
    numeric = central_differences(lambda x: STEP.step(model, x, u, DT), x, 1e-6)
    np.testing.assert_allclose(exact, numeric, atol=1e-6 * np.abs(numeric).max())  # differences
    np.testing.assert_allclose(tangent.pull(np.eye(model.dim_x)), exact, atol=1e-10)  # rounding
    np.testing.assert_allclose(tangent.sandwich(np.eye(len(x))), exact @ exact.T, atol=1e-9)


# --- vibrations


def string(inner, tension=3.0, side=0.1, mass=0.02, k=200.0, damping=0.01):
    """A row of masses stretched between two fixed ends; with its state and input at rest."""
    pairs = grid_pairs(1, inner + 2)['structural']
    springs = Springs(pairs, k, damping, side - tension / k)
    model = MassSpring(springs, np.full(inner + 2, mass), (0, inner + 1), (0, 0, 0))
    flat = flat_grid(1, inner + 2, side)
    return model, _at_rest(model, flat), model.input(flat[model.driven])


def _at_rest(model, position):
    return np.concatenate([position[model.free].ravel(), np.zeros(model.dim_x // 2)])


def test_frequencies_of_a_string_of_masses():
    n = 12
    model, x, u = string(n)
    found = linear_modes(model, x, u, 3 * n)
    across, along = string_frequencies(n)
    expected = np.sort(np.concatenate([across, across, along]))
    np.testing.assert_allclose(found.weight, expected, rtol=1e-10)  # rounding of eigenvalues
    gram = found.basis.T @ (model.mass3[:, None] * found.basis)
    np.testing.assert_allclose(gram, np.eye(3 * n), atol=1e-10)  # rounding


def test_frequencies_of_a_stretched_sheet():
    rows, cols, tension, side, mass, k = 5, 6, 2.0, 0.1, 0.02, 300.0
    pairs = grid_pairs(rows + 2, cols + 2)['structural']
    node = np.arange((rows + 2) * (cols + 2)).reshape(rows + 2, cols + 2)
    border = np.setdiff1d(node, node[1:-1, 1:-1])
    flat = flat_grid(rows + 2, cols + 2, side)
    model = MassSpring(
        Springs(pairs, k, 0.0, side - tension / k), np.full(len(flat), mass), border, (0, 0, 0)
    )
    found = linear_modes(model, _at_rest(model, flat), model.input(flat[border]), 20)
    i, j = np.meshgrid(np.arange(1, rows + 1), np.arange(1, cols + 1))
    down, right = np.pi * i / (2 * (rows + 1)), np.pi * j / (2 * (cols + 1))
    # of the membrane's grid with a fixed border; springs are 15 times stiffer along themselves
    # than across, so that the slow ones all are vibrations out of the plane
    squares = 4 * tension / (side * mass) * (np.sin(down) ** 2 + np.sin(right) ** 2)
    across = np.sqrt(np.sort(squares.ravel()))[: (squares < found.weight[-1] ** 2).sum()]
    slow = found.weight[np.abs(found.basis.reshape(-1, 3, 20)[:, 2]).max(axis=0) > 1e-6]
    assert len(slow) > 5
    np.testing.assert_allclose(slow, across[: len(slow)], rtol=1e-10)  # rounding of eigenvalues


def string_frequencies(n, tension=3.0, side=0.1, mass=0.02, k=200.0):
    """Lagrange's chain with fixed ends: across, of each of two directions, and along."""
    wave = 2 * np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1)))
    return wave * np.sqrt(tension / (side * mass)), wave * np.sqrt(k / mass)


def test_modes_of_a_string_move_by_themselves_and_their_error_falls_with_their_number():
    n = 40
    model, x, u = string(n)
    across, along = string_frequencies(n)
    j = np.arange(1, n + 1)
    frames = [x.copy()]
    frames[0][1 : 3 * n : 3] = 1e-6 * j * (n + 1 - j)  # a parabola, small enough to be linear
    for _ in range(30):
        frames.append(STEP.step(model, frames[-1], u, DT))
    counts, errors = np.array([3, 5, 9, 15]), []
    for count in counts:
        fastest = across[count - 1] * (1 + 1e-9)  # never one direction without the other
        kept = 2 * (across < fastest).sum() + (along < fastest).sum()
        reduced = Reduced(model, x[: 3 * n], linear_modes(model, x, u, kept).basis)
        q = reduced.project(frames[0])
        for _ in range(30):
            q = STEP.step(reduced, q, u, DT)
        exact = reduced.lift(reduced.project(frames[-1]))[: 3 * n]
        # an amplitude of 4.2e-4 m turns the springs by 4e-4: forces are linear up to its square
        np.testing.assert_allclose(reduced.lift(q)[: 3 * n], exact, atol=2e-10)
        left_out = reduced.lift(reduced.project(frames[0])) - frames[0]
        errors.append(np.linalg.norm(left_out))
    # a parabola has shares of 1/j^3 of the odd modes, which leaves j^-2.5 beyond the first j
    assert order_of(errors, counts + 1.0) == pytest.approx(-2.5, abs=0.2)  # slope's curvature


def test_a_falling_sheet_is_followed_the_better_the_more_modes():
    model, x, u = random_surface(np.random.default_rng(6), 4, 4, driven=(0, 1, 2, 3))
    frames = [x]
    for _ in range(50):
        frames.append(STEP.step(model, frames[-1], u, DT))
    frames, n = np.array(frames), 3 * len(model.free)
    rest, errors = frames[0, :n], []
    for count in (2, 6, 12, n):
        basis = motion_modes(model, rest, frames[:, :n], count).basis
        reduced = Reduced(model, rest, basis)
        q, off = reduced.project(x), []
        for frame in frames[1:]:
            q = STEP.step(reduced, q, u, DT)
            off.append(np.linalg.norm(reduced.lift(q)[:n] - frame[:n]))
        errors.append(np.sqrt(np.mean(np.square(off))))
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[3] < 1e-6  # all of them: rounding, grown by fifty steps


# --- shapes of motions


def test_motions_of_few_shapes_are_held_by_as_many():
    rng = np.random.default_rng(7)
    model, x, _ = random_surface(rng, 4, 3, driven=(0,))
    rest = x[: 3 * len(model.free)]
    frames = rest + rng.normal(size=(20, 3)) @ rng.normal(size=(3, len(rest)))
    found = motion_modes(model, rest, frames, 5)
    assert found.weight[3] < 1e-10 * found.weight[0]  # rounding
    reduced = Reduced(model, rest, found.basis[:, :3])
    for frame in frames:
        state = np.concatenate([frame, np.zeros_like(frame)])
        # rounding
        np.testing.assert_allclose(reduced.lift(reduced.project(state)), state, atol=1e-12)


def test_what_they_leave_out_is_what_the_singular_values_say():
    rng = np.random.default_rng(8)
    model, x, _ = random_surface(rng, 4, 3, driven=(0,))
    rest = x[: 3 * len(model.free)]
    frames = rest + rng.normal(0, 0.1, (40, len(rest)))
    weight = motion_modes(model, rest, frames, len(rest)).weight
    reduced = Reduced(model, rest, motion_modes(model, rest, frames, 6).basis)
    off = [
        reduced.lift(reduced.project(np.concatenate([frame, 0 * frame])))[: len(rest)] - frame
        for frame in frames
    ]
    # Eckart and Young, in the metric of the masses; rounding
    left = (model.mass3 * np.square(off)).sum()
    assert left == pytest.approx((weight[6:] ** 2).sum(), rel=1e-10)


# --- bad input


def test_shapes_that_depend_on_each_other_are_refused():
    model, x, _ = random_surface(np.random.default_rng(9), 3, 3, driven=(0,))
    shape = np.ones((24, 1))
    with pytest.raises(ValueError, match='the 2 shapes of the basis depend on each other'):
        Reduced(model, x[:24], np.concatenate([shape, 2 * shape], axis=1))


def test_a_basis_of_another_size_is_refused():
    model, x, _ = random_surface(np.random.default_rng(9), 3, 3, driven=(0,))
    with pytest.raises(ValueError, match=r'\(23, 2\), expected \(24,\) and \(24, modes\)'):
        Reduced(model, x[:24], np.ones((23, 2)))
