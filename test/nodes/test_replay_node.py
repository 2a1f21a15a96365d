"""replay_node: published messages, waiting, exit codes."""

import signal

import msgspec
import pytest
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from support.nodes import NodeProcess, peer, run_to_end, wait_until
from support.recordings import camera_items, pose, stamp_ns, tf, write_bag

from deworldsg_ros.recordings import replaying, source
from deworldsg_ros.streams.poses import stamp_ns_of

COUNT = 12
KINDS = {
    "rgb/image_raw/compressed": CompressedImage,
    "depth/image_raw/compressedDepth": CompressedImage,
    "rgb/image_raw": Image,
    "depth/image_raw": Image,
    "rgb/camera_info": CameraInfo,
    "camera/pose": PoseStamped,
    "/clock": Clock,
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bags") / "bag", camera_items(COUNT))


def options(bag, **changes):
    defaults = {"recording": f"'{bag}'", "rate": 0.0, "wait_s": 0.0, "events": "true"}
    return {"parameters": {**defaults, **changes}}


def events_of(log):
    found = []
    for line in log.splitlines():
        try:
            found.append(replaying.decode(line))
        except msgspec.MsgspecError:
            continue
    return found


def received(folder, bag, **changes):
    """What a replay at the recorded rate publishes, by topic, and its events."""
    with peer() as camera:
        messages = {topic: camera.listen(kind, topic) for topic, kind in KINDS.items()}
        with NodeProcess("replay_node", folder, **options(bag, rate=1.0, **changes)) as process:
            camera.spin_until(lambda: not process.alive, 30, "the replay to end")
            camera.spin_for(0.3)
            assert process.wait(5) == 0, process.log
    return messages, events_of(process.log)


def test_messages_of_a_bag_arrive_byte_for_byte(tmp_path, bag):
    messages, events = received(tmp_path, bag, clock="true")
    recorded = {
        stamp: message
        for topic, _, stamp, message in camera_items(COUNT)
        if topic.endswith("/color/image_raw/compressed")
    }
    rgb = messages["rgb/image_raw/compressed"]
    assert len(rgb) == COUNT
    for message in rgb:
        expected = recorded[stamp_ns_of(message)]
        assert bytes(message.data) == expected.data.tobytes()
        assert message.format == expected.format
    assert len(messages["depth/image_raw/compressedDepth"]) == COUNT
    assert len(messages["rgb/camera_info"]) == COUNT
    assert not messages["rgb/image_raw"]
    clock = messages["/clock"][-1].clock
    assert clock.sec * 10**9 + clock.nanosec == stamp_ns(COUNT - 1)
    assert isinstance(events[-1], replaying.Finished)
    assert events[-1].published == COUNT


def test_poses_from_tf_are_published_as_poses(tmp_path):
    items = camera_items(COUNT, with_pose=False)
    for i in range(COUNT):
        moving = tf(stamp_ns(i), ("map", "camera_optical", pose(i)))
        items.append(("/tf", source.TF_MESSAGE, stamp_ns(i), moving))
    bag = write_bag(tmp_path / "bag", sorted(items, key=lambda item: item[2]))
    messages, _ = received(tmp_path, bag)
    poses = messages["camera/pose"]
    assert len(poses) == COUNT
    for message in poses:
        index = (stamp_ns_of(message) - stamp_ns(0)) / (stamp_ns(1) - stamp_ns(0))
        assert message.pose.position.x == pytest.approx(pose(index)[0, 3])
        assert message.header.frame_id == "map"


def test_without_the_nodes_it_replays_at_the_recorded_rate(tmp_path, bag):
    code, log = run_to_end("replay_node", tmp_path, **options(bag, wait_s=0.5))
    assert code == 0
    events = events_of(log)
    assert any(isinstance(event, replaying.Waiting) for event in events)
    assert events[-1].published == COUNT
    assert "replaying without waiting for results" in log


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_0(tmp_path, bag, number):
    with NodeProcess("replay_node", tmp_path, **options(bag, rate=0.02)) as process:
        wait_until(lambda: '"Started"' in process.log, 30, "the replay to start")
        process.send_signal(number)
        assert process.wait(10) == 0, process.log
        assert "Traceback" not in process.log


@pytest.mark.parametrize(
    ("parameters", "exit_code", "words"),
    [
        ({"save": "true", "wait_s": 1.0}, 3, "still waiting for"),  # the nodes
        ({"recording": "nowhere"}, 2, "nowhere"),
        ({"recording": "''"}, 2, "recording:="),
        ({"intrinsics": "'1,2'"}, 2, "FX,FY,CX,CY"),
        ({"topics": "pose=/nothing"}, 2, "/nothing"),
        ({"topics": "colour=/a"}, 2, "rgb=/a,depth=/b,camera_info=/c,pose=/d"),
        ({"rates": 2.0}, 2, "did you mean rate"),
    ],
)
def test_what_cannot_be_replayed_ends_it(tmp_path, bag, parameters, exit_code, words):
    code, log = run_to_end("replay_node", tmp_path, **options(bag, **parameters))
    assert code == exit_code
    assert words in log
    assert "Traceback" not in log


def test_named_topics_and_a_parameter_file_are_used(tmp_path, bag):
    """The file of the pipeline serves the replay, too: here it asks for raw images only."""
    file = tmp_path / "parameters.yaml"
    file.write_text("/**: {ros__parameters: {inputs: {transport: raw}, output: {top_k: 3}}}")
    topics = {"recording": f"'{bag}'", "topics": "'rgb=/camera/color/image_raw/compressed'"}
    words = ("--params-file", str(file))
    code, log = run_to_end("replay_node", tmp_path, *words, parameters=topics)
    assert code == 2
    assert "no depth topic" in log  # the named RGB topic is compressed all the same
