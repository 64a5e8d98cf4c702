"""Markers at nodes, the nodes between them, and the finer nodes that are published."""

import numpy as np
import pytest
from bodies import REFERENCE, body
from references import central_differences
from scipy.spatial.transform import Rotation

from cloth_predict.bodies.association import UNNAMED, Attached, attach, spacing
from cloth_predict.bodies.filling import Filling
from cloth_predict.bodies.fine_mesh import FineMesh
from cloth_predict.filters.blocks import Blocks
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.superquadric import GLOBAL, LOCAL
from cloth_predict.models.superquadric_shape import positions

STRAIGHT = np.eye(3)


def attached(places, position, rotation=STRAIGHT):
    label = np.full(len(places), UNNAMED)
    return attach(places, label, 0, ClosedMesh.even(len(position)), position, rotation)


# --- markers at nodes


def test_a_marker_is_attached_to_the_nearest_node():
    rng = np.random.default_rng(0)
    model, x, _ = body(60)
    position = model.position(x)
    places = position[rng.integers(0, 60, 40)] + rng.normal(0, 0.02, (40, 3))
    found = attached(places, position, model.rotation(x))
    apart = np.linalg.norm(places[:, None] - position, axis=2)
    np.testing.assert_array_equal(found.node, apart.argmin(axis=1))
    assert (found.seen == 0).all()


def test_a_marker_moves_with_its_node_and_the_frame_of_the_body():
    model, x, _ = body(60)
    position, rotation = model.position(x), model.rotation(x)
    places = position[[3, 8]] + np.array([[0.01, -0.02, 0.01], [0.0, 0.01, 0.0]])
    found = attached(places, position, rotation)
    turn = Rotation.from_rotvec([0.4, -0.1, 0.8]).as_matrix()
    moved = found.place(position @ turn.T + 1.0, turn @ rotation)
    np.testing.assert_allclose(moved, found.place(position, rotation) @ turn.T + 1.0, atol=1e-14)
    back = found.of_nodes(moved, turn @ rotation)
    np.testing.assert_allclose(back, position[found.node] @ turn.T + 1.0, atol=1e-14)  # rounding


@pytest.mark.parametrize('angle', [0.02, 0.04, 0.08])
def test_a_marker_off_its_node_does_not_bend_a_sphere(angle):
    # the tangent plane of the node is off by half the square of the distance
    sphere = ClosedMesh.even(200).directions  # nodes 0.25 apart
    across = np.cross(sphere[100], [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    place = (np.cos(angle) * sphere[100] + np.sin(angle) * across)[None]
    found = attached(place, sphere)
    assert found.node.tolist() == [100]
    implied = np.linalg.norm(found.of_nodes(place, np.eye(3)))
    assert abs(implied - 1.0) < 0.15 * angle**2 / 2


def test_what_a_marker_is_off_across_the_surface_moves_the_node():
    sphere = ClosedMesh.even(500).directions
    place = sphere[[100]] * 1.02
    found = attached(place, sphere)
    np.testing.assert_allclose(found.offset, 0.0, atol=1e-3)  # the normal of the mesh is not exact
    np.testing.assert_allclose(found.of_nodes(place, np.eye(3)), place, atol=1e-3)


def test_no_marker_is_attached_to_no_node():
    sphere = ClosedMesh.even(50).directions
    assert len(attached(np.zeros((0, 3)), sphere)) == 0


def test_markers_are_joined_replaced_and_left_out():
    def marker(k):
        number = np.array([k])
        return Attached(number, np.full((1, 3), float(k)), number, number)

    three = marker(0).joined(marker(1)).joined(marker(2))
    assert three.node.tolist() == [0, 1, 2]
    changed = three.replaced(np.array([1]), marker(7))
    for array in (changed.node, changed.offset[:, 0], changed.label, changed.seen):
        assert array.tolist() == [0, 7, 2]
    assert changed.kept(np.array([True, False, True])).node.tolist() == [0, 2]
    assert three.seen_at(9, np.array([False, True, False])).seen.tolist() == [0, 9, 2]


def test_spacing_is_the_distance_of_the_nearest_other():
    places = np.random.default_rng(1).normal(size=(30, 3))
    apart = np.linalg.norm(places[:, None] - places, axis=2) + np.diag(np.full(30, np.inf))
    np.testing.assert_allclose(spacing(places), apart.min(axis=1), rtol=1e-12)


# --- nodes without a marker


def believed(model, x, seed=0):
    """A belief whose nodes have covariances of all sizes."""
    rng = np.random.default_rng(seed)
    blocks = Blocks.of_body(model, 'pose')
    roots = rng.normal(0, 1e-2, (model.nodes, 6, 6))
    shared = np.diag(rng.uniform(0.1, 1.0, 36))
    return blocks.belief(x, shared, roots @ roots.transpose(0, 2, 1))


def test_nodes_between_markers_are_where_the_membrane_is_at_rest():
    model, x, _ = body(40, w0=0.3)
    seen = np.array([0, 5, 5, 17, 30, 33])
    filling = Filling.of(model, seen)
    belief = believed(model, x)
    found = filling.applied(belief)
    np.testing.assert_array_equal(found.shared, belief.shared)
    for begin in (LOCAL, model.dim_q + LOCAL):
        d = found.mean[begin : begin + 120].reshape(40, 3)
        np.testing.assert_array_equal(d[seen], x[begin : begin + 120].reshape(40, 3)[seen])
        force = model.membrane.apply(d)
        np.testing.assert_allclose(force[filling.unseen], 0.0, atol=1e-15)  # rounding of 1e-2
    np.testing.assert_array_equal(found.own[seen], belief.own[seen])


def test_their_covariance_is_that_of_a_random_field_given_the_others():
    # conditioning the covariance tau K^-1, which the filling never makes
    model, x, _ = body(40, w0=0.3)
    seen = np.array([0, 5, 17, 30, 33])
    filling = Filling.of(model, seen)
    field = np.linalg.inv(model.membrane.matrix().toarray())
    s, u = filling.seen, filling.unseen
    gain = field[np.ix_(u, s)] @ np.linalg.inv(field[np.ix_(s, s)])
    np.testing.assert_allclose(filling.weight, gain, atol=1e-10)  # condition of K: 1e2
    left = field[np.ix_(u, u)] - gain @ field[np.ix_(s, u)]
    np.testing.assert_allclose(filling.variance, np.diag(left), rtol=1e-8)
    belief = believed(model, x)
    own = filling.applied(belief).own
    d = x[LOCAL : model.dim_q].reshape(40, 3)[s]
    tau = np.einsum('si,st,ti->', d, np.linalg.inv(field[np.ix_(s, s)]), d) / d.size
    expected = np.einsum('us,sij->uij', gain**2, belief.own[s])[:, :3, :3]
    expected += (tau * np.diag(left))[:, None, None] * np.eye(3)
    np.testing.assert_allclose(own[u][:, :3, :3], expected, rtol=1e-8)


def test_this_scale_of_the_field_makes_its_displacements_most_likely():
    model, x, _ = body(40, w0=0.3)
    filling = Filling.of(model, np.arange(0, 40, 3))
    d = x[LOCAL : model.dim_q].reshape(40, 3)[filling.seen]
    energy = np.sum(d * (filling.stiffness @ d))

    def likelihood(tau):  # but for a constant
        return -0.5 * d.size * np.log(tau) - 0.5 * energy / tau

    tau = energy / d.size
    beside = 1e-4 * tau
    slope = central_differences(lambda t: np.array([likelihood(t[0])]), np.array([tau]), beside)
    np.testing.assert_allclose(slope * tau, 0.0, atol=1e-4)  # the square of the step, by d.size


def test_a_displacement_that_is_the_same_everywhere_stays_so():
    model, _x, _ = body(40, w0=0.0)
    filling = Filling.of(model, np.array([2, 9, 20]))
    np.testing.assert_allclose(filling.weight.sum(axis=1), 1.0, rtol=1e-10)
    assert filling.weight.min() > 0
    assert filling.between(np.array([20, 9, 2, 2]), model) is filling
    assert filling.between(np.array([20, 9, 3]), model) is not filling


def test_nothing_is_filled_in_where_every_node_has_a_marker():
    model, x, _ = body(20)
    belief = believed(model, x)
    assert Filling.of(model, np.arange(20)).applied(belief) is belief


# --- the nodes that are published


def test_a_mesh_over_itself_is_the_body():
    model, x, forces = body(30)
    fine = FineMesh.of(model.mesh, model.mesh)
    np.testing.assert_array_equal(fine.node, np.arange(30))
    q, rate = x[: model.dim_q], x[model.dim_q :]
    second = model.f(x, forces)[model.dim_q :]
    position, velocity, acceleration = fine.motion(q, rate, second)
    np.testing.assert_allclose(position, model.position(x), atol=1e-14)  # rounding
    np.testing.assert_allclose(velocity, model.velocity(x), atol=1e-13)
    np.testing.assert_allclose(acceleration, model.acceleration(x, forces), atol=1e-10)
    cov = np.random.default_rng(0).normal(size=(30, 3, 3))
    np.testing.assert_allclose(fine.covariance(cov), cov, atol=1e-14)


def test_between_the_nodes_the_global_shape_is_exact():
    coarse, mesh = ClosedMesh.even(20), ClosedMesh.even(300)
    fine = FineMesh.of(mesh, coarse)
    np.testing.assert_allclose(fine.shapes.sum(axis=1), 1.0, rtol=1e-12)
    q = np.zeros(LOCAL + 60)
    q[3], q[GLOBAL] = 1.0, REFERENCE
    np.testing.assert_allclose(
        fine.position(q), positions(REFERENCE, mesh.coordinates), atol=1e-15
    )
    shift = np.array([0.01, 0.02, 0.03])
    q[LOCAL:] = np.tile(shift, 20)
    shifted = positions(REFERENCE, mesh.coordinates) + shift
    np.testing.assert_allclose(fine.position(q), shifted, atol=1e-14)


def test_motion_is_the_change_of_the_position():
    model, x, forces = body(20)
    fine = FineMesh.of(ClosedMesh.even(50), model.mesh)
    q, rate = x[: model.dim_q], x[model.dim_q :]
    second = model.f(x, forces)[model.dim_q :]

    def path(t):
        return fine.position(q + t[0] * rate + 0.5 * t[0] ** 2 * second).ravel()

    def velocity(t):
        return fine.motion(q + t[0] * rate + 0.5 * t[0] ** 2 * second, rate + t[0] * second,
                           second)[1].ravel()  # fmt: skip

    _, first, twice = fine.motion(q, rate, second)
    now = np.zeros(1)
    slope = central_differences(path, now, 1e-5)[:, 0]
    np.testing.assert_allclose(first.ravel(), slope, atol=1e-8)  # 1e-16 over the step
    slope = central_differences(velocity, now, 1e-5)[:, 0]
    np.testing.assert_allclose(twice.ravel(), slope, atol=1e-7)


def test_a_smooth_displacement_converges_with_the_square_of_the_spacing():
    mesh, errors, counts = ClosedMesh.even(500), [], [50, 200, 800]

    def smooth(directions):
        return 0.1 * np.sin(2.0 * directions @ np.array([1.0, 0.5, -0.3]))[:, None] * [1, 2, 0]

    for count in counts:
        coarse = ClosedMesh.even(count)
        fine = FineMesh.of(mesh, coarse)
        d = fine.shapes @ smooth(coarse.directions)
        errors.append(np.sqrt(np.mean((d - smooth(mesh.directions)) ** 2)))
    spacing_of = np.sqrt(1.0 / np.array(counts))
    slope = np.polyfit(np.log(spacing_of), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.2)
