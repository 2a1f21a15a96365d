"""Frames of bags: every form of image and pose that a bag may hold."""

from __future__ import annotations

import numpy as np
import pytest
from support.recordings import (
    CAMERA,
    INTRINSICS,
    STEP_NS,
    WORLD,
    camera_items,
    depth_mm,
    odometry,
    pose,
    rgb_pixels,
    stamp_ns,
    transform,
    write_bag,
)

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.recording import open_recording, open_source
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.recordings.writer import write_mcap
from deworldsg_ros.scene.camera import Intrinsics, invert_pose
from deworldsg_ros.scene.errors import RecordingError
from deworldsg_ros.streams.poses import stamp_ns_of

COUNT = 6


def frames_of(path, **options):
    recording = open_recording(path, **options)
    try:
        return list(recording.frames()), recording
    finally:
        recording.close()


def assert_whole(frames, count=COUNT):
    assert [frame.stamp_ns for frame in frames] == [stamp_ns(index) for index in range(count)]
    for index, frame in enumerate(frames):
        assert frame.intrinsics == INTRINSICS
        assert frame.frame_id == WORLD
        np.testing.assert_array_equal(frame.rgb, rgb_pixels(index))
        np.testing.assert_allclose(frame.depth_m, depth_mm(index) * 1e-3, atol=1e-6)
        np.testing.assert_allclose(frame.T_world_camera, pose(index), atol=1e-12)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("compressed", [True, False])
def test_frames_equal_the_recorded_messages(tmp_path, storage, compressed):
    bag = write_bag(tmp_path / "bag", camera_items(COUNT, compressed=compressed), storage)
    frames, recording = frames_of(bag)
    assert_whole(frames)
    assert recording.frame_count == COUNT
    assert not recording.drops
    assert not recording.losses


def test_a_bag_without_poses_is_refused(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(2, with_pose=False))
    with pytest.raises(RecordingError, match="no pose topic"):
        open_recording(bag)


@pytest.mark.parametrize("compressed", [True, False])
def test_given_intrinsics_replace_those_of_a_bag(tmp_path, compressed):
    items = camera_items(COUNT, compressed=compressed)
    bare = [item for item in items if "camera_info" not in item[0]]
    for name, kept in (("with", items), ("without", bare)):
        bag = write_bag(tmp_path / name, kept)
        frames, recording = frames_of(
            bag, options=DatasetOptions(intrinsics=(50.0, 51.0, 3.0, 4.0))
        )
        assert len(frames) == COUNT
        assert not recording.drops
        size = INTRINSICS.width, INTRINSICS.height
        assert {frame.intrinsics for frame in frames} == {Intrinsics(50.0, 51.0, 3.0, 4.0, *size)}


@pytest.mark.parametrize("compressed", [True, False])
def test_a_colour_topic_is_no_depth_topic(tmp_path, compressed):
    bag = write_bag(tmp_path / "bag", camera_items(2, compressed=compressed))
    color = "/camera/color/image_raw" + "/compressed" * compressed
    with pytest.raises(RecordingError, match=f"{color}: .* picture .*--depth"):
        open_recording(bag, topics=TopicChoice(depth=color))


def test_poses_from_odometry(tmp_path):
    items = camera_items(COUNT, with_pose=False)
    items += [("/odom", ros.ODOMETRY, stamp_ns(i), odometry(i)) for i in range(COUNT)]
    items.sort(key=lambda item: item[2])
    assert_whole(frames_of(write_bag(tmp_path / "bag", items))[0])


T_BASE_CAMERA = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1]])


def tf_items(times_ns, base="base"):
    """/tf of a base that carries the camera, /tf_static of the camera on it; late in the bag."""
    items = []
    for time_ns in times_ns:
        index = (time_ns - stamp_ns(0)) / STEP_NS
        assert index == int(index)
        T = pose(int(index)) @ invert_pose(T_BASE_CAMERA)
        items.append(("/tf", ros.TF_MESSAGE, time_ns, transform(time_ns, WORLD, base, T)))
    static = transform(0, base, CAMERA, T_BASE_CAMERA)
    items.append(("/tf_static", ros.TF_MESSAGE, max(times_ns), static))
    return items


def test_poses_from_tf_along_a_chain(tmp_path):
    items = camera_items(COUNT, with_pose=False) + tf_items([stamp_ns(i) for i in range(COUNT)])
    items.sort(key=lambda item: item[2])
    frames, recording = frames_of(write_bag(tmp_path / "bag", items))
    assert_whole(frames)
    # A replay sees the same poses, as PoseStamped.
    raw = list(recording_raw(tmp_path / "bag"))
    assert {item.msgtype for item in raw if item.role is Role.POSE} == {ros.POSE_STAMPED}


def recording_raw(path):
    source = open_source(path)
    yield from source.raw_messages()
    source.close()


def robot_items():
    """A camera on a base, and the odometry of the base."""
    items = camera_items(COUNT, with_pose=False) + tf_items([stamp_ns(i) for i in range(COUNT)])
    return items + [
        ("/odom", ros.ODOMETRY, stamp_ns(i), odometry(i, "base", invert_pose(T_BASE_CAMERA)))
        for i in range(COUNT)
    ]


@pytest.mark.parametrize(
    ("without", "topic"),
    [
        ((), "/odom"),  # /tf_static carries it over
        (("/tf",), "/odom"),
        (("/tf_static",), "/tf"),  # the two are not connected
    ],
)
def test_an_odometry_of_the_robot_is_transformed_to_its_camera(tmp_path, without, topic):
    items = [item for item in robot_items() if item[0] not in without]
    bag = write_bag(tmp_path / "bag", sorted(items, key=lambda item: item[2]))
    frames, recording = frames_of(bag)
    assert recording.source.topics[Role.POSE].name == topic
    if topic == "/odom":
        assert_whole(frames)
        # A replay sees the same poses, as PoseStamped.
        kinds = {item.msgtype for item in recording_raw(bag) if item.role is Role.POSE}
        assert kinds == {ros.POSE_STAMPED}
    # … unless the user says that it is the camera's.
    inputs = InputsConfig(pose_source="odometry")
    frames, recording = frames_of(bag, inputs=inputs)
    assert recording.source.topics[Role.POSE].msgtype == ros.ODOMETRY
    expected = pose(0) @ invert_pose(T_BASE_CAMERA)
    np.testing.assert_allclose(frames[0].T_world_camera, expected, atol=1e-9)


def test_the_configuration_decides_between_poses_odometry_and_tf(tmp_path):
    items = camera_items(COUNT) + tf_items([stamp_ns(i) for i in range(COUNT)])
    items += [("/odom", ros.ODOMETRY, stamp_ns(i), odometry(i)) for i in range(COUNT)]
    bag = write_bag(tmp_path / "bag", sorted(items, key=lambda item: item[2]))
    for pose_source, topic in (
        ("auto", "/camera/pose"),
        ("pose", "/camera/pose"),
        ("odometry", "/odom"),
        ("tf", "/tf"),
    ):
        frames, recording = frames_of(bag, inputs=InputsConfig(pose_source=pose_source))
        assert recording.source.topics[Role.POSE].name == topic
        assert_whole(frames)
    with pytest.raises(RecordingError, match="no rgb topic"):
        open_recording(bag, InputsConfig(transport="raw"))


def test_tf_that_does_not_connect_the_camera_drops_frames_with_a_reason(tmp_path):
    items = camera_items(COUNT, with_pose=False)
    elsewhere = [
        ("/tf", ros.TF_MESSAGE, stamp_ns(i), transform(stamp_ns(i), WORLD, "arm", np.eye(4)))
        for i in range(COUNT)
    ]
    items = sorted(items + elsewhere, key=lambda item: item[2])
    frames, recording = frames_of(write_bag(tmp_path / "bag", items))
    assert not frames
    assert recording.drops["no_pose"] == COUNT
    assert any(CAMERA in loss and "arm" in loss for loss in recording.losses)


def test_frames_without_depth_are_dropped_and_counted(tmp_path):
    items = [
        item for item in camera_items(COUNT) if not (item[2] == stamp_ns(2) and "depth" in item[0])
    ]
    frames, recording = frames_of(write_bag(tmp_path / "bag", items))
    assert [frame.stamp_ns for frame in frames] == [stamp_ns(i) for i in range(COUNT) if i != 2]
    assert recording.drops["no_depth"] == 1
    assert "depth" in recording.reasons["no_depth"]


def test_the_configured_slop_decides_which_images_match(tmp_path):
    items = camera_items(3)
    for topic, _, _, message in items:
        if "depth" in topic:
            message.header = ros.header(stamp_ns_of(message) + 30_000_000, CAMERA)
    bag = write_bag(tmp_path / "bag", items)
    assert len(frames_of(bag)[0]) == 0
    assert len(frames_of(bag, inputs=InputsConfig(slop_s=0.04))[0]) == 3


def test_a_robots_odometry_is_transformed_although_its_first_message_is_broken(tmp_path):
    items = sorted(robot_items(), key=lambda item: item[2])
    first = next(index for index, item in enumerate(items) if item[0] == "/odom")
    topic, kind, time_ns, message = items[first]
    items[first] = (topic, kind, time_ns, ros.encode(message, kind)[:30])
    frames, recording = frames_of(write_bag(tmp_path / "bag", items))
    assert recording.source.topics[Role.POSE].msgtype == ros.POSE_STAMPED
    assert recording.source.drops["invalid_message"] == 1
    np.testing.assert_allclose(frames[-1].T_world_camera, pose(COUNT - 1), atol=1e-6)


def test_a_message_that_cannot_be_decoded_is_counted(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(3))
    source = open_source(bag)
    raw = list(source.raw_messages())
    source.raw_messages = lambda: iter([raw[0]._replace(data=raw[0].data[:30]), *raw[1:]])
    assert len(list(source.messages())) == len(raw) - 1
    assert source.drops["invalid_message"] == 1
    source.close()


def test_written_bag_gives_the_same_frames_and_foxglove_finds_its_schemas(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(COUNT))
    output = tmp_path / "out.mcap"
    assert write_mcap(recording_raw(bag), output) == 4 * COUNT
    assert_whole(frames_of(output)[0])
    content = output.read_bytes()
    assert content.startswith(b"\x89MCAP0\r\n")
    for word in (
        b"ros2",
        b"sensor_msgs/msg/CompressedImage",
        b"MSG: std_msgs/Header",
        b"/rgb/image_raw/compressed",
        b"/depth/image_raw/compressedDepth",
        b"/rgb/camera_info",
        b"/camera/pose",
    ):
        assert word in content, word
    assert [file.name for file in tmp_path.glob(".deworldsg-*")] == []


def test_output_is_never_overwritten_and_an_interrupted_write_leaves_no_file(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(2))
    output = tmp_path / "out.mcap"

    def interrupted():
        yield from list(recording_raw(bag))[:3]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_mcap(interrupted(), output)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bag"]
    output.write_text("mine")
    with pytest.raises(RecordingError, match="exists already"):
        write_mcap(recording_raw(bag), output)
    assert output.read_text() == "mine"
    for bad in (tmp_path / "out.bag", tmp_path / "no" / "out.mcap"):
        with pytest.raises(RecordingError, match="output"):
            write_mcap(recording_raw(bag), bad)


def test_a_path_without_a_recording_is_refused_with_the_expected_content(tmp_path):
    with pytest.raises(RecordingError, match=r"metadata\.yaml.*rgb\.txt"):
        open_recording(tmp_path)
    (tmp_path / "film.avi").write_text("")
    with pytest.raises(RecordingError, match=r"\.mcap or \.db3"):
        open_recording(tmp_path / "film.avi")
    with pytest.raises(RecordingError, match="no such file"):
        open_recording(tmp_path / "nothing")
