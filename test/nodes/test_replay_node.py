"""replay_node: what it publishes, how it waits, how it ends."""

from __future__ import annotations

import signal

import msgspec
import pytest
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from support.nodes import NodeProcess, peer, wait_until
from support.recordings import camera_items, pose, stamp_ns, transform, write_bag

from deworldsg_ros.recordings import events, messages
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
            found.append(events.decode(line))
        except msgspec.MsgspecError:
            continue
    return found


def test_bytes_of_the_bag_arrive_as_they_are(tmp_path, bag):
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
        wanted = recorded["/color/image_raw/compressed", stamp_ns_of(message)]
        assert bytes(message.data) == wanted.data.tobytes()
        assert message.format == wanted.format
    assert len(received["depth/image_raw/compressedDepth"]) == COUNT
    assert len(received["rgb/camera_info"]) == COUNT
    assert not received["rgb/image_raw"]
    assert clocks
    assert clocks[-1].clock.sec * 10**9 + clocks[-1].clock.nanosec == stamp_ns(COUNT - 1)
    finished = events_of(process)[-1]
    assert isinstance(finished, events.Finished)
    assert finished.published == COUNT


def test_poses_out_of_tf_go_out_as_poses(tmp_path):
    items = camera_items(COUNT, with_pose=False)
    items += [
        (
            "/tf",
            messages.TF_MESSAGE,
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


def test_a_pipeline_that_is_required_and_does_not_come_is_an_error(tmp_path, bag):
    process = replay(tmp_path, bag, wait_s=1.0, required="true")
    try:
        assert process.wait(30) == 3
        assert "still waiting for" in process.log
        assert "segmentation_node" in process.log
    finally:
        process.end()


def test_alone_it_replays_at_its_own_pace(tmp_path, bag):
    process = replay(tmp_path, bag, wait_s=0.5, listener_s=0.2)
    try:
        assert process.wait(30) == 0
    finally:
        process.end()
    told = events_of(process)
    assert any(isinstance(event, events.Waiting) for event in told)
    assert told[-1].published == COUNT
    assert "replaying at its own pace" in process.log


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_0(tmp_path, bag, number):
    process = replay(tmp_path, bag, rate=0.02, listener_s=0.2)
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
        ({"config": "nowhere.yaml"}, "nowhere.yaml"),
        ({"pose_topic": "/nothing"}, "/nothing"),
        ({"rates": 2.0}, "did you mean rate"),
        ({"rate": -1}, "wanted float >= 0"),
    ],
)
def test_what_cannot_be_used_is_told_in_a_sentence(tmp_path, bag, parameters, words):
    process = replay(tmp_path, bag, **parameters)
    try:
        assert process.wait(30) == 2
    finally:
        process.end()
    assert words in process.log
    assert "Traceback" not in process.log


def test_events_survive_their_line():
    for event in (
        events.Waiting(["a \n b"]),
        events.Started(3),
        events.Progress(1, 2, 3),
        events.Saved(True, "ok"),
        events.Finished(1, 1, 0, True, {"n": {"a": "b"}}, {}, ["lost"], [[0.1] * 16]),
    ):
        line = events.encode(event)
        assert "\n" not in line
        assert events.decode(line) == event
