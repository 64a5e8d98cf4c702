"""The warp map, pixel by pixel, against rays that are cut with the mesh where it then is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloth_predict.projection.spans import cut, on_lines
from cloth_predict.projection.warp_map import warp_map

pytestmark = pytest.mark.filterwarnings('error')

WIDTH, HEIGHT = SIZE = (64, 48)
EVERY = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2) * 1.0
"""Every pixel (u, v), row by row."""
ZERO = np.array([0])
FOCAL, CENTRE = 60.0, np.array([31.3, 23.1])
ROUNDING = 2e-6  # some ten roundings of numbers up to 1 in single precision


def grid(rows, cols):
    """Texture coordinates and triangles of a grid."""
    s, t = np.meshgrid(np.linspace(0, 1, cols), np.linspace(0, 1, rows))
    at = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    halves = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    return np.stack([s, t], axis=-1).reshape(-1, 2), np.concatenate(halves)


TEXTURE, TRIANGLES = grid(5, 4)


def seen(points):
    """Pixels and depth of points in the projector's frame, NaN behind it."""
    depth = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    return FOCAL * points[..., :2] / depth[..., None] + CENTRE, depth


def key_lines(motion, lines):
    """Pixels, depth and numbers of the key lines; motion(line) gives positions."""
    pixels, depth = zip(*(seen(motion(line)) for line in lines), strict=True)
    return np.array(pixels), np.array(depth), np.asarray(lines)


def at_line(keys, line):
    """Positions at a line: pixels and depth between key lines, and back into space."""
    pixels, depth, lines = keys
    flat = np.concatenate([pixels, depth[..., None]], axis=-1).reshape(len(lines), -1)
    here = np.array([np.interp(line, lines, values) for values in flat.T]).reshape(-1, 3)
    return np.column_stack([(here[:, :2] - CENTRE) / FOCAL, np.ones(len(here))]) * here[:, 2:]


def ray_cast(positions, texture, triangles, pixels):
    """Texture coordinates, shape (n, 2), by Moeller and Trumbore 1997; NaN for none or a back."""
    rays = np.column_stack([(pixels - CENTRE) / FOCAL, np.ones(len(pixels))])[:, None]
    a, b, c = (positions[triangles[:, i]] for i in range(3))
    across = np.cross(rays, c - a)
    det = (across * (b - a)).sum(axis=-1)
    one = (across * -a).sum(axis=-1) / det
    turned = np.cross(-a, b - a)
    two = (rays * turned).sum(axis=-1) / det
    far = ((c - a) * turned).sum(axis=-1) / det
    hit = (one >= 0) & (two >= 0) & (one + two <= 1) & (far > 0)
    first = np.where(hit, far, np.inf).argmin(axis=1)
    row = np.arange(len(pixels))
    weights = np.stack([1 - one - two, one, two], axis=-1)[row, first]
    found = (weights[..., None] * texture[triangles[first]]).sum(axis=1)
    # The determinant is positive where (a, b, c) turns from u to v.
    s, t = (texture[triangles][..., i] for i in range(2))
    area = (s[:, 1] - s[:, 0]) * (t[:, 2] - t[:, 0]) - (s[:, 2] - s[:, 0]) * (t[:, 1] - t[:, 0])
    normal = np.cross(b - a, c - a)
    front = (normal * a).sum(axis=-1) * area > 0
    return np.where((hit.any(axis=1) & front[first])[:, None], found, np.nan)


def reference(keys, texture, triangles, columns, drawn):
    """The map by one ray per pixel."""
    out = np.full((HEIGHT, WIDTH, 2), np.nan)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([u, v], axis=-1).astype(float)
    for line in np.arange(WIDTH if columns else HEIGHT)[drawn]:
        which = np.s_[:, line] if columns else np.s_[line]
        out[which] = ray_cast(at_line(keys, line), texture, triangles, pixels[which])
    return out


def sheet(x, y, z):
    """A motion from functions of (s, t, line)."""
    s, t = TEXTURE.T

    def motion(line):
        return np.stack([np.broadcast_to(f(s, t, line), s.shape) for f in (x, y, z)], axis=-1)

    return motion


MOTIONS = {
    'flat, still': sheet(
        lambda s, t, line: 0.8 * (s - 0.5),
        lambda s, t, line: 0.64 * (t - 0.5),
        lambda s, t, line: 1.0,
    ),
    'slanted, moving': sheet(
        lambda s, t, line: 0.7 * (s - 0.5) + 0.004 * line,
        lambda s, t, line: 0.5 * (t - 0.5) - 0.002 * line,
        lambda s, t, line: 0.7 + 0.8 * s + 0.3 * t,
    ),
    'wavy, towards the projector': sheet(
        lambda s, t, line: 0.8 * (s - 0.5),
        lambda s, t, line: 0.6 * (t - 0.5) + 0.001 * line,
        lambda s, t, line: 1.1 + 0.1 * np.sin(7 * s + 4 * t) - 0.006 * line,
    ),
    'folded over itself': sheet(
        lambda s, t, line: 0.5 * np.sin(2.3 * s) - 0.2 + 0.002 * line,
        lambda s, t, line: 0.6 * (t - 0.5) + 0.1 * s,
        lambda s, t, line: 1.0 + 0.3 * np.cos(2.3 * s),
    ),
    'folded, the back before the front': sheet(
        lambda s, t, line: 0.5 * np.sin(3.9 * s) - 0.2,
        lambda s, t, line: 0.6 * (t - 0.5) + 0.1 * s,
        lambda s, t, line: 1.0 - 0.3 * np.cos(3.9 * s) + 0.001 * line,
    ),
    'partly outside': sheet(
        lambda s, t, line: 2.0 * s - 0.3,
        lambda s, t, line: 1.7 * t - 1.2,
        lambda s, t, line: 1.0 + 0.5 * t,
    ),
    'all outside': sheet(
        lambda s, t, line: 1.0 + s,
        lambda s, t, line: t,
        lambda s, t, line: 1.0,
    ),
    'with the beam, faster than it for a part': sheet(
        lambda s, t, line: 0.9 * (s - 0.5),
        lambda s, t, line: 0.5 * (t - 0.7) + (0.005 + 0.015 * s) * line,
        lambda s, t, line: 1.0 + 0.2 * s,
    ),
}
SCANS = {
    'rows': (False, slice(None)),
    'odd rows': (False, slice(1, None, 2)),
    'columns': (True, slice(None)),
    'even columns': (True, slice(0, None, 2)),
}


@pytest.mark.parametrize('scan', SCANS)
@pytest.mark.parametrize('name', MOTIONS)
def test_every_pixel_equals_a_ray_through_the_mesh_of_its_line(name, scan):
    columns, drawn = SCANS[scan]
    lines = [0, 11, 30, (WIDTH if columns else HEIGHT) - 1]
    keys = key_lines(MOTIONS[name], lines)
    found = warp_map(*keys, TEXTURE, TRIANGLES, SIZE, columns=columns, drawn=drawn)
    assert found.shape == (HEIGHT, WIDTH, 2)
    assert found.dtype == np.float32
    expected = reference(keys, TEXTURE, TRIANGLES, columns, drawn)
    np.testing.assert_allclose(found, expected, atol=ROUNDING)
    lit = np.isfinite(expected).all(axis=-1).mean()
    assert (lit > 0.04) == (name != 'all outside')  # the case is not an empty one


def test_two_sheets_through_each_other_are_parted_pixel_by_pixel():
    triangles = np.array([[0, 1, 2], [3, 4, 5]])
    texture = np.array([[0, 0], [0.4, 0], [0, 0.4], [0.5, 0.5], [0.9, 0.5], [0.5, 0.9]])
    points = np.array(
        [
            [[-0.5, -0.4, 0.8], [0.5, -0.3, 1.6], [-0.4, 0.4, 1.1]],
            [[-0.4, -0.4, 1.5], [0.5, -0.4, 0.9], [-0.47, 0.52, 1.03]],
        ]
    ).reshape(-1, 3)
    keys = key_lines(lambda line: points, [0])
    found = warp_map(*keys, texture, triangles, SIZE)
    expected = reference(keys, texture, triangles, False, slice(None))
    np.testing.assert_allclose(found, expected, atol=ROUNDING)
    shared = np.array([ray_cast(points, texture, triangles[[i]], EVERY) for i in range(2)])
    both = np.isfinite(shared[..., 0]).all(axis=0).reshape(HEIGHT, WIDTH)
    parts = [(found[both][:, 0] < 0.45).sum(), (found[both][:, 0] > 0.45).sum()]
    assert min(parts) > 50  # pixels: each is in front somewhere


@pytest.mark.parametrize('seed', range(8))
def test_a_heap_of_triangles_is_parted_pixel_by_pixel(seed):
    rng = np.random.default_rng(seed)
    middle = rng.uniform([-0.3, -0.2, 0.9], [0.3, 0.2, 1.3], (12, 1, 3))
    points = (middle + rng.uniform(-0.3, 0.3, (12, 3, 3))).reshape(-1, 3)
    texture, triangles = rng.uniform(0, 1, (36, 2)), np.arange(36).reshape(12, 3)
    keys = key_lines(lambda line: points + 0.003 * line, [0, 20, HEIGHT - 1])
    found = warp_map(*keys, texture, triangles, SIZE)
    expected = reference(keys, texture, triangles, False, slice(None))
    np.testing.assert_allclose(found, expected, atol=ROUNDING)
    assert np.isfinite(expected).sum() > 30  # half of the triangles show their back


def test_a_still_plane_is_a_homography():
    corners = np.array([[-0.3, -0.3, 0.8], [0.6, -0.4, 1.5], [0.5, 0.45, 1.7], [-0.4, 0.35, 1.0]])
    corners[2] = corners[1] + corners[3] - corners[0]
    texture = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    keys = key_lines(lambda line: corners, [0, HEIGHT - 1])
    found = warp_map(*keys, texture, np.array([[0, 1, 2], [0, 2, 3]]), SIZE)
    # position = corner + s across + t down, and pixel ~ K position: 3 x 3 in (s, t, 1)
    camera = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]])
    forward = camera @ np.column_stack(
        [corners[1] - corners[0], corners[3] - corners[0], corners[0]]
    )
    back = np.linalg.solve(forward, np.column_stack([EVERY, np.ones(len(EVERY))]).T)
    s, t = back[:2] / back[2]
    inside = (s > 1e-9) & (s < 1 - 1e-9) & (t > 1e-9) & (t < 1 - 1e-9)  # not on the edge itself
    expected = np.where(inside, (s, t), np.nan).T.reshape(HEIGHT, WIDTH, 2)
    np.testing.assert_allclose(found, expected, atol=ROUNDING)
    assert inside.sum() > 500


def spans_of(pixels, triangles, texture, columns=False):
    """How many pixels all spans hold together."""
    keys = pixels[None, :, ::-1] if columns else pixels[None]
    lines, length = (WIDTH, HEIGHT) if columns else (HEIGHT, WIDTH)
    y = np.arange(lines)
    vertices = on_lines(keys, np.ones(keys.shape[:2]), ZERO, y)
    return int(cut(vertices, texture, triangles, y, length, mirrored=columns).count.sum())


@pytest.mark.parametrize('columns', [False, True])
def test_edges_through_pixel_centres_leave_no_gap_and_no_pixel_twice(columns):
    texture, triangles = grid(6, 9)
    pixels = np.array([10, 5]) + texture * [40, 30]  # vertices and edges at whole pixels
    found = warp_map(
        pixels[None], np.ones((1, 54)), ZERO, texture, triangles, SIZE, columns=columns
    )
    expected = np.full((HEIGHT, WIDTH, 2), np.nan)
    expected[5:35, 10:50] = ((EVERY - [10, 5]) / [40, 30]).reshape(HEIGHT, WIDTH, 2)[5:35, 10:50]
    np.testing.assert_allclose(found, expected, atol=ROUNDING)
    assert spans_of(pixels, triangles, texture, columns) == 40 * 30


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('columns', [False, True])
def test_a_crooked_mesh_has_no_gap_and_no_pixel_twice(seed, columns):
    texture, triangles = grid(9, 12)
    rng = np.random.default_rng(seed)
    inner = ((texture > 0) & (texture < 1)).all(axis=1)
    # By at most a fifth of a cell, so that no triangle turns over.
    pixels = [10, 5] + (texture + inner[:, None] * rng.uniform(-1, 1, (108, 2)) / 60) * [40, 30]
    depth = rng.uniform(0.9, 1.1, (1, 108))
    keys = (pixels[None], depth, ZERO)
    found = warp_map(*keys, texture, triangles, SIZE, columns=columns)
    lit = np.zeros((HEIGHT, WIDTH), bool)
    lit[5:35, 10:50] = True
    np.testing.assert_array_equal(np.isfinite(found).all(axis=-1), lit)
    assert spans_of(pixels, triangles, texture, columns) == lit.sum()


@pytest.mark.parametrize('columns', [False, True])
def test_triangles_agree_on_edges_through_pixel_centres_at_any_slope(columns):
    rng = np.random.default_rng(7)
    u, v = np.arange(4, 60, 4), np.arange(4, 44, 4)
    rim = [(x, 4) for x in u] + [(60, y) for y in v]
    rim = np.array(rim + [(64 - x, 44) for x in u] + [(4, 48 - y) for y in v], float)
    fan = 1 + np.arange(len(rim))
    triangles = np.column_stack([np.zeros(len(rim), int), fan, np.roll(fan, -1)])
    lit = np.zeros((HEIGHT, WIDTH), bool)
    lit[4:44, 4:60] = True
    for middle in rng.integers([8, 8], [56, 40], (20, 2)):
        pixels = np.vstack([middle, rim])
        texture = pixels / SIZE
        found = warp_map(
            pixels[None],
            np.ones((1, len(pixels))),
            ZERO,
            texture,
            triangles,
            SIZE,
            columns=columns,
        )
        np.testing.assert_array_equal(np.isfinite(found).all(axis=-1), lit)
        assert spans_of(pixels, triangles, texture, columns) == lit.sum()


def test_triangles_agree_to_the_last_bit_where_their_common_edge_crosses_a_line():
    # Edges through the centre of a pixel, up to rounding; of one triangle the upper end is alone
    # above the line, of the other the lower end below it.
    rng, line, centre = np.random.default_rng(1), np.array([20]), np.array([30.0, 20.0])
    triangles = np.array([[0, 1, 2], [0, 1, 3]])
    for _ in range(500):
        along, parts = rng.uniform([-1, 0.2], [1, 1]), rng.uniform(3, 9, 2)
        side = [15, rng.uniform(0.1, 0.5)]
        edge = centre + np.outer(parts * [-1, 1], along)
        pixels = np.vstack([edge, centre - side, centre + side])
        vertices = on_lines(pixels[None], np.ones((1, 4)), ZERO, line)
        spans = cut(vertices, pixels, triangles, line, WIDTH, mirrored=False)
        assert spans.first[1] == spans.first[0] + spans.count[0]


def test_a_sliver_of_one_pixel_needs_no_slope():
    pixels = np.array([[[-1e-310, 5.0], [1e-310, 5.0], [0.0, 15.0]]])
    texture = np.array([[0.2, 0.2], [0.3, 0.2], [0.3, 0.4]])
    found = warp_map(pixels, np.ones((1, 3)), ZERO, texture, np.array([[0, 1, 2]]), SIZE)
    assert np.isfinite(found[5:15, 0]).all()
    assert np.isfinite(found).sum() == 20


def test_two_interlaced_fields_make_one_image():
    # Each field sweeps the whole frame: the second one a frame's half later.
    motion = MOTIONS['slanted, moving']
    out, expected = None, np.full((HEIGHT, WIDTH, 2), np.nan)
    for field in range(2):
        keys = key_lines(lambda line, late=24 * field: motion(0.5 * line + late), [field, 20, 47])
        drawn = slice(field, None, 2)
        out = warp_map(*keys, TEXTURE, TRIANGLES, SIZE, drawn=drawn, out=out)
        expected[drawn] = reference(keys, TEXTURE, TRIANGLES, False, drawn)[drawn]
    np.testing.assert_allclose(out, expected, atol=ROUNDING)


def test_key_lines_may_come_in_the_order_in_which_they_are_lit_upwards():
    pixels, depth, lines = key_lines(MOTIONS['slanted, moving'], [0, 11, 30, HEIGHT - 1])
    found = warp_map(pixels[::-1], depth[::-1], lines[::-1], TEXTURE, TRIANGLES, SIZE)
    expected = warp_map(pixels, depth, lines, TEXTURE, TRIANGLES, SIZE)
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(found).any()


@pytest.mark.parametrize('columns', [False, True])
def test_what_was_drawn_before_is_cleared_on_its_own_lines_only(columns):
    out = np.full((HEIGHT, WIDTH, 2), 7.0, np.float32)
    keys = key_lines(MOTIONS['all outside'], [0])
    found = warp_map(
        *keys, TEXTURE, TRIANGLES, SIZE, columns=columns, drawn=slice(0, None, 2), out=out
    )
    assert found is out
    lines = out.swapaxes(0, 1) if columns else out
    assert np.isnan(lines[::2]).all()
    assert (lines[1::2] == 7).all()  # not touched


def test_a_mesh_turned_round_shows_its_back_and_still_hides():
    still = MOTIONS['flat, still'](0)
    keys = key_lines(lambda line: still * [-1, 1, 1], [0])
    assert np.isnan(warp_map(*keys, TEXTURE, TRIANGLES, SIZE)).all()
    # its texture turned round as well, it is lit again
    found = warp_map(*keys, TEXTURE * [-1, 1] + [1, 0], TRIANGLES, SIZE)
    plain = warp_map(*key_lines(lambda line: still, [0]), TEXTURE, TRIANGLES, SIZE)
    assert abs(int(np.isfinite(found).sum()) - int(np.isfinite(plain).sum())) < 200  # edge pixels
    # nearer than another sheet, it hides that
    both = np.concatenate([still * [-1, 1, 1] * 0.5, still])
    keys = key_lines(lambda line: both, [0])
    found = warp_map(
        *keys,
        np.concatenate([TEXTURE, TEXTURE]),
        np.concatenate([TRIANGLES, TRIANGLES + len(TEXTURE)]),
        SIZE,
    )
    expected = reference(
        keys,
        np.concatenate([TEXTURE, TEXTURE]),
        np.concatenate([TRIANGLES, TRIANGLES + len(TEXTURE)]),
        False,
        slice(None),
    )
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


def test_a_vertex_that_is_not_seen_leaves_out_its_triangles_alone():
    still = MOTIONS['flat, still'](0)
    behind = still.copy()
    behind[5, 2] = -1.0
    kept = TRIANGLES[~(TRIANGLES == 5).any(axis=1)]
    found = warp_map(*key_lines(lambda line: behind, [0]), TEXTURE, TRIANGLES, SIZE)
    expected = warp_map(*key_lines(lambda line: still, [0]), TEXTURE, kept, SIZE)
    np.testing.assert_array_equal(found, expected)
    assert 0.2 < np.isfinite(found).mean() < 0.9


def test_a_vertex_that_goes_out_of_sight_takes_its_triangles_with_it():
    still = MOTIONS['flat, still'](0)
    behind = still.copy()
    behind[5, 2] = -1.0
    kept = TRIANGLES[~(TRIANGLES == 5).any(axis=1)]
    keys = key_lines(lambda line: behind if line > 20 else still, [0, 20, HEIGHT - 1])
    found = warp_map(*keys, TEXTURE, TRIANGLES, SIZE)
    plain = key_lines(lambda line: still, [0])
    before, after = (warp_map(*plain, TEXTURE, some, SIZE) for some in (TRIANGLES, kept))
    # On lines of which one of the two key lines has it not.
    np.testing.assert_array_equal(found[:20], before[:20])
    np.testing.assert_array_equal(found[20:], after[20:])
    assert np.isfinite(before[:20]).sum() > np.isfinite(after[:20]).sum()


def test_a_steep_sheet_keeps_its_precision():
    # from 1 mm to 10 m within the frame, away and towards: four decades along one line
    corners = np.array(
        [[-0.0005, -0.0004, 1e-3], [5.0, -4, 10], [5, 4, 10], [-0.0005, 4e-4, 1e-3]]
    )
    texture = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    for mirror in (1, -1):
        keys = key_lines(lambda line, m=mirror: corners * [m, 1, 1], [0])
        tex = texture if mirror > 0 else texture * [1, -1] + [0, 1]
        found = warp_map(*keys, tex, triangles, SIZE)
        expected = reference(keys, tex, triangles, False, slice(None))
        np.testing.assert_allclose(found, expected, atol=ROUNDING)
        assert np.isfinite(expected).mean() > 0.3


wild = st.one_of(
    st.floats(-100, 200), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e9, 10.0, 20.0])
)
deep = st.one_of(
    st.floats(1e-7, 1e7), st.sampled_from([np.nan, np.inf, 0.0, -1.0, 5e-324, 1e300, 1.0])
)


@settings(deadline=None, max_examples=150)
@given(st.data())
def test_any_mesh_is_drawn_without_a_complaint(data):
    nodes, keys = data.draw(st.integers(1, 7)), data.draw(st.integers(1, 3))
    triangles = data.draw(
        st.lists(st.lists(st.integers(0, nodes - 1), min_size=3, max_size=3), max_size=8)
    )
    numbers = st.lists(wild, min_size=2 * keys * nodes, max_size=2 * keys * nodes)
    depths = st.lists(deep, min_size=keys * nodes, max_size=keys * nodes)
    texture = np.random.default_rng(nodes).uniform(0, 1, (nodes, 2))
    found = warp_map(
        np.reshape(data.draw(numbers), (keys, nodes, 2)),
        np.reshape(data.draw(depths), (keys, nodes)),
        np.array([0, 9, 21][:keys]),
        texture,
        np.reshape(triangles, (-1, 3)).astype(int),
        (33, 22),
        columns=data.draw(st.booleans()),
    )
    assert found.shape == (22, 33, 2)
    lit = found[np.isfinite(found).all(axis=-1)]
    np.testing.assert_array_equal(np.isnan(found[..., 0]), np.isnan(found[..., 1]))
    assert ((lit > -1e-4) & (lit < 1 + 1e-4)).all()  # single precision over depths of 13 decades
