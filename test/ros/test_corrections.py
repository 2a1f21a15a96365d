"""What nodes hear of a SLAM system: jumps of its transform below the world frame."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import TransformStamped

from deworldsg_ros.graph.provenance import Trail
from deworldsg_ros.ros import transforms
from deworldsg_ros.scene.camera import invert_pose, rigid_motion
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.poses import set_stamp

S = 10**9


@pytest.fixture
def heard(monkeypatch):
    """Corrections of a node with tf2_msgs, and the ones that it takes."""
    monkeypatch.setattr(transforms, "TFMessage", TransformStamped)
    node, taken = MagicMock(), []
    node.parameters.merging.association = "surface"
    node.guarded = lambda callback: callback
    node.count_publishers.return_value = 0
    transforms.Corrections(node, lambda: "map", taken.append)
    subscribed = {call.args[1]: call.args[2] for call in node.create_subscription.call_args_list}
    return SimpleNamespace(node=node, taken=taken, tf=subscribed["/tf"])


def tf(parent: str, child: str, stamp_ns: int, x: float = 0.0) -> SimpleNamespace:
    transform = TransformStamped(child_frame_id=child)
    transform.header.frame_id = parent
    set_stamp(transform, stamp_ns)
    transform.transform.translation.x, transform.transform.rotation.w = x, 1.0
    return SimpleNamespace(transforms=[transform])


def walked(T_graph_world: np.ndarray | None = None) -> Trail:
    """A camera that goes 8 m and comes back."""
    trail = Trail()
    if T_graph_world is None:
        T_graph_world = np.eye(4)
    trail.place(T_graph_world)
    for number in range(160):
        T = np.eye(4)
        T[0, 3] = 0.1 * min(number, 160 - number)
        trail.note(number * S // 10 + S, T_graph_world @ T, T_graph_world @ T)
    return trail


def test_a_jump_of_map_to_odom_is_a_closed_loop(heard) -> None:
    heard.tf(tf("odom", "base_link", S))
    for second in (15, 16, 17):
        heard.tf(tf("map", "odom", second * S, 0.25))
    assert heard.taken == []
    heard.tf(tf("map", "odom", 18 * S, -0.25))
    (correct,) = heard.taken
    change = correct(walked())
    assert change is not None
    moved = change.T_new_old[:, 0, 3]
    assert moved[-1] == pytest.approx(-0.5, abs=0.02) and abs(moved[1:3]).max() < 0.02
    assert (np.diff(moved[1:]) <= 1e-9).all()


def test_a_jump_moves_a_map_in_its_own_frame() -> None:
    T_map_world = rigid_motion(np.array([3.0, 1.0, 0.0]), np.array([0.0, 0.0, np.pi / 2]))
    jump = rigid_motion(np.array([-0.5, 0.0, 0.0]), np.zeros(3))
    plain, placed = (trail.jump(jump, 18 * S) for trail in (walked(), walked(T_map_world)))
    assert plain is not None and placed is not None
    there = T_map_world @ plain.T_new_old @ invert_pose(T_map_world)
    assert abs(plain.T_new_old[-1, 0, 3] + 0.5) < 0.02
    np.testing.assert_allclose(placed.T_new_old, there, atol=1e-9)


def test_a_robot_that_moves_is_no_loop_nor_one_whose_slam_says_more(heard) -> None:
    # Nothing moves below base_link: it is the robot.
    heard.tf(tf("map", "base_link", 1 * S, 0.0))
    heard.tf(tf("map", "base_link", 2 * S, 1.0))
    # Another world, and a transform that stays.
    heard.tf(tf("odom", "base_link", 1 * S))
    heard.tf(tf("earth", "odom", 1 * S, 0.0))
    heard.tf(tf("earth", "odom", 2 * S, 5.0))
    heard.tf(tf("map", "odom", 1 * S, 0.0))
    heard.tf(tf("map", "odom", 2 * S, 0.0))
    heard.node.count_publishers.return_value = 1
    heard.tf(tf("map", "odom", 3 * S, 1.0))
    assert heard.taken == []
    with pytest.raises(RefusedInput, match="quaternion"):
        heard.tf(tf("map", "odom", 4 * S, float("nan")))


def test_the_paper_takes_poses_as_they_are(monkeypatch) -> None:
    monkeypatch.setattr(transforms, "TFMessage", TransformStamped)
    node = MagicMock()
    node.parameters.merging.association = "paper"
    transforms.Corrections(node, lambda: "map", lambda correct: None)
    topics = [call.args[1] for call in node.create_subscription.call_args_list]
    assert topics == [transforms.CORRECTION_TOPIC]
