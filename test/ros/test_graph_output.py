"""The graph on topics: JSON in pieces, detections, markers, and /tf."""

from types import SimpleNamespace as Value

import msgspec
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseWithCovariance, Quaternion, Vector3
from sensor_msgs.msg import PointField
from std_msgs.msg import Header
from support.merging import move_node
from support.room_nodes import add_node, room, table, thing
from support.spaces import BLOCK, BLOCK_RGB, seen_room
from support.view import box_at, make_graph, make_node
from visualization_msgs.msg import Marker

from deworldsg_ros.graph.floor_plan import floor_plan
from deworldsg_ros.graph.surface import surface_of
from deworldsg_ros.ros import graph_output, transforms
from deworldsg_ros.ros.graph_output import PiecewiseEncoder, marker_array
from deworldsg_ros.ros.transforms import object_transforms
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import empty_scene_graph

# Where vision_msgs lacks, it is imitated.
IMITATED = Value(
    Detection3DArray=lambda: Value(header=Header(), detections=[]),
    Detection3D=lambda id: Value(
        id=id, header=Header(), results=[], bbox=Value(center=Pose(), size=Vector3())
    ),
    ObjectHypothesisWithPose=lambda: Value(
        hypothesis=Value(class_id="", score=0.0), pose=PoseWithCovariance()
    ),
)


def boxed_and_not() -> wire.SceneGraphMessage:
    box = wire.GravityBox([1.0, 2.0, 3.0], [0.4, 0.3, 0.2], [0.0, 0.0, 1.0, 0.0])
    covariance = [[0.04, 0.001, 0.0], [0.001, 0.01, 0.0], [0.0, 0.0, 0.0025]]
    node = make_node(7, "cup", (1.1, 2.0, 3.0), covariance)
    boxed = msgspec.structs.replace(node, box=box, existence=0.5)
    return make_graph([boxed, make_node(8, "shadow")])


@pytest.mark.parametrize("installed", [False, True])
def test_every_object_with_a_box_is_a_detection(installed):
    if installed and graph_output.VISION_MSGS is None:
        pytest.skip("vision_msgs is not installed")
    messages = graph_output.VISION_MSGS if installed else IMITATED
    array = graph_output.detection_array(boxed_and_not(), Time(sec=3), messages)
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


def test_every_object_with_a_box_is_a_frame(monkeypatch):
    (found,) = object_transforms(boxed_and_not(), Time(sec=3), "robot1/")
    assert (found.header.frame_id, found.child_frame_id) == ("map", "robot1/object_7")
    assert found.header.stamp.sec == 3
    assert found.transform.translation == Vector3(x=1.0, y=2.0, z=3.0)
    assert found.transform.rotation == Quaternion(x=0.0, y=0.0, z=1.0, w=0.0)
    monkeypatch.setattr(transforms, "TFMessage", None)
    with pytest.raises(ConfigurationError, match="output.publish_tf .* tf2_msgs"):
        transforms.ObjectTransforms(Value())


def test_the_room_is_a_point_cloud_with_colours_and_ids_of_objects():
    low, high = np.array(BLOCK)
    node = make_node(7, "box", box=box_at((low + high) / 2, high - low))
    surface = surface_of(seen_room())
    cloud = graph_output.point_cloud(surface, [node], "map", Time(sec=3))
    assert (cloud.header.frame_id, cloud.header.stamp.sec, cloud.height) == ("map", 3, 1)
    kinds = {PointField.FLOAT32: "<f4", PointField.UINT32: "<u4"}
    fields = {f.name: (kinds[f.datatype], f.offset) for f in cloud.fields}
    assert list(fields) == ["x", "y", "z", "rgb", "object"]
    kind = np.dtype(
        {
            "names": list(fields),
            "formats": [kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": cloud.point_step,
        }
    )
    values = np.frombuffer(bytes(cloud.data), kind)
    assert len(values) == cloud.width == cloud.row_step / cloud.point_step
    points, colours, _ = surface.kept()
    np.testing.assert_array_equal(np.stack([values[axis] for axis in "xyz"], axis=1), points)
    blue, green, red = np.ascontiguousarray(values["rgb"]).view("u1").reshape(-1, 4)[:, :3].T
    np.testing.assert_array_equal(np.stack([red, green, blue], axis=1), colours)
    assert set(values["object"][(colours == BLOCK_RGB).all(axis=1)]) == {7}


def test_the_floor_plan_is_an_occupancy_grid():
    plan = floor_plan(seen_room(), (0.0, 0.0, 1.0), 1.5)
    grid = graph_output.occupancy_grid(plan, "map", Time(sec=3))
    assert (grid.header.frame_id, grid.info.resolution) == ("map", pytest.approx(0.05))
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    np.testing.assert_array_equal(cells, plan.cells)
    origin = grid.info.origin
    column, row = (np.array([0.8, 0.0]) - [origin.position.x, origin.position.y]) / 0.05
    assert cells[int(row), int(column)] == 100
    assert (origin.orientation.w, origin.position.z) == (1.0, pytest.approx(0.0, abs=0.02))


def test_a_marker_array_replaces_all_markers():
    item = Value(
        namespace="nodes",
        id=7,
        kind="sphere",
        position=np.array([1.0, 2.0, 3.0]),
        quat_xyzw=(0.0, 0.0, 0.0, 1.0),
        scale=(0.1, 0.2, 0.3),
        rgba=(1.0, 0.0, 0.0, 0.5),
        text="",
        points=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    )
    clear, marker = marker_array([item], "map", Time(sec=5)).markers
    assert clear.action == Marker.DELETEALL
    assert (marker.ns, marker.id, marker.type) == ("nodes", 7, Marker.SPHERE)
    assert (marker.header.frame_id, marker.header.stamp.sec) == ("map", 5)
    assert (marker.pose.position.z, marker.scale.y, marker.color.a) == (3.0, 0.2, 0.5)
    assert marker.points[1].x == 1.0
    assert [m.action for m in marker_array([], "map", Time()).markers] == [Marker.DELETEALL]


def test_the_text_of_the_pieces_is_that_of_the_plain_encoder(monkeypatch):
    """Also after changes, and without anything encoded again that did not change."""
    monkeypatch.setattr(graph_output, "PIECE_IDS", 2)
    cups = {f"cup {i}": thing("cup", 0.3 * i - 0.6, 0.0, 0.74, 0.08, 0.08, 0.1) for i in range(5)}
    builder, ids = room({"table": table(0.0, 0.0), **cups})
    encoder, rng = PiecewiseEncoder(), np.random.default_rng(0)
    empty = empty_scene_graph("map")
    assert encoder.encode(empty) == wire.encode(empty)
    changes = [
        lambda: None,
        lambda: add_node(builder, thing("bowl", 0.0, 0.2, 0.74, 0.2, 0.2, 0.1), rng),
        lambda: move_node(builder.graph, ids["cup 1"], np.eye(4)),
        lambda: builder.graph.remove_node(ids["cup 2"]),
    ]
    for change in changes:
        change()
        builder.update()
        message = builder.snapshot()
        assert message.nodes
        assert encoder.encode(message) == wire.encode(message)
    assert message.edges
    encoded: list[object] = []
    plain = msgspec.json.encode
    monkeypatch.setattr(
        graph_output.msgspec.json, "encode", lambda item: (encoded.append(item), plain(item))[1]
    )
    encoder.encode(builder.snapshot())
    assert [type(item) for item in encoded] == [wire.SceneGraphMessage]  # its frame only
