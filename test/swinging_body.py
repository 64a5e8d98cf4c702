"""A closed body that swings, turns and breathes in a known way, and the markers on it."""

import numpy as np

from cloth_predict.config import build, nest
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.superquadric_kinematics import LOCAL, Kinematics

SHAPE = np.array([0.2, 0.6, 0.7, 0.9, 0.9, 1.1, 0.2, 0.1, 0.0, 0.0, 0.5])
MARKERS = 60
FRAME = 10_000_000  # ns
SIGMA = 3e-4  # m
SETTINGS = {
    'model.kind': 'superquadric',
    'model.nodes': 300,
    'model.mass': 0.1,
    'model.gravity': [0.0, 0.0, 0.0],
    'body.nodes': 80,
    'body.mesh': 'markers',
    'body.coupling': 'pose',
    'body.w0': 0.001,
    'body.w1': 0.005,
    'body.push': 'matern',
    'filter.kind': 'decoupled',
    'filter.measurement_noise': SIGMA,
}


def settings(**changes):
    """A configuration for this body; `body__mesh` is `body.mesh`."""
    return build(nest({**SETTINGS, **{k.replace('__', '.'): v for k, v in changes.items()}}), 'x')


class Swinging:
    """Where the surface and its markers are at a time [s]."""

    def __init__(self, markers=MARKERS):
        self._surface, self._markers = (
            Kinematics(ClosedMesh.even(count)) for count in (800, markers)
        )

    def surface(self, time):
        """Points of the surface [m], shape (800, 3)."""
        return self._at(self._surface, time)

    def markers(self, time):
        """Markers [m], shape (markers, 3)."""
        return self._at(self._markers, time)

    def _at(self, kinematics, time):
        q = np.zeros(kinematics.dim_q)
        swing, turn, breath = (np.sin(2 * np.pi * f * time) for f in (0.7, 0.5, 1.0))
        q[:3] = np.array([0.08, 0.05, 0.02]) * swing + np.array([0.3, 1.2, -0.1])
        axis, angle = np.array([0.6, 0.0, 0.8]), 0.5 * turn
        q[3:7] = np.append(np.cos(angle / 2), np.sin(angle / 2) * axis)
        q[7:LOCAL] = SHAPE * (1.0 + 0.05 * breath * (np.arange(11) == 1))
        return kinematics.position(q)


class Feed:
    """Gives a tracker frame after frame: noisy markers with or without their labels."""

    def __init__(self, tracker, body, seed=0, named=()):
        self.tracker, self.body, self._rng = tracker, body, np.random.default_rng(seed)
        self._named = np.asarray(named, int)

    def __call__(self, frame, shown=None, more=(), shift=0.0):
        """Take frame number `frame`, of which only some markers are shown, and more points."""
        return self.tracker.step(FRAME * frame, *self.made(frame, shown, more, shift))

    def made(self, frame, shown=None, more=(), shift=0.0):
        places = self.body.markers(frame * FRAME / 1e9) + shift
        places += self._rng.normal(0.0, SIGMA, places.shape)
        seen = np.ones(len(places), bool) if shown is None else np.asarray(shown)
        positions = np.full((self.tracker.nodes, 3), np.nan)
        visible = np.zeros(self.tracker.nodes, bool)
        positions[self._named], visible[self._named] = places[self._named], seen[self._named]
        positions[~visible] = np.nan
        seen[self._named] = False
        points = self._rng.permutation(places[seen])
        return positions, visible, np.concatenate([points, np.reshape(more, (-1, 3))])
