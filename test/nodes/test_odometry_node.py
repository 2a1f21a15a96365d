"""odometry_node: poses from images, lost frames, the transform on /tf."""

from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from sensor_msgs.msg import CameraInfo, Image
from support.corner_room import INTRINSICS, LEVEL, corner_frame, walk
from support.nodes_bench import Bench, camera_info, changed, image, works
from support.recordings import tf
from support.streams import at as pose_at

from deworldsg_ros.nodes.odometry_node import OdometryNode
from deworldsg_ros.ros.transforms import camera_transform
from deworldsg_ros.scene.camera import Trajectory, invert_pose
from deworldsg_ros.streams.poses import (
    TransformTree,
    pose_from_message,
    pose_from_transform,
    stamp_ns_of,
    trajectory_from_message,
)

TOPICS = {"rgb/image_raw": Image, "depth/image_raw": Image, "rgb/camera_info": CameraInfo}
INFO = changed(
    camera_info,
    width=INTRINSICS.width,
    height=INTRINSICS.height,
    k=INTRINSICS.matrix.ravel().tolist(),
)


@pytest.fixture
def odometry():
    with Bench(OdometryNode, TOPICS) as made:
        yield made


def send(at: Bench, T: np.ndarray, change=lambda depth_m: depth_m, wrong_ns: int = 0) -> None:
    """Send the frame of a pose, with another depth or with wrong stamps."""
    frame = corner_frame(T)
    stamp_ns = at.next_stamp() + wrong_ns
    at.send(
        rgb__camera_info=INFO(stamp_ns),
        depth__image_raw=image(change(frame.depth_m), "32FC1", stamp_ns),
        rgb__image_raw=image(frame.rgb, "rgb8", stamp_ns),
    )


def tracked(at: Bench, *path: np.ndarray) -> None:
    for T in path:
        works(at, lambda T=T: send(at, T))


def collect(at: Bench, kind: type = PoseStamped, topic: str = "camera/pose") -> list[Any]:
    messages = at.peer.listen(kind, topic)
    at.expect(lambda: at.peer.node.count_publishers(topic) > 0, f"a publisher of {topic}")
    at.peer.spin_for(0.5)
    return messages


def assert_at(message: Any, path: list[np.ndarray], place: int) -> None:
    """The pose of a place on a path that began level."""
    estimate, frame_id = pose_from_message(message)
    expected = LEVEL @ invert_pose(path[0]) @ path[place]
    assert np.linalg.norm(estimate[:3, 3] - expected[:3, 3]) < 0.02
    assert frame_id == "odom"


def test_poses_follow_the_camera(odometry):
    poses, odometries = collect(odometry), collect(odometry, Odometry, "camera/odometry")
    path, stamps_ns = walk(6), []
    for T in path:
        tracked(odometry, T)
        stamps_ns.append(odometry.stamp_ns)
    odometry.expect(lambda: len(poses) == len(odometries) == 6, "poses")
    assert [stamp_ns_of(message) for message in poses] == stamps_ns
    for place, (message, other) in enumerate(zip(poses, odometries)):
        assert_at(message, path, place)
        assert other.child_frame_id == "camera"
        assert other.pose.pose == message.pose
    assert odometry.node.more_values()["odometry tracked"] == "6"
    assert odometry.node.waiting_for(0) == []


def test_a_closed_loop_is_published_as_the_trajectory_that_graphs_follow(odometry, monkeypatch):
    paths, poses = collect(odometry, Path, "deworldsg/trajectory"), collect(odometry)
    assert "open" in odometry.node.more_values()["odometry loops"]
    stamps_ns, corrected = np.array([10, 20]), np.array([LEVEL, pose_at(1.0, 2.0) @ LEVEL])
    closing = Trajectory(stamps_ns, corrected, np.array([np.eye(4), pose_at(0.5)]))
    loops = odometry.node._odometry
    monkeypatch.setattr(loops, "track", lambda *frame: (corrected[1], closing))
    loops.closed, loops.correction_m = 2, 0.5
    tracked(odometry, LEVEL)
    odometry.expect(lambda: len(paths) == len(poses) == 1, "a trajectory and a pose")
    got_ns, got, frame_id = trajectory_from_message(paths[0])
    np.testing.assert_array_equal(got_ns, stamps_ns)
    np.testing.assert_allclose(got, corrected, atol=1e-12)
    assert frame_id == "odom"
    values = odometry.node.more_values()
    assert values["odometry loops"] == "loop closed 2 times, last correction 50.0 cm"


def test_a_lost_frame_has_no_pose_and_is_counted(odometry):
    poses, path = collect(odometry), walk(4)
    tracked(odometry, path[0])
    odometry.refuses("odometry_lost", lambda: send(odometry, path[1], np.zeros_like))
    odometry.refuses("grid_mismatch", lambda: send(odometry, path[1], lambda depth_m: depth_m[:60]))
    tracked(odometry, path[2])
    odometry.expect(lambda: len(poses) == 2, "two poses")
    assert odometry.node.more_values()["odometry lost"] == "1"


@pytest.mark.parametrize("wrong_s", [5, -5, 3600])
def test_one_wrong_stamp_costs_a_frame_and_a_restarted_recording_restarts(odometry, wrong_s):
    poses, path = collect(odometry), walk(6)
    tracked(odometry, *path[:3])
    send(odometry, path[3], wrong_ns=wrong_s * 10**9)
    tracked(odometry, *path[4:])
    odometry.expect(lambda: len(poses) == 5, "five poses")
    assert_at(poses[-1], path, -1)
    assert odometry.node.health.drops["time_jump"] == 2  # RGB and depth
    assert odometry.node.more_values()["odometry tracked"] == "5"
    odometry.stamp_ns -= 100 * 10**9
    odometry.refuses("time_jump", lambda: [send(odometry, T) for T in path[:5]])
    odometry.expect(lambda: len(poses) == 9, "four more poses")
    np.testing.assert_allclose(pose_from_message(poses[5])[0], LEVEL, atol=1e-12)


@pytest.mark.parametrize("wrong_s", [5, -5, 3600])
@pytest.mark.parametrize("count", [2, 3])
def test_some_wrong_stamps_in_a_row_do_not_begin_odometry_anew(odometry, wrong_s, count):
    poses, path = collect(odometry), walk(8)
    tracked(odometry, *path[:3])
    for T in path[3 : 3 + count]:
        send(odometry, T, wrong_ns=wrong_s * 10**9)
    tracked(odometry, *path[3 + count :])
    odometry.expect(lambda: len(poses) == 8 - count, "the poses")
    assert_at(poses[-1], path, -1)
    assert odometry.node.more_values()["odometry tracked"] == str(8 - count)


def test_the_root_of_the_mounting_is_published_on_tf():
    """A frame has one parent in TF, and the optical frame has one already."""
    tree, stamp_ns, T = TransformTree(0), 1_700_000_000_123_456_789, pose_at(1.0, 2.0, 0.5)
    alone = camera_transform(tree, stamp_ns, "odom", "optical", T)
    assert (alone.header.frame_id, alone.child_frame_id) == ("odom", "optical")
    np.testing.assert_allclose(pose_from_transform(alone.transform), T, atol=1e-12)
    link_color, color_optical = pose_at(0.0, 0.015), pose_at(turn_rad=1.5)
    mounting = (("camera_link", "color", link_color), ("color", "optical", color_optical))
    tree.add(tf(0, *mounting), static=True)
    mounted = camera_transform(tree, stamp_ns, "odom", "optical", T)
    assert (mounted.child_frame_id, stamp_ns_of(mounted)) == ("camera_link", stamp_ns)
    T_world_link = pose_from_transform(mounted.transform)
    np.testing.assert_allclose(T_world_link @ link_color @ color_optical, T, atol=1e-12)
