"""When, and in which shape, a sheet comes to rest: by itself, and live over DDS."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from live_graph import RELIABLE, frame, stamps, values
from scipy.linalg import solve_discrete_lyapunov
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from swinging_body import Feed, Swinging, settings

from cloth_predict.config import build
from cloth_predict.errors import ConfigError, FrameError, UncertainError
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.formats.pointcloud import decode
from cloth_predict.integrators.implicit_midpoint import ImplicitMidpoint
from cloth_predict.integrators.runge_kutta import RungeKutta
from cloth_predict.nodes.rest_node import RestNode
from cloth_predict.surface.assembly import build_mass_spring, rest_shape
from cloth_predict.tracker import Tracker
from cloth_predict.tracking.envelope import Envelope, adding_up, worst_sigma
from cloth_predict.types import Gaussian

MS = 10**6  # ns
STEP = 0.04
"""Of `rest.step`, s: the times are of no finer resolution."""
VALUES = {
    'model': {'rows': 3, 'cols': 3, 'width': 0.3, 'height': 0.4, 'mass': 0.1,
              'stiffness_structural': 200.0, 'stiffness_shear': 50.0,
              'stiffness_flexion': 20.0, 'damping': 0.1},
    'anchors': {'nodes': [0, 1, 2]},
    'filter': {'process_noise': 1e-6, 'measurement_noise': 3e-4, 'max_step': 0.005,
               'predict_step': 0.02},
    'rest': {'step': STEP},
}  # fmt: skip
FORCES = {'kind': 'ornstein_uhlenbeck', 'sigma': 1.0, 'tau': 1.0}


def sheet(**changes):
    """Configuration of a sheet of 3 x 3 nodes that hangs by its top row; changes by group."""
    groups = VALUES.keys() | changes.keys()
    given = {group: VALUES.get(group, {}) | changes.get(group, {}) for group in groups}
    return build(given, 'test')


@cache
def swing(duration, damping=0.1):
    """Nodes [m] of the sheet, let go 0.6 rad from hanging, every 10 ms, (frames, 9, 3)."""
    config = sheet(model={'damping': damping})
    hung = rest_shape(config.model)
    mesh = build_mass_spring(config, hung)
    u = mesh.input(hung[mesh.driven])
    tilted = Rotation.from_rotvec([0.6, 0.0, 0.0]).apply(hung)
    x, nodes = np.append(tilted[3:].ravel(), np.zeros(18)), []
    for _ in range(round(100 * duration)):
        nodes.append(np.concatenate([hung[:3], x[:18].reshape(-1, 3)]))
        for _ in range(2):
            x = RungeKutta().step(mesh, x, u, 0.005)
    return np.array(nodes)


def seen(nodes):
    """Markers [m] of a mocap system."""
    return nodes + np.random.default_rng(3).normal(0, 3e-4, nodes.shape)


def followed(config, frames, damping=0.1):
    """Tracker after the first frames of the swing."""
    tracker = Tracker(config)
    for k, z in enumerate(seen(swing(8.0, damping)[:frames])):
        tracker.step(10 * k * MS, z, np.ones(9, bool))
    return tracker


def last_far(nodes, shape, near=0.005):
    """Time [s] of the first frame from which on all nodes are near."""
    away = np.linalg.norm(nodes - shape, axis=2).max(axis=1)
    return 0.01 * (np.flatnonzero(away > near)[-1] + 1)


# --- the end of a motion


@pytest.mark.parametrize('damping', [0.2, 0.1, 0.02])
def test_a_sheet_rests_when_and_in_the_shape_that_it_does(damping):
    config = sheet(model={'damping': damping})
    tracker, nodes = followed(config, 100, damping), swing(8.0, damping)
    found = tracker.rest()
    shape = found.surface.position
    # a step; and the filter's own steps, of first order, leave the estimate 0.1 mm too near
    assert 0.99 + found.time == pytest.approx(last_far(nodes, shape), abs=2 * STEP)
    assert found.surface.stamp == round(1e9 * (0.99 + found.time))
    assert STEP / 12**0.5 <= found.time_sigma < 0.1
    now = tracker._track().now
    still = np.append(shape[3:].ravel(), np.zeros(18))
    force = now.mesh.f(still, now.mesh.input(shape[:3], np.zeros((3, 3))))
    assert np.abs(force).max() < 1e-6  # m/s^2: no force is left
    assert (found.surface.velocity == 0).all()
    assert found.surface.covariance.shape == (9, 3, 3)


def plain(tracker, config, shape):
    """Rows of (early, last, late) by looking all the way, to the end of `rest.longest`."""
    track, bounds = tracker._track(), config.rest
    now, dim = track.now, track.now.model.dim_x
    rows, place = now.layout.rows, shape[now.layout.free]
    u = now.input(now.driven.extrapolate(0.0)[0], np.zeros((3, 3)))
    belief = Gaussian(track.belief.mean, track.belief.marginals(np.arange(dim)[None])[0])
    kalman, ends = ExtendedKalmanFilter(ImplicitMidpoint()), np.zeros(3, int)
    for k in range(round(bounds.longest / bounds.step) + 1):
        away = np.linalg.norm(belief.mean[rows] - place, axis=1)
        sigma = worst_sigma(belief.marginals(rows))
        far = [(away + sign * sigma > bounds.near).any() for sign in (-1, 0, 1)]
        ends[far] = k + 1
        belief = kalman.predict(belief, now.model, u, now.noise, bounds.step)
    return ends


@pytest.mark.parametrize(
    'changes',
    [
        {},
        {'filter': {'process_noise': 0.0}},
        {'filter': {'process_noise': 1e-4}},
        {'filter': {'kind': 'fixed_gain'}},
        {'force': FORCES | {'sigma': 1e-3}},
        {'force': FORCES | {'sigma': 1e-3, 'kind': 'matern', 'tau': 0.2}},
        {'model': {'refine': 2}},
        {'rest': {'near': 0.02, 'step': STEP}},
    ],
)
def test_to_look_no_farther_than_needed_changes_nothing(changes):
    config = sheet(**changes)
    tracker = followed(config, 60)
    found = tracker.rest()
    early, last, late = plain(tracker, config, found.surface.position)
    assert found.time == pytest.approx((last - 0.5) * STEP, abs=1e-9)  # rounding
    spread = 0.5 * (late - early) * STEP
    assert found.time_sigma == pytest.approx(np.hypot(spread, STEP / 12**0.5), abs=1e-9)


def test_a_sheet_that_rests_already_rests_now():
    config, tracker = sheet(), Tracker(sheet())
    shape = followed(config, 100).rest().surface.position
    for k, z in enumerate(seen(np.repeat(shape[None], 100, axis=0))):
        tracker.step(10 * k * MS, z, np.ones(9, bool))
    found = tracker.rest()
    assert (found.time, found.surface.stamp) == (0.0, 990 * MS)
    assert found.time_sigma == pytest.approx(STEP / 12**0.5)
    assert found.doubt(config.rest) == ''


def test_what_is_not_certain_says_by_how_much():
    config = sheet(filter={'process_noise': 1e-3})
    found = followed(config, 60).rest()
    bounds = replace(config.rest, time=0.04)
    assert found.doubt(bounds) == (
        f'the sigma of the time at rest is {found.time_sigma:.2g} s, above rest.time of 0.04 s'
    )
    patient = replace(bounds, time=100.0)
    assert found.doubt(patient) == ''
    sigma = found.surface.sigma.max()
    assert found.doubt(replace(patient, position=0.9 * sigma)).startswith(
        f'the sigma of the shape at rest is {sigma:.2g} m, above rest.position of'
    )


def test_a_sheet_that_is_not_at_rest_in_time_has_no_end():
    tracker = followed(sheet(rest={'longest': 1.0}), 20)
    with pytest.raises(UncertainError, match=r'^no end of the motion within 1 s: markers are'):
        tracker.rest()


def test_under_forces_that_last_there_is_no_end():
    tracker = followed(sheet(force=FORCES), 20)
    with pytest.raises(UncertainError, match=r'^no end of the motion: where it rests, the noise'):
        tracker.rest()


def test_before_the_start_and_of_a_body_there_is_no_rest():
    tracker = Tracker(sheet())
    with pytest.raises(FrameError, match=r'^no surface yet: no frame yet$'):
        tracker.rest()
    body = Tracker(settings())
    Feed(body, Swinging())(0)
    with pytest.raises(FrameError, match=r'^a body \(model.kind superquadric\) tells no rest'):
        body.rest()


# --- the bound by which it is known that no marker gets far any more


def stable(rng, size=6, radius=0.95):
    """A step's derivative with this largest eigenvalue, and a covariance of its noise."""
    F = rng.normal(size=(size, size))
    root = rng.normal(size=(size, size))
    return F * radius / np.abs(np.linalg.eigvals(F)).max(), root @ root.T


def test_noise_adds_up_to_what_the_equation_of_lyapunov_says():
    F, noise = stable(np.random.default_rng(1))
    sums = list(adding_up(F, noise))
    direct, power = np.zeros((6, 6)), np.eye(6)
    for count in range(1, 9):
        direct, power = direct + power @ noise @ power.T, F @ power
        for number, found in sums:
            if number == count:
                np.testing.assert_allclose(found, direct, rtol=1e-12)  # rounding
    limit = solve_discrete_lyapunov(F, noise)
    np.testing.assert_allclose(sums[-1][1], limit, atol=1e-5 * limit.max())  # where it ends


def test_no_covariance_leaves_an_envelope():
    rng, rows, fade, steps = np.random.default_rng(2), np.array([[0, 1, 2], [3, 4, 5]]), 0.999, 500
    F, noise = stable(rng)
    for radius in (1.0, 1 / 0.97):  # dies away, and not at all
        turned = radius * F
        *_, (_, W) = adding_up(fade * turned, noise)
        envelope = Envelope.of(W, rows)
        root = rng.normal(size=(6, 6))
        cov = 20.0 * noise + root @ root.T
        most = envelope.reach * np.linalg.eigvals(np.linalg.solve(W, cov)).real.max() ** 0.5
        most = max(most, envelope.reach)
        assert envelope.keeps(cov, 1.001 * most)
        assert not envelope.keeps(cov, 0.999 * most)
        for k in range(steps):
            sigma = worst_sigma(Gaussian(np.zeros(6), cov).marginals(rows)).max()
            assert sigma <= 1.001 * most / fade**k
            cov = turned @ cov @ turned.T + noise


# --- live


PERIOD = 0.5
MODEL = {f'model.{name}': value for name, value in VALUES['model'].items()}
PARAMETERS = MODEL | {
    'anchors.nodes': [0, 1, 2],
    'filter.process_noise': 1e-6,
    'filter.max_step': 0.005,
    'rest.period': PERIOD,
}


class Live:
    """The node, and what it is sent."""

    def __init__(self, graph, **changes):
        self._graph = graph
        graph.listen('cloth/rest', PointCloud2)
        graph.listen('diagnostics', DiagnosticArray)
        self._node = graph.start(RestNode, **PARAMETERS, **changes)
        self._markers = graph.probe.create_publisher(PointCloud2, 'markers', RELIABLE)
        graph.until(
            lambda: (
                self._markers.get_subscription_count() == 1
                and all(graph.probe.count_publishers(t) for t in ('cloth/rest', 'diagnostics'))
            )
        )

    def send(self, *messages):
        """Send frames, one after the other, and wait until the node has taken them all."""
        before = self._taken()
        for message in messages:
            self._markers.publish(message)
        self._graph.until(lambda: self._taken() == before + len(messages))

    def _taken(self):
        return self._node._tracker.counts.total() + self._node._diagnostics.counts['bad']

    @property
    def rests(self):
        return self._graph.heard['cloth/rest']

    def told(self, words):
        """Wait for diagnostics with these words."""
        heard = self._graph.heard['diagnostics']
        self._graph.until(lambda: any(words in m.status[0].message for m in heard))


def frames(first, end, since=0):
    """Messages of the swing of frames first to end; since [ns]: the stamp of frame 0."""
    nodes = seen(swing(8.0))
    return [frame(since + 10 * k * MS, nodes[k]) for k in range(first, end)]


def test_the_rest_is_told_before_it_and_no_more_after_it(graph):
    live = Live(graph)
    live.send(*frames(0, 200))
    graph.until(lambda: live.rests)
    nodes, early = swing(16.0), live.rests[0]
    points = decode(early, ('x', 'y', 'z', 'sigma', 'time_sigma'))
    assert points.shape == (3, 3)
    shape = np.stack([points[axis] for axis in 'xyz'], axis=-1).reshape(9, 3)
    true = last_far(nodes, nodes[-1])
    assert true > 2.5
    assert stamps([early])[0] / 1e9 == pytest.approx(true, abs=0.1)
    assert np.abs(shape - nodes[-1]).max() < 0.003
    assert (points['sigma'] < 0.003).all()
    assert len(np.unique(points['time_sigma'])) == 1
    assert 0 < points['time_sigma'][0, 0] < 0.2
    assert early.header.frame_id == 'mocap'

    live.send(*frames(200, 800))
    graph.until(lambda: float(values(graph, '/rest_node').get('time_to_rest', 1.0)) == 0.0)
    ends = np.array(stamps(live.rests)) / 1e9
    assert ends == pytest.approx(np.full(len(ends), true), abs=0.1)
    assert len(ends) <= true / PERIOD  # one each period, and none once it rests


def test_a_recording_that_plays_again_is_told_again(graph):
    live = Live(graph, **{'filter.max_backstep': 1.0})
    live.send(*frames(0, 200))
    graph.until(lambda: live.rests)
    count = len(live.rests)
    live.send(*frames(0, 200))
    graph.until(lambda: len(live.rests) > count)
    # the same frames say the same; later ones depend on how long the first look took
    assert stamps(live.rests)[count] == stamps(live.rests)[0]


def test_bad_frames_are_dropped_and_counted(graph):
    live = Live(graph)
    good = frames(0, 200)
    nan = frame(5 * MS, np.full((9, 3), np.nan))
    other = frame(5 * MS, np.zeros((9, 3)), frame_id='elsewhere')
    live.send(*good[:100], nan, other, *good[100:])
    graph.until(lambda: live.rests)
    graph.until(lambda: values(graph, '/rest_node').get('bad_frames') == '2')
    live.told("frames dropped: 2 bad (frame_id 'elsewhere', expected 'mocap')")


def test_why_there_is_no_rest_is_told(graph):
    live = Live(graph, **{f'force.{name}': value for name, value in FORCES.items()})
    live.told('no surface yet: no frame yet')
    live.send(*frames(0, 60))
    live.told('no rest: no end of the motion: where it rests, the noise and the unknown forces')
    assert not live.rests


def test_a_body_ends_the_node(graph):
    with pytest.raises(ConfigError, match=r'^rest_node: model.kind: a superquadric tells no rest'):
        graph.start(RestNode, **{'model.kind': 'superquadric', 'model.nodes': 30})
