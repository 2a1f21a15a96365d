"""The state of the pipeline behind a replay: connections, processed frames, drops.

It is read from existing topics: DDS discovery, the local graphs and evidence that graph_node
receives, and /diagnostics.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from deworldsg_ros.recordings.messages import Role
from deworldsg_ros.recordings.pacing import Window
from deworldsg_ros.ros.health import (
    DROPPED,
    LISTENERS,
    LOST_PREFIX,
    UNMATCHED_PREFIX,
    count_in,
    counts_in,
    received_in,
)
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene import wire

SEGMENTATION, LIFTING, RELATION, GRAPH, ODOMETRY = (
    "segmentation_node",
    "lifting_node",
    "relation_node",
    "graph_node",
    "odometry_node",
)
# relation_node listens to RGB too if its world model reads clips.
LISTENERS_OF_INPUTS = {
    Role.RGB: {SEGMENTATION},
    Role.DEPTH: {SEGMENTATION, LIFTING},
    Role.CAMERA_INFO: {SEGMENTATION, LIFTING},
    Role.POSE: {SEGMENTATION, LIFTING},
}
LOCAL_GRAPH, EVIDENCE = "deworldsg/local_graph", "deworldsg/relation_evidence"
# Topic: its publishers, its subscribers.
BETWEEN = {
    "deworldsg/frame_graph": ({SEGMENTATION}, {LIFTING}),
    "deworldsg/instances": ({SEGMENTATION}, {LIFTING}),
    LOCAL_GRAPH: ({LIFTING}, {RELATION, GRAPH}),
    EVIDENCE: ({RELATION}, {GRAPH}),
}
ODOMETRY_LISTENS_TO = (Role.RGB, Role.DEPTH, Role.CAMERA_INFO)
POSES_OF_ODOMETRY = {"camera/pose": ({ODOMETRY}, {SEGMENTATION, LIFTING})}
# One frame in segmentation_node, and one that waits for it or is in another node: with more, a slow
# segmentation_node would drop those that wait too long.
WINDOW_FRAMES = 2
# DDS announces each endpoint to each participant separately: endpoints that are seen here may be
# unknown elsewhere for a moment. Without word from the nodes, they are known everywhere after this.
SETTLE_S = 1.0
# Longest delay of evidence after the last local graph.
EVIDENCE_QUIET_S = 3.0
# The frames of these nodes have no result if the node is killed.
BEFORE_RESULTS = {SEGMENTATION, LIFTING, ODOMETRY}
# Between two looks at which nodes are there; a look takes milliseconds.
LOOK_PERIOD_S = 1.0
# Compiling the kernels for the first frame takes minutes on a small machine.
FIRST_RESULT_S = 300.0


class _LocalGraph(msgspec.Struct):
    """The fields of a local graph that are read here."""

    stamp: wire.Stamp
    T_world_camera: wire.Pose


@dataclass(frozen=True)
class Endpoint:
    """A publisher of the replay, and the full name of its topic."""

    topic: str
    publisher: Any


class Restarts:
    """Notices restarted nodes by their new endpoints; those of a killed node stay for seconds.

    Args:
        node: node of the replay.
        topics: of the endpoints.
    """

    def __init__(self, node: Node, topics: Collection[str]) -> None:
        self._node = node
        self._topics = topics
        self._known: set[tuple[str, bytes]] = set()

    def look(self) -> list[str]:
        """The nodes of `BEFORE_RESULTS` that were restarted since the last call."""
        found = {
            (info.node_name, bytes(info.endpoint_gid))
            for topic in map(self._node.resolve_topic_name, self._topics)
            for info in (
                *self._node.get_publishers_info_by_topic(topic),
                *self._node.get_subscriptions_info_by_topic(topic),
            )
            if info.node_name in BEFORE_RESULTS
        }
        known, self._known = self._known, found
        return sorted({name for name, _ in found - known}) if known else []


class Connections:
    """The connections between the replay and the nodes, and among the nodes.

    Args:
        node: node of the replay.
        diagnostics: newest values of each node, by its name.
        odometry: whether odometry_node publishes the poses.

    Attributes:
        between: publishers and subscribers of each topic between the nodes.
    """

    def __init__(
        self, node: Node, diagnostics: Mapping[str, Mapping[str, str]], *, odometry: bool
    ) -> None:
        self._node = node
        self._diagnostics = diagnostics
        self._listening = {
            role: names | ({ODOMETRY} if odometry and role in ODOMETRY_LISTENS_TO else set())
            for role, names in LISTENERS_OF_INPUTS.items()
        }
        self.between = {**BETWEEN, **(POSES_OF_ODOMETRY if odometry else {})}
        self._complete_since_s: float | None = None

    def missing(self, endpoints: dict[Role, Endpoint], now_s: float) -> list[str]:
        """Missing connections, in words.

        Empty once all nodes have told that they are connected, or all endpoints have existed for
        SETTLE_S.
        """
        missing = self._missing_listeners(endpoints) + self.missing_between()
        if missing:
            self._complete_since_s = None
            return missing
        if self._complete_since_s is None:
            self._complete_since_s = now_s
        return self._unconnected() if now_s - self._complete_since_s < SETTLE_S else []

    def _missing_listeners(self, endpoints: dict[Role, Endpoint]) -> list[str]:
        missing: list[str] = []
        for role, endpoint in endpoints.items():
            absent = self._listening[role] - self._listeners(endpoint.topic)
            missing += [f"{name} to listen to {endpoint.topic}" for name in sorted(absent)]
            expected = len(self._listening[role])
            if not missing and endpoint.publisher.get_subscription_count() < expected:
                missing.append(f"a connection on {endpoint.topic}")
        return missing

    def missing_between(self) -> list[str]:
        """Missing connections between the nodes, in words."""
        missing: list[str] = []
        for topic, (publishers, listeners) in self.between.items():
            full_name = self._node.resolve_topic_name(topic)
            infos = self._node.get_publishers_info_by_topic(full_name)
            absent = publishers - {info.node_name for info in infos}
            missing += [f"{name} to publish {full_name}" for name in sorted(absent)]
            absent = listeners - self._listeners(full_name)
            missing += [f"{name} to listen to {full_name}" for name in sorted(absent)]
        return missing

    def _unconnected(self) -> list[str]:
        """Nodes that have not told that all listeners of their topics are connected."""
        missing: list[str] = []
        for topic, (publishers, _) in self.between.items():
            full_name = self._node.resolve_topic_name(topic)
            expected = len(self._node.get_subscriptions_info_by_topic(full_name))
            for name in sorted(publishers):
                told = count_in(self._diagnostics.get(name, {}), f"{LISTENERS}{full_name}")
                if told < expected:
                    missing.append(f"{name} to connect to the listeners of {full_name}")
        return missing

    def _listeners(self, topic: str) -> set[str]:
        return {info.node_name for info in self._node.get_subscriptions_info_by_topic(topic)}


class PipelineMonitor:
    """Watches the nodes.

    Args:
        node: node of the replay.
        odometry: whether odometry_node publishes the poses.

    Attributes:
        window: frames in flight.
        diagnostics: newest values of each node, by its name.
        connections: between the nodes.
        poses: T_world_camera of the local graphs, 16 values each, row by row.
    """

    def __init__(self, node: Node, *, odometry: bool) -> None:
        self._node = node
        needs = (Role.DEPTH,) if odometry else (Role.DEPTH, Role.POSE)
        self.window = Window(WINDOW_FRAMES, needs)
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.connections = Connections(node, self.diagnostics, odometry=odometry)
        self.poses: list[list[float]] = []
        self._local_graphs = self._evidence = 0
        self._refused: dict[str, int] = {}
        # Messages that graph_node did not receive because it was restarted, by topic.
        self._missed: dict[str, int] = {}
        self._progress_s: float | None = None
        self._own_pace = False
        self._looked_s = 0.0
        self._restarts = Restarts(node, self.connections.between)
        self._restarted_s = math.inf
        node.create_subscription(String, LOCAL_GRAPH, self._on_local, reliable(50))
        node.create_subscription(String, EVIDENCE, self._on_evidence, reliable(50))
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self._save = node.create_client(Trigger, f"{GRAPH}/save")

    @property
    def nodes(self) -> int:
        """Number of nodes in the graph, by the newest diagnostics of graph_node."""
        return count_in(self.diagnostics.get(GRAPH, {}), "nodes")

    def has_to_wait(self, stall_s: float, now_s: float) -> bool:
        """Whether the next frame waits for results of the frames in flight.

        A node that is restarted has lost its frames: the replay goes on when it is connected. If a
        node has gone, or there was no result for `stall_s`, the replay keeps its own pace and
        waits for nothing, until there is a result again.
        """
        if not self.window.is_full:
            return False
        if not self._own_pace:
            stall_s = stall_s if self.window.results else max(stall_s, FIRST_RESULT_S)
            problem = self._look(now_s)
            if now_s - self._restarted_s >= SETTLE_S:
                self._restarted_s, self._progress_s = math.inf, None
                self.window.give_up()
                return False
            if self.silent_for(now_s) > stall_s:
                problem = f"no local graph for {stall_s:g} s"
            if not problem:
                return True
            self._own_pace = True
            self._node.get_logger().warning(
                f"{problem}: stopped waiting for {self.window.in_flight} frames, and replaying at "
                "its own pace until there are results again; the log of each node has the cause"
            )
        self.window.give_up()
        return False

    def _look(self, now_s: float) -> str:
        """Note restarted nodes; returns what a node that has ended leaves missing, "" = nothing."""
        if now_s < self._looked_s + LOOK_PERIOD_S:
            return ""
        self._looked_s = now_s
        restarted = self._restarts.look()
        if restarted:
            self._restarted_s = now_s
            names, lost = " and ".join(restarted), self.window.in_flight
            self._node.get_logger().warning(f"{names} restarted: {lost} frames are lost")
        missing = self.connections.missing_between()
        return f"waiting for {missing[0]}" if missing else ""

    def silent_for(self, now_s: float) -> float:
        """Seconds since the last progress, or since the first call after it."""
        if self._progress_s is None:
            self._progress_s = now_s
        return now_s - self._progress_s

    def drained(self, now_s: float) -> bool:
        """Whether graph_node has received all local graphs and all evidence."""
        silent_s = self.silent_for(now_s)
        if self.window.in_flight:
            return False
        all_evidence = self._evidence >= self._local_graphs - self._drops(RELATION)
        if not (all_evidence or silent_s > EVIDENCE_QUIET_S):
            return False
        if count_in(self.diagnostics.get(RELATION, {}), "clips pending"):
            return False
        return (
            self._received(LOCAL_GRAPH) >= self._local_graphs
            and self._received(EVIDENCE) >= self._evidence
        )

    def request_save(self) -> Any:
        """A future of the response of graph_node's service ~/save."""
        return self._save.call_async(Trigger.Request())

    def _on_local(self, message: Any) -> None:
        try:
            local = msgspec.json.decode(message.data, type=_LocalGraph)
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            self._node.get_logger().warning(f"a local graph is ignored: {error}")
            return
        self.poses.append(local.T_world_camera)
        self._local_graphs += 1
        self._progress_s = None
        self._own_pace = False
        self.window.add_result(wire.ns_from_stamp(local.stamp))

    def _on_evidence(self, message: Any) -> None:
        self._evidence += 1
        self._progress_s = None

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            # /diagnostics is shared: other robots have nodes of the same names.
            name, _, full_name = status.name.partition(": ")
            if status.hardware_id == "deworldsg_ros" and full_name == self._full_name(name):
                self._take_values(name, {item.key: item.value for item in status.values})

    def _take_values(self, name: str, values: dict[str, str]) -> None:
        """Note the newest values of a node; the counts of a restarted node begin again."""
        before, self.diagnostics[name] = self.diagnostics.get(name, {}), values
        if name == GRAPH:
            for topic, sent in ((LOCAL_GRAPH, self._local_graphs), (EVIDENCE, self._evidence)):
                count = received_in(values, topic)
                if count < received_in(before, topic):
                    self._missed[topic] = sent - count
        elif name in (SEGMENTATION, LIFTING):
            refused = self._drops(name)
            known = self._refused.get(name, 0)
            self._refused[name] = refused
            new = refused - known if refused >= known else refused
            if new:
                self.window.excuse(new)
                self._progress_s = None

    def _full_name(self, name: str) -> str:
        """Full name of a node in the namespace of the replay."""
        return f"{self._node.get_namespace().rstrip('/')}/{name}"

    def _drops(self, name: str) -> int:
        """Frames that a node has dropped; unmatched and lost messages are not frames."""
        drops = counts_in(self.diagnostics.get(name, {}), DROPPED)
        return sum(
            n
            for reason, n in drops.items()
            if not reason.startswith((UNMATCHED_PREFIX, LOST_PREFIX))
        )

    def _received(self, topic: str) -> int:
        """Messages that graph_node received, or missed because it was restarted."""
        return received_in(self.diagnostics.get(GRAPH, {}), topic) + self._missed.get(topic, 0)
