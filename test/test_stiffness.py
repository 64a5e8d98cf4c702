"""Stiffness from the material: uniform strains, a stretched strip, and what a step carries."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

from cloth_predict.cli import main
from cloth_predict.config import load
from cloth_predict.errors import ClothPredictError
from cloth_predict.evaluation.cases import case_of, frames_of
from cloth_predict.evaluation.conditioning import condition_number, condition_numbers
from cloth_predict.formats.recording import read
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.integrators.runge_kutta import RungeKutta
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import Springs, grid_pairs
from cloth_predict.models.stiffness import Carried, analytic_stiffness, carried, lloyd_2007
from cloth_predict.surface.assembly import build_mass_spring, rest_shape
from cloth_predict.tracker import Tracker

ROOT = Path(__file__).parents[1]
YOUNG, THICKNESS = 3e5, 2e-3


def sheet(rows, cols, width, height, poisson=1 / 3):
    x, y = np.meshgrid(np.linspace(0, width, cols), np.linspace(0, height, rows))
    shape = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    pairs = np.concatenate(list(grid_pairs(rows, cols).values()))
    length = np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1)
    k = analytic_stiffness(YOUNG, THICKNESS, width, height, rows, cols, poisson).springs
    return shape, Springs(pairs, k, np.zeros(len(k)), length)


def stored(springs, shape, strain):
    """Energy [J] of the springs in a small uniform strain, to second order."""
    offset = shape[springs.pairs[:, 0], :2] - shape[springs.pairs[:, 1], :2]
    stretch = np.einsum('si,ij,sj->s', offset, strain, offset) / springs.rest_length
    return 0.5 * np.sum(springs.stiffness * stretch**2)


@pytest.mark.parametrize('size', [(2, 2, 0.3, 0.3), (5, 4, 0.51, 0.8), (3, 7, 0.6, 0.25)])
def test_every_uniform_strain_stores_the_energy_of_the_sheet(size):
    shape, springs = sheet(*size)
    nu, area = 1 / 3, size[2] * size[3]
    for strain in np.random.default_rng(0).normal(size=(20, 2, 2)):
        strain = 0.5 * (strain + strain.T)
        # plane stress: W = E t / (2 (1 - nu^2)) ((1 - nu) e:e + nu tr(e)^2) per area
        density = (1 - nu) * np.sum(strain**2) + nu * np.trace(strain) ** 2
        energy = YOUNG * THICKNESS / (2 * (1 - nu**2)) * density * area
        assert stored(springs, shape, strain) == pytest.approx(energy, rel=1e-12)  # rounding


@pytest.mark.parametrize('poisson', [0.1, 0.25, 1 / 3, 0.45])
@pytest.mark.parametrize('size', [(5, 4, 0.51, 0.8), (4, 9, 0.8, 0.32)])
def test_a_stretched_strip_has_the_stiffness_of_its_material(size, poisson):
    rows, cols, width, height = size
    shape, springs = sheet(*size, poisson)
    mesh = MassSpring(springs, np.ones(rows * cols))
    n = 3 * rows * cols
    x = np.append(shape.ravel(), np.zeros(n))
    slope = mesh.jac(x, mesh.input()).toarray()[n:, :n]  # of unit masses: the force by positions
    pull = np.zeros((rows, cols, 3))
    share = np.append(0.5, np.append(np.ones(rows - 2), 0.5)) / (rows - 1)  # an even traction
    pull[:, -1, 0], pull[:, 0, 0] = share, -share
    # the least-norm solution has no rigid motion and nothing out of the plane
    moved = np.linalg.lstsq(-slope, pull.ravel(), rcond=1e-10)[0].reshape(rows, cols, 3)
    longer = moved[:, -1, 0].mean() - moved[:, 0, 0].mean()
    assert 1 / longer == pytest.approx(
        YOUNG * THICKNESS * height / width, rel=1e-8
    )  # of a solve with a condition number of 1e4, and springs at rest to rounding
    narrower = moved[0, :, 1].mean() - moved[-1, :, 1].mean()
    assert narrower / height == pytest.approx(poisson * longer / width, rel=1e-8)  # likewise


def test_square_cells():
    found = analytic_stiffness(1e6, 1e-3, 0.4, 0.4, 3, 3)
    # by hand: 3/8 E t of each cell at its sides and diagonals; 8 springs of one cell, 4 of two
    assert found.springs[:12] == pytest.approx(
        [375, 375, 750, 750, 375, 375, 375, 750, 375, 375, 750, 375], rel=1e-12
    )  # rounding
    assert found.springs[12:20] == pytest.approx([375] * 8, rel=1e-12)  # rounding
    assert found.springs[20:].tolist() == [0.0] * 6
    assert (found.structural, found.shear) == pytest.approx((500, 375), rel=1e-12)  # rounding


def test_the_thesis_letter_by_letter():
    # 2 sqrt(2) / 25 = 0.11314; three tetrahedra round an edge of 0.2 m, 7 GPa
    k = lloyd_2007(7e9, np.array([0.2, 0.17]), np.array([3, 1]))
    assert k == pytest.approx([4.7518e8, 1.34634e8], rel=1e-4)  # five digits are given


@pytest.mark.parametrize(
    ('changed', 'named'),
    [
        ({'young': 0.0}, 'young: 0'),
        ({'thickness': float('nan')}, 'thickness: nan'),
        ({'width': -1.0}, 'width: -1'),
        ({'poisson': 0.6}, 'poisson: 0.6'),
        ({'rows': 1}, '1 x 4 nodes are no sheet'),
        ({'width': 2.0}, 'at most 1.73 times'),
    ],
)
def test_what_no_sheet_has(changed, named):
    good = {'young': 1e6, 'thickness': 1e-3, 'width': 0.5, 'height': 0.8, 'rows': 5, 'cols': 4}
    with pytest.raises(ClothPredictError, match=named):
        analytic_stiffness(**(good | changed))


def hung(stiffness=1.0):
    shape, springs = sheet(5, 4, 0.51, 0.8)
    springs = Springs(springs.pairs, stiffness * springs.stiffness, 0.0, springs.rest_length)
    return MassSpring(springs, np.linspace(0.01, 0.03, 20), [0, 1, 2, 3], (0.0, 0.0, 0.0)), shape


def test_the_stiffest_mode_is_that_of_the_eigenvalue_problem():
    mesh, shape = hung()
    n = 3 * len(mesh.free)
    x = np.append(shape[mesh.free].ravel(), np.zeros(n))
    accelerate = mesh.jac(x, mesh.input(shape[mesh.driven])).toarray()[n:, :n]
    mass = np.diag(np.repeat(mesh.mass[mesh.free], 3))
    values = eigh(-mass @ accelerate, mass, eigvals_only=True)
    assert carried(mesh, shape, 0.01).omega == pytest.approx(
        np.sqrt(values[-1]), rel=1e-9
    )  # springs are at rest to rounding


@pytest.mark.parametrize('share', [0.99, 1.01])
def test_an_explicit_step_is_stable_up_to_its_limit(share):
    mesh, shape = hung()
    dt = share * carried(mesh, shape, 0.01).explicit_limit
    x = np.append(shape[mesh.free].ravel(), np.zeros(3 * len(mesh.free)))
    _, jac = RungeKutta().step_jac(mesh, x, mesh.input(shape[mesh.driven]), dt)
    # undamped modes keep |F| <= 1; two equal eigenvalues of 1 (motion across the sheet) round off
    assert (np.abs(np.linalg.eigvals(jac)).max() > 1 + 1e-6) == (share > 1)


def test_an_implicit_step_keeps_what_it_is_said_to_keep():
    mesh, shape = hung()
    found = carried(mesh, shape, 0.004)
    x = np.append(shape[mesh.free].ravel(), np.zeros(3 * len(mesh.free)))
    _, jac = ImplicitEuler().step_jac(mesh, x, mesh.input(shape[mesh.driven]), found.dt)
    moduli = np.abs(np.linalg.eigvals(jac))
    assert moduli.min() == pytest.approx(found.kept, rel=1e-6)  # of an eigenvalue to 1e-8


@pytest.mark.parametrize(
    ('omega', 'said'),
    [
        (900.0, ''),
        (1100.0, '(RK4) is stable up to 2.6e-03 s'),
        (2e8, 'condition number of 4.0e+12'),
    ],
)
def test_what_a_step_cannot_carry_is_said(omega, said):
    complaint = Carried(omega, 0.01).complaint
    assert said in complaint
    assert bool(said) == bool(complaint)


# --- the condition number of P ----------------------------------------------------------------


def test_a_condition_number_is_that_of_the_eigenvalues():
    root = np.random.default_rng(3).normal(size=(6, 6))
    cov = root @ root.T
    assert condition_number(cov) == pytest.approx(np.linalg.cond(cov), rel=1e-9)  # rounding * 1e3
    skew = np.array([[4.0, 100.0], [0.0, -0.5]])  # its singular values tell another story
    assert condition_number(skew) == pytest.approx(8.0, rel=1e-12)  # rounding
    assert condition_number(np.diag([1.0, 0.0])) == np.inf
    assert np.isnan(condition_number(np.diag([1.0, np.nan])))


@pytest.mark.parametrize(
    ('young', 'low', 'high'),
    [
        (None, 1e6, 1e12),  # 1.3e10 measured
        (7e9, 1e15, np.inf),  # beyond what 16 digits hold; 3e17 measured, as rounding has it
    ],
)
def test_stiffness_of_cotton_leaves_the_covariance_singular(young, low, high):
    config = load(ROOT / 'config' / 'towel_coarse.yaml')
    if young:
        springs = analytic_stiffness(young, THICKNESS, 0.51, 0.8, 5, 4, 0.25).springs
        model = replace(config.model, springs=tuple(springs.tolist()), compression=1.0)
        config = replace(config, model=model)
    case = case_of(read(ROOT / 'bags' / 'towel_fan'), config, 'towel')
    case = replace(case, markers=frames_of(case.markers, np.arange(40)))
    found = condition_numbers(case, config)
    assert np.isnan(found[0])  # the start is no update
    assert low < np.median(found[20:]) < high
    tracker = Tracker(config)
    for k, stamp in enumerate(case.markers.stamps.tolist()):
        tracker.step(stamp, case.markers.positions[k], case.markers.visible[k])
    if not young:  # by singular values, which of a covariance are its eigenvalues
        cond = np.linalg.cond(tracker.belief.cov)
        assert found[-1] == pytest.approx(cond, rel=1e-4)  # 1e10 times rounding, and some


def test_a_filter_without_a_covariance_is_named():
    config = load(ROOT / 'config' / 'towel_coarse.yaml')
    config = replace(config, filter=replace(config.filter, kind='fixed_gain'))
    case = case_of(read(ROOT / 'bags' / 'towel_fan'), config, 'towel')
    with pytest.raises(ClothPredictError, match='fixed_gain keeps no full P'):
        condition_numbers(case, config)


def test_springs_stiffer_than_a_number_are_refused(tmp_path, capsys):
    given = ['stiffness', '-c', str(ROOT / 'config/towel.yaml'), '--young', '1e308']
    assert main([*given, '--thickness', '1e5', '-o', str(tmp_path / 'x.yaml')]) == 1
    said = capsys.readouterr().err
    assert "Young's modulus 1e+308 Pa times thickness 100000 m is more than" in said
    assert said.count('\n') == 1
    assert not (tmp_path / 'x.yaml').exists()


@pytest.mark.filterwarnings('default:the stiffest mode')  # the command prints it
def test_the_command_writes_springs_that_a_surface_has(tmp_path, capsys):
    output = tmp_path / 'springs.yaml'
    config = ROOT / 'config' / 'towel.yaml'  # a mesh of 9 x 7 nodes
    material = ['--young', '7e9', '--thickness', '0.002']
    assert main(['stiffness', '-c', str(config), *material, '-o', str(output)]) == 0
    assert 'warning: the stiffest mode, 1.14e+05 rad/s, turns by' in capsys.readouterr().err
    written = load(output)
    expected = analytic_stiffness(7e9, 0.002, 0.51, 0.8, 9, 7).springs
    springs = build_mass_spring(written, rest_shape(written.model)).springs
    assert springs.stiffness == pytest.approx(expected, rel=1e-5)  # six digits are written
    assert 'caution: the stiffest mode' in output.read_text()
    assert main(['stiffness', '-c', str(ROOT / 'config' / 'rope.yaml'), *material]) == 1
    assert '1 x 13 nodes are no sheet' in capsys.readouterr().err
