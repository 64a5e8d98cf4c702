"""What a tracker believes of unknown forces: against simulations under forces that are known."""

import numpy as np
import pytest
from recordings import BAG, beginning
from references import central_differences
from scipy.stats import chi2
from swinging_body import FRAME, Swinging, settings

from cloth_predict.config import build, load
from cloth_predict.errors import FrameError
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.surface.assembly import build_mass_spring, mesh_rest_shape
from cloth_predict.surface.equilibrium import settled
from cloth_predict.surface.layout import lay_out
from cloth_predict.surface.topology import grid
from cloth_predict.tracker import Tracker

FORCE = np.array([0.02, -0.015, 0.05])
"""N on each free node."""
SIGMA = 3e-4  # m
EVERY = np.ones(20, bool)
FORCES = slice(96, 144)
"""Where the state has them, after 16 positions and velocities."""


def sheet(refine=1, **force):
    """A sheet of 0.3 x 0.4 m that hangs from its first row."""
    return build(
        {
            'model': {
                'rows': 5,
                'cols': 4,
                'width': 0.3,
                'height': 0.4,
                'mass': 0.1,
                'refine': refine,
            },
            'anchors': {'nodes': [0, 1, 2, 3]},
            'force': {'kind': 'matern', 'sigma': 0.1, 'tau': 0.5, **force},
            'filter': {'process_noise': 1e-3, 'measurement_noise': SIGMA},
        },
        'test',
    )


def pushed_sheet(config, frames=100):
    """Markers [m], shape (frames, 20, 3), of its mesh, let go under the force, with noise."""
    flat = mesh_rest_shape(config.model)
    layout = lay_out(config, grid(5, 4), flat[:20])
    mesh = build_mass_spring(config, flat[:20], layout)
    u = mesh.input(flat[mesh.driven])
    start = settled(mesh, u, flat)
    u = mesh.input(flat[mesh.driven], force=np.tile(FORCE, len(mesh.free)))
    x = np.concatenate([start[mesh.free].ravel(), np.zeros(mesh.dim_x // 2)])
    found = []
    for _ in range(frames):
        found.append(mesh.surface(x, u)[0][layout.markers])
        for _ in range(10):
            x = ImplicitEuler().step(mesh, x, u, 1e-3)
    noise = np.random.default_rng(1).normal(0.0, SIGMA, (frames, 20, 3))
    return np.array(found) + noise, layout, len(mesh.free)


def followed(config, markers):
    tracker = Tracker(config)
    for k, positions in enumerate(markers):
        tracker.step(k * FRAME, positions, EVERY)
    return tracker


@pytest.fixture(scope='module')
def pushed():
    config = sheet()
    return followed(config, pushed_sheet(config)[0])


def within_three_sigma(error, cov, weights):
    """Whether the error of a weighed sum of forces is what its covariance says, each axis."""
    summed = np.kron(weights, np.eye(3))
    return bool((np.abs(error) < 3.0 * np.sqrt(np.diag(summed @ cov @ summed.T))).all())


def test_loads_of_a_sheet_are_the_force_that_pushes_it(pushed):
    loads = pushed.loads()
    assert not loads[:4].any()  # of what is driven
    error, cov = (loads[4:] - FORCE).ravel(), pushed.belief.cov[FORCES, FORCES]
    assert error @ np.linalg.solve(cov, error) < chi2.ppf(0.999, len(error))
    mean = loads[4:].mean(axis=0)
    assert within_three_sigma(mean - FORCE, cov, np.full(16, 1 / 16))
    # the covariance above says 0.0007 N a component, of 0.056 N
    assert mean @ FORCE > np.cos(0.03) * np.linalg.norm(mean) * np.linalg.norm(FORCE)


def test_loads_of_a_finer_mesh_add_up_to_the_force_on_all_of_its_nodes():
    config = sheet(refine=2)
    markers, layout, free = pushed_sheet(config)
    tracker = followed(config, markers)
    rows = slice(6 * free, 6 * free + 48)
    weights = layout.interpolation.sum(axis=0) / 4.0  # a marker's force is that of 4 nodes
    error = tracker.loads().sum(axis=0) - free * FORCE
    assert within_three_sigma(error, tracker.belief.cov[rows, rows], weights)
    assert np.linalg.norm(error) < 0.05 * free * np.linalg.norm(FORCE)


def test_loads_in_wind_are_its_pressure_on_the_parts_of_the_markers():
    config = load(BAG.parents[1] / 'config' / 'towel.yaml')
    recorded = beginning(60).markers
    tracker = Tracker(config)
    for k, stamp in enumerate(recorded.stamps.tolist()):
        tracker.step(stamp, recorded.positions[k], recorded.visible[k])
    now = tracker._track().now
    u, mean, layout = now.input(*now.driven.extrapolate(0.0)[:2]), now.belief.mean, now.layout
    position, _ = now.mesh.surface(mean, u)
    unknown, free = now.model.load(mean), now.mesh.free
    gust, common = now.mesh.wind_of(unknown)
    pressed = now.mesh.air.at(position).force(np.zeros_like(position), gust, common)[free]
    every = pressed + unknown[: 3 * len(free)].reshape(-1, 3)
    # 1e-9: accelerations of some hundred m/s^2 are subtracted
    np.testing.assert_allclose(
        tracker.loads()[layout.free], layout.interpolation.T @ every, atol=1e-9
    )


def test_loads_of_a_body_give_it_the_acceleration_with_which_it_is_carried():
    acceleration, config = np.array([0.5, -1.0, 0.8]), settings(body__alpha=0.0)
    tracker, markers = Tracker(config), Swinging().markers(0.0)
    rng, none = np.random.default_rng(0), np.zeros((300, 3))
    for k in range(80):
        carried = markers + 0.5 * acceleration * (1e-9 * k * FRAME) ** 2
        points = carried + rng.normal(0.0, SIGMA, markers.shape)
        tracker.step(k * FRAME, none, np.zeros(300, bool), points)
    track = tracker._track()
    body, shown = track.assembly.body, track.assembly.shown
    push = body.dim_x + np.arange(3)
    known = np.sqrt(np.diag(tracker.belief.marginals(push[None])[0]))
    assert (np.abs(tracker.belief.mean[push] - acceleration) < 3.0 * known).all()
    # a body at rest that is pushed for a short time has gone along the push
    q, way = tracker.belief.mean[: body.dim_q], np.zeros(body.dim_q)
    way[:7] = tracker.belief.mean[body.dim_x :][:7]
    gone = central_differences(lambda h: shown.position(q + h * way).ravel(), np.zeros(1), 1e-6)
    found = tracker.loads() / (config.model.mass * shown.mesh.shares[:, None])
    # 1e-8: rounding of positions of 1 m, by the step of 1e-6
    np.testing.assert_allclose(found.ravel(), gone[:, 0], atol=1e-8)


def test_there_are_no_loads_where_none_are_states():
    config = sheet(kind='none')
    assert followed(config, pushed_sheet(sheet(), 2)[0]).loads() is None
    with pytest.raises(FrameError, match='no surface yet'):
        Tracker(config).loads()
