"""replay_node: published messages, waiting, exit codes."""

from __future__ import annotations

import signal

import msgspec
import pytest
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from support.nodes import NodeProcess, peer, wait_until
from support.recordings import camera_items, pose, stamp_ns, transform, write_bag

from deworldsg_ros.recordings import replaying, source
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.streams.poses import stamp_ns_of

COUNT = 12
KINDS = {
    "rgb/image_raw/compressed": CompressedImage,
    "depth/image_raw/compressedDepth": CompressedImage,
    "rgb/image_raw": Image,
    "depth/image_raw": Image,
    "rgb/camera_info": CameraInfo,
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bags") / "bag", camera_items(COUNT))


def replay(tmp_path, bag, **parameters):
    values = {"recording": f"'{bag}'", "rate": 0.0, "wait_s": 0.0, "events": "true", **parameters}
    arguments = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    return NodeProcess("replay_node", tmp_path, "--ros-args", *arguments)


def events_of(process):
    found = []
    for line in process.log.splitlines():
        try:
            found.append(replaying.decode(line))
        except msgspec.MsgspecError:
            continue
    return found


def test_messages_of_a_bag_arrive_byte_for_byte(tmp_path, bag):
    received = {topic: [] for topic in KINDS}
    with peer() as camera:
        for topic, kind in KINDS.items():
            camera.node.create_subscription(
                kind, topic, received[topic].append, reliable(100), raw=False
            )
        clocks = []
        camera.node.create_subscription(Clock, "/clock", clocks.append, reliable(100))
        process = replay(tmp_path, bag, rate=1.0, clock="true")
        try:
            camera.spin_until(lambda: not process.alive, 30, "the replay to end")
            camera.spin_for(0.3)
            assert process.wait(5) == 0, process.log
        finally:
            process.end()
    recorded = {
        (topic.split("/camera")[-1], stamp): message
        for topic, _, stamp, message in camera_items(COUNT)
    }
    rgb = received["rgb/image_raw/compressed"]
    assert len(rgb) == COUNT
    for message in rgb:
        expected = recorded["/color/image_raw/compressed", stamp_ns_of(message)]
        assert bytes(message.data) == expected.data.tobytes()
        assert message.format == expected.format
    assert len(received["depth/image_raw/compressedDepth"]) == COUNT
    assert len(received["rgb/camera_info"]) == COUNT
    assert not received["rgb/image_raw"]
    assert clocks
    assert clocks[-1].clock.sec * 10**9 + clocks[-1].clock.nanosec == stamp_ns(COUNT - 1)
    finished = events_of(process)[-1]
    assert isinstance(finished, replaying.Finished)
    assert finished.published == COUNT


def test_poses_from_tf_are_published_as_poses(tmp_path):
    items = camera_items(COUNT, with_pose=False)
    items += [
        (
            "/tf",
            source.TF_MESSAGE,
            stamp_ns(i),
            transform(stamp_ns(i), "map", "camera_optical", pose(i)),
        )
        for i in range(COUNT)
    ]
    bag = write_bag(tmp_path / "bag", sorted(items, key=lambda item: item[2]))
    poses = []
    with peer() as camera:
        camera.node.create_subscription(PoseStamped, "camera/pose", poses.append, reliable(100))
        process = replay(tmp_path, bag, rate=1.0)
        try:
            camera.spin_until(lambda: not process.alive, 30, "the replay to end")
            camera.spin_for(0.3)
        finally:
            process.end()
    assert len(poses) == COUNT
    for message in poses:
        index = (stamp_ns_of(message) - stamp_ns(0)) / (stamp_ns(1) - stamp_ns(0))
        assert message.pose.position.x == pytest.approx(pose(index)[0, 3])
        assert message.header.frame_id == "map"


def test_save_requires_the_four_nodes(tmp_path, bag):
    process = replay(tmp_path, bag, wait_s=1.0, save="true")
    try:
        assert process.wait(30) == 3
        assert "still waiting for" in process.log
        assert "segmentation_node" in process.log
    finally:
        process.end()


def test_without_the_nodes_it_replays_at_the_recorded_rate(tmp_path, bag):
    process = replay(tmp_path, bag, wait_s=0.5)
    try:
        assert process.wait(30) == 0
    finally:
        process.end()
    printed = events_of(process)
    assert any(isinstance(event, replaying.Waiting) for event in printed)
    assert printed[-1].published == COUNT
    assert "replaying without waiting for results" in process.log


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_0(tmp_path, bag, number):
    process = replay(tmp_path, bag, rate=0.02)
    try:
        wait_until(lambda: '"Started"' in process.log, 30, "the replay to start")
        process._process.send_signal(number)
        assert process.wait(10) == 0, process.log
    finally:
        process.end()
    assert "Traceback" not in process.log


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"recording": "nowhere"}, "nowhere"),
        ({"recording": "''"}, "recording:="),
        ({"intrinsics": "'1,2'"}, "FX,FY,CX,CY"),
        ({"topics": "pose=/nothing"}, "/nothing"),
        ({"topics": "colour=/a"}, "rgb=/a,depth=/b,camera_info=/c,pose=/d"),
        ({"rgb_topic": "/a"}, "did you mean topics?"),
        ({"frame_rate": 30.0}, "there is no parameter frame_rate"),
        ({"rates": 2.0}, "did you mean rate"),
        ({"rate": -1}, "expected float >= 0"),
    ],
)
def test_unusable_parameters_end_it_with_2(tmp_path, bag, parameters, words):
    process = replay(tmp_path, bag, **parameters)
    try:
        assert process.wait(30) == 2
    finally:
        process.end()
    assert words in process.log
    assert "Traceback" not in process.log


def test_named_topics_and_a_parameter_file_are_used(tmp_path, bag):
    """The file of the pipeline serves the replay, too: here it asks for raw images only."""
    topics = "rgb=/camera/color/image_raw/compressed"
    parameters = tmp_path / "parameters.yaml"
    parameters.write_text("/**: {ros__parameters: {inputs: {transport: raw}, output: {top_k: 3}}}")
    arguments = ("--ros-args", "--params-file", str(parameters), "-p", f"recording:='{bag}'")
    process = NodeProcess("replay_node", tmp_path, *arguments, "-p", f"topics:='{topics}'")
    try:
        assert process.wait(30) == 2
    finally:
        process.end()
    assert "no depth topic" in process.log  # the named RGB topic is compressed all the same


def test_events_survive_their_line():
    for event in (
        replaying.Waiting(["a \n b"]),
        replaying.Started(3),
        replaying.Progress(1, 2, 3),
        replaying.Saved(True, "ok"),
        replaying.Finished(1, 1, 0, True, {"n": {"a": "b"}}, {}, ["lost"], [[0.1] * 16]),
    ):
        line = replaying.encode(event)
        assert "\n" not in line
        assert replaying.decode(line) == event
