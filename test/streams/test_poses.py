"""Poses, their interpolation, the gate against jumps, and the TF tree."""

import contextlib
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings import tf
from support.streams import MS, T0, at

from deworldsg_ros.scene.camera import Intrinsics, invert_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.poses import (
    MAX_FRAMES,
    GraphTrajectory,
    JumpGate,
    PoseBuffer,
    TransformTree,
)

SLOP = 100 * MS
SECOND = 10**9


@contextlib.contextmanager
def refused(reason: str, offender: str | None = None):
    with pytest.raises(RefusedInput, match=offender) as caught:
        yield
    assert caught.value.reason == reason


def buffer_of(*poses: tuple[int, np.ndarray]) -> PoseBuffer:
    """Poses at milliseconds after T0."""
    buffer = PoseBuffer(SLOP)
    for offset_ms, T in poses:
        buffer.add(T0 + offset_ms * MS, T)
    return buffer


def test_interpolation_is_linear_in_position_and_spherical_in_rotation():
    buffer = buffer_of((0, at(0.0)), (80, at(4.0, turn_rad=1.0)))
    np.testing.assert_allclose(buffer.at(T0 + 20 * MS), at(1.0, turn_rad=0.25), atol=1e-12)
    np.testing.assert_array_equal(buffer.at(T0), at(0.0))


@pytest.mark.parametrize(
    ("offset_ms", "x"),
    [
        *[(offset_ms, 0.0) for offset_ms in (-100, -1, 0, 100)],
        *[(offset_ms, 5.0) for offset_ms in (401, 600)],
        *[(offset_ms, None) for offset_ms in (-101, 101, 250, 399, 601)],
    ],
)
def test_with_one_neighbour_the_nearest_pose_within_the_slop_is_used(offset_ms, x):
    buffer = buffer_of((0, at(0.0)), (500, at(5.0)))
    if x is None:
        with refused("no_pose", "0.1 s"):
            buffer.at(T0 + offset_ms * MS)
    else:
        assert buffer.at(T0 + offset_ms * MS)[0, 3] == x


@given(st.permutations(range(8)))
def test_poses_may_arrive_in_any_order(order):
    buffer = buffer_of(*((10 * step, at(float(step))) for step in order))
    assert buffer.at(T0 + 35 * MS)[0, 3] == pytest.approx(3.5)


def test_a_buffer_is_bounded_and_keeps_what_is_needed():
    with refused("no_pose"):
        PoseBuffer(SLOP).at(T0)
    small, whole = PoseBuffer(SLOP, capacity=10), PoseBuffer(SLOP)
    for buffer in (small, whole):
        for step in range(1000):
            buffer.add(T0 + step * MS, at(float(step)))
    assert len(small) <= 20
    assert small.at(T0 + 999 * MS)[0, 3] == 999.0
    whole.forget_before(T0 + 900 * MS)
    assert len(whole) < 250
    assert whole.at(T0 + 800 * MS)[0, 3] == 800.0


OK, JUMP = "", "pose_jump"


@pytest.mark.parametrize(
    ("xs", "turns_deg", "step_ms", "expected"),
    [
        ([0, 0.9, 7, 1], 0, 100, [OK, OK, JUMP, OK]),  # one outlier
        # Five consistent frames are a new position.
        ([0, 7, 7.1, 7.2, 7.3, 7.4, 7.5], 0, 100, [OK, *[JUMP] * 4, OK, OK]),
        ([7 * step for step in range(20)], 0, 100, [OK, *[JUMP] * 19]),
        (0, [0, 30, 60, 90], 100, [OK, OK, OK, OK]),  # as fast as a hand rotates
        (0, [0, 60, 10, 20], 100, [OK, JUMP, OK, OK]),
        (0, [0, *[60] * 5], 33, [OK, *[JUMP] * 4, OK]),
        (0, [0, 60, 120], 500, [OK, OK, OK]),  # the frames are seconds apart
        (0, [0, 5, -5, 5], 1, [OK, OK, OK, OK]),  # noise of a fast tracker
    ],
)
def test_jumps_are_refused_until_they_are_a_new_place(xs, turns_deg, step_ms, expected):
    gate, seen = JumpGate(), []
    for place, (x, turn_deg) in enumerate(zip(*np.broadcast_arrays(xs, turns_deg))):
        try:
            gate.check(at(x, turn_rad=math.radians(turn_deg)), T0 + place * step_ms * MS)
            seen.append(OK)
        except RefusedInput as refusal:
            seen.append(refusal.reason)
    assert seen == expected


CAMERA = Intrinsics(200.0, 200.0, 159.5, 119.5, 320, 240)


def view_of_a_room(T_world_camera):
    """Depth of the walls of a room of 6 x 4 x 3 m, seen from inside, with a box in its middle."""
    v, u = np.mgrid[:240, :320]
    rays = np.stack([(u - 159.5) / 200, (v - 119.5) / 200, np.ones(u.shape)], axis=-1)
    directions = rays @ T_world_camera[:3, :3].T + 1e-9
    eye, half = T_world_camera[:3, 3], np.array([3.0, 2.0, 1.5])
    walls = np.maximum((-half - eye) / directions, (half - eye) / directions).min(axis=-1)
    sides = np.stack([(-half / 5 - eye) / directions, (half / 5 - eye) / directions])
    near, far = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    depth = np.where((near < far) & (near > 0), near, walls).astype(np.float32)
    return lambda: depth, CAMERA


@pytest.mark.parametrize(("sparse", "alone"), [(False, JUMP), (True, OK)])
def test_a_wide_step_is_no_jump_if_the_depth_agrees(sparse, alone):
    def step(pose, true_pose, with_depth=True):
        gate = JumpGate(sparse)
        gate.check(start, T0, view_of_a_room(start))
        try:
            gate.check(pose, T0 + 33 * MS, view_of_a_room(true_pose) if with_depth else None)
        except RefusedInput as refusal:
            return refusal.reason
        return OK

    def eye(x, y=0.0, turn_rad=0.0):
        forward = np.eye(4)
        forward[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        return at(x, y, turn_rad) @ forward

    start = eye(-2.5)
    wide, turned = eye(-1.2), eye(-2.5, turn_rad=0.5)
    assert step(wide, wide) == step(turned, turned) == OK
    # The pose says that the camera moved, and its image that it did not; or the reverse.
    assert step(eye(-1.2), start) == JUMP
    assert step(eye(-2.5, turn_rad=0.6), eye(-2.5, turn_rad=-0.4)) == JUMP
    assert step(wide, wide, with_depth=False) == JUMP
    # The images have nothing in common.
    behind = eye(-2.5, turn_rad=math.pi)
    assert step(behind, behind) == alone


def add(tree: TransformTree, stamp_ns: int, pairs: str, T: np.ndarray | None = None, static=False):
    """Add transforms, named "parent child, parent child"."""
    T = at(1.0) if T is None else T
    named = (pair.split() for pair in pairs.split(","))
    tree.add(tf(stamp_ns, *((*names, T) for names in named)), static=static)


def test_tf_chains_static_and_moving_transforms():
    tree = TransformTree(SLOP, "map")
    base_camera, map_odom = at(0.1, 0.2, 0.3), at(10.0, turn_rad=math.pi / 2)
    add(tree, T0, "base camera", base_camera, static=True)
    assert not tree.settled(T0, "camera")
    for step in range(3):
        add(tree, T0 + 50 * MS * step, "odom base", at(float(step)))
        add(tree, T0 + 50 * MS * step, "map odom", map_odom)
    assert tree.settled(T0 + 100 * MS, "camera")
    assert not tree.settled(T0 + 101 * MS, "camera")
    T, frame = tree.at(T0 + 75 * MS, "/camera")
    np.testing.assert_allclose(T, map_odom @ at(1.5) @ base_camera, atol=1e-12)
    assert frame == "map"


def test_the_world_is_the_named_frame_or_the_root_that_was_first():
    tree = TransformTree(SLOP, "world")
    add(tree, T0, "root world", at(5.0), static=True)
    add(tree, T0, "root camera", at(7.0))
    np.testing.assert_allclose(tree.at(T0, "camera")[0], invert_pose(at(5.0)) @ at(7.0))
    tree = TransformTree(SLOP)
    add(tree, T0, "base camera", static=True)
    assert not tree.settled(T0, "camera")
    for pair in ("odom base", "map odom"):
        add(tree, T0, pair)
        assert tree.settled(T0, "camera")
        assert tree.at(T0, "camera")[1] == "odom"


def test_the_mounting_of_the_camera_is_no_world_frame():
    unnamed, on_a_wall = TransformTree(SLOP), TransformTree(SLOP, "camera_link")
    for tree in (unnamed, on_a_wall):
        add(tree, T0, "camera_link camera", static=True)
    with pytest.raises(RefusedInput, match="'camera_link'"):
        unnamed.at(T0, "camera")
    np.testing.assert_allclose(on_a_wall.at(T0, "camera")[0], at(1.0))


@pytest.mark.parametrize(
    ("pairs", "camera", "offender"),
    [("odom base", "camera", "base, odom"), ("a b, b a", "a", None)],  # unknown; a loop
)
def test_a_camera_that_no_chain_reaches_is_refused(pairs, camera, offender):
    tree = TransformTree(SLOP, "map")
    add(tree, T0, pairs, static=True)
    with pytest.raises(RefusedInput, match=offender):
        tree.at(T0, camera)


def test_a_transform_of_the_future_is_lost_and_the_others_are_used():
    tree = TransformTree(SLOP, "map")
    add(tree, T0, "map camera", np.eye(4))
    add(tree, T0 + 3600 * SECOND, "map camera", np.eye(4))
    with refused("time_jump"):
        add(tree, T0 + 50 * MS, "map camera", at(2.0))
    assert tree.newest_ns == T0 + 50 * MS
    assert not tree.settled(T0 + 100 * MS, "camera")
    assert tree.at(T0 + 25 * MS, "camera")[0][0, 3] == pytest.approx(1.0)


def test_silent_frames_are_dropped():
    """Static ones stay, and those between the camera and the world."""
    tree = TransformTree(SLOP, "map")
    add(tree, T0, "base camera, base lidar", static=True)
    add(tree, T0, "map odom, odom base," + ",".join(f"map person_{i}" for i in range(300)))
    assert tree.settled(T0, "camera")
    for seconds in (0, 50, 100, 101, 150):
        add(tree, T0 + seconds * SECOND, "odom base")
        tree.forget_before(T0 + seconds * SECOND)
        assert len(tree) == (304 if seconds <= 100 else 4)
    now_ns = T0 + 150 * SECOND
    with pytest.raises(RefusedInput, match="150.000 s"):
        tree.at(now_ns, "camera")
    for stamp_ns in (now_ns, now_ns + MS):  # the gate waits for the second one
        add(tree, stamp_ns, "map odom, map person_7")
    assert tree.at(now_ns, "camera")[1] == "map"
    np.testing.assert_allclose(tree.between(now_ns, "map", "person_7"), at(1.0))


def test_frames_that_end_before_a_restart_are_forgotten():
    tree = TransformTree(SLOP, "map")
    for run in range(5):
        persons = ",".join(f"map person_{run}_{i}" for i in range(900))
        add(tree, T0 + run * SECOND, f"map camera, {persons}")
        assert tree.settled(T0, "camera")
        tree.restart()
        assert len(tree) == 0


def test_the_number_of_frames_is_bounded():
    tree = TransformTree(SLOP, "map")
    add(tree, T0, "map base")
    for place in range(2 * MAX_FRAMES):
        with contextlib.suppress(RefusedInput):
            add(tree, T0, f"map person_{place}", static=place % 2 == 0)
    assert len(tree) == MAX_FRAMES
    with refused("too_many_frames"):
        add(tree, T0 + 10 * MS, "base camera, map base")
    assert tree.settled(T0 + 10 * MS, "base")  # those that are known go on
    assert not tree.settled(T0, "camera")


def test_objects_of_the_graph_are_no_frames_of_the_camera():
    tree = TransformTree(SLOP, "map")
    add(tree, T0, "map object_1, map robot1/object_22, map object_x, map my_object_3")
    assert len(tree) == 2
    add(tree, T0, "object_1 camera", static=True)
    add(tree, T0, "map object_1, map object_2")  # a tracker that names bodies so
    assert len(tree) == 4
    assert tree.at(T0, "camera")[0][0, 3] == pytest.approx(2.0)


def test_a_graph_of_rtabmap_has_the_stamps_of_the_messages_in_which_its_poses_were_new():
    def graph(stamp_ns, **poses):
        items = [SimpleNamespace(position=point(x), orientation=TURN) for x in poses.values()]
        message = SimpleNamespace(
            header=header(stamp_ns, "map"), poses_id=[int(i[1:]) for i in poses], poses=items
        )
        return message

    TURN = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)

    def point(x):
        return SimpleNamespace(x=x, y=0.0, z=0.0)

    def header(stamp_ns, frame_id):
        stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return SimpleNamespace(stamp=stamp, frame_id=frame_id)

    read = GraphTrajectory().read
    # Poses 1 and 2 came before; landmarks have negative ids.
    assert read(graph(3_000_000_000, n3=0.3, n1=0.1, n2=0.2))[0].tolist() == [3_000_000_000]
    stamps, poses, frame_id = read(graph(4_000_000_000, n1=0.1, n2=0.2, n3=0.35, n5=0.5))
    assert (stamps.tolist(), frame_id) == ([3_000_000_000, 4_000_000_000], "map")
    np.testing.assert_allclose(poses[:, 0, 3], [0.35, 0.5])
    # A pose that was taken out of the graph; and a message that tells nothing new.
    assert read(graph(5_000_000_000, n5=0.6))[0].tolist() == [4_000_000_000]
    assert read(graph(6_000_000_000))[0].tolist() == []
    landmark = SimpleNamespace(
        header=header(7_000_000_000, "map"),
        poses_id=[-4],
        poses=[SimpleNamespace(position=point(0.0), orientation=TURN)],
    )
    assert read(landmark)[0].tolist() == []
