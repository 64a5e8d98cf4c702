"""A configuration whose springs come from what the sheet is made of (Gomes 2016, section 6.4)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cloth_predict import config as configuration
from cloth_predict.config import Config
from cloth_predict.errors import ClothPredictWarning, ConfigError
from cloth_predict.identification.provenance import with_provenance, write_configuration
from cloth_predict.models.stiffness import Carried, SheetStiffness, analytic_stiffness, carried
from cloth_predict.surface.assembly import build_mass_spring, mesh_rest_shape, rest_shape


@dataclass(frozen=True)
class Material:
    """What a sheet is made of: Young's modulus [Pa], thickness [m], Poisson's ratio."""

    young: float
    thickness: float
    poisson: float


@dataclass(frozen=True)
class Analytic:
    """A configuration with the springs of a material, and what its steps make of them."""

    material: Material
    config: Config
    stiffness: SheetStiffness
    carried: Carried

    def summary(self) -> dict[str, Any]:
        """Return the numbers as `stiffness --json` prints them."""
        return {
            'structural_mean_n_m': self.stiffness.structural,
            'shear_n_m': self.stiffness.shear,
            'springs_n_m': self.stiffness.springs.tolist(),
            'stiffest_mode_rad_s': self.carried.omega,
            'step_s': self.carried.dt,
            'left_of_it_after_a_step': self.carried.kept,
            'explicit_limit_s': self.carried.explicit_limit,
            'condition_of_a_step': self.carried.condition,
        }

    def text(self) -> str:
        """Return the result as `stiffness` prints it."""
        at = self.carried
        return (
            f'structural {self.stiffness.structural:.4g} N/m on average (half of it on the '
            f'border), shear {self.stiffness.shear:.4g} N/m\n'
            f'stiffest mode {at.omega:.4g} rad/s; a step of {at.dt:g} s leaves {at.kept:.3g} of it'
        )

    def file(self) -> str:
        """Return the parameter file, with its provenance as comments."""
        m = self.material
        notes = {
            'material': f"Young's modulus {m.young:g} Pa, thickness {m.thickness:g} m, "
            f"Poisson's ratio {m.poisson:g}"
        }
        if complaint := self.carried.complaint:
            notes['caution'] = complaint
        return with_provenance(self.config, 'Springs by cloth-predict stiffness', notes)


def analytic(config: Config, material: Material) -> Analytic:
    """Replace the springs of a configuration; flexion springs, which would stretch too, have none.

    Raises ConfigError where the model is no grid, and ClothPredictError where no such springs are.
    """
    model = config.model
    if model.topology != 'grid':
        raise ConfigError(f'model.topology: {model.topology} has no cells of known size')
    size = model.width, model.height, *model.mesh
    found = analytic_stiffness(material.young, material.thickness, *size, material.poisson)
    if not np.isfinite(found.springs).all():
        raise ConfigError(
            f"Young's modulus {material.young:g} Pa times thickness {material.thickness:g} m is "
            f'more than a number can hold'
        )
    springs = tuple(float(f'{k:.6g}') for k in found.springs)
    config = replace(config, model=replace(model, springs=springs))
    mesh = build_mass_spring(config, rest_shape(model))
    step = carried(mesh, mesh_rest_shape(model), config.filter.max_step)
    return Analytic(material, config, found, step)


def stiffness(config_path: Path, material: Material, output: Path | None) -> Analytic:
    """Do what the command does: warns of what no step can carry, and writes a parameter file."""
    found = analytic(configuration.load(config_path), material)
    if complaint := found.carried.complaint:
        warnings.warn(complaint, ClothPredictWarning, stacklevel=2)
    if output is not None:
        write_configuration(output, found.file())
    return found
