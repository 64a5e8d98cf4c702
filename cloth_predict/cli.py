"""The command `cloth-predict`: parse, one call, print."""

from __future__ import annotations

import argparse
import json
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cloth_predict import __version__
from cloth_predict import commands as run
from cloth_predict.config import Config, ProjectorConfig
from cloth_predict.errors import ClothPredictError, ClothPredictWarning
from cloth_predict.evaluation import projection_report, report
from cloth_predict.evaluation.degrade import Degradation
from cloth_predict.filters.family import FILTERS
from cloth_predict.performance import one_core
from cloth_predict.projection import calibration_report
from cloth_predict.projection.calibration import COUNTS
from cloth_predict.projection.pinhole import MIRRORS
from cloth_predict.share import find
from cloth_predict.simulate import SCENARIOS


def main(arguments: list[str] | None = None) -> int:
    """Run a command; known errors are one line on standard error and exit code 1."""
    options = _parser().parse_args(arguments)
    warnings.showwarning = _warn
    try:
        # the matrices are small: a second BLAS thread costs more than it computes
        with one_core():
            options.call(options)
    except ClothPredictError as error:
        print(f'cloth-predict: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _warn(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Print our own warnings as one line; those of libraries are not the user's business."""
    if issubclass(category, ClothPredictWarning):
        print(f'cloth-predict: warning: {message}', file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='cloth-predict', description='Predict where a moving surface will be.'
    )
    parser.add_argument('--version', action='version', version=__version__)
    commands = parser.add_subparsers(required=True, metavar='COMMAND')

    def command(name: str, call: Callable[[argparse.Namespace], None], text: str) -> _Command:
        added = commands.add_parser(name, help=text, description=text)
        added.set_defaults(call=call, usage=added.error)
        return _Command(added)

    demo = command(
        'demo', _demo, 'run the live graph on a recording and show how well it predicts'
    )
    demo.config(find('config/towel.yaml')).json()
    demo.add('--bag', type=Path, default=find('bags/towel_fan'), help='recording to replay')
    demo.add('-o', '--output', type=Path, default=Path('out/demo'), help='folder for the results')
    simulate = command('simulate', _simulate, 'make a recording with known truth')
    simulate.add('scenario', choices=sorted(SCENARIOS))
    simulate.output_bag()
    simulate.add('--seed', type=_whole, default=0)
    simulate.add('--duration', type=_positive, default=12.0, metavar='S', help='length in seconds')
    convert = command('convert', _convert, 'turn a Motive CSV export into a bag')
    convert.add('file', type=Path)
    convert.output_bag()
    predict = command('predict', _predict, 'predict a recording and write a bag of predictions')
    predict.add('bag', type=Path)
    predict.config().output_bag()
    evaluate = command('evaluate', _evaluate, 'compare predictors on recordings')
    evaluate.add('bag', type=Path, nargs='+', help='recording; several are told apart and pooled')
    evaluate.config().json()
    evaluate.add(
        '--horizon',
        type=_horizon,
        nargs='+',
        default=[],
        metavar='S',
        help='how far ahead to predict, in seconds; default: the configured one',
    )
    evaluate.add(
        '--filters',
        nargs='+',
        default=[],
        choices=[*FILTERS, 'all'],
        metavar='KIND',
        help=f'filters to compare: {", ".join(FILTERS)}, or all; default: the configured one',
    )
    evaluate.add(
        '--best-baselines',
        action='store_true',
        help='give kf_cv and kf_ca the noise of the least error on each recording and horizon',
    )
    evaluate.add('-o', '--output', type=Path, help='folder for tables, figures and configuration')
    evaluate.degradation()
    project = command(
        'project', _project, 'light a recording and tell where the light lands on the surface'
    )
    project.add('bag', type=Path, help='recording')
    project.config().json()
    project.add(
        '--delay',
        type=_delay,
        default=0.05,
        metavar='S',
        help='from the capture of the markers to the start of the frame; default 0.05',
    )
    project.add(
        '--fps', type=_rate, metavar='HZ', help='frames per second; default: projector.fps'
    )
    project.add('-o', '--output', type=Path, help='folder for table, figures and configuration')
    calibrate = command(
        'calibrate-projector',
        _calibrate_projector,
        'fit a projector to pairs of points and pixels',
    )
    calibrate.projector().json()
    return parser


class _Command:
    """Options that several commands share."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.add = parser.add_argument

    def config(self, default: Path | None = None) -> _Command:
        self.add(
            '-c',
            '--config',
            type=Path,
            default=default,
            required=default is None,
            help='parameter file (YAML)',
        )
        return self

    def json(self) -> _Command:
        self.add('--json', action='store_true', help='print one JSON object and nothing else')
        return self

    def degradation(self) -> _Command:
        """Options that make the recording worse; what it is compared with stays."""
        self.add('--drop', type=_share, default=0.0, metavar='SHARE', help='hide samples')
        self.add(
            '--burst', type=_positive, default=0.0, metavar='S', help='length of each such gap'
        )
        self.add(
            '--gone',
            nargs=2,
            default=(0, 0.0),
            metavar=('MARKERS', 'S'),
            action=_Gone,
            help='hide so many markers for so long, show all for as long, and again',
        )
        self.add(
            '--swap',
            type=_share,
            default=0.0,
            metavar='SHARE',
            help='swap two labels in this share of the frames',
        )
        self.add(
            '--unlabelled',
            action='store_true',
            help='take the labels away, but for hold, kf_cv and kf_ca, which need them',
        )
        self.add('--seed', type=_whole, default=0, help='of what is hidden, swapped or shuffled')
        return self

    def projector(self) -> _Command:
        """Options of a calibration."""
        self.add('pairs', type=Path, help='CSV with x, y, z (m, mocap frame) and u, v (pixels)')
        for side in ('width', 'height'):
            text = f'{side} of the frame in pixels'
            self.add(f'--{side}', type=_pixels, required=True, metavar='PX', help=text)
        self.add(
            '-o', '--output', type=Path, required=True, help='file to write, of OpenCV (YAML)'
        )
        self.add(
            '--distortion',
            type=int,
            default=0,
            choices=COUNTS,
            help='how many of k1, k2, p1, p2, k3 to fit; default: no lens',
        )
        self.add('--skew', action='store_true', help='fit the skew, too')
        self.add(
            '--throw',
            default='front',
            choices=MIRRORS,
            help='projector.throw with which the pairs were taken; default: front',
        )
        return self

    def output_bag(self) -> _Command:
        self.add('-o', '--output', type=Path, required=True, help='bag to write (a folder)')
        return self


class _Gone(argparse.Action):
    """A number of markers and a time in seconds."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option: str | None = None,
    ) -> None:
        try:
            namespace.gone = _whole(values[0]), _positive(values[1])
        except (ValueError, argparse.ArgumentTypeError) as error:
            raise argparse.ArgumentError(self, str(error)) from None


def _share(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f'{text} is not a share from 0 to 1')
    return value


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not a positive number')
    return value


def _horizon(text: str) -> float:
    value, most = _positive(text), Config.__dataclass_fields__['horizon'].metadata['high']
    if value > most:
        raise argparse.ArgumentTypeError(f'{text} s is more than {most} s')
    return value


def _delay(text: str) -> float:
    value = float(text)
    if not 0 <= value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} s is no delay: it is 0 or more')
    return value


def _rate(text: str) -> float:
    value, most = _positive(text), ProjectorConfig.__dataclass_fields__['fps'].metadata['high']
    if value > most:
        raise argparse.ArgumentTypeError(f'{text} Hz is more than {most:g} Hz')
    return value


def _whole(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f'{text} is negative')
    return value


def _pixels(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is not a number of pixels')
    return value


def _bar(text: str, unit: str) -> Callable[[float], tqdm]:
    """Progress bar; shows itself only on a terminal."""
    return lambda total: tqdm(total=total, desc=text, unit=unit, disable=None, leave=False)


def _simulate(options: argparse.Namespace) -> None:
    with _bar(options.scenario, 's')(options.duration) as bar:
        run.simulate(options.scenario, options.seed, options.duration, options.output, bar.update)
    print(f'{options.output}: {options.scenario}, {options.duration:g} s, seed {options.seed}')


def _convert(options: argparse.Namespace) -> None:
    markers = run.convert(options.file, options.output)
    missing = 1 - markers.visible.mean()
    seconds = (markers.stamps[-1] - markers.stamps[0]) / 1e9
    print(
        f'{options.output}: {len(markers)} frames, {seconds:.2f} s, {len(markers.labels)} markers'
        f', {missing:.1%} of the samples missing'
    )


def _predict(options: argparse.Namespace) -> None:
    with _bar('predict', 'frame')(0) as bar:
        counts = run.predict(options.bag, options.config, options.output, _counted(bar))
    print(f'{options.output}: ' + ', '.join(f'{n} frames {what}' for what, n in counts.items()))


def _evaluate(options: argparse.Namespace) -> None:
    if options.burst and not options.drop:
        options.usage('--burst needs --drop, the share that is hidden')
    gone, gone_for = options.gone
    worse = Degradation(
        options.drop,
        options.burst,
        gone,
        gone_for,
        options.swap,
        options.unlabelled,
        options.seed,
    )
    ladder = run.Ladder(
        tuple(options.horizon), tuple(options.filters), options.best_baselines, worse
    )
    with _bar('evaluate', 'frame')(0) as bar:
        found = run.evaluate(options.bag, options.config, ladder, options.output, _counted(bar))
    print(json.dumps(report.summaries(found)) if options.json else report.text(found))


def _calibrate_projector(options: argparse.Namespace) -> None:
    calibration, lines = run.calibrate_projector(
        options.pairs,
        options.output,
        (options.width, options.height),
        options.throw,
        options.distortion,
        options.skew,
    )
    if options.json:
        print(json.dumps(calibration_report.summary(calibration, lines)))
        return
    print(calibration_report.text(calibration, lines))
    print(f'{options.output}: for projector.calibration, with projector.throw: {options.throw}')


def _project(options: argparse.Namespace) -> None:
    with _bar('project', 'frame')(0) as bar:
        found = run.project(
            options.bag,
            options.config,
            options.delay,
            options.fps,
            options.output,
            _counted(bar),
        )
    if options.json:
        print(json.dumps(projection_report.summary(found)))
    else:
        print(projection_report.text(found))


def _demo(options: argparse.Namespace) -> None:
    from cloth_predict.nodes.demo import demo  # ROS is needed by this command only

    with _bar('demo', 'frame')(0) as bar:
        result = demo(options.bag, options.config, options.output, _counted(bar))
    if options.json:
        print(json.dumps(result.summary()))
    else:
        print(result.text())


def _counted(bar: tqdm) -> Callable[[int, int], None]:
    def show(done: int, total: int) -> None:
        bar.total = total
        bar.update(done)

    return show


if __name__ == '__main__':
    sys.exit(main())
