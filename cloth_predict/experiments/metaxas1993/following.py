"""The row and the picture of joined bodies that the paper's recipe and ours follow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cloth_predict.experiments.metaxas1993.joined import JoinedFilter, JoinedRecipe, Points
from cloth_predict.experiments.metaxas1993.judging import judged, nets, told
from cloth_predict.experiments.metaxas1993.pictures import Shown, bodies
from cloth_predict.experiments.rows import Row, Scope
from cloth_predict.models.joints import Joint, Joints
from cloth_predict.models.superquadric import Superquadric
from cloth_predict.types import FloatArray, IntArray


@dataclass(frozen=True)
class Models:
    """The parts before the first frame: their states, shape (dim_x,), and what joins them."""

    parts: list[Superquadric]
    states: list[FloatArray]
    joints: list[Joint]

    @property
    def joined(self) -> Joints:
        """The joints, of the bodies that they join."""
        return Joints(self.parts, self.joints)

    @property
    def coordinates(self) -> list[FloatArray]:
        """Coordinates q of each part, shape (dim_q,)."""
        return [x[: part.dim_q] for part, x in zip(self.parts, self.states, strict=True)]


@dataclass(frozen=True)
class Truth:
    """What there is to follow, of each frame and part.

    points: what is seen of it, shape (m, 3); places on its true surface, (k, 3), and the
    triangles between them, of each part, (t, 3).
    """

    points: Sequence[Points]
    places: Sequence[Sequence[FloatArray]]
    triangles: Sequence[IntArray]


@dataclass(frozen=True)
class View:
    """How a picture is looked at: elevation and azimuth [degrees], and height by width.

    upright turns positions, shape (k, 3), so that z points up.
    """

    angles: tuple[float, float]
    tall: float
    upright: Callable[[FloatArray], FloatArray] = np.asarray


def followed(
    texts: tuple[str, str, str],
    models: Models,
    truth: Truth,
    estimators: tuple[JoinedRecipe, JoinedFilter],
    view: View,
    scope: Scope,
) -> Row:
    """Let both estimators follow; texts: the figure, what the paper says, and why ours differ."""
    name, paper, why = texts
    recipe, ours = estimators
    found = {'recipe': list(recipe.frames(models.states, truth.points))}
    scope.progress(0.5)
    found['ours'] = list(ours.frames(models.states, truth.points))
    scope.progress(0.5)
    numbers = {'size': float(np.ptp(np.concatenate(list(truth.places[0])), axis=0).max())}
    for who, q in found.items():
        numbers |= judged(who, models.parts, models.joined, truth.places, q)
    picture = scope.save(
        bodies(_panels(models, truth, found, view), 4, view.angles, view.tall),
        f'figure_{name}.png',
    )
    return Row(
        name, paper, told(numbers, 'recipe'), told(numbers, 'ours'), why, numbers, (picture,)
    )


def _panels(
    models: Models, truth: Truth, found: dict[str, list[list[FloatArray]]], view: View
) -> list[Shown]:
    """First models and truth, each followed by three frames of an estimator."""
    last = len(truth.points) - 1

    def panel(title: str, k: int, parts: Sequence[tuple[FloatArray, IntArray]]) -> Shown:
        turned = [(view.upright(position), triangles) for position, triangles in parts]
        return Shown(title, turned, view.upright(np.concatenate(list(truth.points[k]))))

    true = list(zip(truth.places[last], truth.triangles, strict=True))
    before = (
        panel('first models', 0, nets(models.parts, models.coordinates)),
        panel('truth, last frame', last, true),
    )
    panels: list[Shown] = []
    for first, (who, q) in zip(before, found.items(), strict=True):
        panels.append(first)
        panels += [
            panel(f'{who}, frame {k + 1}', k, nets(models.parts, q[k]))
            for k in (0, last // 2, last)
        ]
    return panels
