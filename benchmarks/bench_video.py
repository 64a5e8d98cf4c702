"""What a bar's friction and stop cost in accuracy from pixels: scenarios of Goeller et al. 2015.

From data with noise of 1 mm and half a degree (RMS of ten noises), from pictures, and from the
same pictures through an MP4 file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from cloth_predict.config.ruler import RulerConfig
from cloth_predict.performance import one_core
from cloth_predict.simulation.ruler import ANNEX_A, Slide, measured, slide
from cloth_predict.tracking.ruler import RulerTracker
from cloth_predict.video.commands import COMPRESSED
from cloth_predict.video.detector import BarDetector
from cloth_predict.video.files import Writer, frames
from cloth_predict.video.generator import Filming, camera_for, film
from cloth_predict.video.watching import Watcher

NOISES = 10
HOW = Filming()


def errors(
    stamps: Iterable[int],
    measurements: Iterable[np.ndarray | None],
    motion: Slide,
    mu: float,
    config: RulerConfig,
) -> np.ndarray:
    """Return errors of mu [%] at the end, and of the stop [mm, degrees] at half of the run."""
    tracker, half = RulerTracker(config), None
    rest = motion.at(np.array([motion.duration]))[0, :3]
    for stamp, z in zip(stamps, measurements, strict=True):
        tracker.step(stamp, z)
        if half is None and stamp >= 0.5e9 * motion.duration:
            half = tracker.stop().mean - rest
    assert half is not None
    of_mu = 100 * (tracker.belief.mean[-1] / mu - 1)
    return np.abs([of_mu, 1e3 * np.hypot(*half[:2]), np.degrees(half[2])])


def main() -> None:
    """Print a table."""
    print(f'{HOW.size[0]} x {HOW.size[1]}, noise {HOW.noise:g} of 255, {HOW.fps:g} Hz')
    print(
        '| scenario | mm/px | from | mu, % | stop, mm | stop, degrees |\n|---|---|---|---|---|---|'
    )
    for version, shot in ANNEX_A.items():
        motion, mu = slide(shot, 1e-9), float(shot.ruler.mu)
        camera = camera_for(motion, 1.0, HOW.size)
        detector = BarDetector(camera)
        stamps, pictures = [], []
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, 'film.mp4')
            watcher = Watcher(detector)
            with Writer(path, HOW.fps) as writer:
                for frame in film(motion, 1.0, camera, HOW, np.random.default_rng(0)):
                    stamps.append(frame.stamp)
                    pictures.append(watcher.see(frame).z)
                    writer.write(frame.picture)
            watcher = Watcher(detector)
            packed = [watcher.see(frame).z for frame in frames(path, HOW.fps)]
        exact, soft = (
            RulerConfig(g=10.0),
            RulerConfig(g=10.0, position_noise=COMPRESSED * camera.scale),
        )
        states = motion.at(np.array(stamps) / 1e9)
        data = [measured(states, 1.0, np.random.default_rng(seed)) for seed in range(NOISES)]
        rms = np.sqrt(np.mean([errors(stamps, z, motion, mu, exact) ** 2 for z in data], axis=0))
        for name, found in (
            ('data', rms),
            ('pictures', errors(stamps, pictures, motion, mu, exact)),
            ('MP4', errors(stamps, packed, motion, mu, soft)),
        ):
            numbers = ' | '.join(f'{one:.2g}' for one in found)
            print(f'| {version} | {1e3 * camera.scale:.1f} | {name} | {numbers} |', flush=True)


if __name__ == '__main__':
    with one_core():
        main()
