"""What the rows and pictures of joined bodies are made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_predict.bodies.surface_distance import nearest_on_surface
from cloth_predict.experiments.rows import short
from cloth_predict.models.joints import Joints
from cloth_predict.models.superquadric import Superquadric
from cloth_predict.types import FloatArray, IntArray


def apart(
    places: Sequence[FloatArray], parts: Sequence[Superquadric], q: Sequence[FloatArray]
) -> float:
    """Mean distance of the true nodes of each part, (nodes, 3), from its surface."""
    every = []
    for own, part, at in zip(places, parts, q, strict=True):
        found = nearest_on_surface(own, part.position(at), part.mesh.triangles)
        every.append(np.linalg.norm(found.place - own, axis=1))
    return float(np.concatenate(every).mean())


def judged(
    who: str,
    parts: Sequence[Superquadric],
    joints: Joints,
    places: Sequence[Sequence[FloatArray]],
    found: Sequence[Sequence[FloatArray]],
) -> dict[str, float]:
    """What the row says of an estimator; places, of each frame and part, (nodes, 3)."""
    errors = [apart(own, parts, q) for own, q in zip(places, found, strict=True)]
    gaps = [joints.violation(np.concatenate(list(q))).reshape(-1, 3) for q in found]
    gap = [float(np.linalg.norm(one, axis=1).max()) for one in gaps]
    return {
        f'{who}: distance from the surface, first frame': errors[0],
        f'{who}: distance from the surface, mean': float(np.mean(errors)),
        f'{who}: joints open by, first frame': gap[0],
        f'{who}: joints open by, last frame': gap[-1],
    }


def told(numbers: dict[str, float], who: str) -> str:
    """Return what became of an estimator as a sentence."""
    first, every, begun, left = (
        short(numbers[f'{who}: {what}'])
        for what in (
            'distance from the surface, first frame',
            'distance from the surface, mean',
            'joints open by, first frame',
            'joints open by, last frame',
        )
    )
    return (
        f'true nodes {first} from the surface in the first frame, {every} over all; joints open '
        f'by {begun}, in the last frame {left}, of a size of {short(numbers["size"])}'
    )


def nets(
    parts: Sequence[Superquadric], q: Sequence[FloatArray]
) -> list[tuple[FloatArray, IntArray]]:
    """Nodes and triangles of the parts."""
    return [(p.position(at), p.mesh.triangles) for p, at in zip(parts, q, strict=True)]
