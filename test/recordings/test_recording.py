"""Frames of bags: every form of image and pose that a bag may hold."""

from contextlib import closing

import numpy as np
import pytest
from support.recordings import (
    CAMERA,
    INTRINSICS,
    WORLD,
    camera_items,
    depth_mm,
    frames_of,
    odometry,
    pose,
    rgb_pixels,
    stamp_ns,
    tf,
    write_bag,
)

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.recording import open_recording, open_source
from deworldsg_ros.recordings.replaying import write_mcap
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.scene.camera import Intrinsics, invert_pose
from deworldsg_ros.scene.errors import RecordingError

COUNT = 6


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


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("has_info", [True, False])
def test_given_intrinsics_replace_those_of_a_bag(tmp_path, compressed, has_info):
    items = camera_items(COUNT, compressed=compressed)
    kept = [item for item in items if has_info or "camera_info" not in item[0]]
    given = (50.0, 51.0, 3.0, 4.0)
    frames, recording = frames_of(write_bag(tmp_path / "bag", kept), intrinsics=given)
    assert len(frames) == COUNT
    assert not recording.drops
    size = INTRINSICS.width, INTRINSICS.height
    assert {frame.intrinsics for frame in frames} == {Intrinsics(*given, *size)}


@pytest.mark.parametrize("compressed", [True, False])
def test_a_colour_topic_is_no_depth_topic(tmp_path, compressed):
    bag = write_bag(tmp_path / "bag", camera_items(2, compressed=compressed))
    color = "/camera/color/image_raw" + "/compressed" * compressed
    with pytest.raises(RecordingError, match=f"{color}: .* picture .*--depth"):
        open_recording(bag, topics=TopicChoice(depth=color))


@pytest.mark.parametrize("compressed", [True, False])
def test_depth_is_known_by_its_encoding(tmp_path, compressed):
    """The driver of an OAK publishes depth on /oak/stereo/image_raw."""
    renamed = [
        (topic.replace("/camera/depth", "/oak/stereo").replace("/color", "/rgb"), *rest)
        for topic, *rest in camera_items(2, compressed=compressed)
    ]
    with closing(open_recording(write_bag(tmp_path / "bag", renamed))) as recording:
        topics = recording.source.topics
        assert topics[Role.DEPTH].name.startswith("/oak/stereo/image_raw")
        assert topics[Role.RGB].name.startswith("/camera/rgb/image_raw")
        assert len(list(recording.frames())) == 2


# --- poses -------------------------------------------------------------------------------------

T_BASE_CAMERA = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1]])


def tf_items():
    """/tf of a base that carries the camera, /tf_static of the camera on it; late in the bag."""
    bases = [pose(i) @ invert_pose(T_BASE_CAMERA) for i in range(COUNT)]
    times_ns = [stamp_ns(i) for i in range(COUNT)]
    static = tf(0, ("base", CAMERA, T_BASE_CAMERA))
    return [
        *(("/tf", ros.TF_MESSAGE, t, tf(t, (WORLD, "base", T))) for t, T in zip(times_ns, bases)),
        ("/tf_static", ros.TF_MESSAGE, max(times_ns), static),
    ]


def odometry_items(child=CAMERA, T_camera_child=np.eye(4)):
    return [
        ("/odom", ros.ODOMETRY, stamp_ns(i), odometry(stamp_ns(i), pose(i) @ T_camera_child, child))
        for i in range(COUNT)
    ]


def robot_items():
    items = camera_items(COUNT, with_pose=False) + tf_items()
    return in_time(items + odometry_items("base", invert_pose(T_BASE_CAMERA)))


def in_time(items):
    return sorted(items, key=lambda item: item[2])


def raw_messages(path):
    with closing(open_source(path)) as source:
        yield from source.raw_messages()


def replayed_poses(path):
    return {item.msgtype for item in raw_messages(path) if item.role is Role.POSE}


@pytest.mark.parametrize(
    ("without", "topic"),
    [
        ((), "/odom"),  # /tf_static carries it over
        (("/tf",), "/odom"),
        (("/tf_static",), "/tf"),  # the two are not connected
        (("/odom",), "/tf"),
    ],
)
def test_poses_of_the_robot_are_transformed_to_its_camera(tmp_path, without, topic):
    items = [item for item in robot_items() if item[0] not in without]
    bag = write_bag(tmp_path / "bag", items)
    frames, recording = frames_of(bag)
    assert recording.source.topics[Role.POSE].name == topic
    if "/tf_static" not in without:
        assert_whole(frames)
        assert replayed_poses(bag) == {ros.POSE_STAMPED}
    if "/odom" not in without:  # … unless the user says that it is the camera's
        frames, recording = frames_of(bag, inputs=InputsConfig(pose_source="odometry"))
        assert recording.source.topics[Role.POSE].msgtype == ros.ODOMETRY
        expected = pose(0) @ invert_pose(T_BASE_CAMERA)
        np.testing.assert_allclose(frames[0].T_world_camera, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("pose_source", "topic"),
    [("auto", "/camera/pose"), ("pose", "/camera/pose"), ("odometry", "/odom"), ("tf", "/tf")],
)
def test_the_configuration_decides_between_poses_odometry_and_tf(tmp_path, pose_source, topic):
    items = in_time(camera_items(COUNT) + tf_items() + odometry_items())
    bag = write_bag(tmp_path / "bag", items)
    frames, recording = frames_of(bag, inputs=InputsConfig(pose_source=pose_source))
    assert recording.source.topics[Role.POSE].name == topic
    assert_whole(frames)
    with pytest.raises(RecordingError, match="no rgb topic"):
        open_recording(bag, InputsConfig(transport="raw"))


def test_tf_that_does_not_connect_the_camera_drops_frames_with_a_reason(tmp_path):
    elsewhere = [
        ("/tf", ros.TF_MESSAGE, stamp_ns(i), tf(stamp_ns(i), (WORLD, "arm", np.eye(4))))
        for i in range(COUNT)
    ]
    items = in_time(camera_items(COUNT, with_pose=False) + elsewhere)
    frames, recording = frames_of(write_bag(tmp_path / "bag", items))
    assert not frames
    assert recording.drops["no_pose"] == COUNT
    assert any(CAMERA in loss and "arm" in loss for loss in recording.losses)


# --- what is left out --------------------------------------------------------------------------


@pytest.mark.parametrize("topic", ["/odom", "/camera/color/camera_info"])
def test_a_message_that_cannot_be_decoded_is_counted(tmp_path, topic):
    items = robot_items()
    first = next(index for index, item in enumerate(items) if item[0] == topic)
    _, kind, time_ns, message = items[first]
    items[first] = (topic, kind, time_ns, ros.encode(message, kind)[:30])
    frames, recording = frames_of(write_bag(tmp_path / "bag", items))
    assert recording.source.topics[Role.POSE].msgtype == ros.POSE_STAMPED
    assert recording.source.drops["invalid_message"] == 1
    np.testing.assert_allclose(frames[-1].T_world_camera, pose(COUNT - 1), atol=1e-6)


# --- written bags ------------------------------------------------------------------------------


def test_written_bag_gives_the_same_frames_and_foxglove_finds_its_schemas(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(COUNT))
    output = tmp_path / "out.mcap"
    assert write_mcap(raw_messages(bag), output) == 4 * COUNT
    assert_whole(frames_of(output)[0])
    content = output.read_bytes()
    assert content.startswith(b"\x89MCAP0\r\n")
    for word in (
        *(b"ros2", b"sensor_msgs/msg/CompressedImage", b"MSG: std_msgs/Header"),
        *(b"/rgb/image_raw/compressed", b"/depth/image_raw/compressedDepth"),
        *(b"/rgb/camera_info", b"/camera/pose"),
    ):
        assert word in content, word


def test_output_is_never_overwritten_and_an_interrupted_write_leaves_no_file(tmp_path):
    messages = list(raw_messages(write_bag(tmp_path / "bag", camera_items(2))))
    output = tmp_path / "out.mcap"

    def interrupted():
        yield from messages[:3]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_mcap(interrupted(), output)
    assert [file.name for file in tmp_path.iterdir()] == ["bag"]

    def beside():
        yield from messages
        output.write_text("mine")

    with pytest.raises(RecordingError, match="exists already"):
        write_mcap(beside(), output)
    for path in (output, tmp_path / "out.bag", tmp_path / "no" / "out.mcap"):
        with pytest.raises(RecordingError, match="output"):
            write_mcap(messages, path)
    assert output.read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (".", r"metadata\.yaml.*rgb\.txt"),
        ("film.avi", r"\.mcap or \.db3"),
        ("nothing", "no such file"),
    ],
)
def test_a_path_without_a_recording_is_refused_with_the_expected_content(tmp_path, name, words):
    if name == "film.avi":
        (tmp_path / name).write_text("")
    with pytest.raises(RecordingError, match=words):
        open_recording(tmp_path / name)
