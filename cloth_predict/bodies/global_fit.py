"""Pose and shape of a body without local displacements, laid through points of its surface.

Closest points by Gauss and Newton, which takes milliseconds where forces (`fitting.py`), which
move each node of a body, take a second.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cloth_predict.bodies.association import unit
from cloth_predict.bodies.surface_distance import nearest_on_surface
from cloth_predict.models.closed_mesh import ClosedMesh, coordinates_of
from cloth_predict.models.superquadric_kinematics import (
    GLOBAL,
    LOCAL,
    Kinematics,
    within_ranges,
)
from cloth_predict.surface.topology import NO_TRIANGLES
from cloth_predict.types import BoolArray, FloatArray

NODES = 500
"""Nodes of the mesh on which closest points are looked for."""
ROUNDS = 50
LONGEST = 0.1
"""Largest change of a coordinate in a round, of lengths by the scale."""
STILL = 1e-4
"""Motion in a round, by the scale of the body, from which on it is taken as at rest."""
OFF = 0.02
"""Distance from the surface, by the scale, at which local displacements put a point."""
SPREAD = np.concatenate([np.full(3, 0.5), np.full(4, 0.5), np.full(11, 0.3)])
"""Standard deviations of a first guess of c, theta and q_s; of lengths by the scale."""
LENGTHS = np.isin(np.arange(LOCAL), [0, 1, 2, GLOBAL.start, GLOBAL.start + 8])
"""Which of the 18 coordinates are lengths: c, a0 and b1."""


class GlobalFit(NamedTuple):
    """c, theta and q_s, shape (18,), and the directions on the sphere of the points, (m, 3)."""

    shared: FloatArray
    directions: FloatArray


def sizes_of(scale: float) -> FloatArray:
    """What a change by 1 is of each of the 18 coordinates: the scale [m] of lengths."""
    return np.where(LENGTHS, scale, 1.0)


def global_fit(begin: FloatArray, free: BoolArray, points: FloatArray) -> GlobalFit:
    """Fit from a first guess, shape (18,), to points [m], shape (m, 3).

    free, shape (11,): the global parameters that may change. In each round a point pulls at the
    place of the surface that is nearest to it, along the normal; what the points do not tell stays
    near the guess.
    """
    scale, moving = begin[GLOBAL][0], np.append(np.ones(GLOBAL.start, bool), free)
    size = sizes_of(scale)[moving]
    surface, shared = Kinematics(ClosedMesh.even(NODES)), begin
    position = _position(surface, shared)
    for _ in range(ROUNDS):
        directions, normals = _nearest(surface.mesh, position, points)
        feet = Kinematics(ClosedMesh(coordinates_of(directions), NO_TRIANGLES))
        off = np.einsum('pi,pi->p', normals, points - _position(feet, shared))
        slopes = np.einsum('pi,pik->pk', normals, feet.global_jacobian(_still(feet, shared)))
        told = np.column_stack([size * slopes[:, moving], off]) / (OFF * scale)
        weak = np.column_stack([np.eye(len(size)), (begin - shared)[moving] / size])
        rows = np.vstack([told, weak / SPREAD[moving][:, None]])
        step = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
        step *= min(1.0, LONGEST / np.abs(step).max())
        shared = shared.copy()
        shared[moving] += size * step
        shared = within_ranges(shared)
        before, position = position, _position(surface, shared)
        if np.abs(position - before).max() < STILL * scale:
            break
    return GlobalFit(shared, _nearest(surface.mesh, position, points)[0])


def _nearest(
    mesh: ClosedMesh, position: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Of the place nearest to each point its direction on the sphere and its normal, (m, 3)."""
    found = nearest_on_surface(points, position, mesh.triangles)
    corners = mesh.triangles[found.triangle]
    directions, normals = (
        np.einsum('pk,pki->pi', found.weight, of_nodes[corners])
        for of_nodes in (mesh.directions, mesh.normals(position))
    )
    return directions, unit(normals)


def _still(surface: Kinematics, shared: FloatArray) -> FloatArray:
    """Coordinates q without displacements."""
    return np.append(shared, np.zeros(surface.dim_q - LOCAL))


def _position(surface: Kinematics, shared: FloatArray) -> FloatArray:
    return surface.position(_still(surface, shared))
