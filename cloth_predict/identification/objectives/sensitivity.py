"""The implicit step of a surface by its own parameters, exact for the step that is made.

The change y of the velocities in a step of dt solves R = 0 (Gomes 2016, eq. 3.32), with w the
rates of the springs' offsets after the step, B the clamped blocks and E the incidence:

    R = M y + E [dt^2 B w + dt d w + dt k c (1 - r/l) (p_i - p_j)] - dt (M G g + load),

so that dy/dtheta = -A^-1 dR/dtheta with A = dR/dy, the matrix of the step itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cloth_predict.models.implicit import LinearisedSurface
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import FloatArray


@dataclass(frozen=True)
class StepSlopes:
    """dR/dtheta of one step, each kind by its own springs or nodes only.

    springs, by kind (stiffness, damping, rest_length, compression), shape (springs, 3): pulls
    first end minus, second end plus as the springs' forces do; nodes, by kind (mass, load), shape
    (nodes, 3).
    """

    model: MassSpring
    springs: Mapping[str, FloatArray]
    nodes: Mapping[str, FloatArray]

    @classmethod
    def of(
        cls, at: LinearisedSurface, factor: FloatArray, dt: float, change: FloatArray
    ) -> StepSlopes:
        """Derivatives at a state, for the change of the state that its step of dt [s] makes.

        factor, shape (nodes,): that of gravity at each node.
        """
        model, shape, s = at.model, at.shape, at.model.springs
        faster = np.zeros((model.nodes, 3))
        faster[model.free] = change[3 * len(model.free) :].reshape(-1, 3)
        after = shape.offset_rate + faster[model.first] - faster[model.second]
        n, short = shape.unit, shape.length < s.rest_length
        along = np.einsum('si,si->s', n, after)[:, None] * n
        geometric = 1.0 - s.rest_length / shape.length
        share = np.where(short, s.compression, 1.0)
        pulled = np.maximum(geometric, 0.0)[:, None] * (after - along) + along
        by_k = dt**2 * pulled + dt * geometric[:, None] * shape.offset
        k = (s.stiffness * share)[:, None]
        taut = np.where(short, 0.0, 1.0 / shape.length)[:, None]
        springs = {
            'stiffness': share[:, None] * by_k,
            'damping': dt * after,
            'rest_length': -k * (dt**2 * taut * (after - along) + dt * n),
            'compression': np.where(short, s.stiffness, 0.0)[:, None] * by_k,
        }
        nodes = {
            'mass': faster - dt * factor[:, None] * model.gravity,
            'load': -dt * model.mass[:, None] * model.gravity,
        }
        return cls(model, springs, nodes)

    def pull(self, adjoint: FloatArray) -> dict[str, FloatArray]:
        """Derivatives a' dy/dtheta by kind, of A^-1 a, shape (3 free,)."""
        each = np.zeros((self.model.nodes, 3))
        each[self.model.free] = adjoint.reshape(-1, 3)
        apart = each[self.model.first] - each[self.model.second]
        found = {kind: -np.einsum('si,si->s', by, apart) for kind, by in self.springs.items()}
        return found | {kind: -np.einsum('ni,ni->n', by, each) for kind, by in self.nodes.items()}

    def push(self, kind: str, direction: FloatArray) -> FloatArray:
        """-dR/dtheta along a direction of one kind, (springs or nodes,), shape (3 free,)."""
        if kind in self.nodes:
            return np.asarray(-(direction[:, None] * self.nodes[kind])[self.model.free].ravel())
        pulls = direction[:, None] * self.springs[kind]
        return np.asarray(-(self.model.blocks.incidence @ pulls)).ravel()
