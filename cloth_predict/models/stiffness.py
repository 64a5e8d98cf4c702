"""Stiffness of springs from what a sheet is made of, and what a step makes of it.

The springs of a cell of a x b, with thickness t, are to store the energy that the sheet of Young's
modulus E and Poisson's ratio ν stores in every uniform strain. Forces along springs alone make a
shear modulus that equals the coupling C12, which is that of the sheet at ν = 1/3 only (Lloyd,
Székely and Harders 2007 find the same for triangles). At another ν the sheet stretches as it
should, and shears as one of ν = 1/3 would.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt

import numpy as np
from scipy import sparse

from cloth_predict.errors import ClothPredictError
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import grid_pairs
from cloth_predict.types import FloatArray, IntArray

POISSON = 1.0 / 3.0
"""The ratio at which springs are exact in shear too."""
RK4_LIMIT = 2.0 * sqrt(2.0)
"""Angle [rad] that the fastest undamped mode may turn in a step of RK4."""
FAST = 10.0
"""Angle [rad] per implicit step from which on a mode is damped out rather than moved: a tenth is
left of it. The towels of the package are at 3, and lose nothing that can be seen."""
SINGULAR = 1e12
"""Condition number of a step's matrix from which on a solve keeps less than 4 of its 16 digits."""


@dataclass(frozen=True)
class SheetStiffness:
    """Stiffness [N/m] of the springs of a grid, shape (springs,) in the order of `grid_pairs`.

    Springs on the border belong to one cell, those inside to two, so that they are twice as stiff.
    Springs to the nodes two away, which would make the sheet stiffer still, have none.
    structural, shear: the means, for a configuration that has one value for each family.
    """

    springs: FloatArray
    structural: float
    shear: float


def analytic_stiffness(
    young: float,
    thickness: float,
    width: float,
    height: float,
    rows: int,
    cols: int,
    poisson: float = POISSON,
) -> SheetStiffness:
    """Stiffness of the springs of a sheet (what Gomes 2016, eq. 6.19 takes from Lloyd 2007).

    young [Pa]; thickness, width (first to last column) and height (first to last row) [m]. With
    C = E t / (1 - ν^2), each cell of a x b adds C (b/a - ν a/b) / 2 to both of its springs along
    a, C (a/b - ν b/a) / 2 to those along b, and gives its two diagonals C ν (a^2 + b^2) / (2 a b).
    Raises ClothPredictError where no such springs exist.
    """
    _check(young, thickness, width, height, rows, cols, poisson)
    a, b = width / (cols - 1), height / (rows - 1)
    membrane = young * thickness / (1.0 - poisson**2)
    along_a, along_b = membrane * (b / a - poisson * a / b), membrane * (a / b - poisson * b / a)
    if min(along_a, along_b) < 0:
        raise ClothPredictError(
            f'no springs have the stiffness of a sheet with cells of {a:g} x {b:g} m: those along '
            f'the long side would push; one side may be at most {1 / sqrt(poisson):.3g} times the '
            f'other, so choose other rows and columns'
        )
    diagonal = membrane * poisson * (a**2 + b**2) / (2.0 * a * b)
    pairs = grid_pairs(rows, cols)
    structural = _structural(pairs['structural'], rows, cols, along_a, along_b)
    shear = np.full(len(pairs['shear']), diagonal)
    none = np.zeros(len(pairs['flexion']))
    every = np.concatenate([structural, shear, none])
    return SheetStiffness(every, float(structural.mean()), float(shear.mean()))


def lloyd_2007(young: float, length: FloatArray, elements: FloatArray) -> FloatArray:
    """Stiffness [N/m] of the springs of a solid of regular tetrahedra, shape (springs,).

    k = sum over the tetrahedra with this edge of 2 sqrt(2) / 25 l E, at ν = 1/4, which is what
    (Gomes 2016, eq. 6.19) prints: its A is that set. young [Pa]; length l [m], shape (springs,);
    elements: how many tetrahedra have the edge, shape (springs,). A sheet has none: for that of
    the thesis the sum is taken over the cells instead.
    """
    return np.asarray(elements * (2.0 * sqrt(2.0) / 25.0) * length * young)


def _structural(
    pairs: IntArray, rows: int, cols: int, along_a: float, along_b: float
) -> FloatArray:
    """Stiffness of the springs to the four neighbours: half of it for each cell beside them."""
    (row, col), second = np.divmod(pairs[:, 0], cols), pairs[:, 1]
    level = second // cols == row
    border = np.where(level, (row == 0) | (row == rows - 1), (col == 0) | (col == cols - 1))
    return np.where(level, along_a, along_b) * np.where(border, 0.5, 1.0)


def _check(
    young: float,
    thickness: float,
    width: float,
    height: float,
    rows: int,
    cols: int,
    poisson: float,
) -> None:
    sizes = {'young': young, 'thickness': thickness, 'width': width, 'height': height}
    for name, value in sizes.items():
        if not 0 < value < inf:
            raise ClothPredictError(f'{name}: {value:g} is not a positive number')
    if not 0 < poisson <= 0.5:
        raise ClothPredictError(f'poisson: {poisson:g} is not above 0 and at most 0.5')
    if min(rows, cols) < 2:
        raise ClothPredictError(
            f'{rows} x {cols} nodes are no sheet: one has 2 rows and 2 columns'
        )


@dataclass(frozen=True)
class Carried:
    """What a step of dt [s] makes of the stiffest mode of a surface.

    omega [rad/s]: its angular frequency at rest, undamped.
    """

    omega: float
    dt: float

    @property
    def explicit_limit(self) -> float:
        """Longest step [s] at which RK4 is stable."""
        return RK4_LIMIT / self.omega if self.omega else inf

    @property
    def kept(self) -> float:
        """Share of the mode's amplitude that an implicit Euler step leaves, 1/sqrt(1+(ω dt)^2)."""
        return float(1.0 / np.hypot(1.0, self.omega * self.dt))

    @property
    def condition(self) -> float:
        """Condition number of the implicit step's M^-1 A = 1 + dt^2 M^-1 K, at most."""
        return 1.0 + (self.omega * self.dt) ** 2

    @property
    def complaint(self) -> str:
        """Return what speaks against this stiffness, in one line, or nothing."""
        angle = self.omega * self.dt
        if angle < FAST:
            return ''
        lost = (
            f'; its matrix has a condition number of {self.condition:.1e}, so that the solve is '
            f'mostly rounding'
            if self.condition > SINGULAR
            else ''
        )
        return (
            f'the stiffest mode, {self.omega:.3g} rad/s, turns by {angle:.3g} rad in a step of '
            f'{self.dt:g} s: an implicit step leaves {self.kept:.1e} of its swing, and an '
            f'explicit one (RK4) is stable up to {self.explicit_limit:.1e} s{lost}'
        )


def carried(mesh: MassSpring, shape: FloatArray, dt: float) -> Carried:
    """Find the stiffest mode of a surface at a shape [m], (nodes, 3), and hold it against dt [s].

    It is that of all springs at rest, none of them compressed: the largest singular value of
    M^-1/2 B sqrt(k), of which each column has the direction of a spring at its two ends.
    """
    offset = shape[mesh.first] - shape[mesh.second]
    unit = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    incidence = sparse.csr_array(mesh.blocks.incidence).toarray()
    ends = incidence[:, None, :] * unit.T  # (free, 3, springs)
    scaled = ends.reshape(len(mesh.mass3), -1) / np.sqrt(mesh.mass3)[:, None]
    return Carried(float(np.linalg.norm(scaled * np.sqrt(mesh.springs.stiffness), 2)), dt)
