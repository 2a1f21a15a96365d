"""The recording that the project ships holds what bags/README.md says it holds."""

from __future__ import annotations

import json
import lzma
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

BAGS = Path(__file__).resolve().parents[2] / "bags"
FRAMES = 171
TOPICS = {
    "/rgb/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/depth/image_raw/compressedDepth": "sensor_msgs/msg/CompressedImage",
    "/rgb/camera_info": "sensor_msgs/msg/CameraInfo",
    "/camera/pose": "geometry_msgs/msg/PoseStamped",
}
PREDICATES = {"on", "in", "near", "with", "under", "above", "against", "attached to"}


def stamp_ns(message) -> int:
    stamp = message.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


@pytest.fixture(scope="module")
def messages():
    by_topic = defaultdict(list)
    with AnyReader([BAGS / "demo_room"]) as reader:
        for connection, log_time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            assert connection.msgtype == TOPICS[connection.topic]
            assert log_time_ns == stamp_ns(message)
            by_topic[connection.topic].append(message)
    return by_topic


@pytest.fixture(scope="module")
def truth():
    return json.loads((BAGS / "demo_room.gt.json").read_text(encoding="utf-8"))


def decode_depth_m(message) -> np.ndarray:
    return cv2.imdecode(np.asarray(message.data[12:]), cv2.IMREAD_UNCHANGED) / 1000.0


def test_each_topic_has_one_message_per_frame_with_the_same_stamp(messages, truth):
    assert set(messages) == set(TOPICS)
    stamps = {topic: [stamp_ns(m) for m in column] for topic, column in messages.items()}
    reference = stamps["/rgb/image_raw/compressed"]
    assert len(reference) == FRAMES == truth["frames"]
    assert all(column == reference for column in stamps.values())
    assert set(np.diff(reference)) == {100_000_000}
    assert str(reference[0]) == truth["first_stamp_ns"]


def test_the_first_frame_decodes(messages):
    rgb = messages["/rgb/image_raw/compressed"][0]
    picture = cv2.imdecode(np.asarray(rgb.data), cv2.IMREAD_COLOR)
    assert picture.shape == (480, 640, 3) and 60 < picture.mean() < 200
    depth = messages["/depth/image_raw/compressedDepth"][0]
    assert depth.format == "16UC1; compressedDepth png"
    image = cv2.imdecode(np.asarray(depth.data[12:]), cv2.IMREAD_UNCHANGED)
    assert image.shape == (480, 640) and image.dtype == np.uint16
    assert rgb.header.frame_id == depth.header.frame_id


def test_depth_is_in_the_range_of_a_room_and_has_holes(messages):
    for message in messages["/depth/image_raw/compressedDepth"][::40]:
        depth_m = decode_depth_m(message)
        valid = depth_m > 0
        assert 0.5 < valid.mean() < 1.0
        assert depth_m[valid].min() >= 0.39 and depth_m.max() <= 4.7


def test_camera_info_agrees_with_the_ground_truth(messages, truth):
    camera = truth["camera"]
    for info in messages["/rgb/camera_info"]:
        assert (info.width, info.height) == (camera["width"], camera["height"])
        fx, _, cx, _, fy, cy, *_ = info.k
        assert (fx, fy, cx, cy) == tuple(camera[k] for k in ("fx", "fy", "cx", "cy"))


def test_the_camera_walks_stands_still_and_comes_back(messages, truth):
    positions, rotations = [], []
    for message in messages["/camera/pose"]:
        assert message.header.frame_id == "world"
        p, q = message.pose.position, message.pose.orientation
        positions.append((p.x, p.y, p.z))
        rotations.append((q.x, q.y, q.z, q.w))
    assert np.allclose(np.linalg.norm(rotations, axis=1), 1, atol=1e-9)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps.max() < 0.15 and steps.sum() > 4
    first, last = (int(10 * s) for s in truth["standstill_s"])
    assert last - first >= 15 and steps[first:last].max() < 0.01
    assert np.linalg.norm(np.subtract(positions[0], positions[-1])) < 0.05


def test_depth_and_pose_put_the_table_where_the_ground_truth_has_it(messages, truth):
    """Pixels of the table in frame 0, back-projected, lie in its box (within the noise)."""
    table = next(o for o in truth["objects"] if o["name"] == "dining table")
    labels = load_instances()
    depth_m = decode_depth_m(messages["/depth/image_raw/compressedDepth"][0])
    rows, columns = np.nonzero((labels[0] == table["id"]) & (depth_m > 0))
    camera = truth["camera"]
    z = depth_m[rows, columns]
    points = np.stack(
        [(columns - camera["cx"]) * z / camera["fx"], (rows - camera["cy"]) * z / camera["fy"], z],
        axis=1,
    )
    pose = messages["/camera/pose"][0].pose
    x, y, z, w = (getattr(pose.orientation, k) for k in "xyzw")
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    world = points @ rotation.T + [pose.position.x, pose.position.y, pose.position.z]
    low, high = np.array(table["aabb"])
    inside = np.all((world > low - 0.03) & (world < high + 0.03), axis=1)
    assert len(world) > 5000 and inside.mean() > 0.9


def load_instances() -> np.ndarray:
    with np.load(BAGS / "demo_room.instances.npz") as packed:
        raw = lzma.decompress(packed["lzma"].tobytes())
        return np.frombuffer(raw, np.uint8).reshape(packed["shape"])


def test_instances_cover_every_frame_and_name_known_objects(truth):
    labels = load_instances()
    assert labels.shape == (FRAMES, 480, 640)
    ids = {o["id"] for o in truth["objects"]}
    assert set(np.unique(labels[::17]).tolist()) <= ids | {0}


def test_the_ground_truth_graph_is_consistent(truth):
    objects = {o["id"]: o for o in truth["objects"]}
    assert len(objects) == len(truth["objects"])
    for item in objects.values():
        low, high = np.array(item["aabb"])
        assert np.all(low <= high)
        assert np.all(low - 1e-3 <= item["surface_centroid"])
        assert np.all(item["surface_centroid"] <= high + 1e-3)
        assert not item["detectable"] or item["class"]
    pairs = [(r["subject"], r["object"]) for r in truth["relations"]]
    assert len(set(pairs)) == len(pairs) >= 50
    assert {i for pair in pairs for i in pair} <= set(objects)
    assert {r["predicate"] for r in truth["relations"]} <= PREDICATES
    classes = {o["class"] for o in objects.values() if o["detectable"]}
    assert {"chair", "diningtable", "cup", "bowl", "bottle", "sofa", "tvmonitor"} <= classes


def test_the_recording_is_smaller_than_20_mb():
    size = sum(path.stat().st_size for path in (BAGS / "demo_room").iterdir())
    assert size < 20e6
