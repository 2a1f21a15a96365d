"""odometry_node: poses from images, lost frames, the transform on /tf."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, Image
from support.corner_room import INTRINSICS, LEVEL, corner_frame, walk
from support.nodes_bench import Bench, bench, camera_info, image, works
from support.streams import tf, transform

from deworldsg_ros.nodes.odometry_node import OdometryNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.ros.transforms import camera_transform
from deworldsg_ros.scene.camera import invert_pose, rigid_motion
from deworldsg_ros.streams.poses import (
    TransformTree,
    pose_from_message,
    pose_from_transform,
    stamp_ns_of,
)

STAMP_NS = 1_700_000_000_123_456_789
TOPICS = {"rgb/image_raw": Image, "depth/image_raw": Image, "rgb/camera_info": CameraInfo}


@pytest.fixture()
def odometry() -> Iterator[Bench]:
    yield from bench(OdometryNode, TOPICS)


def info(stamp_ns: int) -> CameraInfo:
    message = camera_info(stamp_ns)
    message.width, message.height = INTRINSICS.width, INTRINSICS.height
    message.k = INTRINSICS.matrix.ravel().tolist()
    return message


def send(
    at: Bench, T: np.ndarray, *, blind: bool = False, half: bool = False, wrong_ns: int = 0
) -> None:
    stamp_ns = at.next_stamp() + wrong_ns
    frame = corner_frame(T)
    depth_m = np.zeros_like(frame.depth_m) if blind else frame.depth_m
    at.send(
        rgb__camera_info=info(stamp_ns),
        depth__image_raw=image(depth_m[: 60 if half else None], "32FC1", stamp_ns),
        rgb__image_raw=image(frame.rgb, "rgb8", stamp_ns),
    )


def collect(at: Bench, kind: type, topic: str) -> list[Any]:
    messages: list[Any] = []
    at.peer.node.create_subscription(kind, topic, messages.append, reliable(100))
    at.peer.spin_until(
        lambda: at.peer.node.count_publishers(topic) > 0, 10.0, f"a publisher of {topic}"
    )
    at.peer.spin_for(0.5)
    return messages


def test_poses_follow_the_camera(odometry: Bench) -> None:
    poses = collect(odometry, PoseStamped, "camera/pose")
    odometries = collect(odometry, Odometry, "camera/odometry")
    path, stamps_ns = walk(6), []
    for T in path:
        works(odometry, lambda T=T: send(odometry, T))
        stamps_ns.append(odometry.stamp_ns)
    odometry.expect(lambda: len(poses) == len(odometries) == 6, "poses")
    assert [stamp_ns_of(message) for message in poses] == stamps_ns
    for T, message, other in zip(path, poses, odometries):
        estimate, frame_id = pose_from_message(message)
        assert frame_id == "odom"
        expected = LEVEL @ invert_pose(path[0]) @ T
        assert np.linalg.norm(estimate[:3, 3] - expected[:3, 3]) < 0.02
        assert other.child_frame_id == "camera"
        np.testing.assert_array_equal(pose_from_message(other)[0], estimate)
    assert odometry.node.more_values()["odometry tracked"] == "6"
    assert odometry.node.waiting_for(0) == []


def test_a_lost_frame_has_no_pose_and_is_counted(odometry: Bench) -> None:
    poses = collect(odometry, PoseStamped, "camera/pose")
    path = walk(4)
    works(odometry, lambda: send(odometry, path[0]))
    odometry.refuses("odometry_lost", lambda: send(odometry, path[1], blind=True))
    odometry.refuses("grid_mismatch", lambda: send(odometry, path[1], half=True))
    works(odometry, lambda: send(odometry, path[2]))
    odometry.expect(lambda: len(poses) == 2, "two poses")
    assert odometry.node.more_values()["odometry lost"] == "1"


def test_a_restarted_recording_restarts_the_odometry(odometry: Bench) -> None:
    path = walk(3)
    for T in path:
        works(odometry, lambda T=T: send(odometry, T))
    poses = collect(odometry, PoseStamped, "camera/pose")
    odometry.stamp_ns -= 100 * 10**9
    odometry.refuses("time_jump", lambda: [send(odometry, T) for T in path[1:]])
    odometry.expect(lambda: len(poses) == 2, "two poses")
    np.testing.assert_allclose(pose_from_message(poses[0])[0], LEVEL, atol=1e-12)


@pytest.mark.parametrize("wrong_s", [5, -5, 50, 3600])
def test_one_wrong_stamp_costs_one_frame_of_odometry(odometry: Bench, wrong_s: int) -> None:
    poses = collect(odometry, PoseStamped, "camera/pose")
    path = walk(6)
    for place, T in enumerate(path):
        if place == 3:
            send(odometry, T, wrong_ns=wrong_s * 10**9)
        else:
            works(odometry, lambda T=T: send(odometry, T))
    odometry.expect(lambda: len(poses) == 5, "five poses")
    estimate, _ = pose_from_message(poses[-1])
    expected = LEVEL @ invert_pose(path[0]) @ path[-1]
    assert np.linalg.norm(estimate[:3, 3] - expected[:3, 3]) < 0.02
    assert odometry.node.health.drops["time_jump"] == 2  # RGB and depth
    assert odometry.node.more_values()["odometry tracked"] == "5"


def at(x: float = 0.0, y: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    return rigid_motion(np.array([x, y, 0.0]), np.array([0.0, 0.0, turn_rad]))


def test_the_root_of_the_mounting_is_published_on_tf() -> None:
    """A frame has one parent in TF, and the optical frame has one already."""
    tree = TransformTree(0)
    T_world_camera = at(1.0, 2.0, 0.5)
    alone = camera_transform(tree, STAMP_NS, "odom", "optical", T_world_camera)
    assert (alone.header.frame_id, alone.child_frame_id) == ("odom", "optical")
    np.testing.assert_allclose(pose_from_transform(alone.transform), T_world_camera, atol=1e-12)
    link_color, color_optical = at(0.0, 0.015), at(turn_rad=1.5)
    tree.add(tf(transform("camera_link", "color", link_color)), static=True)
    tree.add(tf(transform("color", "optical", color_optical)), static=True)
    mounted = camera_transform(tree, STAMP_NS, "odom", "optical", T_world_camera)
    assert (mounted.child_frame_id, stamp_ns_of(mounted)) == ("camera_link", STAMP_NS)
    T_world_link = pose_from_transform(mounted.transform)
    np.testing.assert_allclose(
        T_world_link @ link_color @ color_optical, T_world_camera, atol=1e-12
    )
