"""Poses, their interpolation, the gate against jumps, and the TF tree."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.streams import MS, T0, header, odometry, pose, tf, transform

from deworldsg_ros.scene.camera import invert_pose, pose_from_quaternion
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.poses import (
    MAX_FRAMES,
    JumpGate,
    PoseBuffer,
    PoseStream,
    TransformTree,
    pose_from_message,
    set_stamp,
    stamp_ns_of,
)

SLOP = 100 * MS


def at(x: float, y: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    """A pose at (x, y, 0), rotated about z."""
    quat = np.array([0, 0, math.sin(turn_rad / 2), math.cos(turn_rad / 2)])
    return pose_from_quaternion(np.array([x, y, 0.0]), quat)


def test_stamps_keep_every_nanosecond() -> None:
    from types import SimpleNamespace

    message = SimpleNamespace(header=header(0))
    set_stamp(message, T0)
    assert stamp_ns_of(message) == T0


def test_pose_and_odometry_are_the_same_pose() -> None:
    T_pose, frame = pose_from_message(pose(x=2.0))
    T_odometry, odometry_frame = pose_from_message(odometry(x=2.0))
    np.testing.assert_array_equal(T_pose, T_odometry)
    assert frame == odometry_frame == "map"


@pytest.mark.parametrize("changes", [{"x": math.nan}, {"x": math.inf}, {"w": 0.0}, {"w": math.nan}])
def test_a_bad_pose_is_refused(changes: dict) -> None:
    with pytest.raises(RefusedInput) as caught:
        pose_from_message(pose(**changes))
    assert caught.value.reason == "invalid_pose"


def test_interpolation_is_linear_in_position_and_spherical_in_rotation() -> None:
    buffer = PoseBuffer(SLOP)
    buffer.add(T0, at(0.0))
    buffer.add(T0 + 80 * MS, at(4.0, turn_rad=1.0))
    np.testing.assert_allclose(buffer.at(T0 + 20 * MS), at(1.0, turn_rad=0.25), atol=1e-12)
    np.testing.assert_array_equal(buffer.at(T0), at(0.0))


@pytest.mark.parametrize(
    ("offset_ms", "x"), [(-100, 0.0), (-1, 0.0), (0, 0.0), (100, 0.0), (401, 5.0), (600, 5.0)]
)
def test_with_one_neighbour_the_nearest_pose_is_used(offset_ms: int, x: float) -> None:
    buffer = PoseBuffer(SLOP)
    buffer.add(T0, at(0.0))
    buffer.add(T0 + 500 * MS, at(5.0))
    assert buffer.at(T0 + offset_ms * MS)[0, 3] == x


@pytest.mark.parametrize("offset_ms", [-101, 101, 250, 399, 601])
def test_beyond_the_slop_there_is_no_pose(offset_ms: int) -> None:
    buffer = PoseBuffer(SLOP)
    buffer.add(T0, at(0.0))
    buffer.add(T0 + 500 * MS, at(5.0))
    with pytest.raises(RefusedInput, match="expected one within 0.1 s") as caught:
        buffer.at(T0 + offset_ms * MS)
    assert caught.value.reason == "no_pose"


def test_an_empty_buffer_has_no_pose() -> None:
    with pytest.raises(RefusedInput, match="there is no pose"):
        PoseBuffer(SLOP).at(T0)


@given(st.permutations(range(8)))
def test_poses_may_arrive_in_any_order(order: list[int]) -> None:
    buffer = PoseBuffer(SLOP)
    for step in order:
        buffer.add(T0 + step * 10 * MS, at(float(step)))
    assert buffer.at(T0 + 35 * MS)[0, 3] == pytest.approx(3.5)


def test_a_buffer_is_bounded() -> None:
    buffer = PoseBuffer(SLOP, capacity=10)
    for step in range(100):
        buffer.add(T0 + step * MS, at(float(step)))
    assert len(buffer) <= 20
    assert buffer.at(T0 + 99 * MS)[0, 3] == 99.0


def test_forget_before_keeps_the_poses_that_are_needed() -> None:
    buffer = PoseBuffer(SLOP)
    for step in range(1000):
        buffer.add(T0 + step * MS, at(float(step)))
    buffer.forget_before(T0 + 900 * MS)
    assert len(buffer) < 250
    assert buffer.at(T0 + 800 * MS)[0, 3] == 800.0


def test_a_pose_in_another_frame_is_refused() -> None:
    expected = PoseStream(SLOP, "odom")
    with pytest.raises(RefusedInput, match="pose is in frame 'map', expected 'odom'") as caught:
        expected.add(pose(), T0)
    assert caught.value.reason == "wrong_frame"
    first = PoseStream(SLOP)
    first.add(pose(), T0)
    with pytest.raises(RefusedInput, match="expected 'map'"):
        first.add(pose(frame_id="odom"), T0 + MS)


def reasons(
    xs: list[float], turns_deg: list[float] | None = None, step_ns: int = 100 * MS
) -> list[str]:
    """Reason why a new gate refuses each pose; empty for an accepted pose."""
    gate = JumpGate()
    result = []
    for place, (x, turn_deg) in enumerate(zip(xs, turns_deg or [0.0] * len(xs))):
        try:
            gate.check(at(x, turn_rad=math.radians(turn_deg)), T0 + place * step_ns)
            result.append("")
        except RefusedInput as refusal:
            result.append(refusal.reason)
    return result


def test_a_single_outlier_pose_is_refused_and_the_next_pose_is_accepted() -> None:
    assert reasons([0.0, 0.9, 7.0, 1.0]) == ["", "", "pose_jump", ""]


def test_a_new_position_is_accepted_after_five_consistent_frames() -> None:
    seen = reasons([0.0, 7.0, 7.1, 7.2, 7.3, 7.4, 7.5])
    assert seen == ["", *["pose_jump"] * 4, "", ""]


def test_poses_that_keep_jumping_are_never_accepted() -> None:
    seen = reasons([0.0, *(7.0 * step for step in range(1, 20))])
    assert seen == ["", *["pose_jump"] * 19]


@pytest.mark.parametrize(
    ("turns_deg", "step_ms", "expected"),
    [
        ([0, 30, 60, 90], 100, ["", "", "", ""]),  # as fast as a hand rotates
        ([0, 60, 10, 20], 100, ["", "pose_jump", "", ""]),
        ([0, *[60] * 5], 33, ["", *["pose_jump"] * 4, ""]),  # consistent: relocalised
        ([0, 60, 120], 500, ["", "", ""]),  # the frames are seconds apart
        ([0, 5, -5, 5], 1, ["", "", "", ""]),  # noise of a fast tracker
    ],
)
def test_a_camera_that_rotates_too_fast_has_jumped(
    turns_deg: list[float], step_ms: int, expected: list[str]
) -> None:
    assert reasons([0.0] * len(turns_deg), turns_deg, step_ms * MS) == expected


def test_tf_chains_static_and_moving_transforms() -> None:
    tree = TransformTree(SLOP, "map")
    base_camera, map_odom = at(0.1, 0.2, 0.3), at(10.0, turn_rad=math.pi / 2)
    tree.add(tf(transform("base", "camera", base_camera)), static=True)
    assert not tree.settled(T0, "camera")
    for step in range(3):
        stamp_ns = T0 + 50 * MS * step
        tree.add(tf(transform("odom", "base", at(float(step)), stamp_ns)), static=False)
        tree.add(tf(transform("map", "odom", map_odom, stamp_ns)), static=False)
    assert tree.settled(T0 + 100 * MS, "camera")
    assert not tree.settled(T0 + 101 * MS, "camera")
    T, frame = tree.at(T0 + 75 * MS, "/camera")
    np.testing.assert_allclose(T, map_odom @ at(1.5) @ base_camera, atol=1e-12)
    assert frame == "map"


def test_tf_reaches_a_world_frame_below_the_root() -> None:
    tree = TransformTree(SLOP, "world")
    tree.add(tf(transform("root", "world", at(5.0))), static=True)
    tree.add(tf(transform("root", "camera", at(7.0), T0)), static=False)
    np.testing.assert_allclose(tree.at(T0, "camera")[0], invert_pose(at(5.0)) @ at(7.0))


def test_without_a_name_the_world_is_the_root_and_stays() -> None:
    tree = TransformTree(SLOP)
    tree.add(tf(transform("base", "camera", at(0.1))), static=True)
    assert not tree.settled(T0, "camera")
    tree.add(tf(transform("odom", "base", at(1.0), T0)), static=False)
    assert tree.settled(T0, "camera")
    assert tree.at(T0, "camera")[1] == "odom"
    tree.add(tf(transform("map", "odom", at(1.0), T0)), static=False)
    assert tree.at(T0, "camera")[1] == "odom"


def test_the_mounting_of_the_camera_is_no_world_frame() -> None:
    tree = TransformTree(SLOP)
    tree.add(tf(transform("camera_link", "camera", at(0.1))), static=True)
    with pytest.raises(RefusedInput, match="fixed to 'camera_link', which does not move"):
        tree.at(T0, "camera")
    named = TransformTree(SLOP, "camera_link")  # a camera on a wall
    named.add(tf(transform("camera_link", "camera", at(0.1))), static=True)
    np.testing.assert_allclose(named.at(T0, "camera")[0], at(0.1))


def test_a_refusal_of_tf_lists_the_known_frames() -> None:
    tree = TransformTree(SLOP, "map")
    tree.add(tf(transform("odom", "base", at(1.0))), static=False)
    with pytest.raises(RefusedInput, match="'camera' with 'map': known frames are base, odom"):
        tree.at(T0, "camera")


def test_a_transform_of_the_future_is_lost_and_the_others_are_used() -> None:
    tree = TransformTree(SLOP, "map")
    hour_ns = 3600 * 10**9
    for stamp_ns in (T0, T0 + hour_ns):
        tree.add(tf(transform("map", "camera", np.eye(4), stamp_ns)), static=False)
    with pytest.raises(RefusedInput) as refused:
        tree.add(tf(transform("map", "camera", at(2.0), T0 + 50 * MS)), static=False)
    assert refused.value.reason == "time_jump"
    assert tree.newest_ns == T0 + 50 * MS
    assert not tree.settled(T0 + 100 * MS, "camera")
    assert tree.at(T0 + 25 * MS, "camera")[0][0, 3] == pytest.approx(1.0)


@pytest.mark.parametrize("x", [1e300, 1e4 + 1, math.inf, -1e9])
def test_a_pose_far_from_the_origin_is_refused(x: float) -> None:
    with pytest.raises(RefusedInput) as refused:
        pose_from_message(pose(x=x))
    assert refused.value.reason == "invalid_pose"


def test_a_frame_id_with_control_characters_is_refused() -> None:
    with pytest.raises(RefusedInput) as refused:
        pose_from_message(pose(frame_id="map\x1b[31m"))
    assert refused.value.reason == "invalid_frame_id"


def test_a_loop_in_tf_ends() -> None:
    tree = TransformTree(SLOP, "map")
    tree.add(tf(transform("a", "b", at(1.0)), transform("b", "a", at(1.0))), static=True)
    with pytest.raises(RefusedInput):
        tree.at(T0, "a")


SECOND = 10**9


def moving(tree: TransformTree, stamp_ns: int, *pairs: str) -> None:
    """Add transforms, named "parent child"."""
    tree.add(tf(*(transform(*pair.split(), at(1.0), stamp_ns) for pair in pairs)), static=False)


def test_silent_frames_are_dropped() -> None:
    """Static ones stay, and those between the camera and the world."""
    tree = TransformTree(SLOP, "map")
    tree.add(
        tf(transform("base", "camera", at(0.1)), transform("base", "lidar", at(0.2))), static=True
    )
    moving(tree, T0, "map odom", "odom base", *(f"map person_{i}" for i in range(300)))
    assert tree.settled(T0, "camera")
    for seconds in (0, 50, 100, 101, 150):
        moving(tree, T0 + seconds * SECOND, "odom base")
        tree.forget_before(T0 + seconds * SECOND)
        assert len(tree) == (304 if seconds <= 100 else 4)
    now_ns = T0 + 150 * SECOND
    with pytest.raises(RefusedInput, match="the nearest pose is 150.000 s away"):
        tree.at(now_ns, "camera")
    for stamp_ns in (now_ns, now_ns + MS):  # the gate waits for the second one
        moving(tree, stamp_ns, "map odom", "map person_7")
    assert tree.at(now_ns, "camera")[1] == "map"
    np.testing.assert_allclose(tree.between(now_ns, "map", "person_7"), at(1.0))


def test_frames_that_end_before_a_restart_are_forgotten() -> None:
    tree = TransformTree(SLOP, "map")
    for run in range(5):
        moving(
            tree, T0 + run * SECOND, "map camera", *(f"map person_{run}_{i}" for i in range(900))
        )
        assert tree.settled(T0, "camera")
        tree.restart()
        assert len(tree) == 0


def test_the_number_of_frames_is_bounded() -> None:
    tree = TransformTree(SLOP, "map")
    moving(tree, T0, "map base")
    for place in range(2 * MAX_FRAMES):
        with contextlib.suppress(RefusedInput):
            tree.add(tf(transform("map", f"person_{place}", at(1.0))), static=place % 2 == 0)
    assert len(tree) == MAX_FRAMES
    with pytest.raises(RefusedInput, match="TF has 1000 frames") as refused:
        moving(tree, T0 + 10 * MS, "base camera", "map base")
    assert refused.value.reason == "too_many_frames"
    assert tree.settled(T0 + 10 * MS, "base")  # those that are known go on
    assert not tree.settled(T0, "camera")


def test_objects_of_the_graph_are_no_frames_of_the_camera() -> None:
    tree = TransformTree(SLOP, "map")
    moving(tree, T0, "map object_1", "map robot1/object_22", "map object_x", "map my_object_3")
    assert len(tree) == 2
    tree.add(tf(transform("object_1", "camera", at(0.1))), static=True)
    moving(tree, T0, "map object_1", "map object_2")  # a tracker that names bodies so
    assert len(tree) == 4
    assert tree.at(T0, "camera")[0][0, 3] == pytest.approx(1.1)
