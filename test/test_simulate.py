"""The simulator: its truth converges in the time step, its wind and sensors are what they say."""

from pathlib import Path

import numpy as np
import pytest
from references import accelerations, even_surface, order_of

from cloth_predict.formats.bag import Truth, read_recording
from cloth_predict.simulation.recordings import (
    AIR_DENSITY,
    SCENARIOS,
    Scene,
    crossing,
    falling_cloth,
    hung_cloth,
    marker_grid,
    measure,
    run,
    settled,
    simulate,
    towel_fan,
    vertex_areas,
)
from cloth_predict.simulation.surroundings import Draught, Fan, Gusts, Rail

ROOT = Path(__file__).parents[1]
STILL = Gusts(np.ones(1), np.zeros(1), np.zeros(1), np.zeros((1, 2)))


def no_progress(seconds):
    pass


def towel_shape():
    shape = np.zeros((17, 13, 3))
    shape[..., 0] = np.linspace(0, 0.51, 13)
    shape[..., 1] = 1.5 - np.linspace(0, 0.80, 17)[:, None]
    return shape


def towel():
    stiffness = {'structural': 400.0, 'shear': 80.0, 'flexion': 20.0}
    return hung_cloth(towel_shape(), 0.34, stiffness, damping=0.02)


def still_scene():
    """A 2 x 2 grid of springs that swing with up to 130 rad/s, in still air."""
    cloth, flat = even_surface(2, 2, driven=(0, 1))
    return Scene(cloth, 2, 2, flat, None), flat


# --- convergence


@pytest.mark.parametrize(
    ('scenario', 'duration', 'bound'),
    # m; 9e-11, 2e-8 and 3e-9 when written, but chaos lets other roundings grow, too
    [(towel_fan, 1.2, 3e-9), (falling_cloth, 0.8, 1e-6), (crossing, 0.8, 1e-7)],
)
def test_half_the_step_gives_the_same_motion(scenario, duration, bound):
    whole = scenario(np.random.default_rng(2026), duration, no_progress)
    half = scenario(np.random.default_rng(2026), duration, no_progress, step=5e-4)
    moved = np.abs(whole.surface[-1] - whole.surface[0]).max()
    assert moved > 0.05  # m; there was a motion
    assert np.abs(half.surface - whole.surface).max() < bound


def test_the_motion_converges_with_the_order_of_the_method():
    # a small towel in gusts, whose time is a state: an error there would lower the order
    cloth, flat = even_surface(5, 4, driven=range(4))
    fan = Fan(Gusts.draw(np.random.default_rng(1)), middle=flat.mean(axis=0))
    scene = Scene(cloth, 5, 4, flat, fan)
    steps = np.array([4e-3, 2e-3, 1e-3])
    ends = [run(scene, flat, np.array([0.0, 0.4]), dt, no_progress)[-1] for dt in (*steps, 1e-4)]
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert order_of(errors, steps) == pytest.approx(4, abs=0.2)  # house rule


def test_steps_divide_the_time_between_frames():
    scene, flat = still_scene()
    times = np.array([0.0, 0.01, 0.035, 0.05])
    coarse = run(scene, flat, times, 0.7e-3, no_progress)
    # each frame alone; m: RK4 with steps of a tenth of the fastest oscillation's radian
    for k, end in enumerate(times):
        alone = run(scene, flat, np.array([0.0, end]), 2.5e-4, no_progress)[-1]
        np.testing.assert_allclose(coarse[k], alone, atol=1e-9)
    gone = []
    run(scene, flat, times, 1e-3, gone.append)
    np.testing.assert_allclose(gone, np.diff(times), rtol=1e-15)  # rounding


def test_a_step_that_diverges_is_an_error():
    scene, flat = still_scene()
    with pytest.raises(FloatingPointError, match=r'step of 0\.05 s'), np.errstate(all='ignore'):
        run(scene, flat * 1.01, np.array([0.0, 20.0]), 0.05, no_progress)


def test_a_free_fall_is_a_parabola():
    # springs of no stiffness: the nodes that are not held fall
    shape = towel_shape()[:3, :3]
    cloth = hung_cloth(shape, 0.1, {'structural': 0.0, 'shear': 0.0, 'flexion': 0.0}, 0.0)
    times = np.linspace(0, 0.5, 6)
    nodes = shape.reshape(-1, 3)
    path = run(Scene(cloth, 3, 3, nodes, None), nodes, times, 0.1, no_progress)
    expected = np.repeat(nodes[None], 6, axis=0)
    expected[:, 3:, 1] -= 0.5 * 9.81 * times[:, None] ** 2
    # RK4 is exact for a polynomial; rounding of 1 m
    np.testing.assert_allclose(path, expected, atol=1e-14)


def test_settled_is_an_equilibrium():
    cloth, nodes = towel(), towel_shape().reshape(-1, 3)
    hung = cloth.input(nodes[cloth.driven])
    position = settled(cloth, hung, nodes)
    x = np.append(position[cloth.free].ravel(), np.zeros(cloth.dim_x // 2))
    # m/s^2, where gravity has 9.81; steps of 1e-10 m times k/m of 2.6e5 1/s^2
    assert np.abs(cloth.acceleration(x, hung)).max() < 1e-4
    np.testing.assert_array_equal(position[:13], nodes[:13])
    sag = nodes[:, 1] - position[:, 1]
    # the towel's weight of 3.1 N on 13 columns of springs of 400 N/m
    assert 1e-3 < sag[-1] < 0.1
    assert np.diff(sag.reshape(17, 13)[:, 6]).min() > 0  # every row hangs lower than the one above
    # and the top carries all of it: springs pull the held nodes down by the weight of the rest
    force = cloth.mass[0] * len(cloth.free) * 9.81
    every = accelerations(
        cloth.springs, cloth.mass, np.zeros(3), position, 0 * position, 0 * position
    )
    pull = (cloth.mass[:, None] * every)[:13].sum(axis=0)
    np.testing.assert_allclose(pull, [0, -force, 0], atol=1e-4 * force)


# --- wind


def blown():
    """A towel that is bent and moves, in the jet of a fan with gusts."""
    rng = np.random.default_rng(3)
    cloth, shape = towel(), towel_shape()
    shape = shape + rng.normal(0, 0.01, shape.shape)
    nodes = shape.reshape(-1, 3)
    fan = Fan(Gusts.draw(rng), middle=nodes.mean(axis=0))
    scene = Scene(cloth, 17, 13, nodes, fan)
    velocity = rng.normal(0, 1.0, (cloth.dim_x // 2,))
    return scene, np.concatenate([nodes[cloth.free].ravel(), velocity, [2.2]])


def test_wind_force_equals_a_loop_over_triangles():
    scene, x = blown()
    position, velocity = scene.cloth.surface(x[:-1], scene.hung)
    grid = position.reshape(17, 13, 3)
    area = np.zeros((17, 13, 3))
    for row in range(16):
        for col in range(12):
            a, b = grid[row, col], grid[row, col + 1]
            c, d = grid[row + 1, col + 1], grid[row + 1, col]
            # two triangles, seen from +z anticlockwise; a quarter of their area to each corner
            cell = np.cross(d - a, c - a) / 2 + np.cross(c - a, b - a) / 2
            for corner in ((row, col), (row, col + 1), (row + 1, col + 1), (row + 1, col)):
                area[corner] += cell / 4
    np.testing.assert_allclose(vertex_areas(grid), area, atol=1e-17)  # rounding of 2 mm^2
    expected = []
    for node, vector in enumerate(area.reshape(-1, 3)):
        size = np.linalg.norm(vector)
        normal = vector / size
        wind = scene.fan(position[[node]], 2.2)[0]
        through = normal @ (wind - velocity[node])
        expected.append(AIR_DENSITY / 2 * size * abs(through) * through * normal)
    found = scene.wind_force(x, scene.hung)
    # rounding of forces of 0.01 N
    np.testing.assert_allclose(found, np.array(expected)[scene.cloth.free], atol=1e-15)


def test_the_wind_accelerates_the_cloth_and_time_runs():
    scene, x = blown()
    u = scene.hung.copy()
    u[6 * 13 :] = scene.wind_force(x, scene.hung).ravel()
    slope = scene.f(x, scene.hung)
    np.testing.assert_array_equal(slope[:-1], scene.cloth.f(x[:-1], u))
    assert slope[-1] == 1.0
    assert (scene.dim_x, scene.dim_u) == (scene.cloth.dim_x + 1, scene.cloth.dim_u)
    with pytest.raises(TypeError, match='explicit'):
        scene.jac(x, u)


def test_area_of_a_flat_towel():
    areas = vertex_areas(towel_shape())
    # rounding of 0.408 m^2
    np.testing.assert_allclose(areas.sum(axis=(0, 1)), [0, 0, 0.51 * 0.80], atol=1e-15)
    cell = 0.51 / 12 * 0.80 / 16
    np.testing.assert_allclose(areas[0, 0], [0, 0, cell / 4], atol=1e-17)  # rounding
    np.testing.assert_allclose(areas[0, 5], [0, 0, cell / 2], atol=1e-17)  # rounding
    np.testing.assert_allclose(areas[8, 5], [0, 0, cell], atol=1e-17)  # rounding


def test_the_jet_of_the_fan():
    fan = Fan(STILL, middle=np.array([0.2, 1.1, 0.0]))
    ahead = fan.middle + np.array([[0.0, 0.0, 0.5]])
    # a quarter of the period of 5 s after the start it looks straight ahead
    for time in (1.25, 6.25):
        expected = 4.0 * (1 - np.exp(-time))
        np.testing.assert_allclose(fan(ahead, time), [[0, 0, expected]], atol=1e-12)  # rounding
    # at the turn, 0.6 rad to the side, two spreads of 0.3 rad: exp(-2) of it
    expected = 4.0 * (1 - np.exp(-2.5)) * np.exp(-2)
    np.testing.assert_allclose(fan(ahead, 2.5), [[0, 0, expected]], atol=1e-12)  # rounding
    assert np.abs(fan(ahead, 0.0)).max() == 0.0  # it spins up


def test_gusts_have_their_intensity_and_spectrum():
    gusts = Gusts.draw(np.random.default_rng(4))
    assert np.sum(gusts.size**2) / 2 == pytest.approx(0.3**2, rel=1e-12)  # rounding
    # the power of a wave falls with frequency^(-5/3), times frequency for equal octaves
    power = gusts.size**2 * gusts.frequency ** (2 / 3)
    np.testing.assert_allclose(power, power[0], rtol=1e-12)  # rounding
    assert 0.2 <= gusts.frequency.min() < gusts.frequency.max() <= 8.0
    time = np.arange(0, 200, 0.02)
    here = np.array([gusts(np.array([[0.1, 1.0, 0.0]]), t)[0] for t in time])
    # 200 s hold 40 periods of the slowest wave, beats of close ones leave a few per cent
    assert here.std() == pytest.approx(0.3, rel=0.05)


def test_the_bar_goes_to_and_fro_at_one_metre_per_second():
    rail = Rail(speed=1.0, straight=0.8, turn=1.0)
    # s: half a turn from rest to full speed, then the straight, then a turn back; m: a turn is a
    # half wave of a cosine, which goes on by speed turn / pi
    reach = 1 / np.pi
    expected = [
        (0.0, 0.0, 0.0),
        (0.5, reach, 1.0),
        (0.9, reach + 0.4, 1.0),
        (1.3, reach + 0.8, 1.0),
        (1.8, 2 * reach + 0.8, 0.0),
        (2.3, reach + 0.8, -1.0),
        (3.1, reach, -1.0),
        (3.6, 0.0, 0.0),
        (4.1, reach, 1.0),
    ]
    for time, place, velocity in expected:
        np.testing.assert_allclose(rail(time), (place, velocity), atol=1e-14)  # rounding
    time, step = np.linspace(0.01, 7.0, 200), 1e-4
    slope = [(rail(t + step)[0] - rail(t - step)[0]) / (2 * step) for t in time]
    # m/s; the third derivative is at most pi^2 m/s^3, of which step^2 / 6; at the ends of a turn
    # it jumps, which is no worse
    np.testing.assert_allclose(slope, [rail(t)[1] for t in time], atol=2e-8)


def test_what_hangs_from_the_bar_is_carried():
    scene, flat = still_scene()
    carried = Scene(scene.cloth, 2, 2, flat, None, Rail())
    x = np.append(np.append(flat[2:].ravel(), np.zeros(6)), 0.9)
    place, velocity = Rail()(0.9)
    aside = np.array([place, 0, 0])
    u = scene.cloth.input(flat[:2] + aside, np.tile([velocity, 0, 0], (2, 1)))
    np.testing.assert_array_equal(carried.f(x, carried.hung)[:-1], scene.cloth.f(x[:-1], u))
    np.testing.assert_array_equal(carried.positions(x)[:2], flat[:2] + aside)
    np.testing.assert_array_equal(scene.carried(scene.hung, 0.9), scene.hung)


def test_a_draught_blows_straight_at_the_cloth():
    position = np.array([[0.1, 1.0, 0.0], [0.3, 0.8, 0.1]])
    even = Draught(STILL, speed=0.7)(position, 2.0)
    expected = 0.7 * (1 - np.exp(-2.0))  # it rises within seconds
    np.testing.assert_allclose(even, [[0, 0, expected]] * 2, atol=1e-15)  # rounding


# --- sensors and recordings


def still_truth(frames, rows=17, cols=13, every=4):
    surface = np.broadcast_to(towel_shape()[:rows, :cols], (frames, rows, cols, 3))
    return Truth(np.arange(frames) * 10**7, surface, marker_grid(rows, cols, every))


def test_markers_sit_on_every_fourth_node():
    ids = marker_grid(17, 13, 4)
    assert ids.shape == (17, 13)
    assert ids[::4, ::4].tolist() == np.arange(20).reshape(5, 4).tolist()
    assert np.count_nonzero(ids >= 0) == 20
    assert ids[0, 1] == ids[1, 0] == ids[16, 11] == -1
    grid = marker_grid(21, 21, 5)
    assert grid[::5, ::5].tolist() == np.arange(25).reshape(5, 5).tolist()
    assert np.count_nonzero(grid >= 0) == 25


def test_noise_and_dropout_have_the_statistics_asked_for():
    truth = still_truth(2000)
    markers = measure(truth, np.random.default_rng(5), noise=3e-4, dropout=0.02)
    assert markers.labels == tuple(f'cloth:{k}' for k in range(20))
    np.testing.assert_array_equal(markers.stamps, truth.stamps)
    seen = markers.visible
    assert seen[0].all()
    np.testing.assert_array_equal(np.isnan(markers.positions).all(axis=2), ~seen)
    missing = 1 - seen[1:].mean()
    # 39,980 draws: a standard deviation of sqrt(0.02 x 0.98 / 39,980) = 7e-4; four of them
    assert missing == pytest.approx(0.02, abs=2.8e-3)
    exact = truth.markers(markers).positions
    noise = (markers.positions - exact)[seen]
    # 118,000 numbers: their standard deviation is known to 1 / sqrt(2 x 118,000) = 0.2 %; four
    assert noise.std() == pytest.approx(3e-4, rel=8e-3)
    assert np.abs(noise.mean(axis=0)).max() < 4 * 3e-4 / np.sqrt(39_000)  # four deviations
    correlation = np.corrcoef(noise.T)[np.triu_indices(3, 1)]
    assert np.abs(correlation).max() < 4 / np.sqrt(39_000)  # four deviations
    half = measure(truth, np.random.default_rng(5), dropout=0.5).visible
    assert half[0].all()  # by chance once in 2^20
    assert half[1:].mean() == pytest.approx(0.5, abs=0.01)  # four deviations of 0.5 / sqrt(39,980)
    clean = measure(truth, np.random.default_rng(5), noise=0.0, dropout=0.0)
    np.testing.assert_array_equal(clean.positions, exact)


@pytest.mark.parametrize('scenario', SCENARIOS)
def test_the_same_seed_gives_the_same_recording(scenario):
    first, again, other = (simulate(scenario, seed, 0.1, no_progress) for seed in (1, 1, 2))
    assert first.markers.positions.tobytes() == again.markers.positions.tobytes()
    assert first.truth.surface.tobytes() == again.truth.surface.tobytes()
    assert first.markers.positions.tobytes() != other.markers.positions.tobytes()
    np.testing.assert_array_equal(first.truth.stamps, np.arange(11) * 10**7)
    # the seed changes the wind; there is none in the falling cloth
    same = first.truth.surface.tobytes() == other.truth.surface.tobytes()
    assert same == (scenario == 'falling_cloth')


def test_the_shipped_recording_is_what_the_simulator_makes():
    shipped = read_recording(ROOT / 'bags/towel_fan')
    made = simulate('towel_fan', 2026, 1.0, no_progress)
    frames = len(made.truth.stamps)
    np.testing.assert_array_equal(shipped.truth.stamps[:frames], made.truth.stamps)
    np.testing.assert_array_equal(shipped.truth.ids, made.truth.ids)
    # m; float32 resolves 1.2e-7 at 1.5 m
    np.testing.assert_allclose(shipped.truth.surface[:frames], made.truth.surface, atol=1e-6)
    assert shipped.markers.labels == made.markers.labels
    # the sensor's draws of the whole take differ from those of its first second; its share not
    assert np.isnan(shipped.markers.positions[..., 0]).mean() == pytest.approx(0.02, abs=4e-3)
    assert len(shipped.markers) == 1101
