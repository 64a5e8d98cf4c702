"""The EKF node follows a closed body over real DDS: points without labels in, a mesh out."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from live_graph import RELIABLE, ROOT, flat, frame, stamps, values
from sensor_msgs.msg import PointCloud2
from swinging_body import FRAME, Swinging
from visualization_msgs.msg import Marker

from cloth_predict.config import load
from cloth_predict.formats.pointcloud import NORMAL, SURFACE, UNLABELLED, decode
from cloth_predict.nodes.ekf_node import EkfNode
from cloth_predict.tracker import Tracker

BALLOON = ROOT / 'config' / 'balloon.yaml'
FRAMES = 20
BODY = Swinging()


def seen(k):
    """Points of a frame [m], as float32 has them, in an order of their own."""
    points = np.random.default_rng(k).permutation(BODY.markers(k * FRAME / 1e9))
    return points.astype(np.float32).astype(float)


class Node:
    """The node, and what it is sent."""

    def __init__(self, graph, **changes):
        for topic, kind in (('cloth/prediction', PointCloud2), ('cloth/mesh', Marker),
                            ('diagnostics', DiagnosticArray)):  # fmt: skip
            graph.listen(topic, kind)
        self._graph = graph
        self._node = graph.start(EkfNode, **flat(BALLOON, **changes))
        self._markers = graph.probe.create_publisher(PointCloud2, 'markers', RELIABLE)
        topics = ('cloth/prediction', 'cloth/mesh', 'diagnostics')
        graph.until(
            lambda: (
                self._markers.get_subscription_count() == 1
                and all(graph.probe.count_publishers(topic) for topic in topics)
            )
        )

    def take(self, k, points):
        """Send a frame of points without labels, and wait until the node has taken it."""
        before = self._taken()
        self._markers.publish(frame(FRAME * k, points, ids=np.full(len(points), UNLABELLED)))
        self._graph.until(lambda: self._taken() > before)

    def _taken(self):
        return self._node._tracker.counts.total() + self._node._diagnostics.counts.total()

    def told(self, level, words):
        """Wait for diagnostics of this level with these words."""

        def found():
            heard = [message.status[0] for message in self._graph.heard['diagnostics']]
            return any(s.level == level and words in s.message for s in heard)

        self._graph.until(found)


def test_a_predicted_mesh_comes_out_of_points_without_labels(graph):
    node = Node(graph)
    tracker = Tracker(load(BALLOON))
    none = np.full((tracker.nodes, 3), np.nan), np.zeros(tracker.nodes, bool)
    for k in range(FRAMES):
        node.take(k, seen(k))
        tracker.step(FRAME * k, *none, seen(k))
    expected = tracker.predict(0.1)
    graph.until(lambda: stamps(graph.heard['cloth/mesh'])[-1:] == [expected.stamp])
    (cloud,) = (m for m in graph.heard['cloth/prediction'] if stamps([m]) == [expected.stamp])
    points = decode(cloud, (*SURFACE.names, *NORMAL))
    assert points.shape == (1, 400)
    named = {'sigma': expected.sigma}
    for prefix, vectors in (('', expected.position), ('v', expected.velocity)):
        named |= {prefix + axis: vectors[:, k] for k, axis in enumerate('xyz')}
    named |= {name: expected.normal[:, k] for k, name in enumerate(NORMAL)}
    for name, values_of in named.items():
        np.testing.assert_array_equal(points[0][name], values_of.astype(np.float32), name)
    assert 0 < points['sigma'].min() < points['sigma'].max() < 0.05
    mesh = np.array([(p.x, p.y, p.z) for p in graph.heard['cloth/mesh'][-1].points])
    np.testing.assert_array_equal(mesh, expected.position[tracker.triangles].reshape(-1, 3))
    side = tracker.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    # a closed mesh: each side once in each direction
    assert {tuple(s) for s in side.tolist()} == {tuple(s[::-1]) for s in side.tolist()}
    assert np.linalg.det(mesh.reshape(-1, 3, 3)).sum() / 6 > 0  # its volume: outward
    graph.until(lambda: values(graph).get('matched_markers') == str(60 * FRAMES))
    assert values(graph)['unlabelled_markers'] == '60'


@pytest.mark.parametrize(
    ('points', 'words'),
    [
        (BODY.markers(0.0)[:7], 'no surface yet: 7 markers, fewer than the 11 global parameters'),
        (np.outer(np.linspace(0, 1, 20), [1.0, 2.0, 0.5]), 'all 20 points lie on a line'),
        (np.where(np.eye(60, 3, -5) > 0, np.nan, BODY.markers(0.0)), 'point 5 has a coordinate'),
    ],
)
def test_points_that_are_no_body_are_told(graph, points, words):
    node = Node(graph)
    node.take(0, points)
    node.told(DiagnosticStatus.WARN, words)
    assert not graph.heard['cloth/prediction']
