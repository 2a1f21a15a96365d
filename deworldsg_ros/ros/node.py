"""What the nodes share: start, parameters, guarded callbacks, diagnostics, a clean end."""

from __future__ import annotations

import contextlib
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from deworldsg_ros.ros.health import INTERNAL_ERROR, Health
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.ros.parameters import declare
from deworldsg_ros.ros.process import run_process
from deworldsg_ros.ros.qos import AutoSubscription, Source, reliable
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import RefusedInput

CHECK_PERIOD_S = 0.25
DIAGNOSTICS_PERIOD_S = 1.0
# A reason that repeats is logged this often at most.
LOG_PERIOD_S = 10.0
# The longest that a signal waits to be noticed.
SPIN_PERIOD_S = 0.2


class StageNode(Node):  # type: ignore[misc]
    """A node around one stage.

    Callbacks made by `guarded` never raise: what is refused is counted by its reason, what was
    not foreseen is counted as ``internal_error`` and logged with its traceback.

    Args:
        name: of the node.
        product: what it makes, for the diagnostics.

    Attributes:
        parameters: the configuration it runs with.
        health: its counts.
    """

    def __init__(self, name: str, product: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.parameters = declare(self, Parameters)
        self.get_logger().info("loading (a first start compiles kernels, up to a minute)")
        self.health = Health(product)
        self._logged_s: dict[str, float] = {}
        self._log_lock = threading.Lock()
        self._subscriptions_to_check: list[AutoSubscription] = []
        # Timers of this node follow real time, also where /clock is not published.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.every(CHECK_PERIOD_S, self._check_publishers)
        self.every(DIAGNOSTICS_PERIOD_S, self._diagnose)

    def waiting_for(self, now_ns: int) -> list[str]:
        """What is missing, in words; for subclasses to say."""
        return []

    def more_values(self) -> dict[str, str]:
        """More for the diagnostics, by name; for subclasses to say."""
        return {}

    def close(self) -> None:
        """End threads before the node goes; for subclasses to extend."""

    def every(self, period_s: float, function: Callable[[], None]) -> None:
        """Call a function periodically, in real time."""
        self.create_timer(period_s, self.guarded(function), clock=self._steady)

    def guarded(self, function: Callable[..., None]) -> Callable[..., None]:
        """The function, unable to raise."""

        def call(*arguments: Any) -> None:
            with self.refusing():
                function(*arguments)

        return call

    @contextlib.contextmanager
    def refusing(self) -> Iterator[None]:
        """Count and log what goes wrong inside, and go on."""
        try:
            yield
        except RefusedInput as refusal:
            self.drop(refusal.reason, str(refusal))
        except Exception as error:  # the node has to outlive what nobody foresaw
            # When the context is gone, publishing fails: that is the end, and no error.
            if rclpy.ok(context=self.context):
                self.drop(INTERNAL_ERROR, f"{error}\n{traceback.format_exc()}")

    def drop(self, reason: str, message: str, number: int = 1) -> None:
        """Count a drop and log it, the same reason not too often."""
        self.health.dropped(reason, number, message)
        now_s = time.monotonic()
        with self._log_lock:
            if now_s - self._logged_s.get(reason, -LOG_PERIOD_S) < LOG_PERIOD_S:
                return
            self._logged_s[reason] = now_s
        log = self.get_logger()
        if reason == INTERNAL_ERROR:
            log.error(f"{reason}: {message}")
        elif reason.startswith("unmatched_"):
            log.debug(f"{reason}: {message}")
        else:
            log.warning(f"{reason}: {message}")

    def listen(
        self,
        name: str,
        sources: Sequence[Source],
        callback: Callable[[Any], None],
        reliability: str,
        depth: int = 10,
    ) -> AutoSubscription:
        """Subscribe to whichever source is published, at the reliability that matches."""

        def received(message: Any) -> None:
            self.health.received(name)
            callback(message)

        subscription = AutoSubscription(
            self, sources, self.guarded(received), reliability=reliability, depth=depth
        )
        self._subscriptions_to_check.append(subscription)
        return subscription

    def listen_json(
        self, topic: str, kind: type[wire.M], callback: Callable[[wire.M], None], depth: int
    ) -> None:
        """Subscribe to JSON messages of one of the package's types."""

        def received(message: Any) -> None:
            self.health.received(topic)
            callback(wire.decode(message.data, kind))

        self.create_subscription(String, topic, self.guarded(received), reliable(depth))

    def json_publisher(
        self, topic: str, depth: int, *, latched: bool = False
    ) -> Callable[[wire.Message], None]:
        """A function that publishes JSON messages on a topic."""
        publisher = self.create_publisher(String, topic, reliable(depth, latched=latched))

        def publish(message: wire.Message) -> None:
            publisher.publish(String(data=wire.encode(message)))

        return publish

    def _check_publishers(self) -> None:
        for subscription in self._subscriptions_to_check:
            if subscription.check():
                self.get_logger().info(f"listening to {subscription.describe()}")

    def _diagnose(self) -> None:
        now_ns = time.monotonic_ns()
        listening = {
            f"listening to {index + 1}": subscription.describe()
            for index, subscription in enumerate(self._subscriptions_to_check)
        }
        report = self.health.report(
            now_ns / 1e9, self.waiting_for(now_ns), {**listening, **self.more_values()}
        )
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([report.level]),
                name=f"{self.get_name()}: {self.get_fully_qualified_name()}",
                message=report.message,
                hardware_id="deworldsg_ros",
                values=[KeyValue(key=key, value=value) for key, value in report.values.items()],
            )
        ]
        self._diagnostics.publish(message)


def run(make_node: Callable[[], StageNode], args: list[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM; returns the exit code, see `run_process`."""

    def body(stop: threading.Event) -> int:
        node = make_node()
        try:
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            node.get_logger().info("ready")
            while not stop.is_set() and rclpy.ok():
                with node.refusing():
                    executor.spin_once(timeout_sec=SPIN_PERIOD_S)
            executor.shutdown(timeout_sec=1.0)
        finally:
            node.close()
            node.destroy_node()
        return 0

    return run_process(body, args)
