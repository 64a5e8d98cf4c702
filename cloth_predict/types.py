"""The nouns of the project: beliefs, recordings and the four protocols.

Conventions: SI units; positions are node-major; a state is ``x = [p; v]`` (Gomes 2016, eq. 3.2);
time is integer nanoseconds until the one place that makes a ``dt`` of it (`tracker.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
Solver: TypeAlias = Callable[[FloatArray], FloatArray]

UNLABELLED_PREFIXES = ('unlabeled', 'unlabelled')


def read_only(array: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return a view that cannot be written to."""
    view = np.asarray(array).view()
    view.flags.writeable = False
    return view


class Belief(Protocol):
    """What a filter carries from one frame to the next; never changed once made."""

    @property
    def mean(self) -> FloatArray:
        """Expected state, shape (dim_x,)."""

    def marginals(self, rows: IntArray) -> FloatArray:
        """Covariances of k groups of m states each, rows of shape (k, m), shape (k, m, m)."""


@dataclass(frozen=True)
class Gaussian:
    """A belief: mean, shape (dim_x,), and covariance, shape (dim_x, dim_x); both read-only."""

    mean: FloatArray
    cov: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, 'mean', read_only(self.mean))
        object.__setattr__(self, 'cov', read_only(self.cov))

    def marginals(self, rows: IntArray) -> FloatArray:
        """Covariances of k groups of m states each, rows of shape (k, m), shape (k, m, m)."""
        return np.asarray(self.cov[rows[:, :, None], rows[:, None, :]])


@dataclass(frozen=True)
class Innovation:
    """What an update learnt: residual z - h(x), shape (m,), and its covariance S, shape (m, m)."""

    residual: FloatArray
    cov: FloatArray
    nis: float
    """Normalised innovation squared, residual' S^-1 residual; chi-square with m degrees."""


@dataclass(frozen=True)
class MarkerSequence:
    """A recording of point markers.

    stamps [ns], shape (frames,), int64, as recorded; labels, one per marker;
    positions [m], shape (frames, markers, 3), NaN where not visible;
    visible, shape (frames, markers).
    """

    stamps: IntArray
    labels: tuple[str, ...]
    positions: FloatArray
    visible: BoolArray
    frame_id: str = ''
    """Frame of the coordinates; empty where the recording does not name one."""

    def __post_init__(self) -> None:
        frames, markers = len(self.stamps), len(self.labels)
        if self.positions.shape != (frames, markers, 3):
            raise ValueError(
                f'positions have shape {self.positions.shape}, '
                f'expected ({frames}, {markers}, 3) from the stamps and labels'
            )
        if self.visible.shape != (frames, markers):
            raise ValueError(
                f'visible has shape {self.visible.shape}, expected ({frames}, {markers})'
            )
        if len(set(self.labels)) != markers:
            raise ValueError('labels are not unique')
        for name in ('stamps', 'positions', 'visible'):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def unlabelled(self) -> BoolArray:
        """Which columns are trajectories that the mocap system did not identify."""
        return np.array([is_unlabelled(label) for label in self.labels], bool)

    def select(self, columns: IntArray | list[int]) -> MarkerSequence:
        """Return the recording with these marker columns only, in this order."""
        index = np.asarray(columns, np.int64)
        return MarkerSequence(
            self.stamps,
            tuple(self.labels[i] for i in index),
            self.positions[:, index],
            self.visible[:, index],
            self.frame_id,
        )

    def beside(self, other: MarkerSequence) -> MarkerSequence:
        """Return the recording with the marker columns of another of the same frames after it."""
        return MarkerSequence(
            self.stamps,
            self.labels + other.labels,
            np.concatenate([self.positions, other.positions], axis=1),
            np.concatenate([self.visible, other.visible], axis=1),
            self.frame_id,
        )


@dataclass(frozen=True)
class Surface:
    """All nodes at one time.

    stamp [ns]; position [m], velocity [m/s], acceleration [m/s^2], each (nodes, 3);
    covariance [m^2] of the position of each node, shape (nodes, 3, 3); normal, shape (nodes, 3):
    unit, outward, of a closed surface only.
    """

    stamp: int
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    covariance: FloatArray
    normal: FloatArray | None = None

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of a coordinate of the position [m], shape (nodes,)."""
        variance = np.trace(self.covariance, axis1=1, axis2=2) / 3.0
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def is_unlabelled(label: str) -> bool:
    """Tell whether a label is a mocap system's name for a marker that it did not identify."""
    return label.lower().startswith(UNLABELLED_PREFIXES)


class Dynamics(Protocol):
    """Motion in continuous time, x' = f(x, u); pure; knows no time step and no filter."""

    @property
    def dim_x(self) -> int:
        """Number of states."""

    @property
    def dim_u(self) -> int:
        """Number of known inputs (driven nodes, external forces)."""

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x, shape (dim_x, dim_x)."""

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to u, shape (dim_x, dim_u)."""

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input dt [s] later, as far as the input itself tells (driven nodes have velocities)."""


class Linearised(Protocol):
    """A model at one state, as an implicit step (I - dt J~) dx = dt (f + dt df/du u') needs it.

    The solve may use a J~ that differs from J where that keeps it positive definite; `tangent`
    accounts for it, so that the step's own derivative is exact all the same.
    """

    def solver(self, dt: float) -> Solver:
        """Return the solver that a step of dt [s] from here uses, for `change` and `tangent`."""

    def change(self, dt: float, solver: Solver) -> FloatArray:
        """Change of the state in a step of dt [s], shape (dim_x,).

        The solver may be that of a state nearby: the step stays consistent, of first order.
        """

    def tangent(self, dt: float, solver: Solver, change: FloatArray) -> Tangent:
        """Derivative of the step that makes this change, for the solver of this state."""


class StiffDynamics(Dynamics, Protocol):
    """Motion that also offers the linear solve of an implicit step."""

    def linearise(self, x: FloatArray, u: FloatArray) -> Linearised:
        """Return the model at (x, u)."""


class Tangent(Protocol):
    """The derivative F of a step, applied from either side."""

    def push(self, columns: FloatArray) -> FloatArray:
        """Return F C, both of shape (dim_x, m)."""

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F, both of shape (m, dim_x)."""

    def sandwich(self, cov: FloatArray) -> FloatArray:
        """Return F P F' of a symmetric P, shape (dim_x, dim_x); here by pushing it twice."""
        return self.push(self.push(cov).T)

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step, (dim_x, m), with its inputs, shape (dim_u, m)."""


class Integrator(Protocol):
    """One step in time of any Dynamics, and the exact Jacobian of that step."""

    def step(self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float) -> FloatArray:
        """State after dt [s], shape (dim_x,); u is held over the step."""

    def step_jac(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """State after dt [s] and its derivative F with respect to x, shape (dim_x, dim_x).

        Here it is the matrix of the map.
        """
        after, tangent = self.step_tangent(model, x, u, dt)
        return after, tangent.push(np.eye(model.dim_x))

    def step_tangent(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, Tangent]:
        """State after dt [s] and its derivative F as a map, where F itself is not needed."""


class Observation(Protocol):
    """What a sensor sees of a state, with its noise covariance."""

    @property
    def cov(self) -> FloatArray:
        """Noise variances, shape (m,), or covariance, shape (m, m)."""

    def h(self, x: FloatArray) -> FloatArray:
        """Measurement expected at x, shape (m,)."""

    def jac(self, x: FloatArray) -> FloatArray | IntArray:
        """Derivative of h, shape (m, dim_x); or, as integers of shape (m,), the rows of x seen."""


B = TypeVar('B', bound=Belief)


class Filter(Protocol[B]):
    """A recursive estimator; holds no state of its own: all that it remembers is in the belief."""

    def start(self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray) -> B:
        """Belief before the first measurement, from a mean and a diagonal covariance."""

    def predict(self, belief: B, model: Dynamics, u: FloatArray, q: FloatArray, dt: float) -> B:
        """Belief dt [s] later; q, shape (dim_x,), is the spectral density of the process noise."""

    def update(self, belief: B, obs: Observation, z: FloatArray) -> tuple[B, Innovation]:
        """Belief given the measurement z, shape (m,), and what was learnt."""

    def forecast(
        self,
        belief: B,
        model: Dynamics,
        inputs: Sequence[FloatArray],
        q: FloatArray,
        dt: float,
        rows: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Mean, shape (dim_x,), after one step of dt [s] per input, and covariances, (k, m, m).

        The covariances are those of k groups of m states each, rows of shape (k, m). Here by
        `predict`, step by step: for filters without a shorter way.
        """
        for u in inputs:
            belief = self.predict(belief, model, u, q, dt)
        return belief.mean, belief.marginals(rows)
