"""The springs of a surface at one state: lengths, directions, and what they make of stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cloth_predict.models.air import Normals
from cloth_predict.models.springs import Springs
from cloth_predict.types import FloatArray


@dataclass(frozen=True)
class Shape:
    """Geometry of the springs: offsets [m] and their rates [m/s], (springs, 3), lengths [m].

    velocity [m/s] of all nodes, shape (nodes, 3); normals, where there is air.
    """

    offset: FloatArray
    offset_rate: FloatArray
    length: FloatArray
    velocity: FloatArray
    normals: Normals | None

    @cached_property
    def unit(self) -> FloatArray:
        """Directions of the springs, shape (springs, 3)."""
        return self.offset / self.length[:, None]

    @cached_property
    def _outer(self) -> FloatArray:
        return (self.unit[:, :, None] * self.unit[:, None, :]).reshape(-1, 9)

    def stiffness(self, springs: Springs, clamp: bool) -> FloatArray:
        """One block k [(1 - r/l)(I - n n') + n n'] per spring, (springs, 9) (Gomes, eq. 3.20)."""
        geometric = 1.0 - springs.rest_length / self.length
        if clamp:
            geometric = np.maximum(geometric, 0.0)
        k = springs.stiffness_at(self.length)
        across = k * geometric
        blocks = self._outer * (k - across)[:, None]
        blocks[:, ::4] += across[:, None]
        return blocks

    def stiffness_change(self, springs: Springs, w: FloatArray) -> FloatArray:
        """Derivative of the clamped block times w, (springs, 3), by the offset, (springs, 9).

        Stretched: k r / l^2 [(n.w) T + n t' + t n'] with T = I - n n', t = T w; compressed, where
        the block is k n n': k / l [(n.w) T + n t'].
        """
        n = self.unit
        along = np.einsum('si,si->s', n, w)
        t = w - along[:, None] * n
        taut = self.length > springs.rest_length
        gain = springs.stiffness_at(self.length) / self.length
        gain = np.where(taut, gain * springs.rest_length / self.length, gain)
        blocks = n[:, :, None] * (t - along[:, None] * n)[:, None, :]
        blocks += (taut[:, None] * t)[:, :, None] * n[:, None, :]
        flat = blocks.reshape(-1, 9)
        flat[:, ::4] += along[:, None]
        return np.asarray(flat * gain[:, None])
