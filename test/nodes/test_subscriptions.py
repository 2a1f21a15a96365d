"""A node adapts to the publishers: best effort, compressed images, odometry, TF, later changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from support.nodes import peer
from support.nodes_bench import (
    CAMERA,
    LIMIT_S,
    Bench,
    camera_info,
    local_graph,
    pose,
    rgb,
    send_frame,
    stamped,
    works,
)

from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.ros import inputs
from deworldsg_ros.ros.inputs import TFMessage
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import AutoSubscription, best_effort, reliable, source
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire


def published(topics: dict[str, type], **options: Any) -> Iterator[Bench]:
    made = Bench(SegmentationNode, topics, **options)
    yield made
    made.close()


@pytest.fixture
def best_effort_camera() -> Iterator[Bench]:
    yield from published(CAMERA, qos=best_effort(10))


@pytest.fixture
def other_camera() -> Iterator[Bench]:
    topics = {
        "rgb/image_raw/compressed": CompressedImage,
        "depth/image_raw/compressedDepth": CompressedImage,
        "rgb/camera_info": CameraInfo,
        "camera/pose": Odometry,
    }
    yield from published(topics)


def test_best_effort_publishers_are_received(best_effort_camera: Bench) -> None:
    works(best_effort_camera, lambda: [send_frame(best_effort_camera) for _ in range(5)])


def compressed_rgb(stamp_ns: int) -> CompressedImage:
    pixels = np.zeros((48, 64, 3), np.uint8)
    message = CompressedImage(format="rgb8; jpeg compressed bgr8")
    message.data = cv2.imencode(".jpg", pixels)[1].tobytes()
    return stamped(message, stamp_ns)


def compressed_depth(stamp_ns: int) -> CompressedImage:
    pixels = np.full((48, 64), 1500, np.uint16)
    message = CompressedImage(format="16UC1; compressedDepth png")
    message.data = bytes(12) + cv2.imencode(".png", pixels)[1].tobytes()
    return stamped(message, stamp_ns)


def odometry(stamp_ns: int, frame_id: str = "odom") -> Odometry:
    message = Odometry(child_frame_id="camera")
    message.pose.pose = pose(stamp_ns).pose
    return stamped(message, stamp_ns, frame_id)


def send_other(at: Bench, **changes: Any) -> None:
    """A frame in other messages than raw images and PoseStamped."""
    others = {
        "rgb__image_raw": None,
        "depth__image_raw": None,
        "rgb__image_raw__compressed": compressed_rgb,
        "depth__image_raw__compressedDepth": compressed_depth,
        "camera__pose": odometry,
    }
    send_frame(at, **{**others, **changes})


def test_compressed_images_and_odometry_are_received(other_camera: Bench) -> None:
    works(other_camera, lambda: send_other(other_camera))
    assert not other_camera.node.health.drops


def test_a_subscription_follows_its_publishers() -> None:
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


def test_a_topic_can_change_its_type() -> None:
    with peer() as me:
        got: list[Any] = []
        sources = [source("pose", PoseStamped), source("pose", Odometry)]
        subscription = AutoSubscription(me.node, sources, got.append, reliability="auto")
        with peer("odometry_publisher") as other:
            publisher = other.node.create_publisher(Odometry, "pose", reliable(5))
            me.spin_until(subscription.check, LIMIT_S, "the other type")
            other.spin_until(lambda: publisher.get_subscription_count() == 1, LIMIT_S, "the match")
            publisher.publish(Odometry())
            me.spin_until(lambda: len(got) == 1, LIMIT_S, "odometry")
            assert isinstance(got[0], Odometry)


def test_tf_without_tf2_msgs_is_refused_at_the_start() -> None:
    if TFMessage is not None:
        pytest.skip("tf2_msgs is installed")
    with peer() as me, pytest.raises(ConfigurationError, match="tf2_msgs is not installed"):
        SegmentationNode(
            context=me.context, parameter_overrides=[Parameter("inputs.pose_source", value="tf")]
        )


def test_predictions_follow_the_pairs_of_a_frame() -> None:
    overrides = [
        Parameter("relations.world_model", value="fake"),
        Parameter("relations.clip_length", value=4),
    ]

    def two_objects(stamp_ns: int) -> wire.LocalGraphMessage:
        message = local_graph(stamp_ns)
        message.objects = [
            *message.objects,
            msgspec.structs.replace(message.objects[0], instance=2),
        ]
        return message

    topics = {"rgb/image_raw": Image, "deworldsg/local_graph": String}
    at = Bench(RelationNode, topics, parameter_overrides=overrides)
    try:
        texts = at.peer.collect("deworldsg/relation_evidence")
        at.peer.spin_for(0.5)
        for _ in range(3):
            stamp_ns = at.next_stamp()
            at.send(rgb__image_raw=rgb(stamp_ns), deworldsg__local_graph=two_objects(stamp_ns))
        at.expect(lambda: len(texts) >= 6, "three times the pairs, three times a prediction")
        messages = [wire.decode(text, wire.RelationEvidenceMessage) for text in texts]
        assert {message.source for message in messages} == {"fake"}
        assert {message.frame_id for message in messages} == {"map"}
        predicted = [bool(pair.prediction) for message in messages for pair in message.pairs]
        assert sorted(predicted) == [False] * 6 + [True] * 6
        assert at.node.more_values()["clips encoded"] == "3"
    finally:
        at.close()


def test_diagnostics_name_missing_and_refused_input(other_camera: Bench) -> None:
    at = other_camera
    statuses: list[DiagnosticStatus] = []
    at.peer.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda message: statuses.extend(message.status), 10
    )

    def reported(text: str) -> Callable[[], bool]:
        def sending() -> bool:
            send_other(at, rgb__camera_info=None)
            at.peer.spin_for(0.1)
            return any(text in status.message for status in statuses)

        return sending

    at.expect(reported("no camera_info on /rgb/camera_info for 3 s"), "the missing input")
    assert statuses[-1].level == DiagnosticStatus.WARN
    at.send(camera__pose=odometry(at.next_stamp(), "elsewhere"))
    at.expect(
        reported("wrong_frame: pose is in frame 'elsewhere', expected 'odom'"), "the refused input"
    )


def topics_of(node: StageNode) -> set[str]:
    return {subscription.topic_name for subscription in node.subscriptions}


@pytest.mark.parametrize("posed", [False, True])
def test_tf_is_used_only_without_a_publisher_of_poses(
    monkeypatch: pytest.MonkeyPatch, posed: bool
) -> None:
    # Only the topic matters here, and any message type will do.
    monkeypatch.setattr(inputs, "TFMessage", TransformStamped)
    monkeypatch.setattr(inputs, "TF_AFTER_S", 1.0)
    camera = {topic: kind for topic, kind in CAMERA.items() if posed or topic != "camera/pose"}
    at = Bench(SegmentationNode, camera)
    try:
        assert "/tf" not in topics_of(at.node)
        at.peer.spin_for(2.0)
        assert ({"/tf", "/tf_static"} <= topics_of(at.node)) == (not posed)
    finally:
        at.close()


@pytest.mark.parametrize("child", ["camera", "base_link"])
def test_tf_is_used_for_odometry_of_another_frame(
    monkeypatch: pytest.MonkeyPatch, child: str
) -> None:
    monkeypatch.setattr(inputs, "TFMessage", TransformStamped)
    at = Bench(SegmentationNode, {**CAMERA, "camera/pose": Odometry})
    try:
        at.send(rgb__camera_info=camera_info(at.next_stamp()))
        at.expect(lambda: at.node._frames.camera_frame == "camera", "the camera's frame")
        message = odometry(at.next_stamp())
        message.child_frame_id = child
        at.send(camera__pose=message)
        at.expect(lambda: at.node._frames._had_poses, "the odometry")
        at.peer.spin_for(0.2)
        assert ({"/tf", "/tf_static"} <= topics_of(at.node)) == (child == "base_link")
    finally:
        at.close()
