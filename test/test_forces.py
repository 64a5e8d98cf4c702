"""What is unknown of the forces: sizes, correlations, and where they act."""

from dataclasses import replace

import numpy as np
import pytest

from cloth_predict.config import build
from cloth_predict.errors import ConfigError
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.surface.assembly import build_mass_spring, first_belief, rest_shape
from cloth_predict.surface.forces import (
    alike,
    disturbed,
    first_forces,
    force_variances,
    process_noise,
    unknown_parts,
)
from cloth_predict.surface.layout import lay_out
from cloth_predict.surface.topology import grid


def windy(refine=2, force='none', **wind):
    """Three by three markers, hung by the first row, in the wind."""
    config = build(
        {
            'model': {'rows': 3, 'cols': 3, 'refine': refine, 'width': 0.4, 'height': 0.4},
            'anchors': {'nodes': [0, 1, 2]},
            'force': {'kind': force, 'sigma': 0.3, 'tau': 0.5},
            'wind': {'kind': 'normal', **wind},
        },
        'test',
    )
    surface = rest_shape(config.model)
    layout = lay_out(config, grid(3, 3), surface)
    mesh = build_mass_spring(config, surface, layout)
    return config, mesh, layout, surface


def test_gusts_are_alike_by_their_distance():
    config, *_, surface = windy(length=0.3, independent=0.25)
    root = alike(config.wind, surface)
    found = root @ root.T
    distance = np.linalg.norm(surface[:, None] - surface, axis=2)
    expected = 0.75 * np.exp(-(distance**2) / (2 * 0.3**2)) + 0.25 * np.eye(9)
    np.testing.assert_allclose(found, expected, atol=1e-14)  # rounding
    np.testing.assert_allclose(np.diag(found), 1.0, rtol=1e-14)  # the same


def test_parts_of_a_refined_sheet():
    config, mesh, layout, surface = windy(force='matern')
    parts = unknown_parts(config, mesh, layout, surface)
    nodes = 4 * 5  # of 5 x 5 mesh nodes the first row is driven; 6 free markers
    assert [part.count for part in parts] == [18, 6, 3]
    assert [part.mix.shape for part in parts[:2]] == [(3 * nodes, 18), (nodes, 6)]
    assert parts[2].mix is None
    model = disturbed(config, mesh, layout, surface)
    assert model.dim_x == 6 * nodes + 2 * (18 + 6 + 3)
    assert mesh.dim_load == 3 * nodes + nodes + 3


def test_an_even_force_and_an_even_gust_are_even_on_the_mesh():
    config, mesh, layout, surface = windy(force='ornstein_uhlenbeck', independent=1.0)
    model = disturbed(config, mesh, layout, surface)
    x = np.zeros(model.dim_x)
    force, gust, common = model.states
    x[force] = np.tile([1.0, 2.0, 3.0], 6)
    x[gust][:6], x[common][:3] = 0.7, [4.0, 5.0, 6.0]
    load = model.load(x)
    # a marker's force is that of the four mesh nodes of its cell; a gust is a pressure
    np.testing.assert_allclose(load[:60].reshape(20, 3), np.tile([0.25, 0.5, 0.75], (20, 1)))
    np.testing.assert_allclose(load[60:80], 0.7, rtol=1e-15)
    np.testing.assert_array_equal(load[80:], [4.0, 5.0, 6.0])


def test_even_wind_pushes_a_sheet_with_the_force_of_all_its_cells():
    # 4 cells of markers, with 1 N each along their normal; half a mesh row hangs on the driven one
    _, mesh, layout, surface = windy()
    flat = layout.between @ surface
    x = np.append(flat[mesh.free].ravel(), np.zeros(60))
    still = mesh.input(flat[mesh.driven])
    u = still.copy()
    u[-3:] = [0.0, 0.0, 1.0]
    pushed = (mesh.acceleration(x, u) - mesh.acceleration(x, still))[:, 2]
    total = pushed @ mesh.mass[mesh.free]
    assert total == pytest.approx(4 - 0.5, rel=1e-12)  # rounding


@pytest.mark.parametrize('force', ['none', 'ornstein_uhlenbeck', 'matern'])
def test_noise_and_variances_are_those_of_the_processes(force):
    config, mesh, layout, surface = windy(
        force=force, sigma=0.12, tau=0.2, common_sigma=0.3, common_tau=2.0
    )
    model = disturbed(config, mesh, layout, surface)
    noise, variance = process_noise(config, mesh, model), force_variances(model)
    assert noise.shape == (model.dim_x,)
    assert len(variance) == model.dim_x - mesh.dim_x
    np.testing.assert_array_equal(noise[: mesh.dim_x], np.repeat([0.0, 1.0], 60))
    own = {
        'none': ([], []),
        'ornstein_uhlenbeck': ([(18, 2 * 0.3**2 / 0.5)], [(18, 0.3**2)]),
        'matern': (
            [(18, 0.0), (18, 4 * 0.3**2 / 0.5**3)],
            [(18, 0.3**2), (18, (0.3 / 0.5) ** 2)],
        ),
    }[force]
    densities = [
        *own[0], (6, 0.0), (6, 4 * 0.12**2 / 0.2**3), (3, 0.0), (3, 4 * 0.3**2 / 2.0**3)
    ]  # fmt: skip
    variances = [*own[1], (6, 0.12**2), (6, 0.6**2), (3, 0.3**2), (3, 0.15**2)]
    for found, expected in ((noise[mesh.dim_x :], densities), (variance, variances)):
        values = np.concatenate([np.full(count, value) for count, value in expected])
        np.testing.assert_allclose(found, values, rtol=1e-14)  # rounding


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'filter': {'kind': 'reduced_rank'}}, 'filter.kind reduced_rank needs wind.kind none'),
        ({'model': {'rows': 1}}, 'wind.kind: a chain or a list of edges has no normals'),
    ],
)
def test_what_wind_does_not_go_with_is_refused(values, message):
    with pytest.raises(ConfigError) as error:
        build({'wind': {'kind': 'normal'}, **values}, 'test')
    assert str(error.value) == f'test: {message}'


def test_the_first_value_of_each_force_is_given():
    config, mesh, layout, surface = windy(force='matern')
    config = replace(config, force=replace(config.force, initial=(1.0, -2.0, 3.0)))
    model = disturbed(config, mesh, layout, surface)
    expected = np.zeros(model.dim_x - mesh.dim_x)
    expected[:18] = np.tile([1.0, -2.0, 3.0], 6)  # their rates, and the wind, are zero
    np.testing.assert_array_equal(first_forces(config, model), expected)
    on_mesh = layout.between @ surface
    belief = first_belief(config, mesh, model, on_mesh, np.zeros(len(on_mesh)))
    np.testing.assert_array_equal(belief.mean[mesh.dim_x :], expected)
    np.testing.assert_array_equal(belief.mean[: mesh.dim_x // 2], on_mesh[mesh.free].ravel())


def test_without_anything_unknown_the_model_is_the_mesh():
    config, mesh, layout, surface = windy(kind='none')
    assert disturbed(config, mesh, layout, surface) is mesh
    assert mesh.air is None
    config, mesh, layout, surface = windy()
    assert isinstance(disturbed(config, mesh, layout, surface), Disturbed)
