"""Where markers sit on a body: each at a node, or a little off it.

The nearest node is found by a k-d tree (the paper's search of all of them, Metaxas & Terzopoulos
1993, section VI). A marker keeps its node, so that motion along the surface is seen as well; those
without a label are attached anew now and then, as they come and go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from cloth_predict.bodies.surface_distance import nearest_on_surface
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.types import BoolArray, FloatArray, IntArray

UNNAMED = -1
"""Label of a marker that has none."""


@dataclass(frozen=True)
class Attached:
    """Markers on a body; each array has a row per marker.

    node: that it is attached to; offset [m], shape (k, 3): from there to the marker, in the frame
    of the body, along the surface; label: its number, or `UNNAMED`; seen: when it was last [ns].
    """

    node: IntArray
    offset: FloatArray
    label: IntArray
    seen: IntArray

    @classmethod
    def none(cls) -> Attached:
        """No marker."""
        nobody = np.zeros(0, np.int64)
        return cls(nobody, np.zeros((0, 3)), nobody, nobody)

    def __len__(self) -> int:
        return len(self.node)

    def place(self, position: FloatArray, rotation: FloatArray) -> FloatArray:
        """Where the markers are [m], (k, 3), on a body with nodes at `position` [m], (N, 3)."""
        return np.asarray(position[self.node] + self.offset @ rotation.T)

    def of_nodes(self, places: FloatArray, rotation: FloatArray) -> FloatArray:
        """Where the nodes are [m], (k, 3), of markers at `places` [m]; the reverse of `place`."""
        return np.asarray(places - self.offset @ rotation.T)

    def kept(self, rows: BoolArray | IntArray) -> Attached:
        """Only these of the markers."""
        return Attached(self.node[rows], self.offset[rows], self.label[rows], self.seen[rows])

    def joined(self, other: Attached) -> Attached:
        """These markers, and others after them."""
        return Attached(
            np.append(self.node, other.node),
            np.concatenate([self.offset, other.offset]),
            np.append(self.label, other.label),
            np.append(self.seen, other.seen),
        )

    def replaced(self, rows: IntArray, other: Attached) -> Attached:
        """These markers, with others in place of some of them."""
        order = np.arange(len(self))
        order[rows] = len(self) + np.arange(len(rows))
        return self.joined(other).kept(order)

    def seen_at(self, stamp: int, rows: BoolArray) -> Attached:
        """The same markers, of which these were seen at a time [ns]."""
        return replace(self, seen=np.where(rows, stamp, self.seen))


def spacing(places: FloatArray) -> FloatArray:
    """Distance [m] of each place, (k, 3), from the nearest other one; infinite of a single one."""
    return np.asarray(cKDTree(places).query(places, 2)[0][:, 1])


def unit(vectors: FloatArray) -> FloatArray:
    """The vectors, shape (m, 3), of length 1; one without a length stays."""
    length = np.linalg.norm(vectors, axis=1)
    return np.asarray(vectors / np.where(length > 0, length, 1.0)[:, None])


def attach(
    places: FloatArray,
    label: IntArray,
    stamp: int,
    mesh: ClosedMesh,
    position: FloatArray,
    rotation: FloatArray,
) -> Attached:
    """Attach markers at `places` [m], shape (k, 3), seen at a time [ns], each to the nearest node.

    position [m], shape (N, 3), of the nodes. What a marker is off along the surface stays as its
    offset; what it is off across the surface does not, and tells that the node is elsewhere. The
    chord between two points of a smooth surface is at right angles to the mean of their normals,
    but for the third power of its length.
    """
    if not len(places):
        return Attached.none()
    _, node = cKDTree(position).query(places)
    normals = mesh.normals(position)
    nearest = nearest_on_surface(places, position, mesh.triangles)
    foot = np.einsum('kc,kci->ki', nearest.weight, normals[mesh.triangles[nearest.triangle]])
    across = unit(normals[node] + unit(foot))
    off = places - position[node]
    along = off - np.einsum('ki,ki->k', off, across)[:, None] * across
    return Attached(node, along @ rotation, label, np.full(len(node), stamp))
