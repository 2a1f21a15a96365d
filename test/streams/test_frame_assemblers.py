"""Joining: the same messages give the same frames, whatever their order between the topics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.streams import (
    MS,
    T0,
    camera_info,
    depth,
    image,
    odometry,
    pose,
    rgb,
    tf,
    transform,
)

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph, Relations, Vocabulary
from deworldsg_ros.streams.frames import FrameAssembler, LiftingAssembler, RelationAssembler

INPUTS = InputsConfig()
PERIOD = 100 * MS
SECOND = 10**9


@dataclass(frozen=True)
class Event:
    """One message on its way to an assembler's method."""

    method: str
    message: Any
    stamp_ns: int


def add(assembler: FrameAssembler, event: Event) -> None:
    getattr(assembler, event.method)(event.message, event.stamp_ns)


def summary(frames: list[RgbdFrame]) -> list[tuple]:
    return [
        (
            frame.stamp_ns,
            int(frame.rgb[0, 0, 0]),
            round(float(frame.depth_m[0, 0]), 4),
            frame.T_world_camera.tobytes(),
            frame.frame_id,
        )
        for frame in frames
    ]


def feed(events: list[Event], **options: Any) -> tuple[list[tuple], dict[str, int]]:
    assembler = FrameAssembler(INPUTS, **options)
    frames = []
    for event in events:
        add(assembler, event)
        frames += assembler.pop_ready(None)
    frames += assembler.flush()
    return summary(frames), dict(assembler.drops)


@st.composite
def recordings(draw: st.DrawFn) -> list[list[Event]]:
    """Streams of a few frames with jitter, gaps and poses at a rate of their own."""
    count = draw(st.integers(0, 6))
    rgb_events, depth_events = [], []
    for step in range(count):
        stamp_ns = T0 + step * PERIOD
        if draw(st.integers(0, 9)):
            rgb_events.append(Event("add_rgb", rgb(stamp_ns, step), stamp_ns))
        if draw(st.integers(0, 9)):
            jittered = stamp_ns + draw(st.sampled_from([0, 0, 5 * MS, -20 * MS, 21 * MS]))
            depth_events.append(Event("add_depth", depth(jittered, 1000 + step), jittered))
    period = draw(st.sampled_from([7 * MS, 100 * MS, 150 * MS]))
    first = T0 + draw(st.sampled_from([-50 * MS, 0, 30 * MS]))
    pose_events = [
        Event("add_pose", pose(first + step * period, 0.01 * step), first + step * period)
        for step in range(count * PERIOD // period)
    ]
    info = [Event("add_camera_info", camera_info(), T0)]
    return [rgb_events, depth_events, pose_events, info]


@st.composite
def interleaved(draw: st.DrawFn) -> tuple[list[Event], list[Event]]:
    """One recording twice: stream after stream, and mixed at random."""
    streams = draw(recordings())
    in_turn = [event for stream in streams for event in stream]
    tags = draw(st.permutations([row for row, stream in enumerate(streams) for _ in stream]))
    left = [iter(stream) for stream in streams]
    return in_turn, [next(left[tag]) for tag in tags]


@given(interleaved())
def test_interleaving_does_not_matter(case: tuple[list[Event], list[Event]]) -> None:
    in_turn, mixed = case
    assert feed(in_turn) == feed(mixed)


@given(interleaved())
def test_every_rgb_image_is_a_frame_or_a_drop(case: tuple[list[Event], list[Event]]) -> None:
    _, mixed = case
    frames, drops = feed(mixed)
    lost = sum(drops.get(reason, 0) for reason in ("no_depth", "no_pose"))
    assert len(frames) + lost == sum(event.method == "add_rgb" for event in mixed)
    assert [frame[0] for frame in frames] == sorted(frame[0] for frame in frames)


def complete(stamp_ns: int, x: float = 0.0, **images: Any) -> list[Event]:
    """The messages of one frame."""
    return [
        Event("add_camera_info", camera_info(stamp_ns), stamp_ns),
        Event("add_pose", pose(stamp_ns, x), stamp_ns),
        Event("add_depth", images.get("depth", depth(stamp_ns)), stamp_ns),
        Event("add_rgb", images.get("rgb", rgb(stamp_ns)), stamp_ns),
    ]


def test_no_messages_give_no_frames() -> None:
    assembler = FrameAssembler(INPUTS)
    assert assembler.pop_ready(0) == assembler.flush() == []
    assert not assembler.drops


def test_a_frame_is_complete_with_its_last_message() -> None:
    assembler = FrameAssembler(INPUTS)
    for event in complete(T0):
        assert assembler.pop_ready(None) == []
        add(assembler, event)
    (frame,) = assembler.pop_ready(None)
    assert (frame.stamp_ns, frame.frame_id) == (T0, "map")
    assert frame.depth_m.dtype == np.float32


def test_an_odometry_of_the_camera_gives_the_pose() -> None:
    events = complete(T0)
    events[1] = Event("add_pose", odometry(T0, 3.0), T0)
    assembler = FrameAssembler(INPUTS)
    for event in events:
        add(assembler, event)
    assert assembler.pop_ready(None)[0].T_world_camera[0, 3] == 3.0


def test_tf_gives_the_pose() -> None:
    assembler = FrameAssembler(InputsConfig(pose_source="tf", world_frame="map"))
    for event in complete(T0):
        if event.method != "add_pose":
            add(assembler, event)
    T = np.eye(4)
    assembler.add_transforms(tf(transform("base", "camera", T)), static=True)
    assert assembler.pop_ready(None) == []
    T[0, 3] = 2.0
    assembler.add_transforms(tf(transform("map", "base", T, T0)))
    (frame,) = assembler.pop_ready(None)
    assert (frame.T_world_camera[0, 3], frame.frame_id) == (2.0, "map")


MOUNT = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])


def robot(options: InputsConfig = INPUTS) -> FrameAssembler:
    """An assembler with an odometry of base_link at x = 3 m, and one image."""
    assembler = FrameAssembler(options)
    assembler.expect_transforms()
    for event in complete(T0):
        if event.method != "add_pose":
            add(assembler, event)
    assembler.add_pose(odometry(T0, 3.0, "base_link"), T0)
    return assembler


def test_an_odometry_of_the_robot_is_transformed_to_its_camera() -> None:
    assembler = robot()
    assert assembler.pop_ready(0) == []  # how the camera is mounted is yet to come
    assembler.add_transforms(tf(transform("base_link", "camera", MOUNT)), static=True)
    # Localisation publishes its transforms ahead of time: that is no jump of the poses.
    ahead_ns = T0 + 2 * SECOND
    assembler.add_transforms(tf(transform("map", "odom", np.eye(4), ahead_ns)))
    (frame,) = assembler.pop_ready(0)
    expected = MOUNT.copy()
    expected[0, 3] += 3.0
    np.testing.assert_allclose(frame.T_world_camera, expected, atol=1e-12)
    for event in complete(T0 + PERIOD):
        if event.method != "add_pose":
            add(assembler, event)
    assembler.add_pose(odometry(T0 + PERIOD, 3.1, "base_link"), T0 + PERIOD)
    (frame,) = assembler.pop_ready(0)
    assert frame.T_world_camera[0, 3] == pytest.approx(3.4)
    assert not assembler.drops


def test_tf_does_not_replace_an_odometry_that_restarts() -> None:
    assembler = robot()
    assembler.add_transforms(tf(transform("base_link", "camera", MOUNT)), static=True)
    assert len(assembler.pop_ready(0)) == 1
    again_ns = T0 - 100 * SECOND
    for stamp_ns in (again_ns, again_ns + PERIOD):
        for event in complete(stamp_ns):
            if event.method != "add_pose":
                add(assembler, event)
        assembler.add_pose(odometry(stamp_ns, float("nan"), "base_link"), stamp_ns)
        assembler.add_transforms(tf(transform("map", "base_link", np.eye(4), stamp_ns)))
    assert assembler.pop_ready(0) == []
    assembler.add_pose(odometry(again_ns, 1.0, "base_link"), again_ns)
    (frame,) = assembler.pop_ready(0)
    assert frame.T_world_camera[0, 3] == pytest.approx(1.3)


def test_an_odometry_of_the_robot_without_the_mounting_gives_no_frame() -> None:
    assembler = robot()
    assert assembler.flush() == []
    assert assembler.drops == {"no_transform": 1}


def test_an_odometry_of_the_camera_needs_no_transforms() -> None:
    assembler = robot()
    assembler.add_pose(odometry(T0 + PERIOD, 3.0, "/camera"), T0 + PERIOD)
    (frame,) = assembler.pop_ready(0)
    assert frame.T_world_camera[0, 3] == 3.0


@pytest.mark.parametrize("missing", ["add_camera_info", "add_pose", "add_depth"])
def test_the_missing_stream_is_the_reason(missing: str) -> None:
    events = [event for event in complete(T0) if event.method != missing]
    frames, drops = feed(events)
    assert frames == []
    assert drops[missing.replace("add_", "no_")] == 1


def test_a_frame_waits_for_the_maximum_wait_and_not_longer() -> None:
    assembler = FrameAssembler(INPUTS, max_wait_s=2.0)
    for event in complete(T0):
        if event.method != "add_depth":
            add(assembler, event)
    assert assembler.pop_ready(5 * SECOND) == []
    assert assembler.pop_ready(int(6.9 * SECOND)) == []
    assert not assembler.drops
    assert assembler.pop_ready(7 * SECOND) == []
    assert assembler.drops == {"no_depth": 1}


def test_after_the_maximum_wait_the_available_pose_is_used() -> None:
    assembler = FrameAssembler(INPUTS, max_wait_s=2.0)
    for event in complete(T0 + 50 * MS):
        if event.method != "add_pose":
            add(assembler, event)
    assembler.add_pose(pose(T0), T0)
    assert assembler.pop_ready(0) == []
    assert len(assembler.pop_ready(2 * SECOND)) == 1


@pytest.mark.parametrize(
    ("images", "reason"),
    [
        ({"rgb": image(np.zeros((6, 8, 3), np.uint8), "yuv422", T0)}, "unknown_encoding"),
        ({"rgb": image(np.zeros((6, 8, 3), np.uint8), "rgb8", T0, step=3)}, "bad_step"),
        ({"rgb": image(np.zeros((5, 8, 3), np.uint8), "rgb8", T0)}, "grid_mismatch"),
        ({"depth": image(np.zeros((3, 4), np.uint16), "16UC1", T0)}, "grid_mismatch"),
        ({"depth": image(np.zeros((6, 8), np.uint16), "16UC1", T0, data=b"")}, "short_buffer"),
    ],
)
def test_a_refused_frame_is_counted_and_the_next_is_accepted(images: dict, reason: str) -> None:
    frames, drops = feed(complete(T0, **images) + complete(T0 + PERIOD))
    assert [frame[0] for frame in frames] == [T0 + PERIOD]
    assert drops == {reason: 1}


def test_bad_camera_info_and_poses_do_not_replace_good_ones() -> None:
    bad = [
        Event("add_camera_info", camera_info(T0, (0.0,) * 9), T0),
        Event("add_pose", pose(T0 + 1, float("nan")), T0 + 1),
        Event("add_pose", pose(T0 + 2, w=0.0), T0 + 2),
        Event("add_pose", pose(T0 + 3, frame_id="odom"), T0 + 3),
    ]
    frames, drops = feed(complete(T0) + bad + complete(T0 + PERIOD))
    assert len(frames) == 2
    assert drops == {"invalid_intrinsics": 1, "invalid_pose": 2, "wrong_frame": 1}


def test_a_jump_is_refused_and_a_relocalisation_is_accepted() -> None:
    xs = [0.0, 0.1, 9.0, 0.2] + [5.0] * 6
    events = [event for row, x in enumerate(xs) for event in complete(T0 + row * PERIOD, x)]
    frames, drops = feed(events)
    assert len(frames) == 5
    assert drops == {"pose_jump": 5}


def test_an_older_image_is_stale() -> None:
    again = Event("add_rgb", rgb(T0), T0)
    frames, drops = feed([*complete(T0), again, *complete(T0 + PERIOD)])
    assert len(frames) == 2
    assert drops == {"stale": 1}


def test_frames_continue_after_a_recording_restarts() -> None:
    first = [event for step in range(30) for event in complete(T0 + step * PERIOD)]
    frames, drops = feed(first + first)
    assert len(frames) >= 30 + 28
    assert drops["time_jump"] >= 1


HOUR = 3600 * SECOND
METHODS = ["add_pose", "add_depth", "add_rgb"]


@pytest.mark.parametrize("jump_ns", [HOUR, 61 * SECOND, -HOUR, -2 * SECOND, -T0])
@pytest.mark.parametrize("methods", [[name] for name in METHODS] + [METHODS])
def test_a_wrong_stamp_costs_its_message(jump_ns: int, methods: list[str]) -> None:
    """The clock of one stream, or of all, is wrong for one message."""
    steps = [complete(T0 + step * PERIOD) for step in range(10)]
    wrong_ns = T0 + 5 * PERIOD + jump_ns
    steps[5] = [
        *[event for event in steps[5] if event.method not in methods],
        *[event for event in complete(wrong_ns) if event.method in methods],
    ]
    frames, drops = feed([event for step in steps for event in step])
    expected = [step * PERIOD for step in range(10) if step != 5]
    if methods == ["add_pose"]:  # interpolated
        expected.insert(5, 5 * PERIOD)
    assert [frame[0] - T0 for frame in frames] == expected
    assert drops.pop("time_jump") == len(methods)
    assert set(drops) <= {"no_depth", "unmatched_depth"}


def test_a_clock_that_was_set_is_followed() -> None:
    steps = [T0 + step * PERIOD for step in range(5)]
    steps += [HOUR + stamp_ns for stamp_ns in steps]
    frames, drops = feed([event for stamp_ns in steps for event in complete(stamp_ns)])
    assert [frame[0] for frame in frames] == steps
    assert drops == {}


@pytest.mark.parametrize("late", [False, True])
def test_streams_that_restart_one_after_the_other_lose_nothing(late: bool) -> None:
    """Poses and depth of the new time come first, an image of the old time after them."""
    old = complete(T0 + 100 * SECOND)
    new = [event for place in range(3) for event in complete(T0 + place * PERIOD)]
    new.sort(key=lambda event: event.method == "add_rgb")  # stable: images last
    straggler = [Event("add_rgb", rgb(T0 + 101 * SECOND), T0 + 101 * SECOND)] if late else []
    images = [event for event in new if event.method == "add_rgb"]
    frames, drops = feed([*old, *new[: -len(images)], *straggler, *images])
    assert [frame[0] - T0 for frame in frames] == [100 * SECOND, 0, PERIOD, 2 * PERIOD]
    assert set(drops) == {"time_jump"}


def test_a_changed_camera_info_is_valid_from_its_stamp_on() -> None:
    changed = camera_info(T0 + PERIOD, (20.0, 0, 4, 0, 20.0, 3, 0, 0, 1))
    assembler = FrameAssembler(INPUTS)
    assembler.add_camera_info(camera_info(T0), T0)
    assembler.add_camera_info(changed, T0 + PERIOD)
    for event in complete(T0)[1:] + complete(T0 + PERIOD)[1:]:
        add(assembler, event)
    assert [frame.intrinsics.fx for frame in assembler.pop_ready(None)] == [10.0, 20.0]


def test_buffers_are_bounded_and_displaced_items_are_counted() -> None:
    assembler = FrameAssembler(INPUTS, capacity=4)
    for step in range(50):
        stamp_ns = T0 + step * PERIOD
        assembler.add_rgb(rgb(stamp_ns), stamp_ns)
        assembler.add_depth(depth(stamp_ns - 50 * MS), stamp_ns - 50 * MS)
        assert assembler.pop_ready(None) == []
    assert assembler.drops["no_camera_info"] + assembler.drops["unmatched_rgb"] >= 46
    assert assembler.drops["unmatched_depth"] >= 40


def test_waiting_for_names_silent_streams_and_their_topics() -> None:
    assembler = FrameAssembler(INPUTS, topics={"camera_info": "/front/camera_info"})
    assert assembler.waiting_for(0) == []
    for event in complete(T0):
        if event.method != "add_camera_info":
            add(assembler, event)
    assert assembler.waiting_for(1 * SECOND) == []
    assert assembler.waiting_for(int(2.9 * SECOND)) == [
        "no camera_info on /front/camera_info for 3 s"
    ]
    assert len(assembler.waiting_for(10 * SECOND)) == 4


def test_waiting_for_names_streams_that_lag_behind() -> None:
    assembler = FrameAssembler(INPUTS, max_wait_s=2.0)
    for event in complete(T0):
        if event.method != "add_pose":
            add(assembler, event)
    early = T0 - 60 * SECOND
    assembler.add_pose(pose(early), early)
    assembler.pop_ready(0)
    (text,) = assembler.waiting_for(int(1.5 * SECOND))
    assert "waits for pose: the newest on camera/pose is at" in text


def test_drops_are_reported_immediately() -> None:
    told: list[tuple[str, str, int]] = []
    assembler = FrameAssembler(INPUTS, on_drop=lambda *arguments: told.append(arguments))
    assembler.add_pose(pose(w=0.0), T0)
    ((reason, message, number),) = told
    assert (reason, number) == ("invalid_pose", 1)
    assert "norm 0.0000" in message


VOCABULARY = Vocabulary(("chair", "cup"), ("on",))


def frame_graph(stamp_ns: int) -> FrameGraph:
    return FrameGraph(
        stamp_ns=stamp_ns,
        frame_id="camera",
        width=8,
        height=6,
        vocabulary=VOCABULARY,
        boxes_xyxy=np.array([[0.0, 0, 4, 4]]),
        class_probabilities=np.array([[0.9, 0.1]]),
        scores=np.array([0.9]),
        relations=Relations.none(1),
    )


def local_graph(stamp_ns: int) -> LocalGraph:
    return LocalGraph(
        stamp_ns=stamp_ns,
        frame_id="map",
        width=8,
        height=6,
        T_world_camera=np.eye(4),
        vocabulary=VOCABULARY,
        instance_ids=np.zeros(0, np.int64),
        boxes_xyxy=np.zeros((0, 4)),
        class_probabilities=np.zeros((0, 2)),
        scores=np.zeros(0),
        means_world=np.zeros((0, 3)),
        covariances_world=np.zeros((0, 3, 3)),
        depths_m=np.zeros(0),
        pixel_counts=np.zeros(0, np.int64),
        surface_points_world=(),
        relations=Relations.none(1),
    )


def instances(stamp_ns: int) -> Any:
    return image(np.zeros((6, 8), np.uint16), "mono16", stamp_ns)


@given(st.permutations([0] * 3 + [1] * 3 + [2] * 3 + [3] * 3 + [4]))
def test_lifting_frames_do_not_depend_on_interleaving(order: list[int]) -> None:
    assembler = LiftingAssembler(INPUTS)
    stamps = [T0 + step * PERIOD for step in range(3)]
    streams = [
        iter([(assembler.add_frame_graph, (frame_graph(stamp),)) for stamp in stamps]),
        iter([(assembler.add_instances, (instances(stamp), stamp)) for stamp in stamps]),
        iter([(assembler.add_depth, (depth(stamp), stamp)) for stamp in stamps]),
        iter(
            [(assembler.add_pose, (pose(stamp, 9.0 * i), stamp)) for i, stamp in enumerate(stamps)]
        ),
        iter([(assembler.add_camera_info, (camera_info(), T0))]),
    ]
    frames = []
    for tag in order:
        method, arguments = next(streams[tag])
        method(*arguments)
        frames += assembler.pop_ready(None)
    assert [frame.frame_graph.stamp_ns for frame in frames] == stamps
    # A jump is the segmentation's to refuse.
    assert [frame.T_world_camera[0, 3] for frame in frames] == [0.0, 9.0, 18.0]
    assert not assembler.drops


def test_a_frame_graph_without_instances_is_dropped() -> None:
    assembler = LiftingAssembler(INPUTS)
    assembler.add_camera_info(camera_info(), T0)
    assembler.add_pose(pose(), T0)
    assembler.add_depth(depth(), T0)
    assembler.add_frame_graph(frame_graph(T0))
    assembler.add_instances(instances(T0 + MS), T0 + MS)
    assert assembler.pop_ready(None) == []
    assert assembler.drops == {"no_instances": 1}


@given(st.permutations([0] * 4 + [1] * 4))
def test_relation_frames_pair_by_stamp(order: list[int]) -> None:
    assembler = RelationAssembler()
    stamps = [T0 + step * PERIOD for step in range(4)]
    images = iter([rgb(stamp, value) for value, stamp in enumerate(stamps)])
    graphs = iter([local_graph(stamp) for stamp in stamps])
    frames = []
    for tag in order:
        if tag:
            message = next(images)
            assembler.add_rgb(
                message, message.header.stamp.sec * SECOND + message.header.stamp.nanosec
            )
        else:
            assembler.add_local_graph(next(graphs))
        frames += assembler.pop_ready(None)
    assert [frame.local.stamp_ns for frame in frames] == stamps
    assert [int(frame.rgb[0, 0, 0]) for frame in frames] == [0, 1, 2, 3]


def test_images_of_frames_without_a_local_graph_are_dropped() -> None:
    assembler = RelationAssembler()
    for step in range(5):
        stamp_ns = T0 + step * PERIOD
        assembler.add_rgb(rgb(stamp_ns), stamp_ns)
    assembler.add_local_graph(local_graph(T0 + 4 * PERIOD))
    assert len(assembler.pop_ready(None)) == 1
    assert assembler.drops == {"unmatched_rgb": 4}
