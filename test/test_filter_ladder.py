"""Every kind of filter up one ladder: textbook, filterpy, statistics, springs, contract, tracker.

`LADDER` says which rungs a kind is held to, and why not to the others.
"""

import dataclasses
import functools
import warnings
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from filterpy.kalman import CubatureKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from filterpy.kalman import ExtendedKalmanFilter as FilterpyEKF
from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas
from references import (
    Linear,
    damped_oscillators,
    kalman_predict,
    kalman_update,
    random_surface,
    selection,
    state_jacobian,
    trapezoid,
)
from scipy.stats import chi2

from cloth_predict.config import FilterConfig, build
from cloth_predict.filters.family import BODY_FILTERS, FILTERS
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.observations import VisiblePositions
from cloth_predict.surface.assembly import rest_shape
from cloth_predict.tracker import Tracker
from cloth_predict.types import Gaussian

SIGMA, DT = 1e-3, 0.01
NO_INPUT = np.zeros(0)
MESH, STATE, INPUT = random_surface(np.random.default_rng(1), 2, 3, (0, 1, 2))
"""Three nodes hang from three driven ones, by springs slack and taut, far from rest."""


def coupled(rng):
    """Stable linear model in the coordinates of three nodes, each pulled by all."""
    return damped_oscillators(rng, 9)


def loose(rng):
    """Nodes that drag alone slows, and nothing couples."""
    zero, one = np.zeros((9, 9)), np.eye(9)
    return Linear(np.block([[zero, one], [zero, -0.3 * one]]))


def chain(rng):
    """A chain of three nodes, hung up and linearised."""
    mesh, x, u = random_surface(rng, 1, 4, (0,), rest=(0.8, 0.99))
    return Linear(state_jacobian(mesh, mesh.surface(x, u)[0]))


@dataclass(frozen=True)
class Rungs:
    """What theory promises of a kind."""

    textbook: str | None
    """The noise with which the textbook's filter is the same on a linear model: that of `density`,
    `none`, or what `forgetting` adds; None where there is no such filter."""
    settings: dict = field(default_factory=dict)
    """Parameters under which it is the same."""
    linear: tuple = (coupled, chain)
    """Linear models: for equality, and for statistics."""
    integrators: tuple = ('euler', 'implicit_euler', 'rk4')
    by_gain: bool = True
    """Whether the mean can be moved by a wrong share of what an update says."""
    tracks: bool = True
    """Whether it follows springs as stiff as a surface's."""


LADDER = {
    'ekf': Rungs('density'),
    'ukf': Rungs('density'),
    'ckf': Rungs('density'),
    # the fit to its window has no gain
    'least_squares': Rungs('none', {'window': 0.4}, by_gain=False),
    'recursive_least_squares': Rungs('forgetting', {'forgetting': 0.2}),
    # nodes by themselves, each with the implicit step: exact where nothing couples them
    'fixed_gain': Rungs('density', linear=(loose, loose), integrators=('implicit_euler',)),
    # exact with all modes
    'reduced_rank': Rungs('density', {'rank': 3}),
    # its transition matrix is not that of the step: no textbook's filter on any model
    'gomes2016': Rungs(None, tracks=False),
}
KINDS = list(FILTERS)
EXACT = [kind for kind in KINDS if LADDER[kind].textbook]


def made(kind, integrator='implicit_euler', **settings):
    config = build({'filter': {'kind': kind, 'integrator': integrator, **settings}}, 'test')
    return FILTERS[kind](config, MESH)


def covariance(belief):
    """Of all states, whatever the belief is made of."""
    size = len(belief.mean)
    return belief.marginals(np.arange(size)[None])[0]


def arrays(belief):
    """All that a belief holds, but for what it was shown."""
    if isinstance(belief, np.ndarray):
        return [belief]
    if isinstance(belief, tuple):
        return [array for part in belief for array in arrays(part)]
    if not dataclasses.is_dataclass(belief) or isinstance(belief, VisiblePositions):
        return []
    return [a for f in dataclasses.fields(belief) for a in arrays(getattr(belief, f.name))]


def test_the_configuration_offers_every_kind_and_each_is_on_the_ladder():
    (kind,) = (f for f in dataclasses.fields(FilterConfig) if f.name == 'kind')
    assert set(kind.metadata['choices']) == {*KINDS, *BODY_FILTERS}
    assert set(LADDER) == set(KINDS)


# --- the textbook's filter


def added_noise(textbook, F, P, density):
    """Covariance that a step adds to F P F'."""
    if textbook == 'density':
        return trapezoid(F, DT * density)
    return np.expm1(DT / 0.2) * F @ P @ F.T if textbook == 'forgetting' else np.zeros_like(P)


@pytest.mark.parametrize(
    ('kind', 'integrator'), [(kind, name) for kind in EXACT for name in LADDER[kind].integrators]
)
def test_on_a_linear_model_it_is_the_textbooks_filter(kind, integrator):
    rungs, rng = LADDER[kind], np.random.default_rng(2)
    model = rungs.linear[0](rng)
    q, R = np.repeat([0.0, 0.2], 9), 0.01 * np.eye(6)
    F = INTEGRATORS[integrator].step_jac(model, np.zeros(18), NO_INPUT, DT)[1]
    obs = VisiblePositions.of_nodes(np.array([0, 2]), 0.1)
    prior = Gaussian(rng.normal(size=18), np.diag(np.repeat([0.5, 2.0], 9)))
    kalman = made(kind, integrator, **rungs.settings)
    belief, x, P = kalman.start(prior, model, NO_INPUT, q), prior.mean, prior.cov
    for _ in range(30):
        z = rng.normal(size=6)
        x, P = kalman_predict(x, P, F, added_noise(rungs.textbook, F, P, q))
        H = selection(obs.rows, 18)
        S, residual = H @ P @ H.T + R, z - H @ x
        x, P = kalman_update(x, P, H, R, z)
        belief = kalman.predict(belief, model, NO_INPUT, q, DT)
        belief, learnt = kalman.update(belief, obs, z)
        np.testing.assert_allclose(belief.mean, x, atol=1e-9)  # the house bound
        np.testing.assert_allclose(covariance(belief), P, atol=1e-9)  # the same
        np.testing.assert_allclose(learnt.residual, residual, atol=1e-9)  # the same
        np.testing.assert_allclose(learnt.cov, S, atol=1e-9)  # the same
        nis = residual @ np.linalg.solve(S, residual)
        assert learnt.nis == pytest.approx(nis, rel=1e-6)  # 1e-9 over S of 0.01


# --- filterpy


class FilterpyTwin:
    """filterpy's filter of the same name, with half of the noise before a step, half after."""

    def __init__(self, kind, belief, integrator, model, dt):
        self.kind, size = kind, len(belief.mean)
        self.step_jac = lambda x: integrator.step_jac(model, x, INPUT, dt)

        def step(x, dt):
            return integrator.step(model, x, INPUT, dt)

        if kind == 'ekf':
            self.filter = FilterpyEKF(size, 1)
        elif kind == 'ckf':
            self.filter = CubatureKalmanFilter(size, 1, dt, hx=None, fx=step)
        else:
            points = MerweScaledSigmaPoints(size, FilterConfig().ukf_alpha, 2.0, 0.0)
            self.filter = UnscentedKalmanFilter(size, 1, dt, None, step, points)
        column = kind != 'ukf'
        self.filter.x = belief.mean[:, None].copy() if column else belief.mean.copy()
        self.filter.P = belief.cov.copy()

    def predict(self, noise):
        other, half = self.filter, np.diag(noise / 2)
        other.P, other.Q = other.P + half, half
        if self.kind == 'ekf':
            after, other.F = self.step_jac(other.x[:, 0])
            other.P = other.F @ other.P @ other.F.T + half
            other.x = after[:, None]
        else:
            other.predict()
        if self.kind == 'ckf':  # its update would go on with points that the noise has not spread
            other.sigmas_f = spherical_radial_sigmas(other.x, other.P)

    def update(self, obs, z):
        R, H = np.diag(obs.cov), selection(obs.rows, len(self.filter.x))
        if self.kind == 'ekf':
            self.filter.update(z[:, None], lambda x: H, lambda x: H @ x, R=R)
        elif self.kind == 'ckf':
            self.filter.sigmas_h = np.zeros((2 * len(self.filter.x), len(z)))
            self.filter.hx = obs.h
            self.filter.update(z[:, None], R=R)
        else:
            self.filter._dim_z = len(z)
            self.filter.update(z, R=R, hx=obs.h)


def on_springs():
    """Model of the mesh under unknown forces, densities of its noise, and a first belief."""
    model = Disturbed(MESH, 0.3)
    prior = Gaussian(np.append(STATE, np.zeros(9)), np.diag(np.repeat([1e-4, 0.25, 0.01], 9)))
    return model, np.repeat([0.0, 0.5, 0.07], 9), prior


def frames(count, seed=3):
    """Markers, a third of them missing, of a motion from another state, and its states."""
    rng = np.random.default_rng(seed)
    x = STATE + rng.normal(0, 0.01, MESH.dim_x)
    for _ in range(count):
        x = ImplicitEuler().step(MESH, x, INPUT, DT)
        obs = VisiblePositions.of_nodes(np.flatnonzero(rng.random(3) < 0.67), SIGMA)
        yield obs, x[obs.rows] + rng.normal(0, SIGMA, len(obs.rows)), x


@pytest.mark.parametrize('integrator', ['implicit_euler', 'rk4'])
@pytest.mark.parametrize('kind', ['ekf', 'ukf', 'ckf'])
def test_on_springs_it_is_filterpys_filter(kind, integrator):
    (model, q, belief), kalman, dt = on_springs(), made(kind, integrator), 0.005
    twin = FilterpyTwin(kind, belief, INTEGRATORS[integrator], model, dt)
    sizes = set()
    for obs, z, _ in frames(20):
        belief = kalman.predict(belief, model, INPUT, q, dt)
        belief, _ = kalman.update(belief, obs, z)
        twin.predict(dt * q)
        if len(z):
            twin.update(obs, z)
        sizes.add(len(z))
        # the house bound; positions of 0.5 m, velocities of 5 m/s, variances below 1
        np.testing.assert_allclose(belief.mean, twin.filter.x.ravel(), atol=1e-9)
        np.testing.assert_allclose(belief.cov, twin.filter.P, atol=1e-9)
    assert sizes == {3, 6, 9}  # the number of markers did change


# --- statistics


class ScaledGain:
    """A filter that goes by a wrong share of its gain, and knows nothing of it."""

    def __init__(self, inner, factor):
        self.inner, self.factor = inner, factor
        self.start, self.predict = inner.start, inner.predict

    def update(self, belief, obs, z):
        after, learnt = self.inner.update(belief, obs, z)
        mean = belief.mean + self.factor * (after.mean - belief.mean)
        return replace(after, mean=mean), learnt


def inside_the_bands(kind, r=1.0, q=1.0, gain=1.0):
    """Whether NEES and NIS of draws from the model lie in their chi-square bands of 99.8 %.

    The filter takes r times the variance of the markers, q times the density of the noise, and
    `gain` times its gain. Without noise in its theory, none is drawn.
    """
    rungs, rng, runs, steps = LADDER[kind], np.random.default_rng(4), 12, 20
    model = rungs.linear[1](rng)
    density = np.repeat([0.0, 2.0 if rungs.textbook in ('density', None) else 0.0], 9)
    endless = {'recursive_least_squares': {'forgetting': 1e9}, 'least_squares': {'window': 0.05}}
    kalman = made(kind, **(rungs.settings | endless.get(kind, {})))
    kalman = kalman if gain == 1.0 else ScaledGain(kalman, gain)
    F = ImplicitEuler().step_jac(model, np.zeros(18), NO_INPUT, DT)[1]
    seen = VisiblePositions.of_nodes(np.array([0, 2]), SIGMA)
    taken = replace(seen, cov=r * seen.cov)
    prior = Gaussian(np.zeros(18), np.diag(np.repeat([1e-4, 0.1], 9)))
    half, nees, nis = np.sqrt(DT * density / 2), 0.0, 0.0
    for _ in range(runs):
        truth = np.sqrt(np.diag(prior.cov)) * rng.normal(size=18)
        belief = kalman.start(prior, model, NO_INPUT, q * density)
        for _ in range(steps):
            truth = F @ (truth + half * rng.normal(size=18)) + half * rng.normal(size=18)
            belief = kalman.predict(belief, model, NO_INPUT, q * density, DT)
            z = truth[seen.rows] + rng.normal(0, SIGMA, 6)
            belief, learnt = kalman.update(belief, taken, z)
            nis += learnt.nis
        error = truth - belief.mean
        nees += error @ np.linalg.solve(covariance(belief), error)
    # innovations are independent, errors of one run are not: one NEES per run
    checks = ((nees, 18 * runs), (nis, 6 * runs * steps))
    return all(low < x < high for x, n in checks for low, high in [chi2.ppf([0.001, 0.999], n)])


@pytest.mark.parametrize('kind', EXACT)
def test_nees_and_nis_lie_in_their_bands(kind):
    assert inside_the_bands(kind)


WRONG = [{'r': 4.0}, {'r': 0.25}, {'q': 4.0}, {'q': 0.25}, {'gain': 0.5}, {'gain': 2.0}]


@pytest.mark.parametrize(
    ('kind', 'wrong'),
    [
        pytest.param(kind, wrong, id=f'{kind}-{wrong}')
        for kind in EXACT
        for wrong in WRONG
        if not ('q' in wrong and LADDER[kind].textbook != 'density')
        and not ('gain' in wrong and not LADDER[kind].by_gain)
    ],
)
def test_a_wrong_noise_or_gain_leaves_the_bands(kind, wrong):
    assert not inside_the_bands(kind, **wrong)


def test_the_thesis_recursion_leaves_the_bands():
    assert not inside_the_bands('gomes2016')


# --- springs


@functools.cache
def followed(kind, count=300):
    """Beliefs and true states on springs, over frames of which a third of the markers miss."""
    (model, q, prior), kalman = on_springs(), made(kind, window=0.04)
    belief, found = kalman.start(prior, model, INPUT, q), []
    for obs, z, truth in frames(count):
        belief = kalman.predict(belief, model, INPUT, q, DT)
        belief, _ = kalman.update(belief, obs, z)
        found.append((belief, truth))
    return found


@pytest.mark.parametrize('kind', EXACT)
def test_covariances_stay_symmetric_and_positive(kind):
    # exactly; but for the projection of the noise on the modes, a product
    slack = 1e-15 if kind == 'reduced_rank' else 0.0
    for belief, _ in followed(kind):
        P, largest = belief.cov, np.abs(belief.cov).max()
        np.testing.assert_allclose(P, P.swapaxes(-1, -2), rtol=0, atol=slack * largest)
    for belief, _ in followed(kind)[::10]:
        cov = covariance(belief)
        scale = np.sqrt(np.diag(cov))
        correlation = cov / np.outer(scale, scale)
        np.testing.assert_allclose(correlation, correlation.T, atol=1e-12)  # where it is a product
        assert np.linalg.eigvalsh(correlation)[0] > -1e-9  # rounding of P - W'W


@pytest.mark.parametrize('kind', [kind for kind in KINDS if LADDER[kind].tracks])
def test_it_follows_springs_of_which_a_third_is_unseen(kind):
    errors = [(belief.mean - np.append(x, np.zeros(9)))[:9] for belief, x in followed(kind)[100:]]
    # seen or not, a node is known better than one marker would tell: 0.13 to 0.81 sigma
    assert np.sqrt(np.mean(np.square(errors))) < SIGMA


@pytest.mark.parametrize('kind', KINDS)
def test_the_same_frames_give_the_same_bytes(kind):
    for (belief, _), (again, _) in zip(
        followed(kind, 6), followed.__wrapped__(kind, 6), strict=True
    ):
        assert [a.tobytes() for a in arrays(belief)] == [a.tobytes() for a in arrays(again)]


# --- the contract


@pytest.mark.parametrize('kind', KINDS)
def test_an_update_without_markers_changes_nothing_and_prints_nothing(kind, capfd):
    belief = followed(kind, 6)[-1][0]
    capfd.readouterr()
    obs = VisiblePositions.of_nodes(np.zeros(0, np.int64), SIGMA)
    after, learnt = made(kind).update(belief, obs, np.zeros(0))
    # LAPACK complains of an empty matrix on stdout, where `evaluate --json` writes
    assert capfd.readouterr() == ('', '')
    for before, same in zip(arrays(belief), arrays(after), strict=True):
        np.testing.assert_array_equal(same, before)
    assert (learnt.nis, learnt.residual.shape, learnt.cov.shape) == (0.0, (0,), (0, 0))


@pytest.mark.parametrize('integrator', ['implicit_euler', 'rk4'])
@pytest.mark.parametrize('kind', KINDS)
def test_a_forecast_is_as_many_predictions(kind, integrator):
    (model, q, _), belief, dt = on_springs(), followed(kind, 6)[-1][0], 0.005
    kalman = made(kind, integrator)
    rng = np.random.default_rng(5)
    inputs = [INPUT + rng.normal(0, 0.01, len(INPUT)) for _ in range(4)]
    rows = np.array([[0, 1, 2], [3, 17, 26], [8, 5, 20]])
    mean, cov = kalman.forecast(belief, model, inputs, q, dt, rows)
    for u in inputs:
        belief = kalman.predict(belief, model, u, q, dt)
    np.testing.assert_array_equal(mean, belief.mean)
    expected = belief.marginals(rows)
    scale = np.sqrt(np.abs(np.einsum('kii->ki', expected)))
    scale = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(cov / scale, expected / scale, atol=1e-9)  # products reordered


@pytest.mark.parametrize('kind', KINDS)
def test_a_forecast_by_no_step_is_the_belief(kind):
    (model, q, _), kalman, belief = on_springs(), made(kind), followed(kind, 6)[-1][0]
    rows = np.array([[3, 20], [20, 21]])
    mean, cov = kalman.forecast(belief, model, [], q, 0.01, rows)
    np.testing.assert_array_equal(mean, belief.mean)
    np.testing.assert_allclose(cov, belief.marginals(rows), rtol=1e-14)  # rounding


@pytest.mark.parametrize('kind', KINDS)
def test_beliefs_cannot_be_written_to_and_are_not_changed(kind):
    (model, q, prior), kalman = on_springs(), made(kind)
    belief, kept = kalman.start(prior, model, INPUT, q), []
    rows = np.arange(9).reshape(3, 3)
    for obs, z, _ in frames(4):
        u = INPUT.copy()
        kept.append((belief, [a.copy() for a in arrays(belief)]))
        belief = kalman.predict(belief, model, u, q, DT)
        kalman.forecast(belief, model, [u], q, DT, rows)
        kept.append((belief, [a.copy() for a in arrays(belief)]))
        belief, _ = kalman.update(belief, obs, z)
        kept.append((belief, [a.copy() for a in arrays(belief)]))
        u[:], z[:] = np.nan, np.nan  # they are the caller's, who may use them again
    for one, before in kept:
        for array, copy in zip(arrays(one), before, strict=True):
            np.testing.assert_array_equal(array, copy)
            assert not array.flags.writeable


@pytest.mark.parametrize('kind', KINDS)
def test_shapes(kind):
    (model, q, prior), kalman = on_springs(), made(kind)
    start = kalman.start(prior, model, INPUT, q)
    obs, z, _ = next(frames(1))
    moved = kalman.predict(start, model, INPUT, q, DT)
    after, learnt = kalman.update(moved, obs, z)
    for belief in (start, moved, after):
        assert belief.mean.shape == (27,)
        assert belief.marginals(np.arange(12).reshape(4, 3)).shape == (4, 3, 3)
    assert (learnt.residual.shape, learnt.cov.shape) == (z.shape, (len(z), len(z)))
    assert isinstance(learnt.nis, float)
    mean, cov = kalman.forecast(after, model, [INPUT], q, DT, np.arange(8).reshape(4, 2))
    assert (mean.shape, cov.shape) == ((27,), (4, 2, 2))


# --- the tracker


@pytest.mark.parametrize('kind', KINDS)
def test_the_tracker_runs_with_it(kind, capfd):
    config = build(
        {
            'model': {'rows': 3, 'cols': 3, 'width': 0.4, 'height': 0.4, 'mass': 0.05},
            'anchors': {'nodes': [0, 1, 2]},
            'force': {'kind': 'ornstein_uhlenbeck'},
            'filter': {'kind': kind, 'process_noise': 0.1, 'measurement_noise': SIGMA},
        },
        'test',
    )
    rng, rest, tracker = np.random.default_rng(6), rest_shape(config.model), Tracker(config)
    errors = []
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for k in range(40):
            swing = 0.02 * np.abs(rest[:, 1:2]) * np.sin(0.05 * k + np.array([0.0, 1.0, 2.0]))
            seen = rng.random(9) < (0.7 if k else 2.0)
            seen[:3] = True  # without a driven node there is no new start after a divergence
            tracker.step(k * 10**7, rest + swing + rng.normal(0, SIGMA, (9, 3)), seen)
            errors.append(tracker.estimate().position - rest - swing)
    assert capfd.readouterr() == ('', '')
    assert sum(tracker.counts.values()) >= 40
    if not LADDER[kind].tracks:
        assert tracker.counts['diverged'] > 0
        return
    assert dict(tracker.counts) == {'started': 1, 'updated': 39}
    # a motion that is not the model's: 0.65 to 0.75 sigma, 1.25 where no noise stands for that
    assert np.sqrt(np.mean(np.square(errors[10:]))) < 1.5 * SIGMA
    assert np.isfinite(tracker.predict(0.02).sigma).all()
