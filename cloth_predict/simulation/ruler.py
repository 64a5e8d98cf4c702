"""Recordings of a sliding bar with known truth, by an adaptive solver that knows its events.

It shares nothing with the step of the filters but the forces: DOP853 runs until a contact stops,
and a bar that turns about a contact has a closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from cloth_predict.formats.bag import Truth
from cloth_predict.models.ruler import ANGLE, SPIN, Ruler
from cloth_predict.simulation.filming import Progress, frame_stamps
from cloth_predict.types import FloatArray

NEAR = 1e-7
"""Speed [m/s] under which a contact has stopped: friction takes it away within a microsecond."""
AWAY = 1e-4
"""Time [s] over which a contact that passes through zero speed is not taken to have stopped."""
LONGEST = 1e3
"""Time [s] within which any bar comes to rest."""
NO_INPUT = np.zeros(0)
Piece = Callable[[float], FloatArray]
"""State at a time [s]."""


@dataclass(frozen=True)
class Shot:
    """A bar and the state, shape (6,), with which it is let go."""

    ruler: Ruler
    start: FloatArray


def _annex(mu: float, contact: float, velocity: tuple[float, float], spin: float) -> Shot:
    start = np.array([0.0, 0.0, 0.0, *velocity, spin])
    return Shot(Ruler(1.0, contact, contact, mu, g=10.0), start)


ANNEX_A = {
    3: _annex(0.2, 0.1, (3.0, 1.0), 10.0),
    4: _annex(0.3, 0.1, (1.0, 1.0), 10.0),
    5: _annex(0.3, 0.4, (2.0, 3.0), 1.0),
}
"""The scenarios by their version (Goeller et al. 2015, annex A)."""


def random_shot(rng: np.random.Generator, g: float = 9.81) -> Shot:
    """A bar of a metre, shot as it comes.

    Friction 0.1 to 0.4; each contact 0.05 to 0.45 m from the centre; speed 1 to 4 m/s in any
    direction; spin 1 to 10 rad/s, either way; any angle. The ranges hold the scenarios of annex A.
    """
    mu, behind, before = rng.uniform((0.1, 0.05, 0.05), (0.4, 0.45, 0.45))
    speed, heading, angle = rng.uniform((1.0, -np.pi, -np.pi), (4.0, np.pi, np.pi))
    spin = rng.uniform(1.0, 10.0) * rng.choice((-1.0, 1.0))
    velocity = speed * np.array([np.cos(heading), np.sin(heading)])
    return Shot(Ruler(1.0, behind, before, mu, g), np.array([0.0, 0.0, angle, *velocity, spin]))


@dataclass(frozen=True)
class Slide:
    """A motion in pieces: since when [s] each holds, and its states by time; the last is rest."""

    since: FloatArray
    pieces: tuple[Piece, ...]

    @property
    def duration(self) -> float:
        """Time [s] until the bar rests."""
        return float(self.since[-1])

    def at(self, times: FloatArray) -> FloatArray:
        """States at times [s], shape (frames,), shape (frames, 6)."""
        which = np.searchsorted(self.since, times, side='right') - 1
        return np.array([self.pieces[k](t) for k, t in zip(which, times, strict=True)])


def slide(shot: Shot, tolerance: float = 1e-11) -> Slide:
    """Motion of a bar until it rests; tolerance: relative, of the solver."""
    ruler, x, time = shot.ruler, np.array(shot.start, float), 0.0
    since: list[float] = []
    pieces: list[Piece] = []
    while (ruler.slip(x) > 2.0 * NEAR).any():
        since.append(time)
        holds = [k for k in (0, 1) if ruler.slip(x)[k] <= 2.0 * NEAR and _can_hold(ruler, x, k)]
        if holds:
            piece, duration = _turning(ruler, x, time, holds[0])
        else:
            piece, duration = _sliding(ruler, x, time, tolerance)
        pieces.append(piece)
        time += duration
        x = piece(time)
    rest = np.append(x[:3], np.zeros(3))
    return Slide(np.array([*since, time]), (*pieces, lambda time: rest))


def _sliding(ruler: Ruler, x: FloatArray, time: float, tolerance: float) -> tuple[Piece, float]:
    """Motion until a contact stops; one that has just stopped and cannot be held is let go."""

    def event(contact: int) -> Callable[[float, FloatArray], float]:
        def slower(time: float, x: FloatArray) -> float:
            return float(ruler.slip(x)[contact] - NEAR)

        slower.terminal, slower.direction = True, -1.0  # type: ignore[attr-defined]
        return slower

    passing = (ruler.slip(x) <= 2.0 * NEAR).any()
    found = solve_ivp(
        lambda time, x: ruler.f(x, NO_INPUT),
        (time, time + (AWAY if passing else LONGEST)),
        x,
        method='DOP853',
        rtol=tolerance,
        atol=0.1 * tolerance,
        events=None if passing else [event(0), event(1)],
        dense_output=True,
    )
    return found.sol, float(found.t[-1] - time)


def _can_hold(ruler: Ruler, x: FloatArray, pivot: int) -> bool:
    """Whether friction can hold a contact about which the bar turns, slower and slower."""
    at, other = ruler.places[[pivot, 1 - pivot]]
    spin, slower = x[SPIN], _slower(ruler, x, pivot)
    sliding = -1j * np.sign(spin * (other - at)) * ruler.grip[1 - pivot]
    needed = -at * (1j * slower - spin**2) - sliding
    return bool(np.abs(needed) <= ruler.grip[pivot])


def _slower(ruler: Ruler, x: FloatArray, pivot: int) -> float:
    """Angular acceleration [rad/s^2] of a bar that turns about a contact."""
    at, other = ruler.places[[pivot, 1 - pivot]]
    moment = -np.sign(x[SPIN]) * np.abs(other - at) * ruler.grip[1 - pivot]
    return float(moment / (ruler.inertia + at**2))


def _turning(ruler: Ruler, x: FloatArray, time: float, pivot: int) -> tuple[Piece, float]:
    """Motion about a contact that is held, until the bar rests."""
    at, slower = ruler.places[pivot], _slower(ruler, x, pivot)
    centre = ruler.contacts(x)[pivot]
    duration = float(np.abs(x[SPIN] / slower))

    def piece(now: float) -> FloatArray:
        since = min(now - time, duration)
        spin = x[SPIN] + slower * since
        angle = x[ANGLE] + x[SPIN] * since + 0.5 * slower * since**2
        along = at * np.exp(1j * angle)
        place, velocity = centre - along, -1j * spin * along
        return np.array([place.real, place.imag, angle, velocity.real, velocity.imag, spin])

    return piece, duration


def measured(
    states: FloatArray,
    length: float,
    rng: np.random.Generator,
    position_noise: float = 1e-3,
    angle_noise: float = np.radians(0.5),
) -> FloatArray:
    """Measurements [x_G, y_G, L, alpha] [m, rad] with noise, (frames, 4); states, (frames, 6)."""
    exact = np.insert(states[:, :3], 2, length, axis=1)
    return exact + rng.normal(size=exact.shape) * [*[position_noise] * 3, angle_noise]


def ruler(rng: np.random.Generator, duration: float, progress: Progress) -> Truth:
    """A bar shot at random, at 100 Hz: its two ends, on a table at height zero."""
    shot, stamps = random_shot(rng), frame_stamps(duration)
    states = slide(shot).at(stamps / 1e9)
    half = 0.5 * shot.ruler.L * np.exp(1j * states[:, ANGLE])
    ends = states[:, 0] + 1j * states[:, 1] + np.array([-half, half])
    surface = np.stack([ends.real, ends.imag, np.zeros_like(ends.real)], axis=-1)
    progress(duration)
    return Truth(stamps, surface.transpose(1, 0, 2)[:, None], np.array([[0, 1]]))


def ruler_labels(markers: int) -> tuple[str, ...]:
    """Label of each end."""
    return tuple(f'ruler:{end}' for end in range(markers))
