"""The maps of a frame: one for each colour, or one in which all fields have their own lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_predict.projection.scanout import KeyRows
from cloth_predict.projection.warp import Warper
from cloth_predict.projection.warp_map import warp_map

Image = NDArray[np.float32]


def field_maps(warper: Warper, keys: tuple[KeyRows, ...]) -> list[tuple[float, Image]]:
    """Start [s] after that of the frame, and map, (height, width, 2), of each picture of a frame.

    keys: key lines by field, none of a frame in which nothing is shown. Colours are pictures of
    their own; the fields of an interlaced frame share one.
    """
    scan, skin = warper.scan, warper.skin
    colours = scan.fields if scan.mode == 'colour_sequential' else 1
    size = scan.width, scan.height
    starts = [field / (scan.fields * scan.fps) for field in range(colours)]
    images = [np.full((scan.height, scan.width, 2), np.nan, np.float32) for _ in starts]
    for field, one in enumerate(keys):
        warp_map(
            one.pixels,
            warper.pinhole.depth(one.position),
            one.lines,
            skin.texture,
            skin.triangles,
            size,
            front=skin.front,
            columns=scan.columns,
            drawn=scan.lit_by(field),
            out=images[field % colours],
        )
    if skin.repeats:
        for image in images:
            image[..., 0] %= 1.0
    return list(zip(starts, images, strict=True))
