"""A live copy of the graph from its topics."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from deworldsg_ros.client.changes import Changes
from deworldsg_ros.client.commands import GraphCommands
from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.replica import GraphReplica

# Updates that DDS keeps for this client; graph_node keeps as many.
UPDATE_DEPTH = 50
SPIN_PERIOD_S = 0.1

Callback = Callable[[SceneGraph, Changes], object]


class SceneGraphClient(GraphCommands):
    """Follows `/scene_graph` and `/scene_graph/updates`; use it in a `with` block.

    It starts from the latched snapshot and applies the numbered updates. After a gap it waits for
    the next snapshot, about a second, and continues from there. Messages arrive in a thread of its
    own. Its commands (`GraphCommands`) change the graph of the robot.

    Args:
        namespace: of the robot, e.g. ``/robot_1``; empty = the topics as they are.
        context: rclpy context, which has to be initialised; None = one of its own.

    Attributes:
        gaps: number of times that updates were lost.
        refused: number of messages that could not be read.
    """

    def __init__(self, namespace: str = "", context: Context | None = None) -> None:
        self.gaps = self.refused = 0
        self._own_context = context is None
        self._context = context if context is not None else Context()
        self._namespace = namespace.rstrip("/")
        self._replica = GraphReplica()
        self._graph: SceneGraph | None = None
        self._waiting: deque[wire.SceneGraphUpdateMessage] = deque(maxlen=UPDATE_DEPTH)
        self._callbacks: list[Callback] = []
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    def __enter__(self) -> SceneGraphClient:
        if self._own_context:
            rclpy.init(context=self._context)
        self._node = rclpy.create_node(
            f"scene_graph_client_{time.monotonic_ns() % 10**9}", context=self._context
        )
        for topic, depth, receive in (
            ("/scene_graph", 1, self._snapshot),
            ("/scene_graph/updates", UPDATE_DEPTH, self._update),
        ):
            self._node.create_subscription(
                String, self._namespace + topic, self._guarded(receive), _qos(depth)
            )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and the node."""
        if self._thread is None:
            return
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)
        self._thread = None
        self._executor.shutdown(timeout_sec=1.0)
        self._node.destroy_node()
        if self._own_context:
            self._context.try_shutdown()

    @property
    def newest(self) -> SceneGraph | None:
        """The newest graph; None before the first one."""
        return self._graph

    @property
    def graph(self) -> SceneGraph:
        """The newest graph; waits up to 10 s for the first one.

        Raises:
            ClientError: if none arrives.
        """
        return self._graph if self._graph is not None else self.wait(timeout_s=10.0)

    def wait(self, sequence: int = 0, timeout_s: float = math.inf) -> SceneGraph:
        """The graph, as soon as it contains the update with this number.

        Raises:
            ClientError: if it does not arrive in time.
        """
        end_s = time.monotonic() + min(timeout_s, threading.TIMEOUT_MAX)
        with self._changed:
            while self._graph is None or self._graph.sequence < sequence:
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    topic = f"{self._namespace}/scene_graph"
                    raise ClientError(
                        f"no graph on {topic} within {timeout_s:g} s: is graph_node running, and "
                        "are ROS_DOMAIN_ID and the namespace the same?"
                    )
                self._changed.wait(min(left_s, 1.0))
            return self._graph

    def on_change(self, callback: Callback) -> None:
        """Call a function with the new graph and the changes, after every change of the graph.

        It runs in the thread of the client, so it should be short.
        """
        self._callbacks.append(callback)

    def _spin(self) -> None:
        while not self._stop.is_set() and self._context.ok():
            self._executor.spin_once(timeout_sec=SPIN_PERIOD_S)

    def _guarded(self, receive: Callable[[Any], bool]) -> Callable[[Any], None]:
        def call(message: Any) -> None:
            try:
                changed = receive(message.data)
            except RefusedInput as refusal:
                self.refused += 1
                self._node.get_logger().warning(str(refusal), throttle_duration_sec=10.0)
                return
            if changed:
                self._publish(SceneGraph(self._replica.message()))

        return call

    def _snapshot(self, text: str) -> bool:
        snapshot = wire.decode(text, wire.SceneGraphMessage)
        same = self._graph is not None and (snapshot.session or None) == self._replica.session
        if same and snapshot.sequence <= self._replica.sequence:
            return False
        self._replica.reset(snapshot)
        # Updates that came during the gap, and are newer than the snapshot.
        waiting, self._waiting = self._waiting, deque(maxlen=UPDATE_DEPTH)
        for update in waiting:
            self._apply(update)
        return True

    def _update(self, text: str) -> bool:
        return self._apply(wire.decode(text, wire.SceneGraphUpdateMessage))

    def _apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply an update, or keep it until a snapshot closes the gap before it."""
        try:
            return self._replica.apply(update)
        except RefusedInput:
            self.gaps += self._graph is not None and not self._waiting
            self._waiting.append(update)
            return False

    def _publish(self, graph: SceneGraph) -> None:
        before = self._graph
        with self._changed:
            self._graph = graph
            self._changed.notify_all()
        if self._callbacks:
            changes = graph.changes_since(before or SceneGraph(GraphReplica().message()))
            for callback in self._callbacks:
                callback(graph, changes)


def _qos(depth: int) -> QoSProfile:
    """As graph_node publishes; the snapshot is latched."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if depth == 1 else DurabilityPolicy.VOLATILE,
    )
