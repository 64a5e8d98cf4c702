"""Cost of one update plus a prediction 0.1 s ahead for 5 x 4 nodes, on one core.

Times are those of this machine; the ratios to filterpy's EKF on the same problem hold elsewhere.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter as Reference

from cloth_predict.config import Config, ForceConfig, load
from cloth_predict.formats.bag import read_recording
from cloth_predict.performance import one_core
from cloth_predict.tracker import Tracker

ROOT = Path(__file__).parents[1]


def timed(call: Callable[[int], object], frames: range) -> tuple[float, float]:
    """Median and 99th percentile [ms] of the calls."""
    taken = []
    for k in frames:
        begin = time.perf_counter()
        call(k)
        taken.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(taken)), float(np.percentile(taken, 99))


def main() -> None:
    """Print the table."""
    markers = read_recording(ROOT / 'bags' / 'towel_fan').markers
    towel = load(ROOT / 'config' / 'towel.yaml')
    print(f'{"states":>7} {"update + 0.1 s: median":>23} {"p99":>7} {"filterpy/ours":>14}   [ms]')
    for config in (dataclasses.replace(towel, force=ForceConfig()), towel):
        tracker = Tracker(config)

        def frame(k: int, tracker: Tracker = tracker, config: Config = config) -> None:
            stamp = int(markers.stamps[k])
            tracker.step(stamp, markers.positions[k], markers.visible[k])
            tracker.predict(config.horizon)

        timed(frame, range(100))
        median, p99 = timed(frame, range(100, 700))
        reference = filterpy_frame(tracker)
        ratio, _ = timed(reference, range(40))
        states = tracker._started().model.dim_x
        print(f'{states:7d} {median:23.2f} {p99:7.2f} {ratio / median:14.1f}')


def filterpy_frame(tracker: Tracker) -> Callable[[int], None]:
    """The same update and five steps of prediction by filterpy, with our Jacobian of the step."""
    now = tracker._started()
    model, belief, held = now.model, now.belief, now.driven.extrapolate(0.0)
    u, dt = now.mesh.input(held[0], held[1]), tracker.config.filter.predict_step
    rows = 3 * len(now.mesh.free)
    selection = np.eye(rows, model.dim_x)
    kalman = Reference(model.dim_x, rows)
    kalman.Q, kalman.R = np.diag(now.noise * dt), 1e-7 * np.eye(rows)

    def frame(_: int) -> None:
        kalman.x, kalman.P = belief.mean.copy(), belief.cov.copy()
        for step in range(6):
            kalman.x, kalman.F = now.filter.integrator.step_jac(model, kalman.x, u, dt)
            kalman.P = kalman.F @ kalman.P @ kalman.F.T + kalman.Q
            if step == 0:
                z = belief.mean[:rows]
                kalman.update(z, lambda _: selection, lambda x: x[:rows])

    return frame


if __name__ == '__main__':
    with one_core():
        main()
