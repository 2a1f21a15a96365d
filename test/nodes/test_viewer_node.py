"""viewer_node: topics become a graph and joined frames; abnormal messages change nothing."""

import time
from unittest.mock import Mock

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from msgspec.structs import replace
from sensor_msgs.msg import Image
from std_msgs.msg import String
from support.nodes_bench import Bench, instances, local_graph, rgb, works
from support.reference_updates import diff
from support.view import make_graph, make_node

import deworldsg_ros.nodes.viewer_node as module
from deworldsg_ros.nodes.viewer_node import ViewerNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica, empty_scene_graph

TOPICS = {
    "/scene_graph/updates": String,
    "/scene_graph": String,
    "deworldsg/local_graph": String,
    "deworldsg/instances": Image,
    "rgb/image_raw": Image,
    "deworldsg/map_transform": TransformStamped,
}


@pytest.fixture
def at(monkeypatch):
    """The node with a viewer without a page."""
    viewer = GraphReplica()
    viewer.look, viewer.say, viewer.close = Mock(), Mock(), Mock()

    def make(options, why_empty, on_error):
        viewer.on_error = on_error
        return viewer

    monkeypatch.setattr(module, "make_viewer", make)
    with Bench(ViewerNode, TOPICS, reliable(50, latched=True)) as bench:
        bench.viewer = viewer
        yield bench
    viewer.close.assert_called_once()


def cup_update(sequence, stamp_ns=0):
    stamp = wire.stamp_from_ns(stamp_ns)
    graph = replace(make_graph([make_node(sequence, "cup")]), stamp=stamp, sequence=sequence)
    before = replace(graph, sequence=sequence - 1, nodes=[])
    update = diff(before, graph, associations=[wire.Association(stamp, [sequence])])
    return replace(update, session="a")


def send_frame(at, sequence):
    at.send_made(
        rgb__image_raw=rgb,
        deworldsg__instances=lambda stamp_ns: instances(stamp_ns, 1),
        deworldsg__local_graph=local_graph,
        __scene_graph__updates=lambda stamp_ns: cup_update(sequence, stamp_ns),
    )


def test_updates_and_frames_reach_the_viewer(at):
    send_frame(at, 1)
    at.expect(lambda: at.viewer.look.called, "a frame")
    view = at.viewer.look.call_args.args[0]
    assert view.stamp_ns == at.stamp_ns and view.node_ids == (1,)
    assert view.rgb.shape == (48, 64, 3) and view.instances.max() == 1
    np.testing.assert_array_equal(view.T_world_camera, np.eye(4))
    assert list(at.viewer.nodes) == [1] and at.viewer.sequence == 1


def test_a_gap_is_closed_by_the_next_snapshot(at):
    send_frame(at, 1)
    at.expect(lambda: at.viewer.sequence == 1, "the first update")
    at.send(__scene_graph__updates=cup_update(3))
    at.expect(lambda: at.node.more_values() == {"gaps": "1"}, "a gap")
    assert at.viewer.sequence == 1
    snapshot = make_graph([make_node(1, "cup"), make_node(2, "cup")])
    snapshot.sequence, snapshot.session = 2, "a"
    at.send(__scene_graph=snapshot)
    at.expect(lambda: at.viewer.sequence == 3, "the snapshot and the update that waited")
    assert sorted(at.viewer.nodes) == [1, 2, 3]


def test_without_a_graph_it_says_what_is_missing(at):
    assert at.node.waiting_for(0) == ["no graph on /scene_graph"]
    at.send(__scene_graph=empty_scene_graph("map"))
    at.expect(lambda: at.viewer.say.called, "another reason")
    assert "empty" in at.viewer.say.call_args.args[0]
    assert at.node.waiting_for(0) == []


@pytest.mark.parametrize(
    "topic", ["__scene_graph", "__scene_graph__updates", "deworldsg__local_graph"]
)
def test_what_is_no_message_is_refused(at, topic):
    for text in ("", "{", '{"schema": 3}', "\x00"):
        at.refuses("invalid_message", lambda text=text: at.send(**{topic: text}))
    works(at, lambda: send_frame(at, at.viewer.sequence + 1))


def test_an_error_of_the_page_is_counted(at):
    at.refuses("internal_error", lambda: at.viewer.on_error(ZeroDivisionError("odd")))
    assert at.node.health.report(0.0).values["example internal_error"] == "odd"


def test_a_graph_that_was_found_in_a_map_brings_its_camera_along(at):
    at.viewer.correct = Mock()
    send_frame(at, 1)
    at.expect(lambda: at.viewer.look.call_count == 1, "the frame")
    message = TransformStamped(child_frame_id="map")
    message.header.frame_id = "scene_map"
    message.transform.translation.x = 2.0
    at.send(deworldsg__map_transform=message)
    at.expect(lambda: at.viewer.correct.called, "the transform")
    (change,) = at.viewer.correct.call_args.args
    assert change.at(np.array([at.stamp_ns]))[0, 0, 3] == 2.0
    time.sleep(module.VIEW_PERIOD_S)
    send_frame(at, 2)
    at.expect(lambda: at.viewer.look.call_count == 2, "the frame")
    before, after = (call.args[0].local for call in at.viewer.look.call_args_list)
    assert after.means_world - before.means_world == pytest.approx(np.array([[2.0, 0.0, 0.0]]))
    # Told again, it moves nothing; found elsewhere, by the difference.
    at.send(deworldsg__map_transform=message)
    message.transform.translation.x = 3.0
    at.send(deworldsg__map_transform=message)
    at.expect(lambda: at.viewer.correct.call_count > 1, "the other transform")
    (change,) = at.viewer.correct.call_args.args
    assert at.viewer.correct.call_count == 2
    assert change.at(np.array([at.stamp_ns]))[0, 0, 3] == pytest.approx(1.0)
