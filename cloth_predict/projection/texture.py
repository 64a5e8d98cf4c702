"""Where each vertex is in the picture that is shown on the surface."""

from __future__ import annotations

import numpy as np

from cloth_predict.config import ModelConfig
from cloth_predict.errors import FrameError
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.types import FloatArray


def texture_coordinates(
    model: ModelConfig, position: FloatArray, pinhole: Pinhole, mirrored: bool = False
) -> FloatArray:
    """Texture coordinates s, t of the nodes, from 0 to 1, shape (nodes, 2); t goes down.

    Those of a grid follow its columns and rows. On any other surface the picture lies as the
    projector sees `position` [m], shape (nodes, 3), stretched to its edges: raises FrameError
    where a node of it is not before the projector.
    """
    if model.topology == 'grid':
        found = grid_texture(*model.shape)
    else:
        pixels = pinhole.project(position)
        if not np.isfinite(pixels).all():
            raise FrameError('the projector does not see the whole surface when it starts')
        found = (pixels - pixels.min(axis=0)) / np.maximum(np.ptp(pixels, axis=0), 1e-9)
    return np.column_stack([1 - found[:, 0], found[:, 1]]) if mirrored else found


def grid_texture(rows: int, cols: int) -> FloatArray:
    """Texture coordinates s, t of the nodes of a grid, shape (nodes, 2)."""
    return np.stack(np.meshgrid(_fractions(cols), _fractions(rows)), axis=-1).reshape(-1, 2)


def _fractions(count: int) -> FloatArray:
    """0 to 1 in equal parts, shape (count,); a single one is 0."""
    return np.linspace(0.0, 1.0, count) if count > 1 else np.zeros(1)
