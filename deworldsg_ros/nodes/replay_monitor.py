"""What a replay knows of the pipeline behind it: who is connected, who is done, what was dropped.

All of it is read from topics that are there anyway: discovery, the local graphs and evidence that
go to the graph node, and /diagnostics.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import msgspec
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from deworldsg_ros.recordings.messages import Role
from deworldsg_ros.recordings.pacing import Window
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene import wire

SEGMENTATION, LIFTING, RELATION, GRAPH, ODOMETRY = (
    "segmentation_node",
    "lifting_node",
    "relation_node",
    "graph_node",
    "odometry_node",
)
LISTENERS = {
    Role.RGB: {SEGMENTATION, RELATION},
    Role.DEPTH: {SEGMENTATION, LIFTING},
    Role.CAMERA_INFO: {SEGMENTATION, LIFTING},
    Role.POSE: {SEGMENTATION, LIFTING},
}
# Topic: who publishes it, and who listens.
BETWEEN = {
    "deworldsg/frame_graph": ({SEGMENTATION}, {LIFTING}),
    "deworldsg/instances": ({SEGMENTATION}, {LIFTING}),
    "deworldsg/local_graph": ({LIFTING}, {RELATION, GRAPH}),
    "deworldsg/relation_evidence": ({RELATION}, {GRAPH}),
}
ODOMETRY_LISTENS_TO = (Role.RGB, Role.DEPTH, Role.CAMERA_INFO)
POSES_OF_ODOMETRY = {"camera/pose": ({ODOMETRY}, {SEGMENTATION, LIFTING})}
# Each participant tells of its endpoints on its own: what is seen here is soon seen everywhere.
SETTLE_S = 1.0
# How long evidence may lag behind the last local graph before it is taken to be all.
EVIDENCE_QUIET_S = 3.0
# How long the first answer of all may take.
FIRST_ANSWER_S = 300.0
RECEIVED = re.compile(r"(\d+) in all")


class _LocalGraph(msgspec.Struct):
    """The parts of a local graph that are read here."""

    stamp: wire.Stamp
    T_world_camera: wire.Matrix4


@dataclass(frozen=True)
class Endpoint:
    """A publisher of the replay, and the full name of its topic."""

    topic: str
    publisher: Any


class PipelineMonitor:
    """Watches the nodes.

    Args:
        node: of the replay.
        window: most frames in flight.
        odometry: whether odometry_node makes the poses.

    Attributes:
        window: frames published and answered.
        diagnostics: what each node told last, by its name.
        poses: T_world_camera of the local graphs, 16 values each.
    """

    def __init__(self, node: Node, window: int, *, odometry: bool) -> None:
        self._node = node
        self.window = Window(window, (Role.DEPTH,) if odometry else (Role.DEPTH, Role.POSE))
        self._listening = {
            role: names | ({ODOMETRY} if odometry and role in ODOMETRY_LISTENS_TO else set())
            for role, names in LISTENERS.items()
        }
        self._between = {**BETWEEN, **(POSES_OF_ODOMETRY if odometry else {})}
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.poses: list[list[float]] = []
        self._local_graphs = self._evidence = 0
        self._refused_frames = 0
        self._complete_since_s: float | None = None
        self._heard_s: float | None = None
        node.create_subscription(String, "deworldsg/local_graph", self._on_local, reliable(50))
        node.create_subscription(
            String, "deworldsg/relation_evidence", self._on_evidence, reliable(50)
        )
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self._save = node.create_client(Trigger, f"{GRAPH}/save")

    @property
    def nodes(self) -> int:
        """Nodes in the graph, as the graph node told last."""
        return int(self.diagnostics.get(GRAPH, {}).get("nodes", 0))

    def missing(self, endpoints: dict[Role, Endpoint], now_s: float) -> list[str]:
        """Connections that are not there yet, in words; empty once all are, for a while."""
        missing: list[str] = []
        for role, endpoint in endpoints.items():
            listeners = self._listeners(endpoint.topic)
            missing += [
                f"{name} to listen to {endpoint.topic}"
                for name in sorted(self._listening[role] - listeners)
            ]
            wanted = len(self._listening[role])
            if not missing and endpoint.publisher.get_subscription_count() < wanted:
                missing.append(f"a connection on {endpoint.topic}")
        for topic, (publishers, listeners) in self._between.items():
            full_name = self._node.resolve_topic_name(topic)
            infos = self._node.get_publishers_info_by_topic(full_name)
            absent = publishers - {info.node_name for info in infos}
            missing += [f"{name} to publish {full_name}" for name in sorted(absent)]
            absent = listeners - self._listeners(full_name)
            missing += [f"{name} to listen to {full_name}" for name in sorted(absent)]
        if missing:
            self._complete_since_s = None
            return missing
        if self._complete_since_s is None:
            self._complete_since_s = now_s
        return [] if now_s - self._complete_since_s >= SETTLE_S else ["discovery to settle"]

    def give_up_after(self, stall_s: float, now_s: float) -> None:
        """Stop waiting for frames in flight where nobody has answered for so long."""
        if not self.window.answered:
            # Kernels may still be compiled for the first frame.
            stall_s = max(stall_s, FIRST_ANSWER_S)
        if self.silent_for(now_s) > stall_s:
            self._node.get_logger().warning(
                f"no local graph for {stall_s:g} s: {self.window.in_flight} frames are given up"
            )
            self.window.give_up()
            self._heard_s = now_s

    def silent_for(self, now_s: float) -> float:
        """Seconds since the last sign of progress, or since this was first asked."""
        if self._heard_s is None:
            self._heard_s = now_s
        return now_s - self._heard_s

    def drained(self, now_s: float) -> bool:
        """Whether the graph node has taken in everything that will come."""
        silent_s = self.silent_for(now_s)
        if self.window.in_flight:
            return False
        all_evidence = self._evidence >= self._local_graphs - self._drops(RELATION)
        if not (all_evidence or silent_s > EVIDENCE_QUIET_S):
            return False
        if int(self.diagnostics.get(RELATION, {}).get("clips pending", 0)):
            return False
        return (
            self._received(GRAPH, "deworldsg/local_graph") >= self._local_graphs
            and self._received(GRAPH, "deworldsg/relation_evidence") >= self._evidence
        )

    def request_save(self) -> Any:
        """A future of the answer of graph_node's service ~/save."""
        return self._save.call_async(Trigger.Request())

    def _listeners(self, topic: str) -> set[str]:
        return {info.node_name for info in self._node.get_subscriptions_info_by_topic(topic)}

    def _on_local(self, message: Any) -> None:
        local = msgspec.json.decode(message.data, type=_LocalGraph)
        self.poses.append(local.T_world_camera)
        self._local_graphs += 1
        self._heard_s = None
        self.window.answer(wire.ns_from_stamp(local.stamp))

    def _on_evidence(self, message: Any) -> None:
        self._evidence += 1
        self._heard_s = None

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            if status.hardware_id == "deworldsg_ros":
                name = status.name.split(":")[0]
                self.diagnostics[name] = {item.key: item.value for item in status.values}
        refused = self._drops(SEGMENTATION) + self._drops(LIFTING)
        if refused > self._refused_frames:
            self.window.excuse(refused - self._refused_frames)
            self._refused_frames = refused
            self._heard_s = None

    def _drops(self, name: str) -> int:
        """Frames that a node has refused; messages that belonged to no frame do not count."""
        return sum(
            int(value)
            for key, value in self.diagnostics.get(name, {}).items()
            if key.startswith("dropped ") and not key.startswith("dropped unmatched_")
        )

    def _received(self, name: str, topic: str) -> int:
        match = RECEIVED.search(self.diagnostics.get(name, {}).get(f"received {topic}", ""))
        return int(match[1]) if match else 0
