"""What a renderer draws of a surface: its vertices, their texture, and which side is the front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import ConfigError, FrameError
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.texture import texture_coordinates
from cloth_predict.projection.visibility import orientation
from cloth_predict.surface.assembly import topology_of
from cloth_predict.types import FloatArray, IntArray, read_only


@dataclass(frozen=True, eq=False)
class Skin:
    """Vertices, which may be more than the nodes of the surface, and their triangles.

    shape: rows and columns of the vertices; source: the node of each vertex, shape (vertices,):
    the nodes themselves in turn, and then those that are drawn twice; texture (s, t), shape
    (vertices, 2); triangles, shape (t, 3), of vertices; front: the sign with which each turns in
    a picture where it shows its front, shape (t,).
    """

    shape: tuple[int, int]
    source: IntArray
    texture: FloatArray
    triangles: IntArray
    front: FloatArray

    def __post_init__(self) -> None:
        for name in ('source', 'texture', 'triangles', 'front'):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def faces(self) -> IntArray:
        """The triangles of nodes, shape (t, 3)."""
        return np.asarray(self.source[self.triangles])

    @property
    def repeats(self) -> bool:
        """Whether the picture goes round the surface, so that s goes on beyond 1."""
        return len(self.source) > self.nodes

    @property
    def nodes(self) -> int:
        """Number of nodes of the surface."""
        return int(self.source.max(initial=-1)) + 1


def skin_of(config: Config, position: FloatArray, pinhole: Pinhole) -> Skin:
    """Return what is drawn of the configured surface, which starts at `position` [m], (nodes, 3).

    Raises FrameError where it is no surface, or the projector does not see all of a sheet.
    """
    model, mirrored = config.model, config.projector.mirrored
    if model.is_body:
        mesh = _mesh_of(config, position)
        return closed(mesh.coordinates, mesh.triangles, pinhole.handedness, mirrored)
    texture = texture_coordinates(model, position, pinhole, mirrored)
    return sheet(model.shape, texture, topology_of(model, position).triangles)


def _mesh_of(config: Config, position: FloatArray) -> ClosedMesh:
    """Mesh of a body; where its nodes are at markers, which are seen first here, through them."""
    if not config.nodes_are_markers:
        return ClosedMesh.even(config.model.nodes)
    try:
        return ClosedMesh.through(position, position.mean(axis=0), np.eye(3), np.ones(3))
    except ConfigError as error:
        raise FrameError(str(error)) from None


def sheet(shape: tuple[int, int], texture: FloatArray, triangles: IntArray) -> Skin:
    """Return a surface of which the front is where the texture is not mirrored."""
    front = np.sign(orientation(texture, triangles))
    return Skin(shape, np.arange(len(texture)), texture, triangles, front)


def closed(
    coordinates: FloatArray, triangles: IntArray, handedness: float, mirrored: bool
) -> Skin:
    """Return a closed surface, of which the front is its outside.

    coordinates: material coordinates u, v [rad] of the nodes, shape (nodes, 2) (Metaxas and
    Terzopoulos 1993, eq. 20); triangles, shape (t, 3), anticlockwise from outside; handedness of
    the projector's pixels. The picture goes once round: s is v and t falls with u, from pole to
    pole. Where a triangle reaches over v = pi its corners beyond are vertices of their own, with
    s above 1, so that a picture that is repeated has no seam. No picture of a ball is whole at
    both poles: it is torn in the triangles that hold them.
    """
    u, v = coordinates.T
    texture = np.column_stack([v / (2 * np.pi) + 0.5, 0.5 - u / np.pi])
    corners = texture[triangles, 0]
    turns = np.round(corners[:, :1] - corners).astype(np.int64)
    turns -= turns.min(axis=1, keepdims=True)
    nodes = len(texture)
    copies, place = np.unique(triangles[turns > 0], return_inverse=True)
    faces = triangles.copy()
    faces[turns > 0] = nodes + place
    source = np.append(np.arange(nodes), copies)
    found = texture[source]
    found[nodes:, 0] += 1.0
    if mirrored:
        found[:, 0] = 1.0 - found[:, 0]
    # v goes down in the pixels of a projector that is not mirrored
    front = np.full(len(faces), -handedness)
    return Skin((1, len(source)), source, found, faces, front)
