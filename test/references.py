"""Second implementations, written for clarity alone, with which the tests compare the package.

And what several test files share: a linear model with known solution and random meshes.
"""

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy import sparse
from scipy.linalg import expm

from cloth_predict.integrators.dense_tangent import DenseTangent
from cloth_predict.models.air import Air
from cloth_predict.models.linear_part import LinearPart
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import Springs, grid_pairs
from cloth_predict.surface.topology import grid_triangles

GRAVITY = np.array([0.0, -9.81, 0.0])


# --- the surface, one spring at a time


def number_of_springs(rows, cols):
    """Gomes 2016, eq. 5.5."""
    return (
        rows * (cols - 1)
        + cols * (rows - 1)
        + 2 * (rows - 1) * (cols - 1)
        + rows * max(0, cols - 2)
        + cols * max(0, rows - 2)
    )


def accelerations(springs, mass, gravity, position, velocity, force):
    """Gomes 2016, eq. 3.5 and 3.7, for every node, shape (nodes, 3)."""
    total = [np.array(f, float) for f in force]
    for s, (i, j) in enumerate(springs.pairs):
        apart = position[i] - position[j]
        length = np.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
        stretch = length - springs.rest_length[s]
        pull = -springs.stiffness[s] * stretch * apart / length
        pull = pull - springs.damping[s] * (velocity[i] - velocity[j])
        total[i] = total[i] + pull
        total[j] = total[j] - pull
    return np.array([gravity + f / m for f, m in zip(total, mass, strict=True)])


def acceleration_jacobians(springs, mass, position, clamp=False):
    """Jap and Jav (eq. 3.14, 3.15, 3.20, 3.22; divided by the masses), (3 nodes, 3 nodes) each."""
    n = len(mass)
    by_position, by_velocity = np.zeros((n, n, 3, 3)), np.zeros((n, n, 3, 3))
    for s, (i, j) in enumerate(springs.pairs):
        apart = position[i] - position[j]
        length = np.linalg.norm(apart)
        along = np.outer(apart, apart) / length**2
        geometric = 1 - springs.rest_length[s] / length
        if clamp:
            geometric = max(geometric, 0.0)
        stiff = springs.stiffness[s] * (geometric * (np.eye(3) - along) + along)
        damp = springs.damping[s] * np.eye(3)
        for a, b in ((i, j), (j, i)):
            by_position[a, a] -= stiff / mass[a]
            by_position[a, b] += stiff / mass[a]
            by_velocity[a, a] -= damp / mass[a]
            by_velocity[a, b] += damp / mass[a]
    flat = (by.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n) for by in (by_position, by_velocity))
    return tuple(flat)


def state_jacobian(model, position, clamp=False):
    """Eq. 3.23 for the free nodes of a mass-spring model, dense."""
    rows = (3 * model.free[:, None] + np.arange(3)).ravel()
    jap, jav = acceleration_jacobians(model.springs, model.mass, position, clamp)
    n = len(rows)
    cut = np.ix_(rows, rows)
    return np.block([[np.zeros((n, n)), np.eye(n)], [jap[cut], jav[cut]]])


# --- the textbooks' filter


def kalman_predict(x, P, F, Q):
    """Mean and covariance after a linear step."""
    return F @ x, F @ P @ F.T + Q


def kalman_update(x, P, H, R, z):
    """Mean and covariance given z, by the explicit inverse and Joseph's form."""
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    rest = np.eye(len(P)) - K @ H
    return x + K @ (z - H @ x), rest @ P @ rest.T + K @ R @ K.T


def trapezoid(F, noise):
    """Covariance of the noise of a step: half of it before and half after."""
    return F @ np.diag(noise / 2) @ F.T + np.diag(noise / 2)


def selection(rows, size):
    """H as a matrix, from the rows that it selects."""
    H = np.zeros((len(rows), size))
    H[np.arange(len(rows)), rows] = 1.0
    return H


def random_covariance(rng, size):
    root = rng.normal(size=(size, 2 * size))
    return root @ root.T / (2 * size)


def noise_over(drift, dt):
    """Integral of exp(drift s) l l' exp(drift s)' over dt, l the last unit vector, by Gauss."""
    node, weight = np.polynomial.legendre.leggauss(40)
    last = expm(drift * (dt * (node + 1) / 2)[:, None, None])[:, :, -1]
    return np.einsum('k,ki,kj->ij', dt * weight / 2, last, last)


class KinematicTrack:
    """One marker by filterpy; drift, shape (n, n), of its position and n - 1 derivatives.

    The three coordinates share F, Q, H and R, so that the state has a column for each.
    """

    def __init__(self, drift, density, sigma, position, spread=1.0):
        self.drift, self.density = drift, density
        self.filter = KalmanFilter(dim_x=len(drift), dim_z=1)
        self.filter.x = np.zeros((len(drift), 3))
        self.filter.x[0] = position
        self.filter.P = np.diag([sigma**2] + [spread**2] * (len(drift) - 1))
        self.filter.R = np.array([[sigma**2]])

    def over(self, dt):
        return expm(self.drift * dt), self.density * noise_over(self.drift, dt)

    def predict(self, dt):
        step, noise = self.over(dt)
        self.filter.predict(F=step, Q=noise)

    def update(self, position):
        # filterpy reshapes z to one column unless H is given with it
        observed = np.eye(1, len(self.drift))
        self.filter.update(np.reshape(position, (1, 3)), H=observed)

    def extrapolate(self, horizon):
        """Position, velocity and acceleration, shape (3, 3)."""
        derivatives = np.zeros((3, 3))
        derivatives[: len(self.drift)] = self.over(horizon)[0] @ self.filter.x
        return derivatives

    def variance(self, horizon):
        step, noise = self.over(horizon)
        return (step @ self.filter.P @ step.T + noise)[0, 0]


# --- numbers about functions


def central_differences(function, x, step):
    """Jacobian of a function of x; error of order step^2, and rounding of order 1e-16 / step."""
    columns = []
    for k in range(len(x)):
        there, back = x.copy(), x.copy()
        there[k] += step
        back[k] -= step
        columns.append((function(there) - function(back)) / (2 * step))
    return np.array(columns).T


def order_of(errors, steps):
    """Slope of the errors over the steps in a log-log plot."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


# --- models


class Linear:
    """x' = A x; offers all that the integrators ask of a model."""

    def __init__(self, A):
        self.A, self.linear_part = A, LinearPart.of_matrix(A)
        self.dim_x, self.dim_u = len(A), 0

    def f(self, x, u):
        return self.A @ x

    def jac(self, x, u):
        return sparse.csr_array(self.A)

    def jac_input(self, x, u):
        return sparse.csr_array((self.dim_x, 0))

    def input_after(self, u, dt):
        return u

    def linearise(self, x, u):
        return LinearAt(self.A, self.A @ x)


@dataclass
class LinearAt:
    A: np.ndarray
    slope: np.ndarray

    def solver(self, dt):
        return lambda b: np.linalg.solve(np.eye(len(self.A)) - dt * self.A, b)

    def change(self, dt, solver):
        return solver(dt * self.slope)

    def tangent(self, dt, solver, change):
        one = np.eye(len(self.A))
        return DenseTangent(one + solver(dt * self.A))


def damped_oscillators(rng, count):
    """Stable linear model of coupled oscillators around 1 rad/s, x = [p; v]."""
    root = rng.normal(size=(count, count))
    stiffness = root @ root.T / count + 0.5 * np.eye(count)
    zero, one = np.zeros((count, count)), np.eye(count)
    return Linear(np.block([[zero, one], [-stiffness, -0.3 * one]]))


def flat_grid(rows, cols, side=0.2):
    """Nodes of a flat grid in the x-y plane [m], shape (rows cols, 3)."""
    grid = np.zeros((rows, cols, 3))
    grid[..., 0] = side * np.arange(cols)
    grid[..., 1] = -side * np.arange(rows)[:, None]
    return grid.reshape(-1, 3)


def lengths(pairs, position):
    return np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)


def random_surface(rng, rows, cols, driven=(), rest=(0.7, 1.3), compression=1.0, air=False):
    """Mesh whose springs, masses and gravity all differ, and a state and input far from rest.

    `rest`: range of the rest lengths, relative to the lengths in the state.
    """
    pairs = np.concatenate(list(grid_pairs(rows, cols).values()))
    position = flat_grid(rows, cols) + rng.normal(0, 0.03, (rows * cols, 3))
    velocity = rng.normal(0, 0.5, (rows * cols, 3))
    springs = Springs(
        pairs,
        rng.uniform(20, 90, len(pairs)),
        rng.uniform(0.05, 0.2, len(pairs)),
        lengths(pairs, position) * rng.uniform(*rest, len(pairs)),
        compression,
    )
    mass = rng.uniform(0.01, 0.03, rows * cols)
    windy = (
        Air(grid_triangles(rows, cols), rng.uniform(0.2, 1.0, rows * cols), 0.3) if air else None
    )
    model = MassSpring(springs, mass, driven, rng.normal(0, 5, 3), windy)
    x = np.concatenate([position[model.free].ravel(), velocity[model.free].ravel()])
    force = rng.normal(0, 0.2, (len(model.free), 3))
    u = model.input(position[model.driven], velocity[model.driven], force)
    if air:
        u[-len(model.free) - 3 :] = rng.normal(0, 0.3, len(model.free) + 3)
    return model, x, u


def even_surface(rows, cols, driven=(), gravity=GRAVITY, stiffness=60.0, damping=0.1, mass=0.017):
    """Mesh of equal springs and masses, at rest as a flat grid; with that grid."""
    pairs = np.concatenate(list(grid_pairs(rows, cols).values()))
    flat = flat_grid(rows, cols)
    size = np.ones(len(pairs))
    springs = Springs(pairs, stiffness * size, damping * size, lengths(pairs, flat))
    return MassSpring(springs, np.full(rows * cols, mass), driven, gravity), flat
