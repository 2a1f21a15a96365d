"""Joining: the same messages give the same frames, whatever their order between the topics."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings import odometry, tf
from support.streams import CAMERA, MS, T0, at, camera_info, depth, image, pose, rgb

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import RelationEvidence, Vocabulary
from deworldsg_ros.streams.assembler import PendingEvidence
from deworldsg_ros.streams.frames import FrameAssembler, LiftingAssembler, RelationAssembler

INPUTS = InputsConfig()
PERIOD = 100 * MS
SECOND = 10**9
HOUR = 3600 * SECOND


@dataclass(frozen=True)
class Event:
    """A message on its way to the assembler."""

    stream: str
    message: Any
    stamp_ns: int


def complete(stamp_ns: int, x: float = 0.0, without: str = "", **messages: Any) -> list[Event]:
    """The messages of one frame, without a stream, or with other messages."""
    made = {
        "camera_info": camera_info(stamp_ns),
        "pose": pose(stamp_ns, x),
        "depth": depth(stamp_ns),
        "rgb": rgb(stamp_ns),
        **messages,
    }
    return [Event(name, item, stamp_ns) for name, item in made.items() if name != without]


def frames_at(stamps_ns: list[int]) -> list[Event]:
    return [event for stamp_ns in stamps_ns for event in complete(stamp_ns)]


def add(assembler: FrameAssembler, *events: Event) -> None:
    for event in events:
        getattr(assembler, f"add_{event.stream}")(event.message, event.stamp_ns)


def filled(*events: Event, inputs: InputsConfig = INPUTS, **options: Any) -> FrameAssembler:
    assembler = FrameAssembler(inputs, **options)
    add(assembler, *events)
    return assembler


def summary(frame: RgbdFrame) -> tuple:
    pixels = int(frame.rgb[0, 0, 0]), round(float(frame.depth_m[0, 0]), 4)
    return frame.stamp_ns, pixels, frame.T_world_camera.tobytes(), frame.frame_id


def feed(events: list[Event]) -> tuple[list[tuple], dict[str, int]]:
    """What the frames are, and the drops."""
    assembler = FrameAssembler(INPUTS)
    frames = []
    for event in events:
        add(assembler, event)
        frames += assembler.pop_ready(None)
    frames += assembler.flush()
    return [summary(frame) for frame in frames], dict(assembler.drops)


@st.composite
def recordings(draw: st.DrawFn) -> list[list[Event]]:
    """Streams of a few frames with jitter, gaps and poses at a rate of their own."""
    count = draw(st.integers(0, 6))
    rgb_events, depth_events = [], []
    for step in range(count):
        stamp_ns = T0 + step * PERIOD
        if draw(st.integers(0, 9)):
            rgb_events.append(Event("rgb", rgb(stamp_ns, step), stamp_ns))
        if draw(st.integers(0, 9)):
            jittered = stamp_ns + draw(st.sampled_from([0, 0, 5 * MS, -20 * MS, 21 * MS]))
            depth_events.append(Event("depth", depth(jittered, 1000 + step), jittered))
    period = draw(st.sampled_from([7 * MS, 100 * MS, 150 * MS]))
    first = T0 + draw(st.sampled_from([-50 * MS, 0, 30 * MS]))
    pose_events = [
        Event("pose", pose(first + step * period, 0.01 * step), first + step * period)
        for step in range(count * PERIOD // period)
    ]
    return [rgb_events, depth_events, pose_events, [Event("camera_info", camera_info(), T0)]]


@given(recordings(), st.data())
def test_interleaving_does_not_matter_and_every_image_is_a_frame_or_a_drop(streams, data):
    tags = data.draw(st.permutations([row for row, part in enumerate(streams) for _ in part]))
    left = [iter(stream) for stream in streams]
    frames, drops = feed([next(left[tag]) for tag in tags])
    assert (frames, drops) == feed([event for stream in streams for event in stream])
    lost = sum(drops.get(reason, 0) for reason in ("no_depth", "no_pose"))
    assert len(frames) + lost == len(streams[0])
    assert [frame[0] for frame in frames] == sorted(frame[0] for frame in frames)


def test_tf_gives_the_pose():
    inputs = InputsConfig(pose_source="tf", world_frame="map")
    assembler = filled(*complete(T0, without="pose"), inputs=inputs)
    T = np.eye(4)
    assembler.add_transforms(tf(T0, ("base", "camera_optical", T)), static=True)
    assert assembler.pop_ready(None) == []
    T[0, 3] = 2.0
    assembler.add_transforms(tf(T0, ("map", "base", T)))
    (frame,) = assembler.pop_ready(None)
    assert (frame.T_world_camera[0, 3], frame.frame_id) == (2.0, "map")


MOUNT = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])


def on_a_robot(stamp_ns: int, x: float) -> list[Event]:
    """A frame with an odometry of base_link."""
    return complete(stamp_ns, pose=odometry(stamp_ns, at(x), "base_link"))


def robot() -> FrameAssembler:
    assembler = FrameAssembler(INPUTS)
    assembler.expect_transforms()
    add(assembler, *on_a_robot(T0, 3.0))
    return assembler


def test_an_odometry_of_the_robot_is_transformed_to_its_camera():
    assembler = robot()
    assert assembler.pop_ready(0) == []  # how the camera is mounted is yet to come
    assembler.add_transforms(tf(T0, ("base_link", "camera_optical", MOUNT)), static=True)
    # Localisation publishes its transforms ahead of time: that is no jump of the poses.
    assembler.add_transforms(tf(T0 + 2 * SECOND, ("map", "odom", np.eye(4))))
    (frame,) = assembler.pop_ready(0)
    expected = MOUNT.copy()
    expected[0, 3] += 3.0
    np.testing.assert_allclose(frame.T_world_camera, expected, atol=1e-12)
    add(assembler, *on_a_robot(T0 + PERIOD, 3.1))
    (frame,) = assembler.pop_ready(0)
    assert frame.T_world_camera[0, 3] == pytest.approx(3.4)
    assert not assembler.drops


def test_tf_does_not_replace_an_odometry_that_restarts():
    assembler = robot()
    assembler.add_transforms(tf(T0, ("base_link", "camera_optical", MOUNT)), static=True)
    assert len(assembler.pop_ready(0)) == 1
    again_ns = T0 - 100 * SECOND
    for stamp_ns in (again_ns, again_ns + PERIOD):
        add(assembler, *on_a_robot(stamp_ns, float("nan")))
        assembler.add_transforms(tf(stamp_ns, ("map", "base_link", np.eye(4))))
    assert assembler.pop_ready(0) == []
    assembler.add_pose(odometry(again_ns, at(1.0), "base_link"), again_ns)
    (frame,) = assembler.pop_ready(0)
    assert frame.T_world_camera[0, 3] == pytest.approx(1.3)


def test_only_an_odometry_of_another_frame_needs_the_mounting():
    assembler = robot()
    assert assembler.flush() == []
    assert assembler.drops == {"no_transform": 1}
    add(assembler, *complete(T0 + PERIOD, pose=odometry(T0 + PERIOD, at(3.0), "/camera_optical")))
    (frame,) = assembler.pop_ready(0)
    assert frame.T_world_camera[0, 3] == 3.0


def test_a_frame_waits_for_the_maximum_wait_and_not_longer():
    assembler = filled(*complete(T0, without="depth"), max_wait_s=2.0)
    for now_s in (5.0, 6.9, 7.0):
        assert not assembler.drops
        assert assembler.pop_ready(int(now_s * SECOND)) == []
    assert assembler.drops == {"no_depth": 1}
    # Then the available pose is used.
    assembler = filled(*complete(T0 + 50 * MS, without="pose"), max_wait_s=2.0)
    assembler.add_pose(pose(T0), T0)
    assert assembler.pop_ready(0) == []
    assert len(assembler.pop_ready(2 * SECOND)) == 1


CLOCKS = ["pose", "depth", "rgb"]


@pytest.mark.parametrize("jump_ns", [HOUR, 61 * SECOND, -HOUR, -2 * SECOND, -T0])
@pytest.mark.parametrize("wrong", [[name] for name in CLOCKS] + [CLOCKS])
def test_a_wrong_stamp_costs_its_message(jump_ns, wrong):
    """The clock of one stream, or of all, is wrong for one message."""
    steps = [complete(T0 + step * PERIOD) for step in range(10)]
    steps[5] = [
        *[event for event in steps[5] if event.stream not in wrong],
        *[event for event in complete(T0 + 5 * PERIOD + jump_ns) if event.stream in wrong],
    ]
    frames, drops = feed(sum(steps, []))
    expected = [step * PERIOD for step in range(10) if step != 5]
    if wrong == ["pose"]:  # interpolated
        expected.insert(5, 5 * PERIOD)
    assert [frame[0] - T0 for frame in frames] == expected
    assert drops.pop("time_jump") == len(wrong)
    assert set(drops) <= {"no_depth", "unmatched_depth"}


def test_a_clock_that_was_set_is_followed():
    stamps_ns = [T0 + step * PERIOD for step in range(5)]
    stamps_ns += [HOUR + stamp_ns for stamp_ns in stamps_ns]
    frames, drops = feed(frames_at(stamps_ns))
    assert [frame[0] for frame in frames] == stamps_ns
    assert drops == {}


@pytest.mark.parametrize("late", [False, True])
def test_streams_that_restart_one_after_the_other_lose_nothing(late):
    """Poses and depth of the new time come first, an image of the old time after them."""
    old = complete(T0 + 100 * SECOND)
    new = frames_at([T0 + place * PERIOD for place in range(3)])
    images = [event for event in new if event.stream == "rgb"]
    others = [event for event in new if event.stream != "rgb"]
    straggler = [Event("rgb", rgb(T0 + 101 * SECOND), T0 + 101 * SECOND)] if late else []
    frames, drops = feed([*old, *others, *straggler, *images])
    assert [frame[0] - T0 for frame in frames] == [100 * SECOND, 0, PERIOD, 2 * PERIOD]
    assert set(drops) == {"time_jump"}


def test_a_changed_camera_info_is_valid_from_its_stamp_on():
    changed = camera_info(T0 + PERIOD, replace(CAMERA, fx=20.0))
    assembler = filled(
        Event("camera_info", camera_info(T0), T0),
        Event("camera_info", changed, T0 + PERIOD),
        *complete(T0, without="camera_info"),
        *complete(T0 + PERIOD, without="camera_info"),
    )
    assert [frame.intrinsics.fx for frame in assembler.pop_ready(None)] == [10.0, 20.0]


def test_buffers_are_bounded_and_displaced_items_are_counted():
    assembler = FrameAssembler(INPUTS, capacity=4)
    for step in range(50):
        stamp_ns = T0 + step * PERIOD
        assembler.add_rgb(rgb(stamp_ns), stamp_ns)
        assembler.add_depth(depth(stamp_ns - 50 * MS), stamp_ns - 50 * MS)
        assert assembler.pop_ready(None) == []
    assert assembler.drops["no_camera_info"] + assembler.drops["unmatched_rgb"] >= 46
    assert assembler.drops["unmatched_depth"] >= 40


def test_waiting_for_names_streams_that_are_silent_or_lag_behind():
    assembler = FrameAssembler(INPUTS, topics={"camera_info": "/front/camera_info"})
    assert assembler.waiting_for(0) == []
    add(assembler, *complete(T0, without="camera_info"))
    assert assembler.waiting_for(1 * SECOND) == []
    (text,) = assembler.waiting_for(int(2.9 * SECOND))
    assert text == "no camera_info on /front/camera_info for 3 s"
    assert len(assembler.waiting_for(10 * SECOND)) == 4
    assembler = filled(*complete(T0, without="pose"), max_wait_s=2.0)
    early_ns = T0 - 60 * SECOND
    assembler.add_pose(pose(early_ns), early_ns)
    assembler.pop_ready(0)
    (text,) = assembler.waiting_for(int(1.5 * SECOND))
    assert "waits for pose: the newest on camera/pose is at" in text


def graph(stamp_ns: int) -> Any:
    """All that an assembler reads of a graph of one image."""
    return SimpleNamespace(stamp_ns=stamp_ns)


@given(st.permutations([0] * 3 + [1] * 3 + [2] * 3 + [3] * 3 + [4]))
def test_lifting_frames_do_not_depend_on_interleaving(order):
    assembler, nothing = LiftingAssembler(INPUTS), np.zeros((6, 8), np.uint16)
    stamps = [T0 + step * PERIOD for step in range(3)]
    streams = [
        iter([lambda at=at: assembler.add_frame_graph(graph(at)) for at in stamps]),
        iter(
            [
                lambda at=at: assembler.add_instances(image(nothing, "mono16", at), at)
                for at in stamps
            ]
        ),
        iter([lambda at=at: assembler.add_depth(depth(at), at) for at in stamps]),
        iter([lambda at=at: assembler.add_pose(pose(at, (at - T0) * 1e-7), at) for at in stamps]),
        iter([lambda: assembler.add_camera_info(camera_info(), T0)]),
    ]
    frames = []
    for tag in order:
        next(streams[tag])()
        frames += assembler.pop_ready(None)
    assert [frame.frame_graph.stamp_ns for frame in frames] == stamps
    # A jump is the segmentation's to refuse.
    assert [frame.T_world_camera[0, 3] for frame in frames] == [0.0, 10.0, 20.0]
    assert not assembler.drops


def test_images_pair_with_the_local_graph_of_their_stamp_and_others_are_dropped():
    assembler = RelationAssembler()
    for step in range(5):
        assembler.add_rgb(rgb(T0 + step * PERIOD, step), T0 + step * PERIOD)
    assembler.add_local_graph(graph(T0 + 4 * PERIOD))
    (frame,) = assembler.pop_ready(None)
    assert frame.rgb[0, 0, 0] == 4
    assert assembler.drops == {"unmatched_rgb": 4}


def evidence(stamp_ns: int, pairs: int = 0) -> RelationEvidence:
    return RelationEvidence(
        stamp_ns=stamp_ns,
        vocabulary=Vocabulary(("chair",), ("on",)),
        pairs=np.tile(np.array([[0, 1]]), (pairs, 1)),
        pair_classes=np.zeros((pairs, 2), np.int64),
        geo_costs=np.zeros(pairs),
        predictions=np.ones((pairs, 1)),
        source="none",
    )


@pytest.mark.parametrize(("limit", "pairs"), [({"capacity": 1}, 0), ({"most_bytes": 40}, 4)])
def test_evidence_that_waits_is_bounded(limit, pairs):
    waiting = PendingEvidence(**limit)
    waiting.add(evidence(2, pairs))
    with pytest.raises(RefusedInput) as caught:
        waiting.add(evidence(3, pairs))
    assert caught.value.reason == "unmatched_evidence"
    assert [item.stamp_ns for item in waiting.take(3)] == [3]
