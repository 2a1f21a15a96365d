"""Running nodes as observations for the doctor: their diagnostics, and the ROS graph."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from deworldsg_ros.doctor import Observations
from deworldsg_ros.doctor.frame_checks import Header
from deworldsg_ros.ros.health import listened, observations_of
from deworldsg_ros.ros.qos import best_effort, source
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.images import DEPTH_ENCODINGS, header_of, info_topic
from deworldsg_ros.streams.poses import stamp_ns_of

# Types that may stand for each other on a topic.
FAMILIES = (
    ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    ("geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry"),
    ("sensor_msgs/msg/CameraInfo",),
)
INFO = "sensor_msgs/msg/CameraInfo"
CAMERA: dict[str, Any] = {
    "sensor_msgs/msg/Image": Image,
    "sensor_msgs/msg/CompressedImage": CompressedImage,
    INFO: CameraInfo,
}
# Our own topics are no input.
OWN = ("/deworldsg/", "/scene_graph")
# Small messages whose stamps are compared with the clock.
STAMPED = (CameraInfo, PoseStamped, Odometry)


def observe_nodes(seconds: float, context: Context | None = None) -> Observations:
    """Listen to /diagnostics, to the ROS graph and to stamps for some seconds.

    Args:
        seconds: nodes publish their diagnostics every second.
        context: of rclpy, initialised; None = one of its own.
    """
    own = context is None
    context = Context() if context is None else context
    if own:
        rclpy.init(context=context)
    node = rclpy.create_node(f"deworldsg_doctor_{os.getpid()}", context=context)
    try:
        return _Listener(node).listen(seconds)
    finally:
        node.destroy_node()
        if own:
            rclpy.shutdown(context=context)


class _Listener:
    def __init__(self, node: Node) -> None:
        self._node = node
        self._statuses: dict[str, dict[str, str]] = {}
        self._behind_s: dict[str, float] = {}
        self._stamped: set[str] = set()
        # The first message of each topic, and its subscription until then: images are large.
        self._first: dict[str, Any] = {}
        self._firsts: dict[str, Subscription] = {}
        self._units: dict[str, AsyncParameterClient] = {}
        self._scales: dict[str, Future] = {}
        node.create_subscription(DiagnosticArray, "/diagnostics", self._take, best_effort(50))

    def listen(self, seconds: float) -> Observations:
        """The observations after so many seconds."""
        executor = SingleThreadedExecutor(context=self._node.context)
        executor.add_node(self._node)
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=min(left_s, 0.2))
            self._listen_to_stamps()
            self._take_firsts()
        executor.shutdown(timeout_sec=1.0)
        return replace(
            observations_of(self._statuses),
            silent=self._silent(),
            incompatible=tuple(self._incompatible()),
            behind_s=self._behind_s,
            headers=self._headers(),
        )

    def _take(self, message: Any) -> None:
        for status in message.status:
            if status.hardware_id == "deworldsg_ros":
                self._statuses[status.name] = {item.key: item.value for item in status.values}

    def _listen_to_stamps(self) -> None:
        kinds = {source("", kind).type_name: kind for kind in STAMPED}
        for topic, type_name, _ in listened(self._statuses):
            if type_name in kinds and topic not in self._stamped:
                self._stamped.add(topic)
                self._node.create_subscription(
                    kinds[type_name], topic, self._noting(topic), best_effort(1)
                )

    def _take_firsts(self) -> None:
        """Take one message of each camera topic, and ask for the unit that nodes take depth in."""
        for topic in [topic for topic in self._firsts if topic in self._first]:
            self._node.destroy_subscription(self._firsts.pop(topic))
        wanted = {topic: name for topic, name, _ in listened(self._statuses) if name in CAMERA}
        beside = map(info_topic, wanted)
        wanted |= {topic: INFO for topic in beside if self._node.count_publishers(topic)}
        for topic, name in wanted.items():
            if topic not in self._first and topic not in self._firsts:
                self._firsts[topic] = self._node.create_subscription(
                    CAMERA[name], topic, partial(self._first.setdefault, topic), best_effort(1)
                )
        for name, values in self._statuses.items():
            if "received depth" not in values or name in self._scales:
                continue
            if name not in self._units:
                self._units[name] = AsyncParameterClient(self._node, name.split(": ")[-1])
            if self._units[name].services_are_ready():
                self._scales[name] = self._units[name].get_parameters(["inputs.depth_scale"])

    def _headers(self) -> dict[str, Header]:
        """What the first messages that nodes listen to say, by role."""
        answers = [future.result() for future in self._scales.values() if future.done()]
        scales = [value.double_value for answer in answers if answer for value in answer.values]
        headers: dict[str, Header] = {}
        for topic, name, _ in listened(self._statuses):
            message = self._first.get(topic)
            if message is None:
                continue
            if name == INFO:
                headers["camera_info"] = header_of(topic, message)
            elif not header_of(topic, message).encoding.startswith(DEPTH_ENCODINGS):
                headers["rgb"] = header_of(topic, message)
            else:
                info = self._first.get(info_topic(topic))
                headers["depth"] = header_of(topic, message, info, scales[0] if scales else 0.0)
        return headers

    def _noting(self, topic: str) -> Callable[[Any], None]:
        def note(message: Any) -> None:
            with contextlib.suppress(RefusedInput):  # a stamp below 0: the nodes count it
                self._behind_s[topic] = time.time() - stamp_ns_of(message) / 1e9

        return note

    def _silent(self) -> dict[str, tuple[str, ...]]:
        """Topics without a publisher, and the topics of the same family that have one."""
        published = {
            (topic, type_name)
            for topic, type_names in self._node.get_topic_names_and_types()
            for type_name in type_names
            if self._node.count_publishers(topic)
        }
        used = {topic for topic, _, _ in listened(self._statuses)}
        silent = {}
        for topic, type_name, _ in listened(self._statuses):
            family = next((names for names in FAMILIES if type_name in names), (type_name,))
            if not self._node.count_publishers(topic):
                silent[topic] = tuple(
                    sorted(
                        name
                        for name, kind in published
                        if kind in family
                        and name not in used
                        and not any(own in name for own in OWN)
                    )
                )
        return silent

    def _incompatible(self) -> list[str]:
        return [
            f"{topic} is published best effort, and a node wants it reliable"
            for topic, _, is_reliable in listened(self._statuses)
            if is_reliable
            and any(
                info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
                for info in self._node.get_publishers_info_by_topic(topic)
            )
        ]
