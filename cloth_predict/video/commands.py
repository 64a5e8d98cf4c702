"""The commands on videos, each as one call."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cloth_predict import config as configuration
from cloth_predict.config import dump
from cloth_predict.config.ruler import RulerConfig
from cloth_predict.config.ruler_video import RulerVideoConfig, VideoConfig
from cloth_predict.errors import FormatError, FrameError
from cloth_predict.evaluation.cases import ahead, split
from cloth_predict.formats.files import make_folder, writing
from cloth_predict.formats.recording import read
from cloth_predict.overlay import Shown, upwards
from cloth_predict.simulation.ruler import ANNEX_A, Shot, Slide, random_shot, slide
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import IntArray
from cloth_predict.video import generator
from cloth_predict.video.files import Writer, frames, rate_of
from cloth_predict.video.following import VideoFollower
from cloth_predict.video.overlay import augmented
from cloth_predict.video.report import RulerReport
from cloth_predict.video.surface import augmented as of_surface
from cloth_predict.video.view import View, camera_for

TRUTH = '# truth:'
"""Where the truth begins in the parameter file of a film."""
COMPRESSED = 0.25
"""Sigma of a centre [px] in a picture that was compressed."""


def follow(
    video: Path, config: RulerVideoConfig, overlay: Path, progress: Callable[[int], object]
) -> RulerReport:
    """Follow a bar through a video, and write the augmented view of it.

    A video that ends in a fault is told up to there. Raises FormatError where no frame of it can
    be read, or none shows a bar.
    """
    report, follower = RulerReport(), VideoFollower(config)
    with Writer(overlay, rate_of(video, config.video.fps)) as writer:
        try:
            for frame in frames(video, config.video.fps):
                seen = follower.see(frame)
                report.add(seen)
                writer.write(augmented(seen, follower.detector.calibration))
                progress(1)
        except FormatError as error:
            if report.last is None:
                raise
            report.faults.append(str(error))
    if report.last is None:
        fault = report.faults[0] if report.faults else 'no frame'
        raise FormatError(f'{video}: nothing to follow in {report.frames} frames: {fault}')
    health = follower.tracker.health()
    if health.level != 'OK':
        report.faults.append(health.text)
    return report


def film(path: Path, shot: str, how: generator.Filming, seed: int) -> tuple[int, Path]:
    """Film a bar: a scenario of annex A by its number, or a `random` shot.

    Beside the video goes a parameter file, which ends in the truth as comments. Returns the number
    of frames and that file.
    """
    rng = np.random.default_rng(seed)
    let_go = random_shot(rng) if shot == 'random' else ANNEX_A[int(shot)]
    motion, length = slide(let_go), float(let_go.ruler.L)
    camera = generator.camera_for(motion, length, how.size)
    count, beside = 0, path.with_suffix('.yaml')
    if beside.exists() and TRUTH not in beside.read_text(encoding='utf-8'):
        raise FormatError(f'{beside}: exists and was not made by `film`; not overwritten')
    with Writer(path, how.fps) as writer:
        for frame in generator.film(motion, length, camera, how, rng):
            writer.write(frame.picture)
            count += 1
    config = RulerVideoConfig(
        ruler=RulerConfig(g=let_go.ruler.g, position_noise=COMPRESSED * camera.scale),
        camera=camera,
        video=VideoConfig(path=str(path), fps=how.fps),
    )
    make_folder(beside.parent)
    with writing(beside):
        beside.write_text(dump(config) + _truth(let_go, motion), encoding='utf-8')
    return count, beside


def overlay(
    source: Path,
    config_path: Path,
    output: Path,
    fps: float,
    view: View | None,
    progress: Callable[[int, int], None],
) -> tuple[int, str]:
    """Follow the surface of a recording and write the augmented view of it.

    Of the frames of the recording the latest one is shown at each time of the video. Returns the
    number of frames of the video, and what was lacking for a surface, if there was none. Raises
    FormatError.
    """
    if os.path.lexists(output):
        raise FormatError(f'{output}: exists; not overwritten')
    config = configuration.load(config_path)
    with Writer(output, fps) as writer:
        markers, strangers = split(read(source).markers, config, str(source))
        every, stamps = markers.beside(strangers), markers.stamps
        known = every.positions[every.visible & np.isfinite(every.positions).all(axis=2)]
        if not len(known):
            raise FormatError(f'{source}: no marker is visible in any frame')
        camera = camera_for(known, upwards(config), view)
        tracker, count, found = Tracker(config), 0, False
        for k, times in enumerate(repeats(stamps, fps, config.filter.max_gap)):
            points = strangers.positions[k][strangers.visible[k]]
            tracker.step(int(stamps[k]), markers.positions[k], markers.visible[k], points)
            found, count = found or tracker.started, count + times
            if times:
                time = (int(stamps[k]) - int(stamps[0])) / NANOSECONDS
                seen = every.positions[k][every.visible[k]]
                picture = of_surface(shown_of(tracker), seen, time, camera)
                for _ in range(times):
                    writer.write(picture)
            progress(1, len(markers))
    return count, '' if found else tracker.health().text


def repeats(stamps: IntArray, fps: float, longest: float) -> list[int]:
    """How often each frame at stamps [ns] is shown in a video.

    A frame that is not later than all before it is not; no gap is longer than `longest` [s].
    """
    latest = np.flatnonzero(ahead(stamps))
    gaps = np.minimum(np.diff(stamps[latest]) / NANOSECONDS, longest)
    times = np.append(0.0, np.cumsum(gaps)) * fps
    rounding = 1e-6  # of a frame
    grid = np.arange(int(times[-1] + rounding) + 1) + rounding
    shown = latest[np.searchsorted(times, grid, side='right') - 1]
    return [int(count) for count in np.bincount(shown, minlength=len(stamps))]


def shown_of(tracker: Tracker) -> Shown | None:
    """What a tracker knows now and at its horizon; None where it has no surface."""
    if not tracker.started:
        return None
    horizon = tracker.config.horizon
    try:
        prediction = tracker.predict(horizon)
    except FrameError:
        prediction = None
    return Shown.of(tracker, prediction, horizon, tracker.health())


def _truth(shot: Shot, motion: Slide) -> str:
    ruler, (x, y, angle) = shot.ruler, motion.at(np.array([motion.duration]))[0, :3]
    return (
        f'{TRUTH} L {ruler.L:g}, L1 {ruler.L1:g}, L2 {ruler.L2:g}, mu {ruler.mu:g}; '
        f'at rest after {motion.duration:.4f} s at x {x:.4f}, y {y:.4f}, angle {angle:.4f}\n'
    )
