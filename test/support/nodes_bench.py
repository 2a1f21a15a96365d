"""A node in the process of the test, publishers on its input topics, and valid messages."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String
from support import merging
from support.failing_backend import Backend
from support.nodes import peer

from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.perception import Perception
from deworldsg_ros.ros import models
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.streams.images import fill_image
from deworldsg_ros.streams.poses import set_stamp
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import local_graph_to_message

WIDTH, HEIGHT = 64, 48
STEP_NS = 100 * 10**6
LIMIT_S = 20.0


def stamped(message: Any, stamp_ns: int, frame_id: str = "camera") -> Any:
    set_stamp(message, stamp_ns)
    message.header.frame_id = frame_id
    return message


def image(pixels: np.ndarray, encoding: str, stamp_ns: int) -> Image:
    message = Image()
    fill_image(message, pixels, encoding)
    return stamped(message, stamp_ns)


def rgb(stamp_ns: int) -> Image:
    return image(np.zeros((HEIGHT, WIDTH, 3), np.uint8), "rgb8", stamp_ns)


def depth(stamp_ns: int, height: int = HEIGHT) -> Image:
    return image(np.full((height, WIDTH), 1500, np.uint16), "16UC1", stamp_ns)


def camera_info(stamp_ns: int) -> CameraInfo:
    message = CameraInfo(width=WIDTH, height=HEIGHT)
    message.k = [60.0, 0.0, 32.0, 0.0, 60.0, 24.0, 0.0, 0.0, 1.0]
    return stamped(message, stamp_ns)


def pose(stamp_ns: int, x: float = 0.0, frame_id: str = "map") -> PoseStamped:
    message = PoseStamped()
    message.pose.position.x = x
    message.pose.orientation.w = 1.0
    return stamped(message, stamp_ns, frame_id)


def instances(stamp_ns: int, value: int = 0) -> Image:
    return image(np.full((HEIGHT, WIDTH), value, np.uint16), "mono16", stamp_ns)


def schema(kind: type[wire.Message], stamp_ns: int, frame_id: str) -> dict[str, Any]:
    return {
        "schema": wire.schema_of(kind),
        "stamp": wire.stamp_from_ns(stamp_ns),
        "frame_id": frame_id,
        "classes": ["chair", "cup"],
        "predicates": ["on"],
    }


def frame_graph(stamp_ns: int) -> wire.FrameGraphMessage:
    return wire.FrameGraphMessage(
        **schema(wire.FrameGraphMessage, stamp_ns, "camera"),
        width=WIDTH,
        height=HEIGHT,
        objects=[],
        relations=[],
    )


def local_graph(
    stamp_ns: int, count: int = 1, predicates: tuple[str, ...] = ("on",)
) -> wire.LocalGraphMessage:
    """A chair, and a cup beside it if there are two."""
    graph = merging.local_graph(
        stamp_ns,
        np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])[:count],
        np.tile(0.01 * np.eye(3), (count, 1, 1)),
        np.array([[0.9, 0.1], [0.1, 0.9]])[:count],
        vocabulary=Vocabulary(("chair", "cup"), predicates),
        frame_id="map",
    )
    return local_graph_to_message(replace(graph, width=WIDTH, height=HEIGHT))


def evidence(stamp_ns: int) -> wire.RelationEvidenceMessage:
    return wire.RelationEvidenceMessage(
        **schema(wire.RelationEvidenceMessage, stamp_ns, "map"), source="none", pairs=[]
    )


def overrides(parameters: dict[str, Any]) -> list[Parameter]:
    return [Parameter(name, value=value) for name, value in parameters.items()]


@contextlib.contextmanager
def alone(
    make: type[StageNode], parameters: dict[str, Any] | None = None, **options: Any
) -> Iterator[Any]:
    """A node that nobody spins, in a context of its own: one allows one message type per topic."""
    if parameters is not None:
        options["parameter_overrides"] = overrides(parameters)
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = make(context=context, **options)
        try:
            yield node
        finally:
            node.close()
            node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)


class Bench(contextlib.ExitStack):
    """A node in the process of the test, and a peer with publishers on its input topics.

    `parameters` are the node's overrides, by name; `with` closes both.
    """

    def __init__(
        self,
        make: type[StageNode],
        topics: dict[str, type],
        qos: QoSProfile | None = None,
        parameters: dict[str, Any] | None = None,
        **options: Any,
    ) -> None:
        super().__init__()
        self.peer = self.enter_context(peer("bench"))
        self.node = self.enter_context(alone(make, parameters, **options))
        self.executor = SingleThreadedExecutor(context=self.node.context)
        self.executor.add_node(self.node)
        self.callback(self.executor.shutdown, timeout_sec=1.0)
        self.peer.also_spin.append(self.executor)
        self._publishers = {
            topic: self.peer.node.create_publisher(kind, topic, qos or reliable(50))
            for topic, kind in topics.items()
        }
        self.stamp_ns = 1_700_000_000 * 10**9
        self.peer.spin_until(
            lambda: all(p.get_subscription_count() > 0 for p in self._publishers.values()),
            LIMIT_S,
            "the node to subscribe",
        )

    def send(self, **messages: Any) -> None:
        """Publish messages. A keyword is a topic with __ for /."""
        for name, message in messages.items():
            if isinstance(message, msgspec.Struct):
                message = String(data=wire.encode(message))
            elif isinstance(message, str):
                message = String(data=message)
            self._publishers[name.replace("__", "/")].publish(message)

    def send_made(self, **makers: Callable[[int], Any] | None) -> None:
        """Publish what functions of the next stamp make; None = nothing."""
        stamp_ns = self.next_stamp()
        self.send(**{name: make(stamp_ns) for name, make in makers.items() if make is not None})

    def next_stamp(self) -> int:
        self.stamp_ns += STEP_NS
        return self.stamp_ns

    def products(self) -> int:
        """A number that grows with every processed frame."""
        if isinstance(self.node, GraphNode):  # the merging rule decides whether it publishes
            return self.node.graph.newest_ns
        return self.node.health.products

    def expect(self, condition: Callable[[], bool], what: str) -> None:
        self.peer.spin_until(condition, LIMIT_S, f"{what}; drops are {self.node.health.drops}")

    def refuses(self, reason: str, provoke: Callable[[], None], number: int = 1) -> None:
        """Expect `number` refusals for a reason after `provoke`."""
        before = self.node.health.drops.get(reason, 0)
        provoke()
        self.expect(
            lambda: self.node.health.drops.get(reason, 0) >= before + number, f"a drop of {reason}"
        )


CAMERA = {
    "rgb/image_raw": Image,
    "depth/image_raw": Image,
    "rgb/camera_info": CameraInfo,
    "camera/pose": PoseStamped,
}
# What relation_node listens to.
PAIRING = {"rgb/image_raw": Image, "deworldsg/local_graph": String}


# Makers of the messages of a complete frame, functions of the stamp.
FRAME = {
    "rgb__camera_info": camera_info,
    "camera__pose": pose,
    "depth__image_raw": depth,
    "rgb__image_raw": rgb,
}


def send_frame(at: Bench, **changes: Any) -> None:
    """Send a complete frame; `changes` replaces makers, None omits the message."""
    at.send_made(**{**FRAME, **changes})


def send_pair(at: Bench) -> int:
    """Send an image and a local graph of two objects; returns their stamp."""
    stamp_ns = at.next_stamp()
    pair = local_graph(stamp_ns, 2, ("on", "under", "near"))
    at.send(rgb__image_raw=rgb(stamp_ns), deworldsg__local_graph=pair)
    return stamp_ns


def fake_perception(patch: pytest.MonkeyPatch) -> None:
    """Nodes are made with this test double of all models."""
    patch.setattr(
        models,
        "build_perception",
        lambda config, **options: Perception(*[Backend()] * 3, config, **options),
    )


def works(at: Bench, send: Callable[[], None]) -> None:
    before = at.products()
    send()
    at.expect(lambda: at.products() > before, "a product")


def changed(make: Callable[[int], Any], **fields: Any) -> Callable[[int], Any]:
    """A maker of messages with some fields changed."""

    def make_changed(stamp_ns: int) -> Any:
        message = make(stamp_ns)
        for name, value in fields.items():
            setattr(message, name, value)
        return message

    return make_changed
