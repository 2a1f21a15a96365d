"""The recording that the project ships holds what bags/README.md says it holds."""

import json
import lzma
from collections import defaultdict

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from support.cli import DEMO_ROOM

from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.streams.poses import stamp_ns_of

FRAMES = 171
DEPTH, INFO, POSE = "/depth/image_raw/compressedDepth", "/rgb/camera_info", "/camera/pose"
TYPES = {
    "/rgb/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    DEPTH: "sensor_msgs/msg/CompressedImage",
    INFO: "sensor_msgs/msg/CameraInfo",
    POSE: "geometry_msgs/msg/PoseStamped",
}


@pytest.fixture(scope="module")
def messages():
    by_topic = defaultdict(list)
    with AnyReader([DEMO_ROOM]) as reader:
        for connection, log_time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            assert connection.msgtype == TYPES[connection.topic]
            assert log_time_ns == stamp_ns_of(message)
            by_topic[connection.topic].append(message)
    return by_topic


@pytest.fixture(scope="module")
def truth():
    return json.loads(DEMO_ROOM.with_name("demo_room.gt.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def instances():
    with np.load(DEMO_ROOM.with_name("demo_room.instances.npz")) as packed:
        raw = lzma.decompress(packed["lzma"].tobytes())
        return np.frombuffer(raw, np.uint8).reshape(packed["shape"])


def depth_m_of(message) -> np.ndarray:
    return cv2.imdecode(np.asarray(message.data[12:]), cv2.IMREAD_UNCHANGED) / 1000.0


def test_each_topic_has_one_message_per_frame_with_the_same_stamp(messages, truth):
    assert set(messages) == set(TYPES)
    stamps = [[stamp_ns_of(message) for message in column] for column in messages.values()]
    assert all(column == stamps[0] for column in stamps)
    assert len(stamps[0]) == FRAMES == truth["frames"]
    assert set(np.diff(stamps[0])) == {100_000_000}
    assert str(stamps[0][0]) == truth["first_stamp_ns"]
    camera = truth["camera"]
    for info in messages[INFO]:
        fx, _, cx, _, fy, cy, *_ = info.k
        found = {"width": info.width, "height": info.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
        assert found.items() <= camera.items()
    assert sum(path.stat().st_size for path in DEMO_ROOM.iterdir()) < 20e6


def pose_of(message) -> np.ndarray:
    p, q = message.pose.position, message.pose.orientation
    return pose_from_quaternion(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))


def test_depth_and_pose_put_the_table_where_the_ground_truth_has_it(messages, truth, instances):
    table = next(o for o in truth["objects"] if o["name"] == "dining table")
    depth_m = depth_m_of(messages[DEPTH][0])
    rows, columns = np.nonzero((instances[0] == table["id"]) & (depth_m > 0))
    camera, z = truth["camera"], depth_m[rows, columns]
    x, y = (columns - camera["cx"]) * z / camera["fx"], (rows - camera["cy"]) * z / camera["fy"]
    T = pose_of(messages[POSE][0])
    world = np.stack([x, y, z], axis=1) @ T[:3, :3].T + T[:3, 3]
    low, high = np.array(table["aabb"])
    inside = np.all((world > low - 0.03) & (world < high + 0.03), axis=1)
    assert len(world) > 5000 and inside.mean() > 0.9
