"""The texture coordinate that each pixel of the projector lights, at the moment it is lit."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cloth_predict.projection.spans import Spans, cut, on_lines
from cloth_predict.types import FloatArray, IntArray

Image = NDArray[np.float32]

BLOCK = 2**14
"""Pixels that are drawn at once: what is computed for them stays in the cache."""


def warp_map(
    pixels: FloatArray,
    depth: FloatArray,
    lines: IntArray,
    texture: FloatArray,
    triangles: IntArray,
    size: tuple[int, int],
    *,
    front: FloatArray | None = None,
    columns: bool = False,
    drawn: slice = slice(None),
    out: Image | None = None,
) -> Image:
    """Texture coordinates (s, t) for every pixel, shape (height, width, 2), ready for a remap.

    A pixel has those of the surface point on its ray at the time of its line; NaN where the ray
    meets none, or a back (where the texture is mirrored), which hides what is behind it. Straight
    edges in space are taken as straight in the picture, as a renderer does: a lens bends them.

    pixels: vertices (u, v) at the key lines [px], shape (k, nodes, 2), NaN where one is not seen:
    its triangles are left out; depth [m], shape (k, nodes); lines: the key lines, in any order,
    shape (k,); between them vertices move linearly. One key line is a field that is lit at once.
    texture: (s, t) of the vertices, shape (nodes, 2); triangles, shape (t, 3); front: which way
    they turn where they show their front, shape (t,), as `cut` takes it;
    size: width and height [px]; columns: lines are columns; drawn: which lines, as `slice(1, None,
    2)` of an interlaced field; out: map to draw into, whose other lines stay as they are.
    """
    width, height = size
    image = np.full((height, width, 2), np.nan, np.float32) if out is None else out
    picture = image.view(np.complex64)[..., 0]  # s + i t: both are moved at once
    if columns:
        picture, pixels = picture.T, pixels[..., ::-1]
    count, length = picture.shape
    y = np.arange(count)[drawn]
    order = np.argsort(lines)
    vertices = on_lines(pixels[order], depth[order], lines[order], y)
    spans = cut(vertices, texture, triangles, y, length, columns, front)
    lit = np.full(len(y) * length, complex(np.nan, np.nan), np.complex64)
    layers = list(_layers(spans, length))
    nearest = np.zeros(len(lit), np.float32) if len(layers) > 1 else None
    for layer in layers:
        _draw(spans[layer], length, lit, nearest)
    picture[drawn] = lit.reshape(len(y), length)
    return image


def _layers(spans: Spans, length: int) -> Iterator[IntArray | slice]:
    """Sets of spans of which no two lie over each other; as few as lie over one pixel."""
    begin = spans.line * length + spans.first
    end = begin + spans.count
    if (end[:-1] <= begin[1:]).all():
        yield slice(None)
        return
    left = np.arange(len(begin))
    while len(left):
        # From one span to the next that begins after its end.
        following = np.searchsorted(begin[left], end[left]).tolist()
        chosen, at = [], 0
        while at < len(following):
            chosen.append(at)
            at = following[at]
        yield left[chosen]
        left = np.delete(left, chosen)


def _draw(
    spans: Spans, length: int, lit: NDArray[np.complex64], nearest: NDArray[np.float32] | None
) -> None:
    """Draw spans that do not lie over each other, where nothing nearer is.

    lit: s + i t of the lines, one after the other, shape (m length,); nearest: 1 / depth of what
    is drawn there, of the same shape, or None to draw all.
    """
    origin = spans.line * length + spans.first + spans.origin
    end = np.cumsum(spans.count)
    marks = np.searchsorted(end, np.arange(BLOCK, end[-1] if len(end) else 0, BLOCK))
    for one, two in pairwise(np.unique([0, *marks, len(end)])):
        count = spans.count[one:two]
        before = np.cumsum(count) - count + spans.origin[one:two]
        at = np.arange(count.sum()) + np.repeat(origin[one:two] - before, count)
        i = np.abs(np.arange(len(at)) - np.repeat(before, count)).astype(np.float32)
        bend, s0, s1, t0, t1, near = np.repeat(spans.values[:, one:two], count, axis=1)
        bend *= i
        bend += 1
        i /= bend
        found = np.empty((len(i), 2), np.float32)
        np.add(s0, np.multiply(s1, i, out=s1), out=found[:, 0])
        np.add(t0, np.multiply(t1, i, out=t1), out=found[:, 1])
        texel = found.view(np.complex64)[:, 0]
        if nearest is not None:
            near *= bend
            wins = near > nearest[at]
            at, texel = at[wins], texel[wins]
            nearest[at] = near[wins]
        lit[at] = texel
