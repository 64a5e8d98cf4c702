"""Errors of estimates by (40), and what no estimate can better."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.models.superquadric import GLOBAL, LOCAL, ROTATION, TRANSLATION, Superquadric
from cloth_predict.types import FloatArray, IntArray


@dataclass(frozen=True)
class Errors:
    """Errors of each frame, shape (frames,), in the paper's units.

    Those of (40) before their mean over the frames. local and position are means over the nodes
    of the distance; whole: the norm of the positions of all nodes, as (40) has it by the letter.
    """

    translation: FloatArray
    rotation: FloatArray
    shape: FloatArray
    local: FloatArray
    position: FloatArray
    whole: FloatArray

    @classmethod
    def of(
        cls, body: Superquadric, estimated: FloatArray, true: FloatArray, places: FloatArray
    ) -> Errors:
        """Compare coordinates, (frames, dim_q), of a body whose nodes are those of the truth.

        places: true positions of the nodes, shape (frames, nodes, 3).
        """
        off = estimated - true
        turned = np.minimum(
            *(
                np.linalg.norm(estimated[:, ROTATION] + s * true[:, ROTATION], axis=1)
                for s in (-1, 1)
            )
        )
        apart = np.array([body.position(q) for q in estimated]) - places
        displaced = off[:, LOCAL:].reshape(len(off), -1, 3)
        return cls(
            np.linalg.norm(off[:, TRANSLATION], axis=1),
            turned,
            np.linalg.norm(off[:, GLOBAL], axis=1),
            np.linalg.norm(displaced, axis=2).mean(axis=1),
            np.linalg.norm(apart, axis=2).mean(axis=1),
            np.linalg.norm(apart, axis=(1, 2)),
        )

    def means(self) -> FloatArray:
        """Means over the frames (40), shape (5,), in the order of the tables."""
        parts = self.translation, self.rotation, self.shape, self.local, self.position
        return np.array([part.mean() for part in parts])


def least_position_error(
    body: Superquadric, true: FloatArray, seen: IntArray, variance: float
) -> float:
    """Bound of the mean position error of a filter that is told nearly everything, as frames pass.

    It knows how the body moves and bends from frame to frame, and all displacements; it lacks the
    coordinates of the pose and the shape at first, of which the prior is the paper's P(0) = I.
    true: coordinates, shape (frames, dim_q); seen: the nodes with a point, of this variance in
    each coordinate. What is left of the unknown, C = (I + sum H'H / variance)^-1, makes at each
    node an error of the covariance L C L' at least (van Trees 1968), whose mean size is at least
    sqrt(2 / pi) of the root of its trace: that is so of an error along a line, and more of others.
    """
    known, means = np.eye(LOCAL), []
    for q in true:
        rows = body.global_jacobian(q)
        told = rows[seen].reshape(-1, LOCAL)
        known = known + told.T @ told / variance
        left = np.einsum('nak,kl,nal->n', rows, np.linalg.inv(known), rows)
        means.append(np.sqrt(2.0 / np.pi * left).mean())
    return float(np.mean(means))
