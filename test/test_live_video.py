"""A video over real DDS: pictures in, the estimate, the stop and the augmented view out."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from live_graph import stamps
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from visualization_msgs.msg import Marker, MarkerArray

from cloth_predict.config import flatten, parameters_in
from cloth_predict.errors import ConfigError, FormatError, FrameError
from cloth_predict.nodes._images import image, picture_of
from cloth_predict.nodes.ruler_node import RulerNode
from cloth_predict.nodes.video_node import VideoNode
from cloth_predict.simulation.ruler import ANNEX_A, slide
from cloth_predict.video.commands import film
from cloth_predict.video.generator import Filming

SIZE = (320, 180)


def start(graph, kind, parameters):
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    return graph.add(
        kind(context=graph.context, use_global_arguments=False, parameter_overrides=overrides)
    )


def test_stop_is_told_before_the_bar_rests(graph, tmp_path):
    count, beside = film(tmp_path / 'five', '5', Filming(size=SIZE), 0)
    parameters = flatten(parameters_in(beside))
    for topic in ('ruler/estimate', 'ruler/stop'):
        graph.listen(topic, PoseWithCovarianceStamped)
    graph.listen('ruler/markers', MarkerArray)
    start(graph, RulerNode, parameters)
    # slow enough for any machine: what is late in real time waits in the queue
    start(graph, VideoNode, parameters | {'video.speed': 0.3})
    graph.until(lambda: len(graph.heard['ruler/estimate']) == count)
    assert np.diff(stamps(graph.heard['ruler/estimate'])).tolist() == [20_000_000] * (count - 1)
    motion = slide(ANNEX_A[5])
    true = motion.at(np.array([motion.duration]))[0, :3]
    stop = graph.heard['ruler/stop'][-1]
    assert [stop.pose.pose.position.x, stop.pose.pose.position.y] == pytest.approx(
        list(true[:2]), abs=0.01
    )
    turn = stop.pose.pose.orientation
    assert 2 * np.arctan2(turn.z, turn.w) == pytest.approx(true[2], abs=np.radians(1))
    covariance = np.reshape(stop.pose.covariance, (6, 6))
    assert (np.linalg.eigvalsh(covariance[np.ix_([0, 1, 5], [0, 1, 5])]) > 0).all()
    assert stamps([stop])[0] / 1e9 == pytest.approx(motion.duration, abs=0.1)
    last = {(m.ns, m.id): m for m in graph.heard['ruler/markers'][-1].markers}
    assert set(last) == {
        ('estimate', 0),
        ('stop', 0),
        ('friction', 0),
        ('friction', 1),
        ('values', 0),
    }
    assert 'mu = 0.3' in last['values', 0].text or 'mu = 0.29' in last['values', 0].text
    assert len(last['estimate', 0].points) == 8  # four edges
    # nothing rubs any more
    assert {key[0] for key, m in last.items() if m.action == Marker.DELETE} == {'friction'}
    every = [m for heard in graph.heard['ruler/markers'] for m in heard.markers]
    assert {m.ns for m in every if m.action == Marker.ADD} == {key[0] for key in last}


@pytest.mark.parametrize(
    ('values', 'kind', 'words'),
    [
        ({}, ConfigError, 'video.path: no video is given'),
        ({'video.path': 'absent.mp4'}, FormatError, 'absent.mp4: no such file or folder'),
        ({'video.fsp': 1.0}, ConfigError, 'did you mean video.fps'),
    ],
)
def test_wrong_parameters_end_the_node(graph, values, kind, words):
    with pytest.raises(kind, match=words):
        start(graph, VideoNode, values)


def test_images_keep_pictures():
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    message = image(1, 'table', picture)
    np.testing.assert_array_equal(picture_of(message), picture)
    message.encoding = 'rgb8'
    np.testing.assert_array_equal(picture_of(message), picture[..., ::-1])
    grey = Image(encoding='mono8', height=2, width=3, step=4, data=[1, 2, 3, 0, 4, 5, 6, 0])
    np.testing.assert_array_equal(picture_of(grey)[..., 1], [[1, 2, 3], [4, 5, 6]])
    for wrong in ({'encoding': '16UC1'}, {'height': 6}, {'step': 3}):
        bad = image(1, 'table', picture)
        for name, value in wrong.items():
            setattr(bad, name, value)
        with pytest.raises(FrameError):
            picture_of(bad)
