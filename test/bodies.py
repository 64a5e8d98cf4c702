"""What the tests of bodies share: a body that moves, and its belief as one matrix."""

import numpy as np

from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.superquadric import Superquadric

REFERENCE = np.array([0.3, 1.0, 0.8, 0.9, 1.0, 1.0, 0.1, 0.0, 0.02, 0.0, 0.5])


def body(nodes=20, seed=1, **settings):
    """A body that moves, stretches and turns, its state, and forces on it."""
    rng = np.random.default_rng(seed)
    settings = {'beta': 0.002, 'gravity': (0.0, 0.0, -9.81), **settings}
    model = Superquadric(ClosedMesh.even(nodes), mass=0.05, reference=REFERENCE, **settings)
    theta, d = rng.normal(size=4), rng.normal(0, 0.01, 3 * nodes)
    x = model.state(rng.normal(size=3), theta / np.linalg.norm(theta), REFERENCE, d)
    x[model.dim_q :] = rng.normal(0, 0.3, model.dim_q) * model.moving
    return model, x, rng.normal(0, 0.002, model.dim_u)


def whole_covariance(belief):
    """Covariance of all states, shape (dim_x, dim_x)."""
    return belief.marginals(np.arange(len(belief.mean))[None])[0]
