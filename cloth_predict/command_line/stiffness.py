"""The command `stiffness`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from cloth_predict.command_line.options import Add, positive
from cloth_predict.identification.analytic import Material, stiffness
from cloth_predict.models.stiffness import POISSON


def add(command: Add) -> None:
    """Add the command."""
    parser = command('stiffness', _stiffness, 'springs of a sheet from what it is made of')
    parser.config().json()
    parser.add('--young', type=positive, required=True, metavar='PA', help="Young's modulus")
    parser.add('--thickness', type=positive, required=True, metavar='M', help='in metres')
    parser.add(
        '--poisson',
        type=positive,
        default=POISSON,
        metavar='RATIO',
        help="Poisson's ratio; default 1/3, at which springs shear as a sheet does",
    )
    parser.add('-o', '--output', type=Path, help='parameter file to write')


def _stiffness(options: argparse.Namespace) -> None:
    material = Material(options.young, options.thickness, options.poisson)
    found = stiffness(options.config, material, options.output)
    print(json.dumps(found.summary()) if options.json else found.text())
