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
from cloth_predict.surface.assembly import build_mass_spring, rest_shape
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
    """Return the markers [m] of a towel without nodes between them, every 10 ms."""
    hung = rest_shape(config.model)
    mesh = build_mass_spring(towel(config.model.damping, 1, 'none'), hung)
    u, method = mesh.input(hung[mesh.driven]), INTEGRATORS['rk4']
    tilted = Rotation.from_rotvec([0.4, 0.0, 0.0]).apply(hung)[mesh.free]
    x, nodes = np.append(tilted.ravel(), np.zeros(mesh.dim_x // 2)), []
    for _ in range(FRAMES):
        nodes.append(mesh.surface(x, u)[0])
        for _ in range(4):
            x = method.step(mesh, x, u, 0.0025)
    return np.array(nodes)


def main() -> None:
    """Print a table."""
    print('| damping | mesh | force | look, ms | rest, s | sigma, s | true, s |')
    print('|---|---|---|---|---|---|---|')
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
            print(f'{head} {text} | | |')
            continue
        away = np.linalg.norm(nodes - found.surface.position, axis=2).max(axis=1)
        true = 0.01 * (np.flatnonzero(away > config.rest.near)[-1] + 1)
        at = 1e-9 * found.surface.stamp
        print(f'{head} {at:.2f} | {found.time_sigma:.2f} | {true:.2f} |')


if __name__ == '__main__':
    with one_core():
        main()
