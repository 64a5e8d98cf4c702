"""How small a recording gets, and how well frames between its frames are known; draws both.

The rope's recordings are left out where they are not there (see test/conftest.py).
"""

from __future__ import annotations

import argparse
import os
import tempfile
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import PropertyMock, patch

import matplotlib as mpl

mpl.use('Agg')
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import LogLocator

from cloth_predict.config import load
from cloth_predict.encoding.encode import write_encoded
from cloth_predict.encoding.interpolation import errors_between
from cloth_predict.encoding.recordings import bag_size
from cloth_predict.evaluation.cases import case_of
from cloth_predict.formats.recording import read
from cloth_predict.performance import one_core
from cloth_predict.tracker import Tracker

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get('CLOTH_PREDICT_DATA', ROOT.parent / 'shared' / 'data'))
BOUNDS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Millimetres."""
EVERY = (2, 4, 8, 16)
"""Of so many frames at 100 Hz one is given."""
RECORDINGS = {
    'towel': (ROOT / 'bags/towel_fan', 'towel.yaml', 'towel_between.yaml'),
    'rope': (DATA / 'rope/rope_take4.csv', 'rope.yaml', 'rope.yaml'),
}


@contextmanager
def without_the_model():
    """Let each marker go on as it moved, which is what is expected where there is no surface."""
    with patch.object(Tracker, 'started', new_callable=PropertyMock, return_value=False):
        yield


def sizes(recording, config):
    """Kilobytes at each bound, and of the bag of the markers alone."""
    markers, found = read(recording).markers, []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, 'small.mcap')
        for bound in BOUNDS:
            write_encoded(file, markers, config, 1e-3 * bound, str(recording))
            found.append(file.stat().st_size / 1e3)
            print(f'  {bound:5g} mm  {found[-1]:7.1f} kB', flush=True)
    return np.array(found), bag_size(markers) / 1e3


def draw_sizes(names, folder):
    """Draw the size of a file over its bound, with the model and without."""
    figure, axes = plt.subplots(1, len(names), figsize=(4.5 * len(names), 3.4), squeeze=False)
    for ax, name in zip(axes[0], names, strict=True):
        recording, config, _ = RECORDINGS[name]
        config = load(ROOT / 'config' / config)
        print(f'{name}: size by the bound')
        by_model, bag = sizes(recording, config)
        print(f'  a bag of the markers {bag:.1f} kB; without the model:')
        with without_the_model():
            by_motion, _ = sizes(recording, config)
        ax.plot(BOUNDS, 100 * by_model / bag, 'o-', label='the model')
        ax.plot(BOUNDS, 100 * by_motion / bag, 's--', label="each marker's motion")
        ax.axhline(25, color='grey', lw=0.8)
        ax.set(xscale='log', xlabel='bound (mm)', title=name, ylim=(0, None))
        ax.xaxis.set_major_formatter('{x:g}')
        ax.set_ylabel('size (% of a zstd bag of the markers)')
        ax.legend(title='expected by', frameon=False)
    figure.tight_layout()
    figure.savefig(folder / 'rate_distortion.png', dpi=110)


def measure_between(name):
    """RMS error [m] between the frames of a recording by method, for each of `EVERY`."""
    recording, _, config = RECORDINGS[name]
    config = load(ROOT / 'config' / config)
    case = case_of(read(recording), config, name)
    print(f'{name}: RMS error of the free nodes at the frames that are withheld, mm')
    found = []
    for every in EVERY:
        found.append(errors_between(case.markers, case.reference.markers, config, every))
        ratio = found[-1]['model'] / found[-1]['cubic']
        told = '  '.join(f'{method} {1e3 * error:.3f}' for method, error in found[-1].items())
        print(f'  {100 / every:5g} Hz  {told}  model / cubic {ratio:.2f}', flush=True)
    return found


def draw_between(found, folder):
    """Draw the error between frames over their rate, for each recording."""
    figure, axes = plt.subplots(1, len(found), figsize=(4.5 * len(found), 3.4), squeeze=False)
    rates = [100 / every for every in EVERY]
    for ax, (name, errors) in zip(axes[0], found.items(), strict=True):
        for method in errors[0]:
            ax.plot(rates, [1e3 * error[method] for error in errors], 'o-', label=method)
        ax.set(xscale='log', yscale='log', xlabel='frames given (Hz)', title=name)
        ax.set_ylabel('RMS error between them (mm)')
        ax.set_xticks(rates, [f'{rate:g}' for rate in rates])
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter('{x:g}')
        ax.minorticks_off()
        ax.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(folder / 'between.png', dpi=110)


def main():
    """Measure both, and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('-o', '--output', type=Path, default=Path('out/encoding'))
    folder = parser.parse_args().output
    folder.mkdir(parents=True, exist_ok=True)
    names = [name for name, (recording, *_) in RECORDINGS.items() if recording.exists()]
    with one_core():
        draw_between({name: measure_between(name) for name in names}, folder)
        draw_sizes(names, folder)


if __name__ == '__main__':
    main()
