"""Node processes, and a camera that publishes a recording to them."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String

from deworldsg_ros.recordings.source import RawRoleMessage, Role
from deworldsg_ros.ros.qos import reliable

ROOT = Path(__file__).resolve().parents[2]
KINDS = {
    "sensor_msgs/msg/Image": Image,
    "sensor_msgs/msg/CompressedImage": CompressedImage,
    "sensor_msgs/msg/CameraInfo": CameraInfo,
    "geometry_msgs/msg/PoseStamped": PoseStamped,
    "nav_msgs/msg/Odometry": Odometry,
}
TOPICS = {
    Role.RGB: "rgb/image_raw",
    Role.DEPTH: "depth/image_raw",
    Role.CAMERA_INFO: "rgb/camera_info",
    Role.POSE: "camera/pose",
}
# Number of the nodes that subscribe to each topic. relation_node takes images for clips only.
SUBSCRIBERS = {Role.RGB: 1, Role.DEPTH: 2, Role.CAMERA_INFO: 2, Role.POSE: 2}


class NodeProcess(subprocess.Popen):
    """One node process; `with` ends it."""

    def __init__(
        self, name: str, folder: Path, *arguments: str, parameters: dict[str, Any] | None = None
    ) -> None:
        values = [f"{key}:={value}" for key, value in (parameters or {}).items()]
        given = ["--ros-args", *(word for value in values for word in ("-p", value))]
        self.name = name
        self.log_path = folder / f"{name}.log"
        # This checkout precedes the paths of a sourced ROS 2.
        python_path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {
            **os.environ,
            "PYTHONPATH": python_path,
            "ROS_LOG_DIR": str(folder / "ros"),
        }
        command = [sys.executable, "-m", f"deworldsg_ros.nodes.{name}", *given, *arguments]
        with self.log_path.open("w") as log:
            super().__init__(
                command, env=environment, cwd=folder, stdout=log, stderr=subprocess.STDOUT
            )

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def log(self) -> str:
        return self.log_path.read_text()

    @property
    def alive(self) -> bool:
        return self.poll() is None

    def wait_ready(self, limit_s: float = 150.0) -> None:
        wait_until(lambda: "ready" in self.log or not self.alive, limit_s, f"{self.name} to start")
        assert self.alive, self.log

    def interrupt(self, limit_s: float = 20.0) -> int:
        """Send SIGINT and wait; returns the exit code."""
        self.send_signal(signal.SIGINT)
        return self.wait(limit_s)

    def end(self) -> None:
        """End the process with SIGINT, then SIGTERM, then SIGKILL."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            self.send_signal(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.wait(5)
                return


def run_to_end(name: str, folder: Path, *arguments: str, **options: Any) -> tuple[int, str]:
    """Exit code and output of a node that ends by itself."""
    with NodeProcess(name, folder, *arguments, **options) as node:
        return node.wait(60.0), node.log


def wait_until(
    condition: Callable[[], bool],
    limit_s: float,
    what: str,
    step: Callable[[], object] = lambda: time.sleep(0.02),
) -> None:
    """Wait for a condition. `what` names it if the time is over."""
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s, f"waited {limit_s:g} s for {what}"
        step()


class Peer:
    """A node in the process of the test, with its own context."""

    def __init__(self, name: str) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = Node(name, context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.also_spin: list[SingleThreadedExecutor] = []

    def spin_until(self, condition: Callable[[], bool], limit_s: float, what: str) -> None:
        wait_until(condition, limit_s, what, self._spin_once)

    def spin_for(self, duration_s: float) -> None:
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            self._spin_once()

    def _spin_once(self) -> None:
        for executor in (self._executor, *self.also_spin):
            executor.spin_once(timeout_sec=0.01)

    def listen(
        self,
        kind: type,
        topic: str,
        depth: int = 100,
        *,
        latched: bool = False,
        parts: Callable[[Any], Any] = lambda message: [message],
    ) -> list[Any]:
        """A list that receives the messages of a topic, or parts of them."""
        received: list[Any] = []
        profile = reliable(depth, latched=latched)
        self.node.create_subscription(kind, topic, lambda it: received.extend(parts(it)), profile)
        return received

    def collect(self, topic: str, depth: int = 100, *, latched: bool = False) -> list[str]:
        return self.listen(String, topic, depth, latched=latched, parts=lambda it: [it.data])

    def statuses(self) -> list[DiagnosticStatus]:
        return self.listen(DiagnosticArray, "/diagnostics", 50, parts=lambda it: it.status)

    def close(self) -> None:
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@contextlib.contextmanager
def peer(name: str = "test_peer") -> Iterator[Peer]:
    made = Peer(name)
    try:
        yield made
    finally:
        made.close()


class Camera:
    """Publishes the unchanged messages of a recording."""

    def __init__(self, peer: Peer, messages: list[RawRoleMessage]) -> None:
        self._peer = peer
        self._messages = messages
        kinds = {message.role: KINDS[message.msgtype] for message in messages}
        self._publishers = {
            role: peer.node.create_publisher(kind, TOPICS[role], reliable(10))
            for role, kind in kinds.items()
        }

    def wait_for_subscribers(self, limit_s: float = 30.0) -> None:
        """Wait until all nodes have subscribed, so that no message is lost."""
        self._peer.spin_until(
            lambda: all(
                publisher.get_subscription_count() >= SUBSCRIBERS[role]
                for role, publisher in self._publishers.items()
            ),
            limit_s,
            "the nodes to subscribe to the camera",
        )

    def publish(self, message: RawRoleMessage, data: bytes) -> None:
        self._publishers[message.role].publish(data)

    def frames(self) -> Iterator[int]:
        """Publish one frame after the other. Yields the stamp of a frame after its messages."""
        stamps_ns = sorted({item.stamp_ns for item in self._messages})
        for stamp_ns in stamps_ns:
            for item in self._messages:
                if item.stamp_ns == stamp_ns:
                    self._publishers[item.role].publish(bytes(item.data))
            yield stamp_ns
