"""What the light of a projector meets: the true surface in time, and where a ray hits it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from cloth_predict.evaluation.cases import Case, in_order
from cloth_predict.formats.bag import Truth
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.surface.topology import grid_triangles
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

ITERATIONS = 100
"""Most steps to the draw time of a vertex; each divides the error by the beam's speed in vertex
speeds, so that what has not converged by then moves about as fast as the beam."""
CLOSE = 1e-9
"""Time [s] within which a draw time is that of its own line."""
EDGE = 1e-9
"""Share of a triangle beyond its edge that counts as its edge: rounding parts no neighbours."""
IN_FRONT = 1e-3
"""Distance [m] by which what hides a vertex is nearer to the projector."""


@dataclass(frozen=True, eq=False)
class Path:
    """Points that move along cubic splines through where they were seen, from `start` [ns] on.

    time [s] from there, shape (frames,); seen, shape (frames, points); longest [s]: interval
    between two frames between which nothing is known.
    """

    start: int
    time: FloatArray
    seen: BoolArray
    spline: CubicSpline
    longest: float

    @classmethod
    def of(cls, markers: MarkerSequence) -> Path:
        """Return the path of markers whose stamps increase strictly."""
        time = 1e-9 * (markers.stamps - markers.stamps[0])
        position = np.array(markers.positions)
        for k, seen in enumerate(markers.visible.T):
            position[:, k] = _filled(time, position[:, k], seen)
        longest = 2.5 * float(np.median(np.diff(time)))
        spline = CubicSpline(time, position)
        return cls(int(markers.stamps[0]), time, markers.visible, spline, longest)

    def at(self, time: FloatArray) -> FloatArray:
        """Positions [m] of all points at each time [s], (m,) to (m, points, 3), NaN if unknown."""
        held, known = self._interval(time)
        return np.where(known[..., None], self.spline(np.where(known.any(1), time, held)), np.nan)

    def each(self, time: FloatArray) -> FloatArray:
        """Position [m] of each point at its own time [s], shape (points,) to (points, 3)."""
        held, known = self._interval(time)
        k, point = np.searchsorted(self.time, held), np.arange(len(time))
        a, b, c, d = self.spline.c[:, k, point]
        x = (time - held)[:, None]
        found = ((a * x + b) * x + c) * x + d
        return np.where(np.diagonal(known)[:, None], found, np.nan)

    def _interval(self, time: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Time [s] of the frame before, shape (m,), and which points are known, (m, points).

        Known is what both frames show that are next to the time, if they are close enough.
        """
        last = len(self.time) - 2
        k = np.clip(np.searchsorted(self.time, time, side='right') - 1, 0, last)
        near = (self.time[0] <= time) & (time <= self.time[-1])
        near &= self.time[k + 1] - self.time[k] <= self.longest
        return self.time[k], near[:, None] & self.seen[k] & self.seen[k + 1]


def _filled(time: FloatArray, position: FloatArray, seen: BoolArray) -> FloatArray:
    """Positions [m] of a point, (frames, 3), where it is not seen on the spline through the rest.

    A spline through them all is then that through those seen.
    """
    if np.count_nonzero(seen) < 2:
        return np.zeros_like(position)
    rest = CubicSpline(time[seen], position[seen])(np.clip(time, *time[seen][[0, -1]]))
    return np.where(seen[:, None], position, rest)


@dataclass(frozen=True)
class Draw:
    """When the beam meets vertices as they truly move, and where they then are.

    dt [s] after the frame's start, shape (vertices,), NaN where it meets none; position [m],
    shape (vertices, 3); visible: whether the light gets there, shape (vertices,).
    """

    dt: FloatArray
    position: FloatArray
    visible: BoolArray


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """The surface as it truly moves: its vertices, and a mesh that may be finer.

    triangles of the mesh, shape (t, 3); none of a chain. grid: rows and columns of the mesh, where
    its corners are those of a grid of vertices; None otherwise.
    """

    vertices: Path
    mesh: Path
    triangles: IntArray
    grid: tuple[int, int] | None = None

    @classmethod
    def of(cls, case: Case, truth: Truth | None, triangles: IntArray) -> TrueSurface:
        """Return the true surface of a recording, or else that of its markers.

        triangles, shape (t, 3), of the markers: needed where the truth is not known.
        """
        vertices = Path.of(case.reference.markers)
        if truth is None:
            return cls(vertices, vertices, triangles)
        rows, cols = truth.ids.shape
        ends = truth.ids.ravel()[[0, -1]] == [0, truth.ids.max()]
        grid = (rows, cols) if ends.all() else None
        mesh = Path.of(in_order(truth.nodes()))
        return cls(vertices, mesh, grid_triangles(rows, cols), grid)

    def drawn(self, begin: float, pinhole: Pinhole, scan: Scan, field: int) -> Draw:
        """When a field of the frame that begins at `begin` [s] meets each vertex.

        The time is that of the line on which the vertex is at that time: a fixed point.
        """
        dt = np.full(self.vertices.seen.shape[1], scan.begins(field))
        change = np.full_like(dt, np.inf)
        for _ in range(ITERATIONS):
            before = dt
            dt = scan.times(pinhole.project(self.vertices.each(begin + dt)), field)
            change = np.abs(dt - before)
            if not (change > CLOSE).any():
                break
        dt = np.where(change <= CLOSE, dt, np.nan)
        position = self.vertices.each(begin + dt)
        pixels = pinhole.project(position)
        visible = pinhole.inside(pixels) & ~self._hidden(begin + dt, position, pinhole)
        return Draw(dt, position, visible)

    def _hidden(self, time: FloatArray, position: FloatArray, pinhole: Pinhole) -> BoolArray:
        """Whether something of the surface is before each vertex at its own time [s]."""
        way = position - pinhole.origin
        far = np.linalg.norm(way, axis=1)
        return np.asarray(self.hits(time, pinhole.origin, way / far[:, None]) < far - IN_FRONT)

    def hits(self, time: FloatArray, origin: FloatArray, direction: FloatArray) -> FloatArray:
        """Distance [m] at which each ray meets the surface at its own time [s]; else infinite.

        Shape (rays,); directions of length 1, shape (rays, 3).
        """
        if not len(self.triangles):
            return np.full(len(time), np.inf)
        return nearest(origin, direction, self.mesh.at(time)[:, self.triangles])

    def landing(
        self, time: FloatArray, pixels: FloatArray, vertices: IntArray, pinhole: Pinhole
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """How far from its vertex light lands [m], in the picture [px], and whether it misses.

        time [s], shape (rays,), at which pixels, shape (rays, 2), are lit, that were meant for
        these vertices, shape (rays,). On the surface the distance is that of two points of it; of
        a ray that misses the surface, that of the ray.
        """
        actual = self.vertices.at(time)[np.arange(len(time)), vertices]
        origin, direction = pinhole.rays(pixels)
        reach = self.hits(time, origin, direction)
        missed = ~np.isfinite(reach)
        along = np.einsum('ri,ri->r', direction, actual - origin)
        light = origin + np.where(missed, along, reach)[:, None] * direction
        apart = np.linalg.norm(light - actual, axis=1)
        return apart, np.linalg.norm(pixels - pinhole.project(actual), axis=1), missed


def nearest(origin: FloatArray, direction: FloatArray, corners: FloatArray) -> FloatArray:
    """Distance [m] along each ray to the first triangle that it meets, or infinity; (rays,).

    direction, shape (rays, 3); corners [m], shape (rays, triangles, 3, 3), each ray its own.
    (Möller and Trumbore 1997.)
    """
    a = corners[..., 0, :]
    ab, ac, to = corners[..., 1, :] - a, corners[..., 2, :] - a, origin - a
    ray = direction[:, None, :]
    p, q = _cross(ray, ac), _cross(to, ab)
    with np.errstate(divide='ignore', invalid='ignore'):  # of a ray along the triangle
        inverse = 1.0 / _dot(ab, p)
        u, v, far = inverse * _dot(to, p), inverse * _dot(ray, q), inverse * _dot(ac, q)
        met = (u >= -EDGE) & (v >= -EDGE) & (u + v <= 1 + EDGE) & (far > 0)
    return np.asarray(np.where(met, far, np.inf).min(axis=1))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    ax, ay, az = np.moveaxis(a, -1, 0)
    bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
