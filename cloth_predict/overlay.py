"""The augmented view: what is shown of a surface, as lines, arrows and words. It draws nothing."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from cloth_predict.config import Config
from cloth_predict.tracker import Tracker
from cloth_predict.tracking.limits import Health
from cloth_predict.types import FloatArray, IntArray, Surface

ESTIMATE, PREDICTION, FORCE = (0.84, 0.37, 0.0), (0.0, 0.45, 0.7), (0.0, 0.62, 0.45)
"""Red, green, blue: vermilion, blue and bluish green, which all eyes tell apart (Okabe and Ito,
Color Universal Design, 2008)."""
WEIGHT = 0.2
"""Length [m] of the arrow of a force as large as the weight of the part that it acts on."""
GRAVITY = 9.81
"""Acceleration [m/s^2] that makes the weight; of no account which way."""
ARROWS = 40
"""Arrows at most, evenly among the nodes: from one to the next a push changes little."""
DASHES, FINEST = 3, 0.025
"""Dashes of an edge of the mean length, but none shorter than this share of the extent."""
SHORTEST = 1e-9
"""Length [m] of dashes of which none is shorter."""


@dataclass(frozen=True)
class Shown:
    """What is known of a surface after a frame.

    prediction: None where it was refused; ahead, health: of it, in words; edges, shape (e, 2):
    neighbours among the nodes; pushed, shape (a,): nodes at which unknown forces are shown, none
    where none are states; arrows [m], shape (a, 2, 3): their tails and tips; scale [m/N]: length
    of an arrow by its force.
    """

    estimate: Surface
    prediction: Surface | None
    ahead: str
    health: str
    edges: IntArray
    pushed: IntArray
    arrows: FloatArray
    scale: float

    @classmethod
    def of(
        cls, tracker: Tracker, prediction: Surface | None, horizon: float, health: Health
    ) -> Shown:
        """What a tracker knows, and what it predicted `horizon` [s] ahead."""
        estimate, loads, scale = tracker.estimate(), tracker.loads(), arrow_scale(tracker.config)
        ahead = f'prediction {1e3 * horizon:.3g} ms ahead'
        pushed, tails = np.zeros(0, np.int64), estimate.position
        tips = tails
        if loads is not None:
            pushed = np.arange(0, len(tails), ceil(len(tails) / ARROWS))
            tips = tails + scale * loads
        return cls(
            estimate=estimate,
            prediction=prediction,
            ahead=ahead if prediction else f'no {ahead}',
            health=health.text,
            edges=tracker.edges,
            pushed=pushed,
            arrows=np.stack([tails, tips], axis=1)[pushed],
            scale=scale,
        )

    @property
    def told(self) -> list[str]:
        """What is known in words, line by line."""
        force = f'unknown force: 10 cm are {0.1 / self.scale:.2g} N'
        return [self.ahead, self.health, *([force] if len(self.pushed) else [])]

    @property
    def solid(self) -> FloatArray:
        """Edges of the estimate [m], shape (e, 2, 3)."""
        return self.estimate.position[self.edges]

    @property
    def dashed(self) -> FloatArray:
        """Dashes [m] along the edges of the prediction, shape (d, 2, 3)."""
        if self.prediction is None:
            return np.zeros((0, 2, 3))
        return dashes_of_net(self.prediction.position[self.edges])


def arrow_scale(config: Config) -> float:
    """Length of an arrow by the force on the part of a node [m/N]."""
    return WEIGHT * config.model.count / (config.model.mass * GRAVITY)


def dashes_of_net(edges: FloatArray) -> FloatArray:
    """Dashes [m], shape (d, 2, 3), along the edges of a net [m], shape (e, 2, 3)."""
    if not len(edges):
        return edges
    mean = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).mean()
    extent = np.linalg.norm(np.ptp(edges.reshape(-1, edges.shape[2]), axis=0))
    return dashes(edges, max(mean / (2 * DASHES), FINEST * extent, SHORTEST))


def dashes(segments: FloatArray, length: float) -> FloatArray:
    """Dashes of about `length` [m] that cover half of each of the segments, from end to end.

    segments [m], shape (s, 2, n); shape (d, 2, n). Each segment begins and ends with half a gap.
    """
    start, way = segments[:, 0], segments[:, 1] - segments[:, 0]
    count = np.rint(np.linalg.norm(way, axis=1) / (2.0 * length)).astype(int)
    count = np.maximum(count, 1)
    of = np.repeat(np.arange(len(segments)), count)
    number = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    share = (number[:, None] + [0.25, 0.75]) / count[of][:, None]
    return np.asarray(start[of][:, None] + share[..., None] * way[of][:, None])


def polygon(corners: FloatArray) -> FloatArray:
    """Sides of a polygon, shape (c, 2, n) of (c, n)."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def upwards(config: Config) -> FloatArray:
    """Unit vector against gravity, shape (3,); y where there is none."""
    gravity = np.array(config.model.gravity)
    size = np.linalg.norm(gravity)
    return -gravity / size if size else np.array([0.0, 1.0, 0.0])
