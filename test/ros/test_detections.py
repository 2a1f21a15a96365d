"""Objects as Detection3DArray and on /tf. Where vision_msgs lacks, it is imitated."""

from __future__ import annotations

from types import SimpleNamespace as Value

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseWithCovariance, Quaternion, Vector3
from std_msgs.msg import Header
from support.view import make_graph, make_node

from deworldsg_ros.ros import graph_output, transforms
from deworldsg_ros.ros.transforms import object_transforms
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire

IMITATED = Value(
    Detection3DArray=lambda: Value(header=Header(), detections=[]),
    Detection3D=lambda id: Value(
        id=id, header=Header(), results=[], bbox=Value(center=Pose(), size=Vector3())
    ),
    ObjectHypothesisWithPose=lambda: Value(
        hypothesis=Value(class_id="", score=0.0), pose=PoseWithCovariance()
    ),
)


def boxed(node_id: int) -> wire.NodeState:
    box = wire.GravityBox([1.0, 2.0, 3.0], [0.4, 0.3, 0.2], [0.0, 0.0, 1.0, 0.0])
    covariance = [[0.04, 0.001, 0.0], [0.001, 0.01, 0.0], [0.0, 0.0, 0.0025]]
    node = make_node(node_id, "cup", (1.1, 2.0, 3.0), covariance)
    return wire.msgspec.structs.replace(node, box=box, existence=0.5)


@pytest.mark.parametrize("installed", [False, True])
def test_every_object_with_a_box_is_a_detection(installed: bool) -> None:
    if installed and graph_output.VISION_MSGS is None:
        pytest.skip("vision_msgs is not installed")
    messages = graph_output.VISION_MSGS if installed else IMITATED
    graph = make_graph([boxed(7), make_node(8, "shadow")])
    array = graph_output.detection_array(graph, Time(sec=3), messages)
    assert array.header.frame_id == "map"
    (found,) = array.detections
    assert (found.id, found.header.stamp.sec) == ("7", 3)
    assert found.bbox.size.x == 0.4
    assert found.bbox.center.orientation.z == 1.0
    assert [result.hypothesis.class_id for result in found.results] == ["cup", "other"]
    first = found.results[0]
    assert first.hypothesis.score == pytest.approx(0.45)
    assert first.pose.pose.position.x == 1.1
    assert first.pose.covariance.reshape(6, 6)[:2, :2].tolist() == [[0.04, 0.001], [0.001, 0.01]]
    assert first.pose.covariance[14] == 0.0025
    assert not first.pose.covariance[21:].any()


def test_every_object_with_a_box_is_a_frame() -> None:
    graph = make_graph([boxed(7), make_node(8, "shadow")])
    (found,) = object_transforms(graph, Time(sec=3), "robot1/")
    assert (found.header.frame_id, found.child_frame_id) == ("map", "robot1/object_7")
    assert found.header.stamp.sec == 3
    assert found.transform.translation == Vector3(x=1.0, y=2.0, z=3.0)
    assert found.transform.rotation == Quaternion(x=0.0, y=0.0, z=1.0, w=0.0)


def test_frames_of_objects_need_tf2_msgs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transforms, "TFMessage", None)
    with pytest.raises(ConfigurationError, match="output.publish_tf is true, but tf2_msgs"):
        transforms.ObjectTransforms(Value())
