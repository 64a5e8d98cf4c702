"""The augmented view of a surface over real DDS: what is shown, and taken away."""

import numpy as np
from live_graph import RELIABLE, ROOT, flat, frame, stamps
from recordings import beginning
from sensor_msgs.msg import PointCloud2
from swinging_body import FRAME, SETTINGS, Swinging
from visualization_msgs.msg import Marker, MarkerArray

from cloth_predict.config import load
from cloth_predict.formats.pointcloud import UNLABELLED
from cloth_predict.nodes.ekf_node import EkfNode
from cloth_predict.overlay import ARROWS, arrow_scale, dashes_of_net
from cloth_predict.tracker import Tracker

TOWEL = ROOT / 'config' / 'towel.yaml'


class Viewed:
    """The EKF node, what it is sent, and what is shown of it."""

    def __init__(self, graph, **parameters):
        self._graph = graph
        graph.listen('cloth/markers', MarkerArray)
        node = graph.start(EkfNode, **parameters)
        self._markers = graph.probe.create_publisher(PointCloud2, 'markers', RELIABLE)
        graph.until(
            lambda: (
                self._markers.get_subscription_count() == 1
                and node._overlay.get_subscription_count() == 1
            )
        )

    def after(self, message):
        """Send a frame and return what is shown of it, by namespace and number."""
        heard = self._graph.heard['cloth/markers']
        before = len(heard)
        self.send(message)
        self._graph.until(lambda: len(heard) > before)
        return {(m.ns, m.id): m for m in heard[-1].markers}

    def send(self, message):
        """Send a frame that is not shown, as it comes too early after the last one."""
        self._markers.publish(message)


def points(marker):
    return np.array([(p.x, p.y, p.z) for p in marker.points]).reshape(-1, 2, 3)


def actions(shown, name):
    return {m.action for (ns, _), m in shown.items() if ns == name}


def test_a_sheet_is_shown_as_the_tracker_knows_it(graph):
    viewed, tracker, towel = Viewed(graph, **flat()), Tracker(load(TOWEL)), beginning(31).markers
    for k, stamp in enumerate(towel.stamps.tolist()):
        seen = np.flatnonzero(towel.visible[k])
        take = viewed.send if k % 5 else viewed.after  # it is shown every 50 ms
        shown = take(frame(stamp, towel.positions[k, seen], ids=seen))
        tracker.step(stamp, towel.positions[k], towel.visible[k])
        prediction = tracker.predict(0.1)  # its covariance is kept for some frames
    assert {ns for ns, _ in shown} == {'estimate', 'prediction', 'forces', 'values'}
    estimate, loads = tracker.estimate(), tracker.loads()
    solid, dashed = shown['estimate', 0], shown['prediction', 0]
    assert solid.type == dashed.type == Marker.LINE_LIST
    assert stamps([solid, dashed]) == [estimate.stamp, prediction.stamp]
    np.testing.assert_array_equal(points(solid), estimate.position[tracker.edges])
    expected = dashes_of_net(prediction.position[tracker.edges])
    np.testing.assert_array_equal(points(dashed), expected)
    scale = arrow_scale(tracker.config)
    for node in range(20):
        arrow = shown['forces', node]
        if node < 4:  # driven: nothing is known of the force there
            assert arrow.action == Marker.DELETE
            continue
        tail, tip = points(arrow)[0]
        np.testing.assert_array_equal(tail, estimate.position[node])
        np.testing.assert_allclose(tip - tail, scale * loads[node], atol=1e-12)
    text = shown['values', 0]
    assert 'prediction 100 ms ahead' in text.text
    assert tracker.health().text in text.text
    assert f'10 cm are {0.1 / scale:.2g} N' in text.text
    assert text.pose.position.y > estimate.position[:, 1].max()  # y is upwards


def test_what_is_not_known_any_more_is_taken_away(graph):
    good = beginning(1).markers.positions[0]
    # no prediction is as certain as that
    viewed = Viewed(graph, **flat(**{'limits.sigma_error': 1e-6, 'limits.sigma_warn': 1e-7}))
    refused = viewed.after(frame(0, good))
    assert actions(refused, 'prediction') == {Marker.DELETE}
    assert actions(refused, 'estimate') == {Marker.ADD}
    assert 'no prediction 100 ms ahead' in refused['values', 0].text
    # after a jump in time a surface has to be found anew, of which the held nodes are hidden
    gone = viewed.after(frame(10**11, good[4:], ids=np.arange(4, 20)))
    assert {m.action for m in gone.values()} == {Marker.DELETEALL}


def test_a_surface_without_unknown_forces_has_no_arrows(graph):
    still = {'force.kind': 'none', 'wind.kind': 'none'}
    shown = Viewed(graph, **flat(**still)).after(frame(0, beginning(1).markers.positions[0]))
    assert {ns for ns, _ in shown} == {'estimate', 'prediction', 'values'}


def test_a_body_is_shown(graph):
    viewed, moving = Viewed(graph, **{'frame': 'mocap', **SETTINGS}), Swinging()
    for k in range(0, 25, 5):
        seen = moving.markers(1e-9 * k * FRAME)
        shown = viewed.after(frame(k * FRAME, seen, ids=np.full(len(seen), UNLABELLED)))
    assert len(points(shown['estimate', 0])) == 3 * (300 - 2)  # of a closed surface: Euler
    assert actions(shown, 'forces') == {Marker.ADD}
    assert sum(ns == 'forces' for ns, _ in shown) <= ARROWS
