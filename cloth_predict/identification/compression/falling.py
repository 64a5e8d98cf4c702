"""What a dense sheet does that is held by its first row and let go; a coarse one follows it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import ConfigError
from cloth_predict.identification.failing import or_none
from cloth_predict.identification.objectives.trajectory import Scenario, simulate
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.surface.assembly import build_mass_spring, rest_shape
from cloth_predict.types import FloatArray, IntArray, read_only

STEP = 0.01
"""Implicit step [s], also of what follows (Gomes 2016, section 3.3)."""
DURATION = 10.0
"""Time [s] that the thesis shows (Gomes 2016, figure 3.7)."""
SWING = 3.0
"""Velocity [m/s] of the lower row's middle when a hanging sheet is pushed."""


@dataclass(frozen=True)
class Release:
    """How a flat sheet is let go: turned about its first row, and how fast.

    angle [rad] from level, upwards; velocity [m/s] out of the hanging plane at the middle of the
    last row, which falls to zero at the first and differs from side to side by the share `twist`.
    """

    angle: float
    velocity: float = 0.0
    twist: float = 0.0
    text: str = ''


HANGING = Release(-np.pi / 2)
RELEASES = {
    'falling': Release(0.0, text='level, at rest (Gomes 2016, section 3.3)'),
    'raised': Release(np.pi / 4, text='45 degrees above level, at rest'),
    'lowered': Release(-np.pi / 4, text='45 degrees below level, at rest'),
    'pushed': Release(-np.pi / 2, SWING, 1.0, 'hanging, swung out at 3 m/s, one side faster'),
}
"""Initial conditions by name."""


@dataclass(frozen=True)
class Motion:
    """What a dense sheet does: times [s], (frames,); positions [m], (frames, nodes, 3).

    velocity [m/s] of all nodes at the first time, shape (nodes, 3).
    """

    name: str
    times: FloatArray
    position: FloatArray
    velocity: FloatArray

    def at_nodes(self, nodes: IntArray, driven: IntArray) -> Scenario:
        """Motion of some nodes as what a sheet of these nodes is to follow; A of (5.4).

        driven, which of these are held.
        """
        place = self.position[:, nodes]
        return Scenario(
            self.name,
            self.times,
            place[0],
            self.velocity[nodes],
            place[:, driven],
            place,
            np.arange(len(nodes)),
        )


def sheet(config: Config) -> MassSpring:
    """Build the model of a configuration whose rest lengths are those of its dimensions."""
    return build_mass_spring(config, np.zeros((config.model.count, 3)))


def times(duration: float) -> FloatArray:
    """Ends of the steps [s], and the start."""
    return np.asarray(STEP * np.arange(round(duration / STEP) + 1), float)


@lru_cache(maxsize=8)
def motion(config: Config, name: str, duration: float = DURATION) -> Motion:
    """Let the sheet of a configuration go in one of the `RELEASES`, by implicit steps.

    Raises ConfigError where its model does not get to the end.
    """
    model = sheet(config)
    position, velocity = released(config, RELEASES[name])
    at = times(duration)
    held = np.broadcast_to(position[model.driven], (len(at), len(model.driven), 3))
    nothing = np.zeros((len(at), 0, 3))
    alone = Scenario(name, at, position, velocity, held, nothing, np.zeros(0, np.int64))
    states = or_none(lambda: simulate(model, alone))
    if states is None:
        raise ConfigError(
            f'model: the dense sheet diverges in scenario {name}, with steps of {STEP:g} s'
        )
    found = np.repeat(position[None], len(at), axis=0)
    found[:, model.free] = states[:, : model.dim_x // 2].reshape(len(at), -1, 3)
    return Motion(name, at, np.asarray(read_only(found)), velocity)


def released(config: Config, release: Release) -> tuple[FloatArray, FloatArray]:
    """Positions [m] and velocities [m/s] of the nodes when let go, each (nodes, 3)."""
    across, down, out = _directions(np.array(config.model.gravity))
    flat = rest_shape(config.model)
    right, along = flat[:, 0], -flat[:, 1]
    incline = np.cos(release.angle) * out - np.sin(release.angle) * down
    position = np.outer(right, across) + np.outer(along, incline)
    depth, side = along / config.model.height, right / config.model.width
    speed = release.velocity * depth * (1.0 + release.twist * (side - 0.5))
    return position, np.outer(speed, out)


def _directions(gravity: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit vectors along the first row, down, and out of the plane of a hanging sheet."""
    largest = np.abs(gravity).max()
    down = gravity / largest if largest else np.array([0.0, -1.0, 0.0])
    down /= np.linalg.norm(down)
    first = np.eye(3)[0] if abs(down[0]) < 0.9 else np.eye(3)[1]
    across = first - (first @ down) * down
    across /= np.linalg.norm(across)
    return across, down, np.cross(down, across)
