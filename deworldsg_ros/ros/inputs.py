"""Subscriptions to the camera: images, camera_info and poses in every supported type."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String

from deworldsg_ros.ros.joining import JoiningNode
from deworldsg_ros.ros.node import CHECK_PERIOD_S, StageNode
from deworldsg_ros.ros.qos import AutoSubscription, Source, reliable, source
from deworldsg_ros.ros.transforms import POSE_DEPTH, TFMessage
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.streams.detections import read_detections
from deworldsg_ros.streams.frames import TOPICS, FrameAssembler, PosedAssembler
from deworldsg_ros.streams.poses import stamp_ns_of

try:  # Part of ROS 2, but not of its wheels.
    from vision_msgs.msg import Detection2DArray as Detection2DArray
except ImportError:
    Detection2DArray = None

# Takes a message and its stamp in nanoseconds.
Taker = Callable[[Any, int], None]
# Messages that DDS keeps: a third of a second of images at 30 Hz.
IMAGE_DEPTH = 10
# The same for images that a busy node leaves to DDS: the newest, and enough to find the depth image
# of an RGB image.
WANTED_DEPTH = 4
# Without a publisher of poses for this time, poses come from TF.
TF_AFTER_S = 3.0


def image_sources(topic: str, compressed_suffix: str, transport: str) -> list[Source]:
    """Topics and types of images, in order of preference.

    Args:
        topic: topic of the raw images.
        compressed_suffix: suffix of image_transport, e.g. ``/compressed``.
        transport: auto, raw or compressed.
    """
    raw = [source(topic, Image)]
    compressed = [
        source(topic + compressed_suffix, CompressedImage),
        source(topic, CompressedImage),
    ]
    return {"raw": raw, "compressed": compressed, "auto": raw + compressed}[transport]


def listen_rgb(
    node: StageNode, take: Taker, is_wanted: Callable[[], bool], depth: int = IMAGE_DEPTH
) -> None:
    """Subscribe to RGB images; `is_wanted` and `depth` as in `AutoSubscription`."""
    inputs = node.parameters.inputs
    topic = node.resolve_topic_name("rgb/image_raw")
    sources = image_sources(topic, "/compressed", inputs.transport)
    node.listen("rgb", sources, _stamped(take), inputs.reliability, depth, is_wanted)


def listen_depth(
    node: StageNode, take: Taker, is_wanted: Callable[[], bool], depth: int = IMAGE_DEPTH
) -> None:
    """Subscribe to depth images; `is_wanted` and `depth` as in `AutoSubscription`."""
    inputs = node.parameters.inputs
    topic = node.resolve_topic_name("depth/image_raw")
    sources = image_sources(topic, "/compressedDepth", inputs.transport)
    node.listen("depth", sources, _stamped(take), inputs.reliability, depth, is_wanted)


def listen_camera_info(node: JoiningNode[Any], take: Taker) -> None:
    """Subscribe to camera_info."""
    sources = [source("rgb/camera_info", CameraInfo)]
    reliability = node.parameters.inputs.reliability
    node.listen("camera_info", sources, _stamped(take), reliability, POSE_DEPTH, node.wants_rest)


def listen_detections(node: JoiningNode[Any], frames: FrameAssembler) -> None:
    """Subscribe to the detections of another process, and to their instance image."""
    kinds = [String] if Detection2DArray is None else [String, Detection2DArray]
    reliability = node.parameters.inputs.reliability
    taking = node.taking(lambda message: frames.add_detections(read_detections(message)))
    sources = [source(TOPICS["detections"], kind) for kind in kinds]
    node.listen("detections", sources, taking, reliability, IMAGE_DEPTH, node.wants_rest)
    taking = node.taking(
        lambda message: frames.add_detection_instances(message, stamp_ns_of(message))
    )
    sources = [source(TOPICS["detection_instances"], Image)]
    node.listen("detection_instances", sources, taking, reliability, IMAGE_DEPTH, node.wants_rest)


def listen_pose(node: JoiningNode[Any], frames: PosedAssembler[Any, Any]) -> None:
    """Subscribe to poses, and to TF if `inputs.pose_source` or an odometry requires it.

    Raises:
        ConfigurationError: if TF is required and tf2_msgs is not installed.
    """
    pose_source = node.parameters.inputs.pose_source
    transforms = _Transforms(node, frames)
    if pose_source == "tf":
        transforms.listen()
        return
    kinds = {"pose": [PoseStamped], "odometry": [Odometry], "auto": [PoseStamped, Odometry]}
    uses_tf = pose_source == "auto" and TFMessage is not None
    add = node.taking(frames.add_pose)

    def take(message: Any, stamp_ns: int) -> None:
        add(message, stamp_ns)
        if uses_tf and getattr(message, "child_frame_id", "") not in ("", frames.camera_frame):
            transforms.listen()

    sources = [source("camera/pose", kind) for kind in kinds[pose_source]]
    reliability = node.parameters.inputs.reliability
    poses = node.listen("pose", sources, _stamped(take), reliability, POSE_DEPTH, node.wants_rest)
    if uses_tf:
        frames.expect_transforms()
        _fall_back_on_transforms(node, poses, transforms)


class _Transforms:
    """Subscriptions to /tf and /tf_static, created once."""

    def __init__(self, node: JoiningNode[Any], frames: PosedAssembler[Any, Any]) -> None:
        self._node = node
        self._take = node.taking(frames.add_transforms)
        self._is_listening = False

    def listen(self) -> None:
        """Subscribe at the first call; raises ConfigurationError without tf2_msgs."""
        if TFMessage is None:
            raise ConfigurationError(
                "parameter inputs.pose_source is 'tf', but tf2_msgs is not installed: install all "
                "of ROS 2, or publish poses on camera/pose"
            )
        if self._is_listening:
            return
        self._is_listening = True
        self._node.get_logger().info("listening to /tf and /tf_static")
        for topic, static in (("/tf", False), ("/tf_static", True)):

            def received(message: Any, topic: str = topic, static: bool = static) -> None:
                self._node.health.received(topic)
                self._take(message, static)

            profile = reliable(POSE_DEPTH, latched=static)
            self._node.create_subscription(TFMessage, topic, self._node.guarded(received), profile)


def _fall_back_on_transforms(
    node: StageNode, poses: AutoSubscription, transforms: _Transforms
) -> None:
    """Subscribe to TF after TF_AFTER_S without a publisher of poses.

    Not earlier: poses and TF may have different world frames, and a graph has one.
    """
    started_s = time.monotonic()

    def check() -> None:
        if not poses.was_published and time.monotonic() - started_s > TF_AFTER_S:
            transforms.listen()

    node.every(CHECK_PERIOD_S, check)


def _stamped(take: Taker) -> Callable[[Any], None]:
    return lambda message: take(message, stamp_ns_of(message))
