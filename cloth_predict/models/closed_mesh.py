"""The mesh of a closed surface: nodes on the unit sphere, and the triangles between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from cloth_predict.errors import ConfigError
from cloth_predict.models.air import Air, Normals
from cloth_predict.types import FloatArray, IntArray, read_only

GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
"""Turn [rad] from one node to the next that never brings two above each other."""


@dataclass(frozen=True)
class ClosedMesh:
    """Nodes of a closed surface by their material coordinates, and its triangles.

    coordinates u, v [rad], shape (N, 2), latitude and longitude of Metaxas & Terzopoulos 1993,
    eq. 20 (w = 1); triangles, shape (t, 3), corners anticlockwise as seen from outside.
    """

    coordinates: FloatArray
    triangles: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, 'coordinates', read_only(self.coordinates))
        object.__setattr__(self, 'triangles', read_only(self.triangles))

    def __len__(self) -> int:
        return len(self.coordinates)

    @cached_property
    def directions(self) -> FloatArray:
        """The nodes on the unit sphere, shape (N, 3)."""
        u, v = self.coordinates.T
        return np.stack([np.cos(u) * np.cos(v), np.cos(u) * np.sin(v), np.sin(u)], axis=1)

    @cached_property
    def shares(self) -> FloatArray:
        """Share of the unit sphere that belongs to each node, shape (N,); they add up to 1."""
        area = self.on_sphere.area
        return np.asarray(area / area.sum())

    @cached_property
    def on_sphere(self) -> Normals:
        """Normals, areas and sides of the triangles between the nodes on the unit sphere."""
        return self._at(self.directions)

    def normals(self, position: FloatArray) -> FloatArray:
        """Outward unit normals at the nodes of a surface [m], (N, 3), weighted by area."""
        return self._at(position).unit

    def _at(self, position: FloatArray) -> Normals:
        return Air(self.triangles, np.ones(len(self)), 0.0).at(position)

    @classmethod
    def even(cls, nodes: int) -> ClosedMesh:
        """Any number of nodes, from 4 on, spread evenly over the sphere: a Fibonacci lattice."""
        if nodes < 4:
            raise ConfigError(f'a closed mesh of {nodes} nodes: it takes at least 4')
        order = np.arange(nodes)
        latitude = np.arcsin(1.0 - (2.0 * order + 1.0) / nodes)
        return cls._of(np.stack([latitude, _wrapped(order * GOLDEN_ANGLE)], axis=1))

    @classmethod
    def through(
        cls,
        positions: FloatArray,
        centre: FloatArray,
        rotation: FloatArray,
        semi_axes: FloatArray,
    ) -> ClosedMesh:
        """A node at each point, in its direction from the centre of an ellipsoid.

        positions [m], shape (N, 3), in the inertial frame; rotation, shape (3, 3), from the
        ellipsoid's frame to that; semi_axes [m], shape (3,). Raises ConfigError where the points
        do not surround the centre, or where two of them lie in one direction.
        """
        direction = (positions - centre) @ rotation / semi_axes
        length = np.linalg.norm(direction, axis=1)
        if np.any(length == 0.0):
            at = int(np.argmin(length))
            raise ConfigError(f'a closed mesh through the points: point {at} is at the centre')
        return cls._of(coordinates_of(direction))

    @classmethod
    def _of(cls, coordinates: FloatArray) -> ClosedMesh:
        directions = cls(coordinates, np.empty((0, 3), np.int64)).directions
        try:
            hull = ConvexHull(directions)
        except (QhullError, ValueError):
            raise ConfigError(
                f'a closed mesh through {len(coordinates)} points: it takes at least 4 that are '
                'finite and do not lie on one circle about the centre'
            ) from None
        if np.any(hull.equations[:, 3] >= 0.0):
            raise ConfigError(
                'a closed mesh through the points: they lie on one side of the centre'
            )
        triangles = np.asarray(hull.simplices, np.int64)
        missing = np.setdiff1d(np.arange(len(coordinates)), triangles)
        if len(missing):
            raise ConfigError(
                f'a closed mesh through the points: point {missing[0]} lies in the same direction '
                'from the centre as another'
            )
        inward = np.linalg.det(directions[triangles]) < 0.0
        triangles[inward] = triangles[inward][:, ::-1]
        return cls(coordinates, triangles)


def coordinates_of(directions: FloatArray) -> FloatArray:
    """Material coordinates u, v [rad], shape (N, 2), of directions of any length, (N, 3)."""
    x, y, z = (directions / np.linalg.norm(directions, axis=1)[:, None]).T
    return np.stack([np.arcsin(np.clip(z, -1.0, 1.0)), np.arctan2(y, x)], axis=1)


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
