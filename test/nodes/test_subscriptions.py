"""A node adapts to the publishers: best effort, compressed images, odometry, TF, later changes."""

import time
from functools import partial
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from support.nodes import peer, wait_until
from support.nodes_bench import (
    CAMERA,
    LIMIT_S,
    Bench,
    alone,
    camera_info,
    local_graph,
    pose,
    stamped,
    works,
)
from support.recordings import encoded
from support.streams import compressed_depth

from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.ros import inputs
from deworldsg_ros.ros.node import Waiting, serve
from deworldsg_ros.ros.qos import AutoSubscription, best_effort, reliable, source
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire


def compressed_rgb(stamp_ns: int) -> CompressedImage:
    jpeg = encoded(np.zeros((48, 64, 3), np.uint8), ".jpg")
    return stamped(CompressedImage(format="rgb8; jpeg compressed bgr8", data=jpeg), stamp_ns)


def depth_png(stamp_ns: int) -> CompressedImage:
    data = compressed_depth(np.full((48, 64), 1500, np.uint16))
    return stamped(CompressedImage(format="16UC1; compressedDepth png", data=data), stamp_ns)


def odometry(stamp_ns: int, frame_id: str = "odom", child: str = "camera") -> Odometry:
    message = Odometry(child_frame_id=child)
    message.pose.pose = pose(stamp_ns).pose
    return stamped(message, stamp_ns, frame_id)


@pytest.fixture
def other_camera():
    """A node with a camera that publishes other messages than raw images and PoseStamped."""
    topics = {
        "rgb/image_raw/compressed": CompressedImage,
        "depth/image_raw/compressedDepth": CompressedImage,
        "rgb/camera_info": CameraInfo,
        "camera/pose": Odometry,
    }
    with Bench(SegmentationNode, topics) as at:
        yield at


def send_other(at: Bench, **changes: Any) -> None:
    makers = {
        "rgb__camera_info": camera_info,
        "rgb__image_raw__compressed": compressed_rgb,
        "depth__image_raw__compressedDepth": depth_png,
        "camera__pose": odometry,
    }
    at.send_made(**{**makers, **changes})


def test_compressed_images_and_odometry_are_received(other_camera):
    works(other_camera, partial(send_other, other_camera))
    assert not other_camera.node.health.drops


def test_a_subscription_follows_its_publishers():
    with peer() as me:
        got: list[Any] = []
        sources = [source("image", Image), source("image/compressed", CompressedImage)]
        subscription = AutoSubscription(me.node, sources, got.append, reliability="auto")
        assert subscription.describe() == "/image [sensor_msgs/msg/Image] reliable"
        first = me.node.create_publisher(Image, "image", reliable(5))
        me.spin_until(lambda: first.get_subscription_count() == 1, LIMIT_S, "the first match")
        assert not subscription.check()
        second = me.node.create_publisher(Image, "image", best_effort(5))
        me.spin_until(subscription.check, LIMIT_S, "the change to best effort")
        me.spin_until(lambda: second.get_subscription_count() == 1, LIMIT_S, "the second match")
        first.publish(Image())
        second.publish(Image())
        me.spin_until(lambda: len(got) == 2, LIMIT_S, "both images")
        me.node.destroy_publisher(second)
        me.spin_until(subscription.check, LIMIT_S, "the change back")
        assert subscription.describe().endswith("reliable")
        me.node.destroy_publisher(first)
        me.spin_for(0.3)
        assert not subscription.check()


def test_diagnostics_name_missing_and_refused_input(other_camera):
    at, statuses = other_camera, other_camera.peer.statuses()

    def reported(text: str) -> bool:
        send_other(at, rgb__camera_info=None)
        at.peer.spin_for(0.1)
        return any(text in status.message for status in statuses)

    missing = "no camera_info on /rgb/camera_info for 3 s"
    at.expect(lambda: reported(missing), "the missing input")
    assert statuses[-1].level == DiagnosticStatus.WARN
    at.send(camera__pose=odometry(at.next_stamp(), "elsewhere"))
    refused = "wrong_frame: pose is in frame 'elsewhere', expected 'odom'"
    at.expect(lambda: reported(refused), "the refused input")


def test_tf_without_tf2_msgs_is_refused_at_the_start(monkeypatch):
    monkeypatch.setattr(inputs, "TFMessage", None)
    refused = pytest.raises(ConfigurationError, match="tf2_msgs")
    with refused, alone(SegmentationNode, {"inputs.pose_source": "tf"}):
        pass


@pytest.fixture
def any_tf(monkeypatch):
    # Only the topic matters here, and any message type will do.
    monkeypatch.setattr(inputs, "TFMessage", TransformStamped)
    monkeypatch.setattr(inputs, "TF_AFTER_S", 1.0)


def listens_to_tf(at: Bench) -> bool:
    return {"/tf", "/tf_static"} <= {item.topic_name for item in at.node.subscriptions}


@pytest.mark.parametrize("posed", [False, True])
def test_tf_is_used_only_without_a_publisher_of_poses(any_tf, posed):
    camera = {topic: kind for topic, kind in CAMERA.items() if posed or topic != "camera/pose"}
    with Bench(SegmentationNode, camera) as at:
        assert not listens_to_tf(at)
        at.peer.spin_for(2.0)
        assert listens_to_tf(at) is not posed


@pytest.mark.parametrize("child", ["camera", "base_link"])
def test_tf_is_used_for_odometry_of_another_frame(any_tf, child):
    with Bench(SegmentationNode, {**CAMERA, "camera/pose": Odometry}) as at:
        at.send_made(rgb__camera_info=camera_info)
        at.expect(lambda: at.node._frames.camera_frame == "camera", "the camera's frame")
        at.send_made(camera__pose=partial(odometry, child=child))
        at.expect(lambda: at.node._frames._had_poses, "the odometry")
        at.peer.spin_for(0.2)
        assert listens_to_tf(at) is (child == "base_link")


def test_a_text_that_cannot_be_decoded_is_counted_and_its_topic_named(caplog):
    """DDS itself drops such a text, and says nothing."""
    topic = "deworldsg/local_graph"
    first, whole = (
        serialize_message(String(data=wire.encode(local_graph(second * 10**9))))
        for second in (1, 2)
    )
    with peer("sender") as sender, alone(GraphNode) as node:
        waiting = Waiting(node)
        publisher = sender.node.create_publisher(String, topic, reliable(10))

        def reaches(second, step):
            wait_until(lambda: node.graph.newest_ns == second * 10**9, LIMIT_S, topic, step)

        reaches(1, lambda: (publisher.publish(first), time.sleep(0.2), serve(node, waiting)))
        for text in (whole[:40], b"", whole[:4] + b"\xff" * 4 + whole[8:], whole):
            publisher.publish(text)
        reaches(2, partial(serve, node, waiting))
        assert node.health.drops["invalid_message"] == 3
        waiting.close()
