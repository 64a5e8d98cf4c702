"""What the commands `encode` and `decode` do, as one call each; prints nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from cloth_predict.commands import keep_source
from cloth_predict.config import Config, load
from cloth_predict.config.ruler_video import RulerVideoConfig, load_ruler_video
from cloth_predict.encoding.decode import Decoded, Progress, read_markers
from cloth_predict.encoding.encode import write_encoded
from cloth_predict.encoding.smoothed import smoothed
from cloth_predict.encoding.smoothed_bar import smoothed_bar
from cloth_predict.evaluation.cases import in_order
from cloth_predict.formats.bag import UNNAMED_FRAME, Recording, create_bag, write_recording
from cloth_predict.formats.pointcloud import encode_markers, encode_surface
from cloth_predict.formats.recording import read
from cloth_predict.tracker import NANOSECONDS
from cloth_predict.types import MarkerSequence

UNBOUNDED = 3.0
"""The bound by the noise of a measured coordinate where none is asked for: rounding to it makes as
much noise as the measurement has."""
SIZES = {
    'bag': 'a bag of the markers',
    'video': 'the video',
    'pictures': 'its pictures without compression',
}


@dataclass(frozen=True)
class Source:
    """What is encoded: markers, their model, and the noise [m] of a measured coordinate.

    sizes: bytes of what they come from, by what that is; faults: what is wrong with it.
    """

    markers: MarkerSequence
    config: Config | RulerVideoConfig
    noise: float
    sizes: dict[str, int]
    faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class Encoded:
    """How large a recording is, in bytes: encoded, and before, by what it was."""

    frames: int
    markers: int
    size: int
    sizes: dict[str, int]
    max_error: float
    faults: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Return the result for programs."""
        return {
            'frames': self.frames,
            'markers': self.markers,
            'max_error_mm': 1e3 * self.max_error,
            'bytes': self.size,
            **{f'{what}_bytes': size for what, size in self.sizes.items()},
            'ratio': self.size / self.sizes['bag'],
            'faults': list(self.faults),
        }

    def text(self) -> str:
        """Return the result for people."""
        shares = [
            f'{100 * self.size / size:.2g} % of {SIZES[what]}' for what, size in self.sizes.items()
        ]
        return (
            f'{self.frames} frames of {self.markers} markers to within {1e3 * self.max_error:.3g} '
            f'mm, {self.size / 1e3:.1f} kB, {", ".join(shares)}'
        )


@dataclass(frozen=True)
class Rebuilt:
    """What was rebuilt: so many frames at a rate [Hz], or as recorded, from those recorded.

    missing: share of the samples that are not there; fault: of the file, empty of a sound one.
    """

    recorded: int
    frames: int
    max_error: float
    rate: float | None
    missing: float
    fault: str

    def summary(self) -> dict[str, Any]:
        """Return the result for programs."""
        return {
            'recorded': self.recorded,
            'frames': self.frames,
            'max_error_mm': 1e3 * self.max_error,
            'rate_hz': self.rate,
            'missing': self.missing,
            'fault': self.fault or None,
        }

    def text(self) -> str:
        """Return the result for people."""
        missing = f'{self.missing:.1%} of the samples missing'
        if self.rate is None:
            return f'{self.frames} frames to within {1e3 * self.max_error:.3g} mm, {missing}'
        return f'{self.frames} frames at {self.rate:g} Hz from {self.recorded}, {missing}'


def encode(
    source: Path, config_path: Path, max_error: float | None, output: Path, progress: Progress
) -> Encoded:
    """Encode a recording's markers with a bound [m], or one that suits the markers' noise.

    Of a video of a sliding bar the markers are the two ends.
    """
    keep_source(source, output)
    found = (_video if is_video(source) else _recording)(source, config_path)
    markers = found.markers
    if max_error is None:
        max_error = UNBOUNDED * found.noise
    write_encoded(output, markers, found.config, max_error, str(source), progress)
    frames, columns = markers.visible.shape
    size = output.stat().st_size
    return Encoded(frames, columns, size, found.sizes, max_error, found.faults)


def is_video(source: Path) -> bool:
    """Whether a recording is one of pictures: MP4, or a folder of PNG files."""
    return source.suffix.lower() == '.mp4' or any(source.glob('*.png'))


def _recording(source: Path, config_path: Path) -> Source:
    config, markers = load(config_path), read(source).markers
    return Source(markers, config, config.filter.measurement_noise, {'bag': bag_size(markers)})


def _video(source: Path, config_path: Path) -> Source:
    from cloth_predict.video.ends import ends_in  # OpenCV, an optional extra

    config = load_ruler_video(config_path)
    markers, faults, pictures = ends_in(source, config)
    files = [source] if source.is_file() else source.glob('*.png')
    sizes = {
        'bag': bag_size(markers),
        'video': sum(file.stat().st_size for file in files),
        'pictures': pictures,
    }
    return Source(markers, config, config.ruler.position_noise, sizes, faults)


def bag_size(markers: MarkerSequence) -> int:
    """Bytes of an MCAP file that holds the markers, in zstd chunks."""
    with TemporaryDirectory() as folder:
        write_recording(Path(folder, 'bag'), Recording(markers))
        return sum(file.stat().st_size for file in Path(folder, 'bag').glob('*.mcap'))


def decode(
    source: Path,
    output: Path,
    rate: float | None,
    config_path: Path | None,
    states: bool,
    progress: Progress,
) -> Rebuilt:
    """Rebuild the markers of an encoded recording, as recorded or at a rate [Hz].

    config_path: what is smoothed with, if not with that of the recording; states: whether to write
    what the filter made of each frame as well.
    """
    found = read_markers(source, states, progress)
    markers, config = found.markers, found.config
    if config_path is not None:
        of_bar = isinstance(config, RulerVideoConfig)
        config = load_ruler_video(config_path) if of_bar else load(config_path)
    if rate is not None:
        markers = between(found.nodes, config, rate, progress)
    _write(output, markers, found)
    missing = float(1.0 - markers.visible.mean())
    recorded = len(found.markers)
    return Rebuilt(recorded, len(markers), found.max_error, rate, missing, found.fault)


def between(
    nodes: MarkerSequence, config: Config | RulerVideoConfig, rate: float, progress: Progress
) -> MarkerSequence:
    """Nodes of a surface, or ends of a bar, at so many frames per second, from first to last.

    One of which too little is known (`limits.sigma_error`) is not visible, nor is a bar between
    two motions.
    """
    nodes = in_order(nodes)
    first, last = nodes.stamps[[0, -1]].tolist()
    count = int((last - first) * rate / NANOSECONDS + 1e-6) + 1
    times = first + np.rint(np.arange(count) * (NANOSECONDS / rate)).astype(np.int64)
    if isinstance(config, RulerVideoConfig):
        positions = smoothed_bar(nodes, config.ruler, times)
        known = np.isfinite(positions[..., 0])
        progress(count, count)
    else:
        positions, sigma = smoothed(nodes, config, times, lambda done: progress(done, count))
        known = sigma <= config.limits.sigma_error  # nor where it is NaN
        positions = np.where(known[..., None], positions, np.nan)
    return MarkerSequence(times, nodes.labels, positions, known, nodes.frame_id)


def _write(output: Path, markers: MarkerSequence, found: Decoded) -> None:
    """Write markers and, where there are any, the states of the filter, in the order of time."""
    if not any(found.states):
        write_recording(output, Recording(markers))
        return
    frame_id = markers.frame_id or UNNAMED_FRAME
    clouds = [
        (stamp, '/markers', encode_markers(positions, visible, markers.unlabelled))
        for stamp, positions, visible in zip(
            markers.stamps.tolist(), markers.positions, markers.visible, strict=True
        )
    ]
    states = {state.stamp: state for state in found.states if state is not None}
    clouds += [
        (stamp, '/cloth/estimate', encode_surface(state, *found.shape))
        for stamp, state in states.items()
    ]
    with create_bag(output, markers.labels) as bag:
        for stamp, topic, points in sorted(clouds, key=lambda cloud: cloud[0]):
            bag.cloud(topic, stamp, frame_id, points)
