"""How long it takes to look ahead to the rest of a towel, and how right the time of rest is.

The towel of config/towel.yaml without wind and unknown forces, let go 0.4 rad from hanging; its
truth by RK4 at 2.5 ms.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from cloth_predict.config import Config, load
from cloth_predict.errors import UncertainError
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.performance import one_core
from cloth_predict.share import find
from cloth_predict.surface.assembly import (
    build_mass_spring,
    mesh_rest_shape,
    rest_shape,
    topology_of,
)
from cloth_predict.surface.layout import lay_out
from cloth_predict.tracker import Tracker

SEEN, FRAMES = 60, 1200


def towel(damping: float, refine: int, force: str) -> Config:
    """Return the configuration."""
    config = load(find('config/towel.yaml'))
    return replace(
        config,
        model=replace(config.model, damping=damping, refine=refine),
        force=replace(config.force, kind=force),
        wind=replace(config.wind, kind='none'),
        filter=replace(config.filter, process_noise=1e-6, hold=1),
    )


def swing(config: Config) -> np.ndarray:
    """Return the markers [m] of the towel, every 10 ms."""
    flat, hung = rest_shape(config.model), mesh_rest_shape(config.model)
    markers = lay_out(config, topology_of(config.model, flat), flat).markers
    mesh = build_mass_spring(config, flat)
    u, method = mesh.input(hung[mesh.driven]), INTEGRATORS['rk4']
    tilted = Rotation.from_rotvec([0.4, 0.0, 0.0]).apply(hung)[mesh.free]
    x, nodes = np.append(tilted.ravel(), np.zeros(mesh.dim_x // 2)), []
    for _ in range(FRAMES):
        nodes.append(mesh.surface(x, u)[0][markers])
        for _ in range(4):
            x = method.step(mesh, x, u, 0.0025)
    return np.array(nodes)


def damped(tracker: Tracker, config: Config, place: np.ndarray) -> float:
    """Return when it would rest [s] by the steps of first order that short predictions take."""
    now = tracker._track().now
    held, x, dt = now.driven.extrapolate(0.0)[0], tracker.belief.mean, config.filter.predict_step
    u, away, method = now.input(held, np.zeros_like(held)), [], INTEGRATORS['implicit_euler']
    for _ in range(round(config.rest.longest / dt)):
        away.append(np.linalg.norm(x[now.layout.rows] - place[now.layout.free], axis=1).max())
        x = method.step(now.model, x, u, dt)
    return 0.01 * (SEEN - 1) + dt * float(
        np.flatnonzero(np.array(away) > config.rest.near)[-1] + 1
    )


def main() -> None:
    """Print a table."""
    print('| damping | mesh | force | look, ms | rest, s | sigma, s | by Euler, s | true, s |')
    print('|---|---|---|---|---|---|---|---|')
    for damping, refine, force in (
        (0.02, 1, 'none'),
        (0.2, 1, 'none'),
        (0.2, 2, 'none'),
        (0.2, 1, 'ornstein_uhlenbeck'),
    ):
        config = towel(damping, refine, force)
        nodes, tracker = swing(config), Tracker(config)
        z = nodes[:SEEN] + np.random.default_rng(3).normal(0, 3e-4, nodes[:SEEN].shape)
        for k, positions in enumerate(z):
            tracker.step(10**7 * k, positions, np.ones(len(positions), bool))
        begin, found = time.perf_counter(), None
        try:
            found = tracker.rest()
        except UncertainError as error:
            text = str(error)
        took = 1e3 * (time.perf_counter() - begin)
        head = f'| {damping} | x{refine} | {force} | {took:.0f} |'
        if found is None:
            print(f'{head} {text} | | | |')
            continue
        away = np.linalg.norm(nodes - found.surface.position, axis=2).max(axis=1)
        true = 0.01 * (np.flatnonzero(away > config.rest.near)[-1] + 1)
        at = 1e-9 * found.surface.stamp
        euler = damped(tracker, config, found.surface.position)
        print(f'{head} {at:.2f} | {found.time_sigma:.2f} | {euler:.2f} | {true:.2f} |')


if __name__ == '__main__':
    with one_core():
        main()
