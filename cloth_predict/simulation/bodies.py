"""Recordings of closed bodies with known truth: a balloon on a string, and an insect.

Each part is a deformable superquadric with more nodes than any filter runs, and with an elasticity
of which filters know nothing. Without the inertial forces of eq. 49, which with a lumped mass give
energy to a body that turns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from cloth_predict.formats.bag import Truth
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.constraints import Articulated, Joint
from cloth_predict.models.superquadric import ROTATION, TRANSLATION, Superquadric
from cloth_predict.models.superquadric_shape import PARAMETERS
from cloth_predict.simulation.filming import Progress, film, frame_stamps
from cloth_predict.types import FloatArray

Forces = Callable[[FloatArray, float], FloatArray]
"""Forces [N] on nodes at positions [m], both (N, 3), at a time [s]."""
SOFT = np.isin(PARAMETERS, ('a1', 'a2', 'a3', 't1', 't2', 'b1'))
"""Global parameters that move: the aspect ratios, the tapers and the size of the bend."""
GRIP = 0.5
"""Angle [rad] on the sphere of the nodes within which a pull takes hold of a body."""


class Moved:
    """Bodies under forces on their nodes; time is the last state.

    forces: those on each part, all of which add up. Quaternions keep their length, of which the
    bodies leave the motion open: it is of no account, but what turns them depends on it.
    """

    def __init__(self, bodies: Articulated, forces: Sequence[Sequence[Forces]]) -> None:
        self.bodies, self.forces = bodies, forces
        self.hung = np.zeros(0)

    @property
    def dim_x(self) -> int:
        """States of the bodies, and the time."""
        return self.bodies.dim_x + 1

    @property
    def dim_u(self) -> int:
        """None: the state says what the forces are."""
        return 0

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        states, time = self.bodies.split(x[:-1]), float(x[-1])
        given = []
        for part, state, forces in zip(self.bodies.parts, states, self.forces, strict=True):
            given.append(total(forces, part.position(state), time).ravel())
        changes = self.bodies.split(self.bodies.f(x[:-1], np.concatenate(given)))
        for part, state, change in zip(self.bodies.parts, states, changes, strict=True):
            theta, rate = state[ROTATION], state[part.dim_q :][ROTATION]
            turning = change[part.dim_q :][ROTATION]
            turning -= theta * (theta @ turning + rate @ rate) / (theta @ theta)
        return np.append(self.bodies.join(changes), 1.0)

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """There is none."""
        return u

    def positions(self, x: FloatArray) -> FloatArray:
        """Positions of all nodes [m], part by part, shape (nodes, 3)."""
        return self.bodies.position(x[:-1])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Not needed by an explicit step, and not offered."""
        raise TypeError('bodies are simulated by explicit steps only')

    jac_input = jac


def total(forces: Sequence[Forces], position: FloatArray, time: float) -> FloatArray:
    """All of the forces on nodes [N], shape (N, 3), at positions [m] and a time [s]."""
    return np.asarray(np.sum([force(position, time) for force in forces], axis=0))


@dataclass(frozen=True, eq=False)
class Elastic:
    """A body that keeps its shape: springs of its nodes to where they are at rest.

    rest [m], shape (N, 3), moved as close to the nodes as a rigid motion brings it (Müller et al.
    2005, "Meshless deformations based on shape matching"): the forces add up to none, and to no
    torque. stiffness [N/m] of all springs together.
    """

    rest: FloatArray
    stiffness: float

    def __call__(self, position: FloatArray, time: float) -> FloatArray:
        """Forces on the nodes [N], shape (N, 3)."""
        rest, off = self.rest - self.rest.mean(axis=0), position - position.mean(axis=0)
        turn, _ = Rotation.align_vectors(off, rest)
        return np.asarray(self.stiffness / len(rest) * (turn.apply(rest) - off))


@dataclass(frozen=True, eq=False)
class Tether:
    """Soft springs from the nodes to where they start [m], shape (N, 3), as a foam holds a body.

    stiffness [N/m] of all springs together.
    """

    start: FloatArray
    stiffness: float

    def __call__(self, position: FloatArray, time: float) -> FloatArray:
        """Forces on the nodes [N], shape (N, 3)."""
        return np.asarray(self.stiffness / len(position) * (self.start - position))


@dataclass(frozen=True, eq=False)
class Pull:
    """A force on some nodes that comes and goes: a sum of sinusoids along each axis.

    share, shape (N,), of each node; frequency [Hz], shape (waves,); phase [rad] and size [N],
    shape (waves, 3).
    """

    share: FloatArray
    frequency: FloatArray
    phase: FloatArray
    size: FloatArray

    @classmethod
    def draw(
        cls, rng: np.random.Generator, share: FloatArray, strength: Sequence[float], waves: int = 6
    ) -> Pull:
        """Draw waves from 0.2 to 1.5 Hz, with an RMS of strength [N], shape (3,), by axis."""
        frequency = np.exp(rng.uniform(np.log(0.2), np.log(1.5), waves))
        size = rng.uniform(0.5, 1.0, (waves, 3))
        size *= np.asarray(strength) * np.sqrt(2.0 / np.square(size).sum(axis=0))
        return cls(share, frequency, rng.uniform(0, 2 * np.pi, (waves, 3)), size)

    def __call__(self, position: FloatArray, time: float) -> FloatArray:
        """Forces on the nodes [N], shape (N, 3)."""
        rise = 1.0 - np.exp(-5.0 * time)  # so that the body starts from rest
        angle = 2 * np.pi * self.frequency[:, None] * time + self.phase
        return np.outer(self.share, rise * (self.size * np.sin(angle)).sum(axis=0))


def gripped(mesh: ClosedMesh, direction: Sequence[float]) -> FloatArray:
    """Share of a pull that each node takes, shape (N,): those about a direction on the sphere."""
    angle = np.arccos(np.clip(mesh.directions @ np.asarray(direction), -1.0, 1.0))
    share = np.exp(-((angle / GRIP) ** 2))
    return np.asarray(share / share.sum())


UPRIGHT = np.array([1.0, -1.0, 0.0, 0.0]) / np.sqrt(2.0)
"""Quaternion of a body whose z axis points up, which in the mocap frame is y."""


def balloon(
    rng: np.random.Generator, duration: float, progress: Progress, step: float = 5e-3
) -> Truth:
    """A balloon of 100 g, 0.36 m long and soft, pulled by a string at its lower end."""
    shape = np.array([0.18, 0.7, 0.8, 1.0, 1.0, 1.0, 0.2, 0.2, 0.02, 0.0, 0.6])
    mesh = ClosedMesh.even(200)
    body = Superquadric(mesh, mass=0.1, reference=shape, w0=0.2, w1=0.2, alpha=1.0, free=SOFT)
    start = body.state(np.array([0.0, 1.2, 0.0]), UPRIGHT, shape)
    rest = body.position(start)
    pull = Pull.draw(rng, gripped(mesh, (0.0, 0.0, -1.0)), (0.06, 0.06, 0.06))
    bodies, forces = Articulated([body], [], 0.0), (Elastic(rest, 20.0), Tether(rest, 2.0), pull)
    return _filmed(bodies, [start], [forces], duration, progress, step, 3)


@dataclass(frozen=True)
class Limb:
    """A part of the insect: half its length [m], aspect ratios along x, y, z, and its mass [kg].

    root: direction on the limb of the node by which it is joined; at: that on the trunk.
    """

    size: float
    ratios: tuple[float, float, float]
    mass: float
    root: tuple[float, float, float] = (0.0, 0.0, 0.0)
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)


INSECT = {
    'body': Limb(0.12, (1.0, 0.4, 0.4), 0.05),
    'head': Limb(0.06, (1.0, 0.9, 0.8), 0.02, (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    'tail': Limb(0.14, (1.0, 0.3, 0.3), 0.04, (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    'wing_left': Limb(0.2, (0.4, 1.0, 0.08), 0.02, (0.0, -1.0, 0.0), (0.0, 0.8, 0.6)),
    'wing_right': Limb(0.2, (0.4, 1.0, 0.08), 0.02, (0.0, 1.0, 0.0), (0.0, -0.8, 0.6)),
}
"""x is ahead, y to the left and z up; all parts are joined to the first."""
LIMB_NODES = 60
BETWEEN_MARKERS = 2


def insect(
    rng: np.random.Generator, duration: float, progress: Progress, step: float = 5e-3
) -> Truth:
    """An insect of five parts, pulled at its nose and at the tips of its wings (sec. VI)."""
    return _filmed(*insect_scene(rng, LIMB_NODES), duration, progress, step, BETWEEN_MARKERS)


def insect_scene(
    rng: np.random.Generator, nodes: int
) -> tuple[Articulated, list[FloatArray], list[list[Forces]]]:
    """The insect with so many nodes on each part, its parts at rest, and the forces on each."""
    bodies, starts = insect_at_rest(ClosedMesh.even(nodes))
    flap = Pull.draw(rng, np.zeros(0), (0.005, 0.03, 0.005), waves=2)
    nose = Pull.draw(rng, np.zeros(0), (0.03, 0.015, 0.015))
    pulls = {
        'head': replace(nose, share=gripped(bodies.parts[1].mesh, (1.0, 0.0, 0.0))),
        'wing_left': replace(flap, share=gripped(bodies.parts[3].mesh, (0.0, 1.0, 0.0))),
        'wing_right': replace(flap, share=gripped(bodies.parts[4].mesh, (0.0, -1.0, 0.0))),
    }
    forces: list[list[Forces]] = []
    for name, part, start in zip(INSECT, bodies.parts, starts, strict=True):
        rest = part.position(start)
        own = [pulls[name]] if name in pulls else []
        forces.append([Elastic(rest, 10.0), Tether(rest, 0.5), *own])
    return bodies, starts, forces


def insect_labels(markers: int) -> tuple[str, ...]:
    """Label of each marker of an insect: its part, and its number there."""
    each = markers // len(INSECT)
    return tuple(f'{name}/{k}' for name in INSECT for k in range(each))


def insect_at_rest(mesh: ClosedMesh) -> tuple[Articulated, list[FloatArray]]:
    """The joined parts, each with the nodes of `mesh`, and their states where the joints hold."""
    parts: list[Superquadric] = []
    starts: list[FloatArray] = []
    joints: list[Joint] = []
    for index, limb in enumerate(INSECT.values()):
        shape = np.array([limb.size, *limb.ratios, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5])
        part = Superquadric(mesh, mass=limb.mass, reference=shape, w0=0.1, w1=0.5, free=SOFT)
        start = part.state(np.array([0.0, 1.2, 0.0]), UPRIGHT, shape)
        if parts:
            root, at = (
                int((mesh.directions @ np.array(d)).argmax()) for d in (limb.root, limb.at)
            )
            joints.append(Joint(0, at, index, root))
            start[TRANSLATION] += parts[0].position(starts[0])[at] - part.position(start)[root]
        parts.append(part)
        starts.append(start)
    return Articulated(parts, joints, 20.0), starts


def _filmed(
    bodies: Articulated,
    starts: Sequence[FloatArray],
    forces: Sequence[Sequence[Forces]],
    duration: float,
    progress: Progress,
    step: float,
    every: int,
) -> Truth:
    """Let bodies go; every so many nodes there is a marker."""
    stamps = frame_stamps(duration)
    start = np.append(bodies.join(starts), 0.0)
    surface = film(Moved(bodies, forces), start, stamps / 1e9, step, progress)
    ids = np.full((1, surface.shape[1]), -1, np.int64)
    chosen = np.arange(0, surface.shape[1], every)
    ids[0, chosen] = np.arange(len(chosen))
    return Truth(stamps, surface[:, None], ids)
