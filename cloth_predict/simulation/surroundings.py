"""What moves a simulated cloth: the air, and the rail on which it hangs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cloth_predict.types import FloatArray


@dataclass(frozen=True)
class Gusts:
    """Turbulence of the fan's jet: a sum of sinusoids carried along with the wind.

    frequency [Hz], phase [rad], size (share of the mean speed), each of shape (waves,); wave
    numbers across and down the cloth [rad/m], shape (waves, 2).
    """

    frequency: FloatArray
    phase: FloatArray
    size: FloatArray
    wave_number: FloatArray

    @classmethod
    def draw(cls, rng: np.random.Generator, waves: int = 24, intensity: float = 0.3) -> Gusts:
        """Draw waves from 0.2 to 8 Hz whose power falls with the -5/3 power of frequency."""
        frequency = np.exp(rng.uniform(np.log(0.2), np.log(8.0), waves))
        power = frequency ** (-5 / 3) * frequency  # equal numbers per octave
        size = intensity * np.sqrt(2 * power / power.sum())
        return cls(
            frequency,
            rng.uniform(0, 2 * np.pi, waves),
            size,
            rng.normal(0.0, 4.0, (waves, 2)) * np.sqrt(frequency)[:, None],
        )

    def __call__(self, position: FloatArray, time: float) -> FloatArray:
        """Relative change of the speed at positions [m], shape (nodes, 3), at time [s]."""
        angle = position[:, :2] @ self.wave_number.T - 2 * np.pi * self.frequency * time
        return np.asarray(np.cos(angle + self.phase) @ self.size)


@dataclass(frozen=True)
class Fan:
    """A fan behind the cloth that turns from side to side.

    distance [m] from the cloth; middle [m], shape (3,), of the cloth; speed [m/s] in the jet;
    swing [rad] to each side; period [s] of a full swing; spread [rad] of the jet.
    """

    gusts: Gusts
    middle: FloatArray
    distance: float = 1.5
    speed: float = 4.0
    swing: float = 0.6
    period: float = 5.0
    spread: float = 0.3

    def __call__(self, position: FloatArray, time: float) -> FloatArray:
        """Velocity of the air [m/s] at positions [m], shape (nodes, 3), at time [s]."""
        ray = position - (self.middle - np.array([0.0, 0.0, self.distance]))
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        heading = self.swing * np.sin(2 * np.pi * time / self.period - np.pi / 2)
        aim = np.array([np.sin(heading), 0.0, np.cos(heading)])
        angle = np.arccos(np.clip(ray @ aim, -1.0, 1.0))
        rise = 1.0 - np.exp(-time)  # the fan spins up, so that the cloth starts from rest
        speed = rise * self.speed * np.exp(-0.5 * (angle / self.spread) ** 2)
        return np.asarray(ray * (speed * (1.0 + self.gusts(position, time)))[:, None])


@dataclass(frozen=True)
class Draught:
    """Air that moves through a room, straight at the cloth, with gusts; speed [m/s]."""

    gusts: Gusts
    speed: float = 0.7

    def __call__(self, position: FloatArray, time: float) -> FloatArray:
        """Velocity of the air [m/s] at positions [m], shape (nodes, 3), at time [s]."""
        velocity = np.zeros_like(position)
        rise = 1.0 - np.exp(-time)  # so that the cloth starts from rest
        velocity[:, 2] = rise * self.speed * (1.0 + self.gusts(position, time))
        return velocity


Air = Callable[[FloatArray, float], FloatArray]
"""Velocity of the air [m/s] at positions [m], shape (nodes, 3), at a time [s]."""


@dataclass(frozen=True)
class Rail:
    """A rail on which what the cloth hangs from goes to and fro.

    speed [m/s] on the straight; straight [s] and turn [s]: how long each takes. In a turn the
    velocity is a cosine, so that the acceleration is continuous.
    """

    speed: float = 1.0
    straight: float = 0.8
    turn: float = 1.0

    def __call__(self, time: float) -> tuple[float, float]:
        """Place [m] along the rail and velocity [m/s] at a time [s]; it begins at rest, at 0."""
        half = self.straight + self.turn
        passes, within = divmod(time + self.turn / 2, half)
        way = self.speed if passes % 2 == 0 else -self.speed
        reach = self.turn / np.pi
        middle = self.speed * (reach + self.straight / 2)
        if within < self.turn:  # from the velocity -way to way
            angle = np.pi * within / self.turn
            bent = way * (reach * np.sin(angle) + self.straight / 2)
            return float(middle - bent), float(-way * np.cos(angle))
        return float(middle + way * (within - self.turn - self.straight / 2)), float(way)
