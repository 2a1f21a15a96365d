"""replay_node: publishes a bag or data set folder on the topics of the pipeline."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import Trigger

from deworldsg_ros.base.words import counted
from deworldsg_ros.recordings import replaying, source
from deworldsg_ros.recordings.bags.topics import parse_topics
from deworldsg_ros.recordings.folders.dataset import DatasetOptions, parse_intrinsics
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.replaying import Pace, Window, topic_of
from deworldsg_ros.recordings.source import RawRoleMessage, Role, Source
from deworldsg_ros.ros.health import (
    DROPPED,
    LISTENERS,
    LOST_PREFIX,
    UNMATCHED_PREFIX,
    count_in,
    counts_in,
    received_in,
)
from deworldsg_ros.ros.node import refuse, run_process
from deworldsg_ros.ros.options import ReplayParameters
from deworldsg_ros.ros.parameters import declare
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError
from deworldsg_ros.wire import messages as wire

# --- The state of the pipeline behind a replay: connections, processed frames, drops.
#
# It is read from existing topics: DDS discovery, the local graphs and evidence that graph_node
# receives, and /diagnostics.

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
    # segmentation_node listens to them only with `perception.detector: topic`.
    Role.DETECTIONS: set(),
    Role.DETECTION_INSTANCES: set(),
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


# --- replay_node: publishes a bag or data set folder on the topics of the pipeline.
#
# Messages of a bag are published byte for byte. Poses are computed from TF, and messages from
# folders, during the replay. The node waits for the pipeline and limits the frames in flight, so
# that a slow machine loses no frame.

CLASSES = {
    source.IMAGE: Image,
    source.COMPRESSED_IMAGE: CompressedImage,
    source.CAMERA_INFO: CameraInfo,
    source.POSE_STAMPED: PoseStamped,
    source.ODOMETRY: Odometry,
    source.STRING: String,
}
# Messages that DDS keeps for a subscriber: more than the window of a replay, and small in memory.
PUBLISHER_DEPTH = 10
# Without the four nodes: a viewer or a recorder subscribes within this time.
LISTENER_WAIT_S = 4.0
# Without a result for this time, a node has failed or hangs: the slowest step, a large model on a
# CPU, takes seconds per frame.
STALL_S = 30.0
# Longest delay until a signal is noticed.
SPIN_PERIOD_S = 0.1
EXIT_NOT_READY = 3


class NotReady(DeWorldSGError):
    """The four nodes did not start in time."""


class Stopped(Exception):
    """SIGINT or SIGTERM arrived."""


class ReplayNode(Node):
    """Publishes a recording; `replay` runs from the first message to the last.

    Args:
        stop: set by a signal.
        stop_early: set by `replaying.STOP_EARLY`; None = never.
        options: arguments of rclpy's Node.

    Raises:
        ConfigurationError: for an unknown parameter, or without a recording.
        RecordingError: for a recording that cannot be read.
    """

    def __init__(
        self, stop: threading.Event, stop_early: threading.Event | None = None, **options: Any
    ) -> None:
        super().__init__("replay_node", **options)
        self._stop = stop
        self._stop_early = stop_early or threading.Event()
        parameters = declare(self, ReplayParameters)
        self._options = parameters.node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._source = _open_recording(parameters)
        self._outputs = {
            role: self._publisher(role, topic.msgtype)
            for role, topic in self._source.topics.items()
            if role is not Role.POSE or not self._options.odometry
        }
        self._clock_output = (
            self.create_publisher(Clock, "/clock", 10) if self._options.clock else None
        )
        self._monitor = PipelineMonitor(self, odometry=self._options.odometry)
        self._pace = Pace(self._options.rate)
        self._published = 0
        self._reported_s = 0.0

    def replay(self) -> None:
        """Wait for the nodes, publish everything, wait until it is processed.

        Raises:
            NotReady: if the nodes are required and do not start in time.
            Stopped: after a signal.
        """
        alone = not self._wait_for_pipeline()
        if alone:
            self._wait_for_listeners()
        self._emit(replaying.Started(self._source.frame_count))
        for message in self._source.raw_messages():
            if message.role in self._outputs:
                self._wait_until_due(message, alone)
                if self._stop_early.is_set():
                    break
                self._publish(message)
                self._emit_progress()
        self._monitor.window.close()
        drained = alone or self._drain()
        if self._options.save and not alone:
            self._save()
        self._emit_progress(at_once=True)
        self._finish(drained)

    def close(self) -> None:
        """Close the recording and the executor."""
        self._source.close()
        self._executor.shutdown(timeout_sec=1.0)

    def _publisher(self, role: Role, msgtype: str) -> Any:
        # TF is replayed as the poses computed from it.
        kind = source.POSE_STAMPED if msgtype == source.TF_MESSAGE else msgtype
        topic = topic_of(role, kind).lstrip("/")
        return self.create_publisher(CLASSES[kind], topic, reliable(PUBLISHER_DEPTH))

    def _publish(self, message: RawRoleMessage) -> None:
        self._outputs[message.role].publish(message.data)
        if self._clock_output is not None:
            sec, nanosec = divmod(message.log_time_ns, 10**9)
            self._clock_output.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))
        if message.role is Role.RGB:
            self._published += 1
            self._monitor.window.publish(message.stamp_ns)
        else:
            self._monitor.window.passed(message.role, message.stamp_ns)

    def _spin(self, seconds: float) -> None:
        self._executor.spin_once(timeout_sec=max(0.0, min(seconds, SPIN_PERIOD_S)))
        if self._stop.is_set():
            raise Stopped

    def _wait_for_pipeline(self) -> bool:
        """Whether the four nodes are connected within `wait_s`."""
        wait_s = self._options.wait_s
        end_s = time.monotonic() + wait_s
        endpoints = {
            role: Endpoint(output.topic_name, output) for role, output in self._outputs.items()
        }
        missing = ["the four nodes"]
        while wait_s > 0 and time.monotonic() < end_s:
            missing = self._monitor.connections.missing(endpoints, time.monotonic())
            if not missing:
                return True
            if time.monotonic() - self._reported_s > 1.0:
                self._reported_s = time.monotonic()
                self._emit(replaying.Waiting(missing))
            self._spin(SPIN_PERIOD_S)
        if self._options.save:
            raise NotReady(
                f"after {wait_s:g} s still waiting for: {'; '.join(missing)}. Start the four nodes "
                "first, or raise wait_s; save:=true requires them"
            )
        if wait_s > 0:
            self.get_logger().warning(
                f"no pipeline after {wait_s:g} s (missing: {'; '.join(missing)}): replaying "
                "without waiting for results"
            )
        return False

    def _wait_for_listeners(self) -> None:
        """Wait until a subscriber has discovered the topics, at most LISTENER_WAIT_S."""
        end_s = time.monotonic() + LISTENER_WAIT_S
        while time.monotonic() < end_s and not self._has_listener():
            self._spin(SPIN_PERIOD_S)
        end_s = time.monotonic() + SETTLE_S
        while time.monotonic() < end_s:
            self._spin(SPIN_PERIOD_S)

    def _has_listener(self) -> bool:
        return any(output.get_subscription_count() for output in self._outputs.values())

    def _wait_until_due(self, message: RawRoleMessage, alone: bool) -> None:
        now_s = time.monotonic()
        due_s = self._pace.due_s(message.log_time_ns, now_s)
        while now_s < due_s and not self._stop_early.is_set():
            self._spin(due_s - now_s)
            now_s = time.monotonic()
        self._spin(0.0)
        # The other messages of a frame surround its RGB image, so only the image has to wait.
        while (
            message.role is Role.RGB
            and not alone
            and not self._stop_early.is_set()
            and self._monitor.has_to_wait(STALL_S, time.monotonic())
        ):
            self._spin(SPIN_PERIOD_S)
            self._emit_progress()
        self._pace.late(time.monotonic() - now_s)

    def _drain(self) -> bool:
        """Wait until all frames are processed; False if no result comes for STALL_S."""
        while not self._monitor.drained(time.monotonic()):
            if self._monitor.silent_for(time.monotonic()) > STALL_S:
                self._monitor.window.give_up()
                return False
            self._spin(SPIN_PERIOD_S)
            self._emit_progress()
        return True

    def _save(self) -> None:
        future = self._monitor.request_save()
        end_s = time.monotonic() + STALL_S
        while not future.done() and time.monotonic() < end_s:
            self._spin(SPIN_PERIOD_S)
        if future.done():
            response = future.result()
            self._emit(replaying.Saved(response.success, response.message))
        else:
            self._emit(replaying.Saved(False, f"no response from graph_node for {STALL_S:g} s"))

    def _finish(self, drained: bool) -> None:
        window = self._monitor.window
        self._emit(
            replaying.Finished(
                published=self._published,
                processed=window.results,
                without_result=window.given_up,
                drained=drained,
                diagnostics=self._monitor.diagnostics,
                drops=dict(self._source.drops),
                losses=list(dict.fromkeys(self._source.losses)),
                poses=self._monitor.poses,
            )
        )
        self.get_logger().info(f"done: {counted(self._published, 'frame')} published")

    def _emit_progress(self, *, at_once: bool = False) -> None:
        now_s = time.monotonic()
        if at_once or now_s - self._reported_s > 0.2:
            self._reported_s = now_s
            monitor = self._monitor
            self._emit(replaying.Progress(self._published, monitor.window.results, monitor.nodes))

    def _emit(self, event: replaying.Event) -> None:
        if self._options.events:
            print(replaying.encode(event), flush=True)


def _open_recording(parameters: ReplayParameters) -> Source:
    options = parameters.node
    if not options.recording:
        raise ConfigurationError(
            "parameter recording is empty, expected the path of a bag or a data set folder: add "
            "-p recording:=PATH"
        )
    return open_source(
        Path(options.recording),
        topics=parse_topics(options.topics),
        inputs=parameters.inputs,
        options=DatasetOptions(intrinsics=parse_intrinsics(options.intrinsics)),
        need_poses=not options.odometry,
    )


def main(args: list[str] | None = None) -> int:
    """Run the node; 0 at the end or after a signal, 2 for unusable input, 3 without the nodes."""
    stop_early = threading.Event()
    signal.signal(replaying.STOP_EARLY, lambda *_: stop_early.set())

    def body(stop: threading.Event) -> int:
        node = ReplayNode(stop, stop_early)
        try:
            node.replay()
        except NotReady as error:
            return refuse(error, EXIT_NOT_READY)
        except Stopped:
            pass
        finally:
            node.close()
            node.destroy_node()
        return 0

    return run_process(body, args)


if __name__ == "__main__":
    sys.exit(main())
