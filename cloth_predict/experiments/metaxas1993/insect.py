"""Figures 9 and 10: an insect of five parts and four joints, with many points and with few."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloth_predict.experiments.metaxas1993.following import Models, Truth, View, followed
from cloth_predict.experiments.metaxas1993.joined import JoinedFilter, JoinedRecipe, Points
from cloth_predict.experiments.metaxas1993.object import INTERVAL, model
from cloth_predict.experiments.metaxas1993.ours import Ours, Settings
from cloth_predict.experiments.metaxas1993.recipe import Recipe
from cloth_predict.experiments.rows import Experiment, Row, Scope
from cloth_predict.models import rotation
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.joints import Joint
from cloth_predict.simulation.bodies import INSECT, Moved, insect_scene
from cloth_predict.simulation.filming import film
from cloth_predict.types import FloatArray

DENSE = (
    'five parts of 27 nodes, four joints, 27 points on each, 36 frames: the forces of the joints '
    'help to configure the parts, which follow (no number given)'
)
SPARSE = 'the same with 7 points on each part: follows, but the shapes of the wings differ'
FRAMES, NODES, FEW = 36, 27, 7
SCALE = 10.0
"""Units of a0 in a metre of the simulated insect: 2 for half a wing."""
SEED = 1993
FIRST_SHAPE = np.array([2.0, 0.8, 0.07, 0.07, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5])
"""The paper's first model of every part."""
ALPHA = 60.0
"""Rate at which joints close [1/s]. The paper tells none of the insect, and 6 of its arms, with
which the joints are left open by 1.2 here."""
SIGMA = 0.05
"""What a point is off its nearest node, for ours."""
OUTWARD = {
    'body': (1.0, 0.0, 0.0), 'head': (1.0, 0.0, 0.0), 'tail': (-1.0, 0.0, 0.0),
    'wing_left': (0.0, 0.0, -1.0), 'wing_right': (0.0, 0.0, 1.0),
}  # fmt: skip
"""Where the x axis of each first model points, away from the joint; y is up."""
WHY = (
    'The motion is another one. The recipe takes the next frame at rates below 2.5 in a second: '
    f'with a = b = {ALPHA:g} a joint that is open by less than {2.5 / ALPHA:.1g} closes no '
    'further in a frame. Ours takes the joints as measurements without noise.'
)


def flown(frames: int) -> FloatArray:
    """Places of the nodes of all parts, shape (frames, 5, 27, 3), in the paper's units."""
    scene, starts, forces = insect_scene(np.random.default_rng(SEED), NODES)
    start = np.append(scene.join(starts), 0.0)
    times = INTERVAL * np.arange(frames, dtype=np.float64)
    places = film(Moved(scene, forces), start, times, 5e-3, lambda seconds: None)
    return SCALE * places.reshape(frames, len(INSECT), NODES, 3)


def first_models(points: Points) -> Models:
    """Ellipsoids at the middle of their points, their states, and the joints between them."""
    models = Models([], [], [])
    for index, (limb, towards) in enumerate(zip(INSECT.values(), OUTWARD.values(), strict=True)):
        part = model(NODES, FIRST_SHAPE)
        directions = part.mesh.directions
        ahead, up = np.array(towards), np.array([0.0, 1.0, 0.0])
        turn = np.stack([ahead, np.cross(up, ahead), up], axis=1)
        models.states.append(
            part.state(points[index].mean(axis=0), rotation.from_matrix(turn), FIRST_SHAPE)
        )
        if models.parts:
            root = int((-directions[:, 0]).argmax())
            held = int((directions @ np.array(limb.at)).argmax())
            models.joints.append(Joint(0, held, index, root))
        models.parts.append(part)
    return models


def run(few: bool, scope: Scope) -> Row:
    """Figure 9, or 10 with few points."""
    places = flown(8 if scope.quick else FRAMES)
    rng = np.random.default_rng(SEED)
    chosen = [np.sort(rng.permutation(NODES)[: FEW if few else NODES]) for _ in INSECT]
    points = [[own[nodes] for own, nodes in zip(frame, chosen, strict=True)] for frame in places]
    models = first_models(points[0])
    ours = Ours(SIGMA, INTERVAL, Settings(push=2.0, turn=2.0, local=0.3))
    return followed(
        ('10', SPARSE, WHY) if few else ('9', DENSE, WHY),
        models,
        Truth(points, [list(p) for p in places], [ClosedMesh.even(NODES).triangles] * len(INSECT)),
        (
            JoinedRecipe(Recipe(), models.joined, ALPHA),
            JoinedFilter(models.joined, ours),
        ),
        View((40.0, -50.0), 0.75, _upright),
        scope,
    )


def _upright(position: FloatArray) -> FloatArray:
    """Turn y, which is up, to the vertical of a picture."""
    return position[:, [0, 2, 1]] * [1.0, -1.0, 1.0]


EXPERIMENTS = (
    Experiment(('9',), DENSE, partial(run, False)),
    Experiment(('10',), SPARSE, partial(run, True)),
)
