"""The implicit step of a surface, and its derivative, through one matrix of the velocities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from cloth_predict.models.geometry import Shape
from cloth_predict.types import FloatArray, Solver

if TYPE_CHECKING:
    from cloth_predict.models.mass_spring import MassSpring


@dataclass(frozen=True)
class LinearisedSurface:
    """A surface at one state; see `types.Linearised`.

    velocity [m/s] of the free nodes and inner force [N] on them, each of shape (3 free,); load,
    shape (dim_load,).
    """

    model: MassSpring
    shape: Shape
    velocity: FloatArray
    force: FloatArray
    load: FloatArray

    def solver(self, dt: float) -> Solver:
        """Solver of A, by its Cholesky factor; b has shape (3 free, m)."""
        return self.model.blocks.cholesky(self.matrix(dt))

    def matrix(self, dt: float) -> FloatArray:
        """Blocks of A = M - dt^2 K - dt D, shape (blocks, 9).

        The geometric stiffness of a compressed spring is negative and can make the matrix
        indefinite: there it is left out (1 - r/l clamped at 0), which keeps the matrix positive
        definite for every state.
        """
        m, blocks = self.model, self.model.blocks
        stiffness = blocks.gather(self._clamped)
        matrix = m.mass_blocks - dt**2 * stiffness - dt * m.damping_blocks
        if self.shape.normals is not None:
            matrix -= dt * m.air_damping(self.shape.normals)
        return matrix

    def change(self, dt: float, solver: Solver, load: FloatArray | float = 0.0) -> FloatArray:
        """Change of the state in a step (Gomes 2016, eq. 3.32); the driven nodes move on in it.

        load: what comes to that of the input, shape (dim_load,).
        """
        m = self.model
        blocks = self._clamped.reshape(-1, 3, 3)
        resistance = np.einsum('sij,sj->si', blocks, self.shape.offset_rate)
        pulled = (m.blocks.incidence @ resistance).ravel()
        force = self.force + m.force_of(self.shape, self.load + load)
        faster = solver(dt * force - dt**2 * pulled)
        return np.concatenate([dt * (self.velocity + faster), faster])

    def tangent(
        self, dt: float, solver: Solver, change: FloatArray, load: FloatArray | float = 0.0
    ) -> MechanicalTangent:
        """Derivative of the step, through the change of the matrix with the state too."""
        m, n = self.model, 3 * len(self.model.free)
        faster = np.zeros((m.nodes, 3))
        faster[m.free] = change[n:].reshape(-1, 3)
        moved = dt * (self.shape.offset_rate + faster[m.first] - faster[m.second])
        slope = self.shape.stiffness(m.springs, clamp=False)
        slope += self.shape.stiffness_change(m.springs, moved)
        return MechanicalTangent(self, dt, solver, slope, self.air_slope(faster, load))

    def air_slope(self, faster: FloatArray | float, load: FloatArray | float) -> FloatArray | None:
        """Derivative of the air's force by the positions, (t, 3, 3, 9); None without air.

        It acts on the velocity after the step, which is higher by `faster` [m/s], (nodes, 3).
        """
        if self.shape.normals is None:
            return None
        wind = self.model.wind_of(self.load + load)
        return self.shape.normals.slope(self.shape.velocity + faster, *wind)

    @cached_property
    def _clamped(self) -> FloatArray:
        return self.shape.stiffness(self.model.springs, clamp=True)


class MechanicalTangent:
    """Derivative of the implicit step of a surface, through A y = M v + dt S p + dt F.

    S, shape (3 free, 3 free), is the derivative of the forces, the clamped ones over the step
    included, by the positions; y the velocity after the step. See `types.Tangent`.
    """

    def __init__(
        self,
        at: LinearisedSurface,
        dt: float,
        solver: Solver,
        springs: FloatArray,
        air: FloatArray | None,
    ) -> None:
        """Take S of each spring, shape (springs, 9), and of the air, shape (t, 3, 3, 9)."""
        blocks = at.model.blocks
        self._at, self._dt, self._solver = at, dt, solver
        self._springs, self._air = springs, air
        slope = blocks.gather(springs)
        self.slope = blocks.matrix(slope if air is None else slope + blocks.of_triangles(air))
        """S."""
        self._mass = at.model.mass3[:, None]

    def push(self, columns: FloatArray, load: FloatArray | None = None) -> FloatArray:
        """Return F C, shape (dim_x, m), for changes of the load, (dim_load, m), as well."""
        n, dt = len(self._mass), self._dt
        position, velocity = columns[:n], columns[n:]
        pulled = self.slope @ position
        if load is not None:
            pulled += self._at.model.force_of(self._at.shape, load)
        after = self._solver(self._mass * velocity + dt * pulled)
        return np.concatenate([position + dt * after, after])

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F, shape (m, dim_x)."""
        return self.pull_load(rows)[0]

    def sandwich(self, cov: FloatArray) -> FloatArray:
        """Return F P F' of a symmetric P."""
        return self.sandwiched(self.push(cov), self.push)

    def sandwiched(
        self, pushed: FloatArray, push: Callable[[FloatArray], FloatArray]
    ) -> FloatArray:
        """Columns of the positions and velocities of F P F', from F P, which may have more rows.

        Those of the velocities are pushed; a position moves on by dt times its velocity after the
        step, and so do the columns.
        """
        n = len(self._mass)
        velocity = push(pushed[n : 2 * n].T)
        return np.concatenate([pushed[:, :n] + self._dt * velocity, velocity], axis=1)

    def pull_load(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return W F and the derivative of W x by the load, shapes (m, dim_x), (m, dim_load)."""
        n, dt = len(self._mass), self._dt
        both = self._solver((rows[:, n:] + dt * rows[:, :n]).T)
        position = rows[:, :n] + dt * (self.slope.T @ both).T
        pulled = np.concatenate([position, (self._mass * both).T], axis=1)
        return pulled, dt * self._by_load(both.T)

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with the driven nodes and the load."""
        after = self._solver(self._dt * self.pushed(inputs))
        return np.concatenate([self._dt * after, after])

    def pushed(self, inputs: FloatArray, held: bool = False) -> FloatArray:
        """Change of the force on the free nodes, (3 free, m), with inputs, (dim_u, m).

        The driven nodes move on over the step, or are held.
        """
        m, dt = self._at.model, 0.0 if held else self._dt
        size, columns = 3 * len(m.driven), inputs.shape[1]
        force = m.force_of(self._at.shape, inputs[2 * size :])
        if not size:
            return force
        position = inputs[:size]
        offset, rate = (
            (m.driven_ends @ part).reshape(-1, 3, columns)
            for part in (position, inputs[size : 2 * size])
        )
        clamped = self._at._clamped.reshape(-1, 3, 3)
        pull = self._springs.reshape(-1, 3, 3) @ offset
        pull += dt * clamped @ rate + m.springs.damping[:, None, None] * rate
        force = force - (m.blocks.incidence @ pull.reshape(len(pull), -1)).reshape(-1, columns)
        return np.asarray(force if self._air is None else force + self._turned(position))

    def _turned(self, driven: FloatArray) -> FloatArray:
        """Change of the air's force with the positions [m] of the driven nodes, (3 driven, m)."""
        m, columns = self._at.model, driven.shape[1]
        assert m.air is not None and self._air is not None  # noqa: PT018
        moved, force = np.zeros((2, m.nodes, 3, columns))
        moved[m.driven] = driven.reshape(-1, 3, columns)
        corner = moved[m.air.triangles].reshape(len(m.air.triangles), 9, columns)
        by_corner = self._air.reshape(-1, 3, 3, 3, 3).transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)
        turned = (by_corner @ corner).reshape(-1, 3, 3, columns)
        np.add.at(force, m.air.triangles, turned)
        return np.asarray(force[m.free]).reshape(-1, columns)

    def _by_load(self, rows: FloatArray) -> FloatArray:
        """Derivative by the load, (m, dim_load), from that by the forces, (m, 3 free)."""
        normals, free = self._at.shape.normals, self._at.model.free
        if normals is None:
            return rows
        along = np.einsum('mfi,fi->mf', rows.reshape(len(rows), -1, 3), normals.unit[free])
        along *= normals.air.share[free]
        return np.concatenate([rows, along, along @ normals.unit[free]], axis=1)
