"""Warps the predicted surface for the moment at which each of its rows is drawn."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace

from sensor_msgs.msg import PointCloud2

from cloth_predict.errors import FrameError
from cloth_predict.formats.prediction import Prediction, UnsafeError, decode_prediction
from cloth_predict.nodes._clock import NodeClock
from cloth_predict.nodes._diagnostics import STEADY, Diagnostics
from cloth_predict.nodes._maps import MapWriter
from cloth_predict.nodes._ros import ConfiguredNode, cloud, nanoseconds, run
from cloth_predict.nodes._vsync import FrameTimer
from cloth_predict.projection.budget import Budget
from cloth_predict.projection.frames import Frames, Shown
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.tracking.horizons import EARLIEST, LATEST, PREDICTION


class ProjectorNode(ConfiguredNode):
    """Makes a frame of each prediction, or, with `horizon_mode: vsync`, one for each vsync."""

    _maps: MapWriter | None = None  # also of a node whose configuration is refused

    def __init__(self, **options: object) -> None:
        super().__init__('projector_node', **options)
        config = self.config.projector
        Pinhole.from_config(config)  # what is no projector ends the node here
        self._frames, self._budget = Frames(self.config), Budget()
        self._latest: Prediction | None = None
        self._arrived, self._unsafe, self._stale = 0.0, '', False
        self._seen, self._late = 0, 0
        self._vertices = self.publisher(PointCloud2, 'projector/vertices')
        self._scanlines = self.publisher(PointCloud2, 'projector/scanlines')
        if config.warp_map:
            self._maps = MapWriter(self, self.config.frame)
        self._diagnostics = Diagnostics(self, self._values, self._findings)
        self._timer: FrameTimer | None = None
        if self.config.horizon_mode == 'vsync':
            self._timer = FrameTimer(self, self._on_frame, self._frames.forget)
            self._time = self._timer.clock
        else:
            self._time = NodeClock(self)
            self.create_timer(min(0.25 * config.max_age, 1.0), self._on_idle, clock=STEADY)
        self.subscribe(PointCloud2, PREDICTION, self._on_prediction)

    def _on_prediction(self, message: PointCloud2) -> None:
        stamp = nanoseconds(message.header.stamp)
        try:
            self.check_frame(message.header)
            shape, frame = self.config.model.shape, 1.0 / self.config.projector.fps
            prediction = decode_prediction(message, stamp, shape, frame)
        except FrameError as error:
            self._diagnostics.drop('bad', str(error))
            if not isinstance(error, UnsafeError):
                return
            self._unsafe = str(error)
        else:
            self._seen += 1
            start = self._earliest(stamp) if self._timer is None else self._timer.start
            if start is None or not self._frames.offer(self._dated(prediction), start):
                return
            self._latest, self._arrived = prediction, time.monotonic()
            self._unsafe, self._stale = '', False
        if self._timer is None:
            self._on_frame(stamp)

    def _earliest(self, stamp: int) -> int:
        """Return the start [ns] of the last frame, unless time has jumped back from it."""
        last = self._latest.stamp if self._latest else stamp
        if last - stamp <= 1e9 * self.config.filter.max_backstep:
            return last
        self._frames.forget()
        return stamp

    def _dated(self, prediction: Prediction) -> Prediction:
        """Take one that does not tell when it was measured as measured now."""
        now = self._time.now()
        if prediction.capture is not None or now is None:
            return prediction
        return replace(prediction, horizon=1e-9 * (prediction.stamp - now))

    def _on_frame(self, start: int) -> None:
        """Make the frame that is due."""
        begin, now = time.perf_counter(), self._time.now()
        if self._latest is None:
            return
        if self._unsafe:
            shown = self._frames.fall_back(start, self._unsafe)
        else:
            chosen = self._frames.choose(start)
            capture = chosen.capture if chosen else None
            # a frame for each prediction needs no common clock: `_on_idle` knows when none comes
            timed = self._timer is not None and capture is not None and now is not None
            age = 1e-9 * (now - capture) if timed else 0.0  # type: ignore[operator]
            shown = self._frames.make(start, chosen, age)
        self._show(shown, begin)

    def _on_idle(self) -> None:
        """Fall back where no prediction comes any more; what is held is shown already."""
        config, latest = self.config.projector, self._latest
        since = time.monotonic() - self._arrived
        if latest is None or self._stale or since <= config.max_age:
            return
        self._stale = True
        begin, stamp = time.perf_counter(), latest.stamp + round(1e9 * since)
        text = f'no prediction for more than projector.max_age ({config.max_age:g} s)'
        shown = self._frames.fall_back(stamp, text)
        if config.fallback == 'blank':
            self._show(shown, begin)

    def _show(self, shown: Shown | None, begin: float) -> None:
        if shown is None:
            return
        frame = self.config.frame
        self._vertices.publish(cloud(shown.start, frame, shown.vertices))
        published = self._time.now()
        self._scanlines.publish(cloud(shown.start, frame, shown.scanlines))
        if self._maps and self._frames.warper:
            self._maps.offer(shown, self._frames.warper)
        self._diagnostics.frame(time.perf_counter() - begin)
        if published is not None:
            self._account(shown, published)

    def _account(self, shown: Shown, published: int) -> None:
        """Add a frame to the latency budget, where the clocks belong together."""
        prediction, warped = shown.prediction, shown.warped
        capture = prediction.capture if prediction else None
        if prediction is None or warped is None or capture is None:
            return
        if EARLIEST <= prediction.received <= LATEST:
            start = 1e-9 * (shown.start - capture)
            row = start + sum(float(one.dt.mean()) for one in warped.drawn) / len(warped.drawn)
            since = 1e-9 * (published - capture)
            vsync = start - self.config.projector.delay
            times = [0.0, prediction.received, prediction.filtered, since, vsync, row]
            self._budget.add(times)

    def _findings(self) -> Iterator[tuple[str, str]]:
        """What is wrong: with the predictions, the picture, and the vsyncs."""
        frames = self._frames
        if frames.flaw:
            shown = 'the last safe frame is held'
            if self.config.projector.fallback == 'blank' or not frames.started:
                shown = 'nothing is shown'
            yield 'ERROR', f'{frames.flaw}: {shown}'
        if frames.catching_up:
            yield 'WARN', 'the picture is on its way back from where it was held'
        if frames.empty:
            yield 'WARN', 'the surface is outside the frame of the projector: nothing is shown'
        late, seen = frames.counts['late'] - self._late, self._seen
        self._late, self._seen = frames.counts['late'], 0
        if 2 * late > seen:
            yield 'WARN', f'{late} of {seen} predictions were too late for their frame'
        for part in (self._timer, self._maps):
            if part:
                yield from part.findings()

    def _values(self) -> dict[str, object]:
        counts, timer = self._frames.counts, self._timer
        values: dict[str, object] = {
            **{f'vertices_{name}': n for name, n in self._frames.flags.items()},
            **{f'{name}_frames': counts[name] for name in ('held', 'blanked', 'empty')},
            'late_predictions': counts['late'],
            **self._budget.values(),
        }
        if timer:
            values |= {f'{name}_frames': timer.counts[name] for name in ('late', 'missed')}
        if self._maps:
            values |= {'warp_maps': self._maps.published, 'skipped_warp_maps': self._maps.skipped}
        return values

    def destroy_node(self) -> None:
        """End what runs beside the node as well."""
        if self._maps:
            self._maps.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(ProjectorNode, args)


if __name__ == '__main__':
    sys.exit(main())
