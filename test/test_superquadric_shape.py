"""The shape of a superquadric: closed forms, the printed Jacobian, poles and edges."""

import numpy as np
import pytest
from references import central_differences

from cloth_predict.errors import ConfigError
from cloth_predict.models import superquadric_shape as shape
from cloth_predict.models.closed_mesh import ClosedMesh

BENT = np.array([2.7, 0.4, 0.6, 0.7, 0.8, 1.3, 0.2, -0.3, 0.4, 0.1, 0.6])
"""All eleven parameters matter."""
COORDINATES = ClosedMesh.even(40).coordinates
CORNERS = np.array(
    [(u, v) for u in (-np.pi / 2, 0.0, np.pi / 2) for v in (-np.pi, -np.pi / 2, 0.0, np.pi / 2)]
    + [(1e-9, -1e-9), (np.pi / 2 - 1e-9, np.pi - 1e-9)]
)
"""Poles, equator, and where a sine or cosine of v is 0; and right beside."""


def plain(a0, a1, a2, a3, e1=1.0, e2=1.0):
    return np.array([a0, a1, a2, a3, e1, e2, 0.0, 0.0, 0.0, 0.0, 1.0])


# --- closed forms


def test_a_sphere():
    points = shape.positions(plain(2.0, 0.5, 0.5, 0.5), COORDINATES)
    # rounding
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, rtol=1e-14)


@pytest.mark.parametrize('squareness', [(1.0, 1.0), (0.3, 0.7), (1.6, 0.4), (2.0, 2.0)])
def test_points_are_on_the_implicit_surface(squareness):
    e1, e2 = squareness
    q_s = plain(2.0, 0.3, 0.4, 0.5, e1, e2)
    x, y, z = np.abs(shape.positions(q_s, COORDINATES) / (2.0 * q_s[1:4])).T
    inside = (x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1)
    np.testing.assert_allclose(inside, 1.0, rtol=1e-12)  # rounding, to the power of 7


def test_squareness_0_is_a_box_2_an_octahedron():
    for e, norm in ((0.0, np.inf), (2.0, 1)):
        points = shape.positions(plain(2.0, 0.3, 0.4, 0.5, e, e), COORDINATES)
        sizes = np.linalg.norm(points / [0.6, 0.8, 1.0], norm, axis=1)
        np.testing.assert_allclose(sizes, 1.0, rtol=1e-14)  # rounding


def test_points_keep_the_signs_of_their_coordinates():
    points = shape.positions(plain(2.0, 0.3, 0.4, 0.5, 0.3, 1.8), COORDINATES)
    u, v = COORDINATES.T
    np.testing.assert_array_equal(
        np.sign(points), np.sign(np.stack([np.cos(v), np.sin(v), np.sin(u)], axis=1))
    )


def test_taper_and_bend():
    """Equation 21 at the poles and at a point of the equator, by hand."""
    q_s = plain(2.0, 0.3, 0.4, 0.5)
    q_s[6:] = 0.5, -0.2, 0.1, 0.25, 0.5
    points = shape.positions(q_s, np.array([[np.pi / 2, 0.0], [0.0, 0.0], [np.pi / 6, np.pi / 2]]))
    # r = (sin u + b2 / (a0 a3)) pi b3 with b2 / (a0 a3) = 1/4
    r = np.array([1.25, 0.25, 0.75]) * np.pi / 2
    expected = np.array([[0, 0, 1], [0.6, 0, 0], [0, 0.8 * np.cos(np.pi / 6) * 0.9, 0.5]])
    expected[:, 0] += 0.1 * np.cos(r)
    np.testing.assert_allclose(points, expected, atol=1e-15)  # rounding


# --- derivatives


def random_parameters(rng):
    low = np.where(np.isfinite(shape.LOW), shape.LOW, -1.0)
    high = np.where(np.isfinite(shape.HIGH), shape.HIGH, 3.0)
    q_s = rng.uniform(low, high)
    q_s[0] += 0.3  # terms with 1 / (a0 a3)^2 would be too steep for central differences
    q_s[3] = 0.2 + 0.8 * q_s[3]
    return q_s


@pytest.mark.parametrize('seed', range(5))
def test_the_jacobian_equals_central_differences(seed):
    q_s = random_parameters(np.random.default_rng(seed))
    expected = central_differences(lambda q: shape.positions(q, COORDINATES).ravel(), q_s, 1e-5)
    found = shape.jacobian(q_s, COORDINATES).reshape(-1, 11)
    # the square of the step by a third derivative, which has b1 / (a0 a3)^3
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(found).max())


@pytest.mark.parametrize('seed', range(5))
def test_the_rate_of_the_jacobian_equals_central_differences(seed):
    rng = np.random.default_rng(seed)
    q_s, rate = random_parameters(rng), rng.normal(size=11)
    along = central_differences(
        lambda t: (shape.jacobian(q_s + t[0] * rate, COORDINATES) @ rate).ravel(),
        np.zeros(1),
        1e-5,
    )
    moved = shape.motion(q_s, rate, COORDINATES)
    # as above, by the fourth derivative
    expected = along.reshape(-1, 3)
    np.testing.assert_allclose(moved.second, expected, atol=1e-6 * np.abs(along).max())
    np.testing.assert_allclose(
        moved.value, shape.positions(q_s, COORDINATES), atol=1e-15
    )  # rounding
    expected = shape.jacobian(q_s, COORDINATES) @ rate
    np.testing.assert_allclose(moved.first, expected, atol=1e-12 * np.abs(expected).max())  # same


def test_the_scale_is_redundant():
    """Only the products of a0 with the aspect ratios matter: the columns depend on each other."""
    columns = shape.jacobian(BENT, COORDINATES)
    together = columns[:, :, 1:4] @ BENT[1:4]
    np.testing.assert_allclose(BENT[0] * columns[:, :, 0], together, atol=1e-14)  # rounding
    assert np.linalg.matrix_rank(columns.reshape(-1, 11)) == 10


# --- the printed appendix


def as_printed(q_s, u, v, w):
    """Equation 41 as it is printed, shape (3, 11)."""
    a0, a1, a2, a3, e1, e2, t1, t2, b1, b2, b3 = q_s

    def power(base, e):
        return np.sign(base) * abs(base) ** e

    cu, su = power(np.cos(u), e1), power(np.sin(u), e1)
    cv, sv = power(np.cos(v), e2), power(np.sin(v), e2)
    ln_cu, ln_su = np.log(abs(np.cos(u))), np.log(abs(np.sin(u)))
    ln_cv, ln_sv = np.log(abs(np.cos(v))), np.log(abs(np.sin(v)))
    r = (a0 * w * a3 * su + b2) / (a0 * w * a3) * np.pi * b3
    j = np.zeros((3, 11))
    j[0, 0] = (t1 * su + 1) * w * a1 * cu * cv + b1 * b2 * b3 / (a0**2 * w * a3) * np.pi * np.sin(
        r
    )
    j[1, 0] = (t2 * su + 1) * w * a2 * cu * sv
    j[2, 0] = w * a3 * su
    j[0, 1] = (t1 * su + 1) * a0 * w * cu * cv
    j[1, 2] = (t2 * su + 1) * a0 * w * cu * sv
    j[0, 3] = b1 * b2 * b3 / (a0 * w * a3**2) * np.pi * np.sin(r)
    j[2, 3] = a0 * w * su
    j[0, 4] = (
        t1 * ln_su * su * a0 * w * a1 * cu * cv
        + (t1 * su + 1) * a0 * w * a1 * ln_cu * cu * cv
        - b1 * b3 * np.pi * ln_su * su * np.sin(r)
    )
    j[1, 4] = (
        t2 * ln_su * su * a0 * w * a2 * cu * sv + (t2 * su + 1) * a0 * w * a2 * ln_cu * cu * sv
    )
    j[2, 4] = a0 * w * a3 * ln_su * su
    j[0, 5] = (t1 * su + 1) * a0 * w * a1 * ln_cv * cu * cv
    j[1, 5] = (t2 * su + 1) * a0 * w * a2 * ln_sv * cu * sv
    j[0, 6] = su * a0 * w * a1 * cu * cv
    j[1, 7] = su * a0 * w * a2 * cu * sv
    j[0, 8] = np.cos(r)
    j[0, 9] = -b1 * b3 / (a0 * w * a3) * np.pi * np.sin(r)
    j[0, 10] = -b1 * np.pi * np.sin(r) * r
    return j


def solid(q_s, u, v, w):
    """Equations 20 and 21 as they are printed, inside the body too, shape (3,)."""
    a0, a1, a2, a3, e1, e2, t1, t2, b1, b2, b3 = q_s
    base = np.array([np.cos(u), np.sin(u), np.cos(v), np.sin(v)])
    cu, su, cv, sv = np.sign(base) * np.abs(base) ** [e1, e1, e2, e2]
    x, y, z = a0 * w * np.array([a1 * cu * cv, a2 * cu * sv, a3 * su])
    bend = b1 * np.cos((z + b2) / (a0 * a3) * np.pi * b3)
    return np.array([(t1 * z / (a0 * a3) + 1) * x + bend, (t2 * z / (a0 * a3) + 1) * y, z])


def wrong_entries(found, expected):
    """Which entries, by coordinate and parameter, differ at any of the points, (n, 3, 11)."""
    off = np.abs(found - expected).max(axis=0)
    return {f'{"xyz"[row]} by {shape.PARAMETERS[k]}' for row, k in np.argwhere(off > 1e-6)}


def printed_and_differences(w):
    points = [(u, v, w) for u, v in COORDINATES[1:]]  # the first has v = 0, and ln 0 as printed
    printed = np.array([as_printed(BENT, *point) for point in points])
    exact = [central_differences(lambda q, p=p: solid(q, *p), BENT, 1e-6) for p in points]
    return printed, np.array(exact)


def test_one_printed_entry_is_wrong_on_the_surface():
    """By b3 it is -b1 sin(r) r / b3, printed as -b1 pi sin(r) r; the other 16 are right."""
    printed, exact = printed_and_differences(w=1.0)
    assert wrong_entries(printed, exact) == {'x by b3'}
    right = printed.copy()
    right[:, :, 10] /= np.pi * BENT[10]
    assert wrong_entries(right, exact) == set()
    assert wrong_entries(right, shape.jacobian(BENT, COORDINATES[1:])) == set()
    assert np.count_nonzero(np.abs(printed).max(axis=0)) == 17


def test_inside_the_body_the_printed_entries_are_those_of_another_shape():
    """They divide by a0 w a3 where equation 21 does by a0 a3, so that taper and bend lose w."""
    printed, exact = printed_and_differences(w=0.5)
    assert wrong_entries(printed, exact) == {
        *(f'x by {name}' for name in ('a0', 'a1', 'a3', 'e1', 'e2', 't1', 'b1', 'b2', 'b3')),
        *(f'y by {name}' for name in ('a0', 'a2', 'e1', 'e2', 't2')),
    }


# --- poles, equator, edges


@pytest.mark.parametrize('e1', [0.0, 1e-9, 1.0, 2.0])
@pytest.mark.parametrize('e2', [0.0, 1e-9, 1.0, 2.0])
def test_all_is_finite_at_poles_and_edges(e1, e2):
    q_s = BENT.copy()
    q_s[4:6] = e1, e2
    rate = np.random.default_rng(1).normal(size=11)
    assert np.all(np.isfinite(shape.positions(q_s, CORNERS)))
    assert np.all(np.isfinite(shape.jacobian(q_s, CORNERS)))
    moved = shape.motion(q_s, rate, CORNERS)
    assert np.all(np.isfinite([moved.value, moved.first, moved.second]))


def test_where_a_sine_is_0_squareness_moves_nothing():
    """The limit of x^e ln x, also where pi / 2 is rounded and its cosine is 6e-17."""
    for e in (1e-3, 0.0):
        q_s = plain(2.0, 0.3, 0.4, 0.5, e, e)
        poles = shape.jacobian(q_s, np.array([[np.pi / 2, 0.3], [-np.pi / 2, 0.3]]))
        np.testing.assert_array_equal(poles[:, :, 4], 0.0)
        equator = shape.jacobian(q_s, np.array([[0.0, -np.pi], [0.0, np.pi / 2], [0.0, 0.0]]))
        np.testing.assert_array_equal(equator[:, :, 4:6], 0.0)


def test_next_to_a_pole_the_derivative_vanishes_like_its_limit():
    """At a small x it is a0 a1 x^e ln x."""
    for x in (1e-3, 1e-6, 1e-12):
        q_s = plain(2.0, 0.3, 0.4, 0.5, 1.5, 1.0)
        found = shape.jacobian(q_s, np.array([[np.arccos(x), 0.0]]))[0, 0, 4]
        # arccos near pi / 2 keeps x to the rounding of pi / 2, 2e-16
        np.testing.assert_allclose(found, 0.6 * x**1.5 * np.log(x), rtol=1e-15 / x + 1e-12)


# --- what is no superquadric


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('a0', 0.0),
        ('a1', 1.1),
        ('a2', -0.1),
        ('a3', 0.0),
        ('e1', -0.1),
        ('e2', 2.5),
        ('t1', 1.2),
        ('t2', -1.2),
        ('b1', np.inf),
        ('b1', np.nan),
        ('b2', 1.5),
        ('b3', 0.0),
    ],
)
def test_a_parameter_out_of_range_is_named(name, value):
    q_s = BENT.copy()
    q_s[shape.PARAMETERS.index(name)] = value
    with pytest.raises(ConfigError, match=f'superquadric: {name} is {value:g}, expected a number'):
        shape.check_parameters(q_s)


def test_too_few_parameters():
    with pytest.raises(ConfigError, match=r'a superquadric has 11 parameters \(a0, .*, not 3'):
        shape.check_parameters(np.ones(3))
