"""How bodies are compared: by the distance of true points from the surface that is predicted.

The nodes of a body are no markers, so that there is no error node by node; and the simple methods
move the body that the tracker estimates.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import nan

import numpy as np
from scipy.spatial.transform import Rotation

from cloth_predict.bodies.surface_distance import nearest_on_surface
from cloth_predict.config import Config
from cloth_predict.evaluation.predictors import BASELINES, Make, Predicted, Tracked, methods
from cloth_predict.tracker import Tracker
from cloth_predict.types import FloatArray, Surface


def by_surface(config: Config) -> bool:
    """Whether predictions are compared with points of the surface, and not node by node."""
    return config.model.is_body and not config.nodes_are_markers


def on_surface(predicted: Predicted, actual: FloatArray) -> Predicted:
    """Return the place of a predicted surface that is nearest to each true point.

    actual [m], shape (points, 3), NaN where not known.
    """
    found = Predicted.unknown(len(actual))
    known = np.isfinite(actual).all(axis=1)
    if not known.any() or not np.isfinite(predicted.position).all():
        return found
    nearest = nearest_on_surface(actual[known], predicted.position, predicted.triangles)
    corners = predicted.triangles[nearest.triangle]
    found.position[known] = nearest.place
    found.sigma[known] = np.einsum('pk,pk->p', nearest.weight, predicted.sigma[corners])
    return found


def carried(now: Surface, horizon: float) -> Surface:
    """Return a surface `horizon` [s] later if it moves on as a rigid body.

    Its velocity and its spin are those of the rigid motion that is nearest to its own.
    """
    middle, velocity = now.position.mean(axis=0), now.velocity.mean(axis=0)
    off = now.position - middle
    inertia = np.square(off).sum() * np.eye(3) - off.T @ off
    spin = np.linalg.solve(inertia, np.cross(off, now.velocity - velocity).sum(axis=0))
    turned = Rotation.from_rotvec(horizon * spin).apply(off)
    return replace(now, position=middle + horizon * velocity + turned)


def _unsure(surface: Surface) -> Surface:
    """The surface without a claim of how well it is known."""
    return replace(surface, covariance=np.full_like(surface.covariance, nan))


def _held(tracker: Tracker, horizon: float) -> Surface:
    return _unsure(tracker.estimate())


def _rigid(tracker: Tracker, horizon: float) -> Surface:
    return _unsure(carried(tracker.estimate(), horizon))


ON_SURFACE: dict[str, Make] = {
    'hold': lambda config: Tracked(config, ahead=_held),
    'rigid': lambda config: Tracked(config, ahead=_rigid),
}
"""What the filter of a body is compared with: the body last estimated, at rest or rigid."""


def methods_of(config: Config, kinds: Iterable[str]) -> dict[str, Make]:
    """Return the baselines of the configured surface, and the tracker with these filters."""
    return methods(kinds, ON_SURFACE if by_surface(config) else BASELINES)
