"""Detections of another process arrive while the nodes run; names are new at any time."""

import os
import subprocess
import sys
from functools import partial

import msgspec
import numpy as np
import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import String
from support.cli import DEMO_ROOM, ROOT, deworldsg
from support.detections import vision_message, wire_message
from support.nodes_bench import CAMERA, FRAME, HEIGHT, WIDTH, Bench, image, pose, works

from deworldsg_ros.nodes.deworldsg_node import DeworldsgNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

SENT, MASKS = "deworldsg/detections", "deworldsg/detections/instances"
LEFT, RIGHT = [4.0, 8.0, 24.0, 40.0], [36.0, 8.0, 60.0, 40.0]

# A first start compiles.
pytestmark = pytest.mark.timeout(300)


def mask_of(box):
    x1, y1, x2, y2 = map(int, box)
    bits = np.packbits(np.ones((y2 - y1) * (x2 - x1), np.uint8)).tobytes()
    return wire.SentMask(x1, y1, x2 - x1, y2 - y1, bits)


def seen(stamp_ns, *named):
    """Detections with masks: no segmenter is asked."""
    message = wire_message(named, stamp_ns)
    for item in message.detections:
        item.mask = mask_of(item.box_xyxy)
    return message


def node(make, **parameters):
    topics = {**CAMERA, SENT: String, MASKS: Image}
    return Bench(make, topics, parameters={"perception.detector": "topic", **parameters})


def send(bench, *named, at_m=0.0):
    """A frame of a camera at this x, and what was seen in it."""
    makers = {**FRAME, "camera__pose": lambda stamp_ns: pose(stamp_ns, at_m)}
    bench.send_made(**makers, deworldsg__detections=lambda stamp_ns: seen(stamp_ns, *named))


def test_500_names_arrive_and_whoever_listened_before_goes_on():
    with node(DeworldsgNode, **{"merging.association": "paper", "output.rate_hz": 50.0}) as bench:
        client = GraphReplica()
        updates = bench.peer.collect("/scene_graph/updates")
        names = [f"thing {number}" for number in range(500)]
        for number in range(250):  # two new ones in each frame
            named = [(LEFT, {names[2 * number]: 0.9}), (RIGHT, {names[2 * number + 1]: 0.9})]
            works(bench, partial(send, bench, *named, at_m=0.9 * number))

        def labels():
            while updates:
                client.apply(wire.decode(updates.pop(0), wire.SceneGraphUpdateMessage))
            return {item.label for item in client.nodes.values()}

        bench.expect(lambda: labels() == set(names), "every name in the graph")
        assert sum(bench.node.health.drops.values()) == 0


def test_masks_may_come_as_an_instance_image_and_every_loss_has_a_reason():
    with node(SegmentationNode) as bench:
        graphs = bench.peer.collect("deworldsg/frame_graph")
        named = (LEFT, {"mug": 0.7}), (RIGHT, {"desk": 0.6})
        works(bench, lambda: send(bench, *named))
        # The detector has left out an image, and its next result tells that.
        bench.refuses("no_detections", lambda: (bench.send_made(**FRAME), send(bench, *named)))
        # A stamp of no image, before that of the next one.
        bench.send(deworldsg__detections=seen(bench.stamp_ns + 1, *named))
        bench.refuses("unmatched_detections", lambda: send(bench, *named))
        pixels = np.zeros((HEIGHT, WIDTH), np.uint16)
        pixels[10:20, 40:50] = 2
        bench.send_made(
            **FRAME,
            deworldsg__detections=lambda stamp_ns: wire_message(named, stamp_ns),
            deworldsg__detections__instances=lambda stamp_ns: image(pixels, "mono16", stamp_ns),
        )
        bench.expect(lambda: len(graphs) == 4, "a frame graph with the masks of the image")
        bench.refuses("no_detection_instances", lambda: send(bench, *named))
        bad = msgspec.structs.replace(seen(bench.next_stamp(), *named), frame_id="a\nb")
        bench.refuses("invalid_frame_id", lambda: bench.send(deworldsg__detections=bad))
        found = wire.decode(graphs[-1], wire.FrameGraphMessage)
        assert found.classes == ["mug", "desk"]
        assert [item.box_xyxy for item in found.objects] == [LEFT, RIGHT]


def test_messages_of_vision_msgs_arrive():
    kind = pytest.importorskip("vision_msgs.msg").Detection2DArray
    from rosidl_runtime_py import convert, set_message

    topics = {**CAMERA, SENT: kind}
    with Bench(SegmentationNode, topics, parameters={"perception.detector": "topic"}) as bench:
        graphs = bench.peer.collect("deworldsg/frame_graph")

        def typed(stamp_ns):
            message = kind()
            content = convert.message_to_ordereddict(vision_message([(LEFT, {"mug": 0.7})]))
            set_message.set_message_fields(message, content)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            return message

        works(bench, lambda: bench.send_made(**FRAME, deworldsg__detections=typed))
        assert wire.decode(graphs[-1], wire.FrameGraphMessage).classes == ["mug"]


@pytest.mark.slow
def test_the_example_detects_in_a_process_of_its_own(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "ROS_LOG_DIR": str(tmp_path)}
    command = [sys.executable, str(ROOT / "tools" / "example_detector.py")]
    detector = subprocess.Popen(command, env=environment)
    try:
        words = "--rate", 0, "--no-view", "--set", "perception.detector=topic"
        done = deworldsg(tmp_path, "demo", DEMO_ROOM, "--out", "out", *words, limit_s=250)
    finally:
        detector.kill()  # rclpy's own end hangs now and then, under load
        detector.wait()
    assert done.returncode == 0, done.stdout + done.stderr
    graph = wire.decode((tmp_path / "out" / "scene_graph.json").read_text(), wire.SceneGraphMessage)
    labels = [item.label for item in graph.nodes]
    assert len(labels) > 20 and {"chair", "refrigerator", "dining table"} <= set(labels)
