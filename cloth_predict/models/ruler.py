"""A rigid bar that slides on a table on two points, with dry friction (Goeller et al. 2015, 2.1).

Vectors in the plane of the table are complex numbers here, x + iy; divided by exp(i alpha) they
are along the bar (real part) and across it. What belongs to the contacts has a last axis of two.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cloth_predict.types import BoolArray, FloatArray

ComplexArray = NDArray[np.complex128]

ANGLE, VELOCITY, SPIN = 2, slice(3, 5), 5
"""Where the state has alpha [rad], V_x, V_y [m/s] and V_alpha [rad/s]; x_G, y_G [m] come first."""
TINY = 1e-300
"""Speed [m/s] under which a contact has none, so that its direction exists."""


@dataclass(frozen=True)
class Ruler:
    """A bar of length L [m] on contacts A, L1 [m] behind its centre, and B, L2 [m] before it.

    State x = [x_G, y_G, alpha, V_x, V_y, V_alpha]; no input. mu: Coulomb's coefficient; g [m/s^2];
    share: part of the weight that rests on A, from 0 to 1; None is that of statics,
    L2 / (L1 + L2). The mass cancels: weight, friction and the inertia m L^2 / 12 are all in
    proportion to it.

    States may come many at once, of shape (..., 6), with one parameter for all or, of states of
    shape (points, 6), one for each.
    """

    L: FloatArray | float
    L1: FloatArray | float
    L2: FloatArray | float
    mu: FloatArray | float
    g: float = 9.81
    share: float | None = None

    dim_x = 6
    dim_u = 0

    @cached_property
    def inertia(self) -> FloatArray:
        """Moment of inertia about the centre by the mass [m^2], shape (...)."""
        return np.asarray(self.L) ** 2 / 12.0

    @cached_property
    def places(self) -> FloatArray:
        """Where the contacts are along the bar, from its centre [m], shape (..., 2)."""
        return np.array([np.negative(self.L1), self.L2]).T

    @cached_property
    def grip(self) -> FloatArray:
        """Greatest friction at the contacts by the mass of the bar [N/kg], shape (..., 2)."""
        span = np.add(self.L1, self.L2)
        on_a = self.L2 / span if self.share is None else np.full_like(span, self.share)
        return np.array([on_a, 1.0 - on_a]).T * (self.g * np.asarray(self.mu)[..., None])

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state (the equations of section 2.1), while both contacts slide.

        A contact without velocity has no friction: what holds it there is found by `arrested`.
        """
        turn = np.exp(1j * x[..., ANGLE])
        pulls = self._pulls(x, turn)
        force = pulls.sum(axis=-1) * turn
        after = np.empty_like(x)
        after[..., :3] = x[..., 3:]
        after[..., 3], after[..., 4] = force.real, force.imag
        after[..., SPIN] = (self._levers * pulls.imag).sum(axis=-1)
        return after

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x, of one state, while both contacts slide."""
        along = np.array([np.cos(x[ANGLE]), np.sin(x[ANGLE])])
        across = np.array([-along[1], along[0]])
        full = np.zeros((6, 6))
        full[:3, 3:] = np.eye(3)
        for at, grip in zip(self.places, self.grip, strict=True):
            velocity = x[VELOCITY] + at * x[SPIN] * across
            speed = np.hypot(*velocity)
            if speed == 0.0:
                continue
            sideways = np.array([-velocity[1], velocity[0]]) / speed
            by_velocity = -grip / speed * np.outer(sideways, sideways)
            pull = np.zeros((2, 6))
            pull[:, ANGLE] = -at * x[SPIN] * (by_velocity @ along)
            pull[:, VELOCITY] = by_velocity
            pull[:, SPIN] = at * (by_velocity @ across)
            full[VELOCITY] += pull
            full[SPIN] += at / self.inertia * (across @ pull)
            full[SPIN, ANGLE] += at / self.inertia * grip / speed * (along @ velocity)
        return sparse.csr_array(full)

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to u, shape (6, 0): there is no input."""
        return sparse.csr_array((6, 0))

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input dt [s] later: none."""
        return u

    def contacts(self, x: FloatArray) -> ComplexArray:
        """Places of A and B [m] as x + iy, shape (..., 2)."""
        turn = np.exp(1j * x[..., ANGLE])
        return np.asarray(_centre(x)[..., None] + self.places * turn[..., None])

    def friction(self, x: FloatArray) -> ComplexArray:
        """Friction on A and B by the mass of the bar [N/kg] as x + iy, shape (..., 2)."""
        turn = np.exp(1j * x[..., ANGLE])
        return np.asarray(self._pulls(x, turn) * turn[..., None])

    def slip(self, x: FloatArray) -> FloatArray:
        """Speeds of A and B [m/s], shape (..., 2)."""
        return np.abs(self._velocities(x, np.exp(1j * x[..., ANGLE])))

    def energy(self, x: FloatArray) -> FloatArray:
        """Kinetic energy by the mass of the bar [J/kg], shape (...)."""
        return np.asarray(
            0.5 * (np.square(x[..., VELOCITY]).sum(axis=-1) + self.inertia * x[..., SPIN] ** 2)
        )

    def resting(self, x: FloatArray) -> BoolArray:
        """Whether the bar is at rest, shape (...)."""
        return np.asarray((x[..., 3:] == 0.0).all(axis=-1))

    def arrested(self, x: FloatArray, dt: float) -> tuple[FloatArray, BoolArray]:
        """State after dt [s] where friction stops a contact in that time; where it does, (...).

        Friction over the step is an impulse at each contact, of at most dt mu N. Where two such
        impulses take all motion away, the bar comes to rest; where one holds its contact while the
        other slides on, the bar turns about it. Both are closed forms; an implicit step (Moreau
        1988) knows no other case but that both slide, for which the state returned is of no use.
        """
        turn = np.exp(1j * x[..., ANGLE])
        velocities, impulse = self._velocities(x, turn), dt * self.grip
        after, held = x, np.zeros(x.shape[:-1], bool)
        quickest = self._quickest + np.abs(self.places) * x[..., SPIN, None] ** 2
        slow = np.abs(velocities) <= dt * quickest
        if not slow.any():
            return after, held
        for pivot in (0, 1):
            if slow[..., pivot].any():
                turned, holds = self._turned(x, turn, pivot, impulse, dt)
                after = np.where(holds[..., None], turned, after)
                held = held | holds
        stops = self._stops(x, turn, impulse)
        after = np.where(stops[..., None], self._stopped(x, velocities), after)
        return after, held | stops

    def _stops(self, x: FloatArray, turn: ComplexArray, impulse: FloatArray) -> BoolArray:
        """Whether impulses of that size at the contacts can take all motion away.

        Across the bar the motion determines them; along it the two share what is left as they can.
        """
        velocity = (_velocity(x) / turn)[..., None]
        other, spin = self.places[..., ::-1], (self.inertia * x[..., SPIN])[..., None]
        across = (other * velocity.imag - spin) / (other - self.places)
        left = impulse**2 - across**2
        room = np.sqrt(np.maximum(left, 0.0)).sum(axis=-1)
        return np.asarray((left >= 0.0).all(axis=-1) & (np.abs(velocity.real[..., 0]) <= room))

    def _stopped(self, x: FloatArray, velocities: ComplexArray) -> FloatArray:
        """State at rest: friction of constant direction takes the energy away in 2 energy / power.

        That is within the step, as the impulses of `_stops` are no larger than those of friction.
        """
        power = (self.grip * np.abs(velocities)).sum(axis=-1)
        time = 2.0 * self.energy(x) / np.where(power > 0.0, power, 1.0)
        after = np.zeros_like(x)
        after[..., :3] = x[..., :3] + 0.5 * time[..., None] * x[..., 3:]
        return after

    def _turned(
        self, x: FloatArray, turn: ComplexArray, pivot: int, impulse: FloatArray, dt: float
    ) -> tuple[FloatArray, BoolArray]:
        """State after turning about a contact that is held, and whether friction can hold it.

        The angular momentum about that contact loses what friction at the other one takes.
        """
        at, other = self.places[..., pivot], self.places[..., 1 - pivot]
        velocity, inertia = _velocity(x), self.inertia + at**2
        momentum = self.inertia * x[..., SPIN] - at * (velocity / turn).imag
        left = np.abs(momentum) - np.abs(other - at) * impulse[..., 1 - pivot]
        sign = np.sign(momentum)
        first, last = momentum / inertia, sign * np.maximum(left, 0.0) / inertia
        angle = 0.5 * dt * (first + last)
        end = turn * np.exp(1j * angle)
        sliding = -1j * sign * np.sign(other - at) * impulse[..., 1 - pivot]
        later = -1j * at * last * end
        holding = later - velocity - sliding * turn * np.exp(0.5j * angle)
        holds = (np.abs(holding) <= impulse[..., pivot]) & (left > 0.0)
        centre = _centre(x) + at * (turn - end)
        state = (centre.real, centre.imag, x[..., ANGLE] + angle, later.real, later.imag, last)
        return np.stack(state, axis=-1), np.asarray(holds)

    @cached_property
    def _across(self) -> ComplexArray:
        return np.asarray(1j * self.places)

    @cached_property
    def _levers(self) -> FloatArray:
        """Angular acceleration by each unit of friction across the bar [1/m], shape (..., 2)."""
        return np.asarray(self.places / self.inertia[..., None])

    @cached_property
    def _quickest(self) -> FloatArray:
        """Acceleration of each contact [m/s^2], (..., 2), that friction at both cannot exceed."""
        by_other = np.abs(self.places[..., None] * self._levers[..., None, :])
        return np.asarray((self.grip[..., None, :] * (1.0 + by_other)).sum(axis=-1))

    def _pulls(self, x: FloatArray, turn: ComplexArray) -> ComplexArray:
        """Friction on the contacts by the mass [N/kg], along and across the bar, (..., 2)."""
        velocity = self._velocities(x, turn)
        return np.asarray(-self.grip * velocity / np.maximum(np.abs(velocity), TINY))

    def _velocities(self, x: FloatArray, turn: ComplexArray) -> ComplexArray:
        """Velocities of the contacts [m/s], along and across the bar, shape (..., 2)."""
        centre = (_velocity(x) * turn.conj())[..., None]
        return np.asarray(centre + self._across * x[..., SPIN, None])


def _centre(x: FloatArray) -> ComplexArray:
    return np.asarray(x[..., 0] + 1j * x[..., 1])


def _velocity(x: FloatArray) -> ComplexArray:
    return np.asarray(x[..., 3] + 1j * x[..., 4])
