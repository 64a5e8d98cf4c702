"""What each command does, as one call; prints nothing."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cloth_predict import config as configuration
from cloth_predict.config import Config
from cloth_predict.errors import (
    ClothPredictError,
    ClothPredictWarning,
    ConfigError,
    FormatError,
    FrameError,
)
from cloth_predict.evaluation.bodies import methods_of
from cloth_predict.evaluation.cases import case_of, split
from cloth_predict.evaluation.compare import Evaluation, compare, pooled
from cloth_predict.evaluation.degrade import NOTHING, Degradation, degraded
from cloth_predict.evaluation.predictors import Make
from cloth_predict.evaluation.projection import Compensation
from cloth_predict.evaluation.projection import project as light
from cloth_predict.evaluation.projection_report import report as report_projection
from cloth_predict.evaluation.report import report
from cloth_predict.filters.family import kinds_of
from cloth_predict.formats.bag import BagWriter, create_bag, write_recording
from cloth_predict.formats.calibration_file import DeviceCalibration, write_calibration
from cloth_predict.formats.files import make_folder
from cloth_predict.formats.pairs_csv import read_pairs
from cloth_predict.formats.pointcloud import encode_markers, encode_surface
from cloth_predict.formats.recording import read
from cloth_predict.projection.calibration import Calibration, calibrate
from cloth_predict.projection.calibration_report import complaints
from cloth_predict.simulation import recordings as simulation
from cloth_predict.tracker import Tracker
from cloth_predict.types import MarkerSequence

Progress = Callable[[int, int], None]
"""Called with what was done since the last call, and the total."""


def simulate(
    scenario: str,
    seed: int,
    duration: float,
    output: Path,
    progress: Callable[[float], None],
    labelled: bool = True,
) -> None:
    """Make a recording with known truth and write it."""
    write_recording(output, simulation.simulate(scenario, seed, duration, progress, labelled))


def convert(source: Path, output: Path) -> MarkerSequence:
    """Turn a recording of any known format into a bag."""
    keep_source(source, output)
    recording = read(source)
    write_recording(output, recording)
    return recording.markers


def predict(source: Path, config_path: Path, output: Path, progress: Progress) -> Counter[str]:
    """Write the estimate and the prediction of every frame; returns what became of the frames.

    A frame without a prediction is counted as `unpredicted`. Raises FormatError that says why
    where no frame has shown a surface.
    """
    keep_source(source, output)
    config = configuration.load(config_path)
    markers, strangers = split(read(source).markers, config, str(source))
    tracker, unpredicted, latest = Tracker(config), 0, None
    with create_bag(output, markers.labels + strangers.labels) as bag:
        for k, stamp in enumerate(markers.stamps.tolist()):
            bag.cloud('/markers', stamp, config.frame, _cloud(markers, strangers, k))
            points = strangers.positions[k][strangers.visible[k]]
            tracker.step(stamp, markers.positions[k], markers.visible[k], points)
            if tracker.started:
                try:
                    latest = _write(bag, tracker, config, latest)
                except FrameError:
                    unpredicted += 1
            progress(1, len(markers))
        if not tracker.started:
            raise FormatError(f'{source}: {tracker.health().text}')
    return tracker.counts + Counter(unpredicted=unpredicted)


def _cloud(markers: MarkerSequence, strangers: MarkerSequence, k: int) -> NDArray[np.void]:
    """Markers of a frame, those without a label after the others."""
    unlabelled = np.arange(len(markers.labels) + len(strangers.labels)) >= len(markers.labels)
    positions = np.concatenate([markers.positions[k], strangers.positions[k]])
    visible = np.concatenate([markers.visible[k], strangers.visible[k]])
    return encode_markers(positions, visible, unlabelled)


def _write(bag: BagWriter, tracker: Tracker, config: Config, latest: int | None) -> int:
    """Write the estimate and the prediction, once for each stamp [ns]; returns the latest."""
    estimate = tracker.estimate()
    if latest is not None and estimate.stamp == latest:
        return latest  # a late frame: at that stamp there is one already
    prediction = tracker.predict(config.horizon)
    for topic, surface in (('/cloth/estimate', estimate), ('/cloth/prediction', prediction)):
        cloud = encode_surface(surface, *config.model.shape)
        bag.cloud(topic, surface.stamp, config.frame, cloud)
    return estimate.stamp


@dataclass(frozen=True)
class Ladder:
    """What to compare: horizons [s], none of them means the configured one; kinds of filters.

    filters: choices of `filter.kind`, or `all`; none of them means the configured one.
    best_baselines: whether the kinematic filters get the noise that serves them best.
    """

    horizons: tuple[float, ...] = ()
    filters: tuple[str, ...] = ()
    best_baselines: bool = False
    degradation: Degradation = NOTHING

    def methods(self, config: Config) -> dict[str, Make]:
        """Return the methods by name.

        Raises ConfigError for a filter that does not work with the configuration; of all filters
        it leaves those out, with a warning.
        """
        kinds = kinds_of(config) if 'all' in self.filters else self.filters or [config.filter.kind]
        lacks = {kind: configuration.misfit(config, kind) for kind in kinds}
        for lack in filter(None, lacks.values()):
            if 'all' not in self.filters:
                raise ConfigError(lack)
            warnings.warn(lack, ClothPredictWarning, stacklevel=2)
        return methods_of(config, [kind for kind, lack in lacks.items() if not lack])


def evaluate(
    sources: Sequence[Path],
    config_path: Path,
    ladder: Ladder,
    output: Path | None,
    progress: Progress,
) -> list[Evaluation]:
    """Compare the predictors at each horizon on each recording and, if several, on all together.

    Writes tables, numbers and figures into a folder if one is given.
    """
    config = configuration.load(config_path)
    cases = [
        degraded(case_of(read(source), config, str(source)), ladder.degradation)
        for source in sources
    ]
    if output is not None:
        make_folder(output)
    makers = ladder.methods(config)
    total = len(makers) * sum(len(case.markers) for case in cases)
    found = [
        compare(
            case,
            config,
            ladder.horizons or (config.horizon,),
            makers,
            ladder.best_baselines,
            progress=lambda done: progress(done, total),
        )
        for case in cases
    ]
    if len(found) > 1:
        found.append([pooled(one, config) for one in zip(*found, strict=True)])
    if output is not None:
        report(found, config, output)
    return [evaluation for of_bag in found for evaluation in of_bag]


def calibrate_projector(
    source: Path,
    output: Path,
    resolution: tuple[int, int],
    throw: str,
    distortion: int,
    skew: bool,
) -> tuple[Calibration, tuple[int, ...]]:
    """Fit a projector to pairs and write its file; warns of what the pairs do not tell.

    Returns the calibration, and the lines of the pairs in their file.
    """
    keep_source(source, output)
    pairs = read_pairs(source, *resolution)
    try:
        found = calibrate(pairs.points, pairs.pixels, *resolution, throw, distortion, skew)
    except ClothPredictError as error:
        raise FormatError(f'{source}: {error}') from None
    device = found.pinhole
    parts = device.intrinsic, device.distortion, device.rotation, device.translation
    write_calibration(output, DeviceCalibration(*resolution, *parts), found.rms)
    for complaint in complaints(found, pairs.lines):
        warnings.warn(f'{source}: {complaint}', ClothPredictWarning, stacklevel=2)
    return found, pairs.lines


def project(
    source: Path,
    config_path: Path,
    delay: float,
    fps: float | None,
    output: Path | None,
    progress: Progress,
) -> Compensation:
    """Light a recording as the configured projector would, by four methods.

    delay [s]: from the capture of the markers to the start of the frame made of them; fps [Hz]
    takes the place of the configured one. Writes a table, numbers and figures into a folder if one
    is given.
    """
    config = configuration.load(config_path)
    if fps is not None:
        config = replace(config, projector=replace(config.projector, fps=fps))
    recording = read(source)
    case = case_of(recording, config, str(source))
    if output is not None:
        make_folder(output)
    total = len(case.markers)
    found = light(case, recording.truth, config, delay, lambda done: progress(done, total))
    if output is not None:
        report_projection(found, output)
    return found


def keep_source(source: Path, output: Path) -> None:
    """Raise FormatError where the output would replace what it is made from."""
    both_there = os.path.exists(source) and os.path.exists(output)
    if both_there and os.path.samefile(source, output):
        raise FormatError(f'{output}: is the recording itself; choose another output')
