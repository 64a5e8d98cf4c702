"""From the motion of a surface to what the projector draws: vertices, key lines and flags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cloth_predict.config import Config
from cloth_predict.formats.pointcloud import SCANLINE, WARPED
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.projection.scanout import Drawn, KeyRows, draw, key_rows
from cloth_predict.projection.skin import Skin, skin_of
from cloth_predict.projection.visibility import Flag, back_facing, occluded
from cloth_predict.types import FloatArray, IntArray


@dataclass(frozen=True)
class Warped:
    """What is drawn in one frame, by field.

    drawn: the vertices at the moments at which they are lit; flags, shape (fields, vertices), bits
    of `Flag`; keys: all vertices at the draw times of the key lines.
    """

    drawn: tuple[Drawn, ...]
    flags: IntArray
    keys: tuple[KeyRows, ...]

    @property
    def empty(self) -> bool:
        """Whether no vertex is within the frame."""
        return bool((self.flags & (Flag.BEHIND | Flag.OUTSIDE)).astype(bool).all())


@dataclass(frozen=True)
class Warper:
    """Warps a surface for a projector.

    max_row_error [px] of what is interpolated between key lines.
    """

    pinhole: Pinhole
    scan: Scan
    skin: Skin
    max_row_error: float

    @classmethod
    def of(cls, config: Config, position: FloatArray) -> Warper:
        """Return the configured projector before a surface that starts at `position` [m].

        Raises ConfigError where the projector is none, FrameError where the surface is none.
        """
        pinhole = Pinhole.from_config(config.projector)
        scan = Scan.of(config.projector, pinhole.width, pinhole.height)
        skin = skin_of(config, position, pinhole)
        return cls(pinhole, scan, skin, config.projector.max_row_error_px)

    def warp(self, motion: Motion) -> Warped:
        """Return what is drawn of nodes that move so from the start of the frame on."""
        motion = Motion(motion.coefficients[:, self.skin.source])
        fields = range(self.scan.fields)
        drawn = tuple(draw(motion, self.pinhole, self.scan, field) for field in fields)
        keys = tuple(
            key_rows(motion, self.pinhole, self.scan, field, self.max_row_error)
            for field in fields
        )
        return Warped(drawn, np.array([self.flags(one) for one in drawn]), keys)

    def flags(self, drawn: Drawn) -> IntArray:
        """Bits of `Flag` of each vertex, shape (vertices,); they are those of its node."""
        skin, nodes = self.skin, self.skin.nodes
        pixels, depth = drawn.pixels[:nodes], self.pinhole.depth(drawn.position[:nodes])
        behind = ~np.isfinite(pixels).all(axis=1)
        found = np.where(behind, int(Flag.BEHIND), 0)
        for flag, holds in (
            (Flag.OUTSIDE, ~behind & ~self.pinhole.inside(pixels)),
            (Flag.BACK_FACING, back_facing(pixels, skin.faces, skin.front)),
            (Flag.OCCLUDED, occluded(pixels, depth, skin.faces)),
            (Flag.UNCONVERGED, ~drawn.converged[:nodes]),
        ):
            found |= np.where(holds, int(flag), 0)
        return np.asarray(found[skin.source])

    def vertices(self, warped: Warped) -> NDArray[np.void]:
        """Pack the vertices, shape (fields * rows, cols): the fields below each other."""
        rows, cols = self.skin.shape
        found = np.empty((len(warped.drawn), rows * cols), WARPED)
        found['s'], found['t'] = self.skin.texture.T
        found['flags'] = warped.flags
        for field, drawn in enumerate(warped.drawn):
            of_field = found[field]
            of_field['u'], of_field['v'] = drawn.pixels.T
            for k, axis in enumerate('xyz'):
                of_field[axis] = drawn.position[:, k]
            of_field['dt'], of_field['field'] = drawn.dt, field
        return found.reshape(len(warped.drawn) * rows, cols)

    def scanlines(self, warped: Warped) -> NDArray[np.void]:
        """Pack the key lines, shape (key lines of all fields, vertices)."""
        packed = []
        for field, keys in enumerate(warped.keys):
            found = np.empty(keys.pixels.shape[:2], SCANLINE)
            found['u'], found['v'] = keys.pixels[..., 0], keys.pixels[..., 1]
            found['dt'], found['line'] = keys.dt[:, None], keys.lines[:, None]
            found['field'] = field
            packed.append(found)
        return np.concatenate(packed)
