"""The command `cloth-predict`: parse, one call, print."""

from __future__ import annotations

import argparse
import json
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

from cloth_predict import __version__
from cloth_predict import commands as run
from cloth_predict.command_line import (
    calibrate_projector,
    compress,
    decode,
    encode,
    film,
    identify,
    overlay,
    project,
    reproduce,
    ruler,
    stiffness,
    tune,
)
from cloth_predict.command_line.options import (
    Command,
    counted,
    positive,
    progress_bar,
    whole,
)
from cloth_predict.errors import ClothPredictError, ClothPredictWarning
from cloth_predict.evaluation import report
from cloth_predict.evaluation.degrade import Degradation
from cloth_predict.filters.family import KINDS
from cloth_predict.performance import one_core
from cloth_predict.share import find
from cloth_predict.simulation.recordings import SCENARIOS


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

    def command(name: str, call: Callable[[argparse.Namespace], None], text: str) -> Command:
        added = commands.add_parser(name, help=text, description=text)
        added.set_defaults(call=call, usage=added.error)
        return Command(added)

    demo = command(
        'demo', _demo, 'run the live graph on a recording and show how well it predicts'
    )
    demo.config(find('config/towel.yaml')).json()
    demo.add('--bag', type=Path, default=find('bags/towel_fan'), help='recording to replay')
    demo.add('-o', '--output', type=Path, default=Path('out/demo'), help='folder for the results')
    simulate = command('simulate', _simulate, 'make a recording with known truth')
    simulate.add('scenario', choices=sorted(SCENARIOS))
    simulate.output_bag()
    simulate.add('--seed', type=whole, default=0)
    simulate.add('--duration', type=positive, default=12.0, metavar='S', help='length in seconds')
    simulate.add('--unlabelled', action='store_true', help='the markers have no labels')
    convert = command('convert', _convert, 'turn a Motive CSV export into a bag')
    convert.add('file', type=Path)
    convert.output_bag()
    predict = command('predict', _predict, 'predict a recording and write a bag of predictions')
    predict.add('bag', type=Path)
    predict.config().output_bag()
    evaluate = command('evaluate', _evaluate, 'compare predictors on recordings')
    evaluate.add('bag', type=Path, nargs='+', help='recording; several are told apart and pooled')
    evaluate.config().json()
    evaluate.horizon(nargs='+', default=[])
    evaluate.add(
        '--filters',
        nargs='+',
        default=[],
        choices=[*KINDS, 'all'],
        metavar='KIND',
        help=f'filters to compare: {", ".join(KINDS)}, or all; default: the configured one',
    )
    evaluate.add(
        '--best-baselines',
        action='store_true',
        help='give kf_cv and kf_ca the noise of the least error on each recording and horizon',
    )
    evaluate.add('-o', '--output', type=Path, help='folder for tables, figures and configuration')
    evaluate.degradation()
    project.add(command)
    calibrate_projector.add(command)
    identify.add(command)
    tune.add(command)
    stiffness.add(command)
    compress.add(command)
    encode.add(command)
    decode.add(command)
    film.add(command)
    ruler.add(command)
    overlay.add(command)
    reproduce.add(command)
    return parser


def _simulate(options: argparse.Namespace) -> None:
    with progress_bar(options.scenario, 's')(options.duration) as bar:
        run.simulate(
            options.scenario,
            options.seed,
            options.duration,
            options.output,
            bar.update,
            not options.unlabelled,
        )
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
    with progress_bar('predict', 'frame')(0) as bar:
        counts = run.predict(options.bag, options.config, options.output, counted(bar))
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
    with progress_bar('evaluate', 'frame')(0) as bar:
        found = run.evaluate(options.bag, options.config, ladder, options.output, counted(bar))
    print(json.dumps(report.summaries(found)) if options.json else report.text(found))


def _demo(options: argparse.Namespace) -> None:
    from cloth_predict.nodes.demo import demo  # ROS is needed by this command only

    with progress_bar('demo', 'frame')(0) as bar:
        result = demo(options.bag, options.config, options.output, counted(bar))
    if options.json:
        print(json.dumps(result.summary()))
    else:
        print(result.text())


if __name__ == '__main__':
    sys.exit(main())
