"""What each command does, as one call; prints nothing."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from math import isnan, nan
from pathlib import Path

from cloth_predict import config as configuration
from cloth_predict import simulate as simulation
from cloth_predict.association import markers_of_nodes
from cloth_predict.config import Config
from cloth_predict.errors import FormatError
from cloth_predict.evaluation import Evaluation
from cloth_predict.evaluation import evaluate as compare
from cloth_predict.formats.bag import Recording, create_bag, write_recording
from cloth_predict.formats.pointcloud import encode_markers, encode_surface
from cloth_predict.formats.recording import read
from cloth_predict.predictors import METHODS
from cloth_predict.tracker import Tracker
from cloth_predict.types import MarkerSequence

Progress = Callable[[int, int], None]
"""Called with what was done since the last call, and the total."""


def simulate(
    scenario: str, seed: int, duration: float, output: Path, progress: Callable[[float], None]
) -> None:
    """Make a recording with known truth and write it."""
    write_recording(output, simulation.simulate(scenario, seed, duration, progress))


def convert(source: Path, output: Path) -> MarkerSequence:
    """Turn a recording of any known format into a bag."""
    keep_source(source, output)
    recording = read(source)
    write_recording(output, recording)
    return recording.markers


def predict(source: Path, config_path: Path, output: Path, progress: Progress) -> Counter[str]:
    """Write the estimate and the prediction of every frame; returns what became of the frames."""
    keep_source(source, output)
    config = configuration.load(config_path)
    markers = markers_of_nodes(read(source).markers, config, str(source))
    tracker, frame_id = Tracker(config), config.frame
    rows, cols = config.model.shape
    with create_bag(output, markers.labels) as bag:
        for k, stamp in enumerate(markers.stamps.tolist()):
            positions, visible = markers.positions[k], markers.visible[k]
            points = encode_markers(positions, visible, markers.unlabelled)
            bag.cloud('/markers', stamp, frame_id, points)
            outcome = tracker.step(stamp, positions, visible).outcome
            if tracker.started and outcome != 'late':
                for topic, surface in (
                    ('/cloth/estimate', tracker.estimate()),
                    ('/cloth/prediction', tracker.predict(config.horizon)),
                ):
                    cloud = encode_surface(surface, rows, cols)
                    bag.cloud(topic, surface.stamp, frame_id, cloud)
            progress(1, len(markers))
    return tracker.counts


def evaluate(
    source: Path,
    config_path: Path,
    horizons: list[float] | None,
    output: Path | None,
    progress: Progress,
) -> list[Evaluation]:
    """Compare the predictors at each horizon; writes tables and figures into a folder if given."""
    config = configuration.load(config_path)
    recording = read(source)
    markers = markers_of_nodes(recording.markers, config, str(source))
    reference = reference_of(recording, markers)
    chosen = horizons or [config.horizon]
    if output is not None:
        make_folder(output)
    total = len(chosen) * len(METHODS) * len(markers)
    found = [
        compare(
            markers,
            config,
            h,
            reference,
            progress=lambda done: progress(done, total),
            source=str(source),
        )
        for h in chosen
    ]
    if output is not None:
        for evaluation in found:
            report(evaluation, config, output, f'_{1e3 * evaluation.horizon:g}ms')
    return found


def keep_source(source: Path, output: Path) -> None:
    """Raise FormatError where the output would replace what it is made from."""
    both_there = os.path.exists(source) and os.path.exists(output)
    if both_there and os.path.samefile(source, output):
        raise FormatError(f'{output}: is the recording itself; choose another output')


def make_folder(path: Path) -> None:
    """Make a folder for results. Raises FormatError where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f'{path}: cannot be written: {error.strerror}') from None


def reference_of(recording: Recording, markers: MarkerSequence) -> MarkerSequence | None:
    """Return the true motion of the markers in use, or None where the recording has none."""
    if recording.truth is None:
        return None
    truth = recording.truth.markers(recording.markers)
    return truth.select([truth.labels.index(label) for label in markers.labels])


def report(evaluation: Evaluation, config: Config, output: Path, suffix: str = '') -> None:
    """Write the tables, the figures and the configuration used into a folder."""
    from cloth_predict import figures  # matplotlib takes half a second to import

    (output / f'table{suffix}.txt').write_text(table(evaluation) + '\n', encoding='utf-8')
    (output / f'details{suffix}.txt').write_text(details(evaluation) + '\n', encoding='utf-8')
    (output / 'config.yaml').write_text(configuration.dump(config), encoding='utf-8')
    figures.error_over_time(evaluation, output / f'error{suffix}.png')
    rows, cols = config.model.rows, config.model.cols
    figures.snapshots(evaluation, rows, cols, output / f'snapshots{suffix}.png')


def table(evaluation: Evaluation) -> str:
    """Return the comparison as text."""
    lines = [
        f'predicted {1e3 * evaluation.horizon:g} ms ahead, {len(evaluation.targets)} frames, '
        'errors in mm, 95 % interval of the RMS',
        f'{"method":10} {"RMS":>8} {"free":>8} {"p95":>8} {"max":>8} {"interval":>15} '
        f'{"us/frame":>9}',
    ]
    for name, s in evaluation.scores.items():
        numbers = ' '.join(f'{v:8.2f}' for v in (s.rmse_mm, s.rmse_free_mm, s.p95_mm, s.max_mm))
        low, high = s.rmse_95_mm
        interval = '-' if isnan(low) else f'{low:.2f}-{high:.2f}'
        lines.append(f'{name:10} {numbers} {interval:>15} {evaluation.us_per_frame[name]:9.0f}')
    return '\n'.join(lines)


def details(evaluation: Evaluation) -> str:
    """Return the coverage, the NIS and the errors by speed as text."""
    ends = [found.up_to_m_s for found in next(iter(evaluation.details.values())).by_speed]
    speeds = ' '.join(f'{_number(end, "<= ", " m/s"):>12}' for end in ends)
    lines = [
        'free nodes: share of errors within 1, 2, 3 sigma; NIS per degree of freedom; RMS in mm '
        'by speed',
        f'{"method":10} {"1 sigma":>8} {"2 sigma":>8} {"3 sigma":>8} {"NIS":>8} {speeds}',
    ]
    for name, found in evaluation.details.items():
        shares = [100 * share for share in found.coverage or (nan, nan, nan)]
        numbers = ' '.join(f'{_number(share, unit=" %", digits=1):>8}' for share in shares)
        errors = ' '.join(f'{_number(part.rmse_mm):>12}' for part in found.by_speed)
        lines.append(f'{name:10} {numbers} {_number(found.nis):>8} {errors}')
    return '\n'.join(lines)


def _number(value: float, before: str = '', unit: str = '', digits: int = 2) -> str:
    return '-' if isnan(value) else f'{before}{value:.{digits}f}{unit}'
