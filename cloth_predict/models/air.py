"""Air that presses on a surface along its normals, and damps its motion along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.types import BoolArray, FloatArray, IntArray

SMALLEST = 1e-12
"""Area [m^2] under which a node has no normal."""


@dataclass(frozen=True)
class Air:
    """Force F = s n [w + n (u - c v)] on each node with its normal n and velocity v.

    w [N] is a gust at the node itself, u [N], a vector, one that all nodes share; c [N s/m] is the
    drag of the air. All three are those of a node whose share s is 1. It is the viscous force
    along the normal (Gomes 2016, eq. 6.14) with the wind's part of it, which nobody measures, as
    the unknown.

    triangles, shape (t, 3), make the normals; share s, shape (nodes,).
    """

    triangles: IntArray
    share: FloatArray
    drag: float

    def at(self, position: FloatArray) -> Normals:
        """Return the normals of a surface [m], shape (nodes, 3)."""
        corner = position[self.triangles]
        # opposite[:, k] is the side of the triangle that lies opposite to its corner k
        opposite = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)
        cross = _cross(opposite[:, 1], opposite[:, 2]) / 6.0
        area = np.zeros_like(position)
        np.add.at(area, self.triangles, cross[:, None])
        size = np.linalg.norm(area, axis=1)
        flat = size < SMALLEST
        size = np.where(flat, 1.0, size)
        return Normals(self, area / size[:, None], size, flat, opposite)


@dataclass(frozen=True)
class Normals:
    """Unit normals, shape (nodes, 3), of a surface, and the areas [m^2] behind them, (nodes,).

    flat, shape (nodes,): nodes without an area; opposite [m], shape (t, 3, 3): the sides of the
    triangles.
    """

    air: Air
    unit: FloatArray
    area: FloatArray
    flat: BoolArray
    opposite: FloatArray

    def force(self, velocity: FloatArray, gust: FloatArray, common: FloatArray) -> FloatArray:
        """Force on each node [N], shape (nodes, 3).

        velocity [m/s], shape (nodes, 3); gust w [N], shape (nodes,); common u [N], shape (3,).
        """
        return (self.air.share * self._pressure(velocity, gust, common))[:, None] * self.unit

    def damping(self) -> FloatArray:
        """Derivative of the force by the own velocity, (nodes, 9), negative semidefinite."""
        outer = self.unit[:, :, None] * self.unit[:, None, :]
        return (-self.air.drag * self.air.share)[:, None] * outer.reshape(-1, 9)

    def slope(self, velocity: FloatArray, gust: FloatArray, common: FloatArray) -> FloatArray:
        """Derivative of the force on corner a of a triangle by its corner b, (t, 3, 3, 9).

        The velocity is held. A node's derivative is the sum over the triangles that it is in.
        """
        along = common - self.air.drag * velocity
        identity = np.eye(3)
        turning = self._pressure(velocity, gust, common)[:, None, None] * identity
        turning = turning + self.unit[:, :, None] * along[:, None, :]
        across = identity - self.unit[:, :, None] * self.unit[:, None, :]
        by_area = (self.air.share / self.area)[:, None, None] * (turning @ across)
        by_area[self.flat] = 0.0
        # the cross product's derivative by corner b is [opposite side of b] x
        at_corner = by_area[self.air.triangles][:, :, None]
        return _cross(at_corner, self.opposite[:, None, :, None] / 6.0).reshape(-1, 3, 3, 9)

    def _pressure(self, velocity: FloatArray, gust: FloatArray, common: FloatArray) -> FloatArray:
        along = common - self.air.drag * velocity
        return np.asarray(gust + np.einsum('ij,ij->i', self.unit, along))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products along the last axis; numpy's own takes longer to begin than to compute."""
    (x, y, z), (u, v, w) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)
