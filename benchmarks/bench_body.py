"""What dropping correlations costs and saves in the filter of a body of 123 nodes.

The truth moves by the filters' own model and noise, so that a full covariance is right and its
NEES is 1. Times are of one core of this machine; their ratios hold elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cloth_predict.filters.blocks import Blocks
from cloth_predict.filters.decoupled import Decoupled, position_covariances
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.integrators.exponential import Exponential
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.superquadric import GLOBAL, LOCAL, ROTATION, TRANSLATION, Superquadric
from cloth_predict.observations import NodePositions
from cloth_predict.performance import one_core
from cloth_predict.types import Filter, FloatArray, Gaussian

NODES, SIGMA, DT, HORIZON = 123, 3e-4, 0.01, 0.1
FRAMES, RUNS = 40, 3
SHAPE = np.array([0.3, 0.8, 0.7, 0.9, 1.0, 1.0, 0.1, 0.0, 0.02, 0.0, 0.5])
STEP = Exponential()


@dataclass
class Told:
    """What came out of the frames of one filter: errors [m], NEES per degree, seconds."""

    now: list[float] = field(default_factory=list)
    ahead: list[float] = field(default_factory=list)
    sure_now: list[float] = field(default_factory=list)
    sure_ahead: list[float] = field(default_factory=list)
    shared: list[float] = field(default_factory=list)
    taken: list[float] = field(default_factory=list)


def main() -> None:
    """Print a table for all nodes seen, and one for every other."""
    body = Superquadric(ClosedMesh.even(NODES), mass=0.05, reference=SHAPE)
    filters: dict[str, Filter[Any]] = {
        'full': ExtendedKalmanFilter(STEP),
        'pose': Decoupled(STEP, Blocks.of_body(body, 'pose')),
        'parts': Decoupled(STEP, Blocks.of_body(body, 'parts')),
    }
    for seen in (np.arange(NODES), np.arange(0, NODES, 2)):
        told = {name: Told() for name in filters}
        for run in range(RUNS):
            moved = list(truth(body, np.random.default_rng(run)))
            for name, kalman in filters.items():
                follow(kalman, body, moved, seen, np.random.default_rng(100 + run), told[name])
        show(told, len(seen))


def densities(body: Superquadric, places: Sequence[float], rates: Sequence[float]) -> FloatArray:
    """Values for translation, rotation, global and local coordinates, then their rates."""
    parts = np.empty((2, body.dim_q))
    for values, row in zip((places, rates), parts, strict=True):
        for at, value in zip((TRANSLATION, ROTATION, GLOBAL), values, strict=False):
            row[at] = value
        row[LOCAL:] = values[3]
    return parts.ravel()


def noise(body: Superquadric) -> FloatArray:
    """Spectral density of accelerations, shape (dim_x,)."""
    return densities(body, (0.0, 0.0, 0.0, 0.0), (0.3, 1.0, 0.02, 0.02))


def spread(body: Superquadric) -> FloatArray:
    """Standard deviations of the states at the start, shape (dim_x,)."""
    return densities(body, (0.01, 0.03, 0.01, 0.003), (0.1, 0.3, 0.03, 0.03))


def truth(body: Superquadric, rng: np.random.Generator) -> Iterator[FloatArray]:
    """States at each frame, and until the horizon after the last one."""
    still, half = np.zeros(body.dim_u), np.sqrt(0.5 * DT * noise(body))
    x = body.state(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), SHAPE)
    x += spread(body) * rng.normal(size=len(x))
    for _ in range(FRAMES + round(HORIZON / DT)):
        yield x
        x = STEP.step(body, x + half * rng.normal(size=len(x)), still, DT)
        x = x + half * rng.normal(size=len(x))


def follow(
    kalman: Filter[Any],
    body: Superquadric,
    moved: list[FloatArray],
    seen: np.ndarray[Any, Any],
    rng: np.random.Generator,
    told: Told,
) -> None:
    """Run a filter over the frames."""
    still, q = np.zeros(body.dim_u), noise(body)
    start = body.state(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), SHAPE)
    belief = kalman.start(Gaussian(start, np.diag(spread(body) ** 2)), body, still, q)
    obs, every = NodePositions(body, seen, SIGMA), NodePositions(body, np.arange(NODES), SIGMA)
    later = round(HORIZON / DT)
    shared = np.concatenate([np.arange(LOCAL), body.dim_q + np.arange(LOCAL)])
    for k in range(FRAMES):
        z = obs.h(moved[k]) + rng.normal(0, SIGMA, 3 * len(seen))
        begin = time.thread_time()
        belief, _ = kalman.update(belief, obs, z)
        ahead = kalman.predict(belief, body, still, q, HORIZON)
        expected = position_covariances(ahead, every)
        taken = time.thread_time() - begin
        if k >= 5:  # frames after the start
            told.taken.append(taken)
            judge(told.ahead, told.sure_ahead, body, ahead.mean, expected, moved[k + later])
            now = position_covariances(belief, every)
            judge(told.now, told.sure_now, body, belief.mean, now, moved[k])
            error = (belief.mean - moved[k])[shared]
            cov = belief.marginals(shared[None])[0]
            told.shared.append(float(error @ np.linalg.solve(cov, error)) / len(shared))
        belief = kalman.predict(belief, body, still, q, DT)


def judge(
    errors: list[float],
    sure: list[float],
    body: Superquadric,
    mean: FloatArray,
    cov: FloatArray,
    x: FloatArray,
) -> None:
    """Mean squared distance [m^2] of the nodes, and NEES of a node's position per coordinate."""
    error = body.position(mean) - body.position(x)
    errors.append(float(np.mean(np.sum(error**2, axis=1))))
    white = np.linalg.solve(cov, error[:, :, None])[:, :, 0]
    sure.append(float(np.mean(np.sum(white * error, axis=1)) / 3.0))


def show(told: dict[str, Told], seen: int) -> None:
    """Print a row for each filter."""
    full = told['full']
    print(f'{NODES} nodes, {seen} seen; ahead: {HORIZON} s; of nodes: position; NEES: 1 is right')
    print(
        f'{"":6} {"now mm":>7} {"NEES":>6} {"ahead mm":>9} {"NEES":>6} {"shared NEES":>12} '
        f'{"median ms":>10} {"99 %":>7} {"error":>7} {"ahead":>7} {"cost":>7} of full'
    )
    for name, own in told.items():
        now, ahead = (1e3 * np.sqrt(np.mean(values)) for values in (own.now, own.ahead))
        median = np.median(own.taken)
        ratios = (
            np.sqrt(np.mean(own.now) / np.mean(full.now)),
            np.sqrt(np.mean(own.ahead) / np.mean(full.ahead)),
            median / np.median(full.taken),
        )
        print(
            f'{name:6} {now:7.3f} {np.mean(own.sure_now):6.2f} {ahead:9.3f} '
            f'{np.mean(own.sure_ahead):6.2f} {np.mean(own.shared):12.2f} {1e3 * median:10.2f} '
            f'{1e3 * np.percentile(own.taken, 99):7.2f} {ratios[0]:7.3f} {ratios[1]:7.3f} '
            f'{ratios[2]:7.4f}'
        )


if __name__ == '__main__':
    with one_core():
        main()
