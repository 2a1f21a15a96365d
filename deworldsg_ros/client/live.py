"""A live copy of the graph from its topics, or of a part of it, and commands to its node."""

from __future__ import annotations

import json
import math
import secrets
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import rclpy
from diagnostic_msgs.srv import AddDiagnostics
from msgspec import structs
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from deworldsg_ros.base.words import visible
from deworldsg_ros.client.boxes import box_of
from deworldsg_ros.client.changes import Changes
from deworldsg_ros.client.goals import Robot
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.meanings import is_class
from deworldsg_ros.client.next_view import NOTHING
from deworldsg_ros.client.objects import Point
from deworldsg_ros.graph.embeddings import Looks
from deworldsg_ros.scene.errors import ClientError, NoService, RefusedInput
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import MOST_WAITING, GraphFollower, GraphReplica, empty_scene_graph

# The types of the services of graph_node: with JSON in `load_namespace`, and without arguments.
TEXT_SERVICE, TRIGGER_SERVICE = AddDiagnostics, Trigger
# Either of these nodes has the graph.
NODES = ("graph_node", "deworldsg_node")
# These publish a graph, too.
OTHERS = ("fleet_node", "region_node")
# The graph's thread may compile kernels, or write a large map.
TIMEOUT_S = 60.0
FIND_S = 10.0
# Between two looks whether the client was closed meanwhile.
STEP_S = 0.1
SPIN_PERIOD_S = 0.1
# Minimum time between two log lines of a kind: a function that fails may do so at each update.
LOG_PERIOD_S = 10.0

Callback = Callable[[SceneGraph, Changes], object]
GraphMessage = wire.SceneGraphMessage | wire.SceneGraphUpdateMessage


class _ToldReplica:
    """A copy of the graph that tells listeners each message that changed it.

    Args:
        call: calls a listener with a message, and does not raise.
    """

    def __init__(self, call: Callable[..., object]) -> None:
        self.graph = GraphReplica()
        self.listeners: list[Callable[[GraphMessage], object]] = []
        self._call = call

    @property
    def session(self) -> str | None:
        return self.graph.session

    @property
    def sequence(self) -> int:
        return self.graph.sequence

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        self.graph.reset(snapshot)
        self._tell(snapshot)

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        is_new = self.graph.apply(update)
        if is_new:
            self._tell(update)
        return is_new

    def _tell(self, message: GraphMessage) -> None:
        for listener in self.listeners:
            self._call(listener, message)


class SceneGraphClient:
    """Follows `/scene_graph` and `/scene_graph/updates`; use it in a `with` block.

    It starts from the latched snapshot and applies the numbered updates. After a gap it waits for
    the next snapshot, about a second, and continues from there. Messages arrive in a thread of its
    own.

    The commands from `set_label` to `command` call services of the node with the graph. They raise
    ClientError with the node's own words if the node refuses, or if there is no answer.

    Args:
        namespace: of the robot, e.g. ``/robot_1``; empty = the topics as they are.
        embeddings: follow `deworldsg/embeddings`, too, for `SceneGraph.similar`.
        context: rclpy context, which has to be initialised; None = one of its own.

    Attributes:
        refused: number of messages that could not be read.
        on_refused: called with the reason for each of them; None = the log has it.
    """

    def __init__(
        self, namespace: str = "", context: Context | None = None, *, embeddings: bool = False
    ) -> None:
        self.refused = 0
        self.on_refused: Callable[[RefusedInput], object] | None = None
        self._own_context = context is None
        self._context = context if context is not None else Context()
        self._namespace = namespace.rstrip("/")
        self._wants_embeddings = embeddings
        self._looks, self._looks_session = Looks("", {}), ""
        self._replica = _ToldReplica(self._survives)
        self._follower = GraphFollower(self._replica)
        # Made from the copy when somebody asks: a large graph changes more often than that.
        self._graph: SceneGraph | None = None
        self._told: SceneGraph | None = None
        self._is_outdated = False
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
            ("/scene_graph/updates", MOST_WAITING, self._update),
        ):
            self._node.create_subscription(
                String, self._namespace + topic, self._guarded(receive), _qos(depth)
            )
        if self._wants_embeddings:
            topic = f"{self._namespace}/deworldsg/embeddings"
            self._node.create_subscription(
                String, topic, self._guarded(self._embeddings, tells=False), _qos(1)
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
    def session(self) -> str | None:
        """Of the copy: in another session, ids may name other objects; None before the graph."""
        return self._replica.session

    @property
    def has_graph(self) -> bool:
        """Whether there is a graph to ask."""
        return self._follower.has_graph

    @property
    def gaps(self) -> int:
        """Number of times that updates were lost."""
        return self._follower.gaps

    @property
    def newest(self) -> SceneGraph | None:
        """The newest graph; None before the first one."""
        with self._changed:
            if self._is_outdated:
                self._graph = SceneGraph(self._replica.graph.message())
                if self._looks.vectors and self._looks_session == self._replica.session:
                    self._graph.looks = self._looks
                self._is_outdated = False
            return self._graph

    @property
    def graph(self) -> SceneGraph:
        """The newest graph; waits up to 10 s for the first one.

        Raises:
            ClientError: if none arrives.
        """
        return self.wait(timeout_s=10.0)

    def wait(self, sequence: int = 0, timeout_s: float = math.inf) -> SceneGraph:
        """The graph, as soon as it contains the update with this number.

        Raises:
            ClientError: if it does not arrive in time; in functions of `on_change`; after `close`.
        """
        end_s = time.monotonic() + min(timeout_s, threading.TIMEOUT_MAX)
        with self._changed:
            while not self.has_graph or self._replica.sequence < sequence:
                self._check_can_wait()
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    topic = f"{self._namespace}/scene_graph"
                    raise ClientError(
                        f"no graph on {topic} within {timeout_s:g} s: is graph_node running, and "
                        "are ROS_DOMAIN_ID and the namespace the same?"
                    )
                self._changed.wait(min(left_s, STEP_S))
            graph = self.newest
        assert graph is not None
        return graph

    def goal_near(
        self,
        of: int | str,
        distance_m: float = 1.0,
        robot: Robot = Robot(),
    ) -> dict[str, Any]:
        """A pose from which an object is in view, with the fields of `Goal.to_dict`.

        The node with the graph computes it and does not publish it: only this node has the depth
        images that show walls. The graphs of fleets and regions have no such node; there,
        ``seen_free`` is None and walls are not known.

        Args:
            of: id or class of the object.
            distance_m: horizontal distance from its box.
            robot: that is to stand there.

        Raises:
            ClientError: if there is no such object, or no free side of it.
        """
        try:
            return self.command(
                "goal_near", object=of, distance_m=distance_m, publish=False, **asdict(robot)
            )
        except NoService:
            return self.graph.goal_near(of, distance_m, robot=robot).to_dict()

    def next_view(self, robot: Robot = Robot(), start: Point | None = None) -> dict[str, Any]:
        """Where to look next, with the fields of `NextView.to_dict`; ``pose`` None = nowhere.

        As `goal_near`, the node computes it and does not publish it. It remembers what all views
        have shown since the first call. Where no node does, as for fleets and regions, it is
        computed from the copy, which knows rooms and objects, and no unseen space.

        Args:
            robot: that is to stand there.
            start: where it is, world frame; None = where the camera was in the newest frame.
        """
        try:
            return self.command("next_view", start=start, publish=False, **asdict(robot))
        except NoService:
            found = self.graph.next_view(robot=robot, start=start)
            return {"pose": None, "reason": NOTHING} if found is None else found.to_dict()

    def explain(self, what: int | str) -> dict[str, Any]:
        """Ask the node why an object is in its graph, or what it knows of a place.

        The node knows hidden objects, frames and seen space, which the copy of its topics has not.
        The copy answers where no node does, as for the graphs of fleets and regions.

        Args:
            what: id, class, or a place such as ``chair near (1.6, -0.5)``.

        Raises:
            ClientError: there is no such object or class.
        """
        try:
            return self.command("explain", object=what)
        except NoService:
            return self.graph.explain(what).to_dict()

    def on_change(self, callback: Callback) -> None:
        """Call a function with the new graph and the changes, after every change of the graph.

        It runs in the thread of the client, so it should be short. It must not wait for the client:
        there, commands and `wait` raise ClientError. If it raises an exception, this is logged with
        its traceback, and the client goes on.
        """
        self._callbacks.append(callback)

    def on_message(self, callback: Callable[[GraphMessage], object]) -> None:
        """Call a function with each message that changes the copy, in order: whole graphs, updates.

        It runs in the thread of the client, as in `on_change`; an exception is logged, too.
        """
        self._replica.listeners.append(callback)

    def name_room(self, room: int, name: str) -> dict[str, Any]:
        """Say what a room is called; an empty name takes it back."""
        return self.command("name_room", room=room, name=name)

    def set_label(self, node: int, label: str) -> dict[str, Any]:
        """Set the class of an object."""
        return self.command("set_label", node=node, label=label)

    def merge(self, a: int, b: int) -> dict[str, Any]:
        """Make two objects one; the answer has its id under ``nodes``."""
        return self.command("merge", nodes=[a, b])

    def split(self, node: int, near_m: tuple[Point, Point] | None = None) -> dict[str, Any]:
        """Make an object two; see `graph.edits.SplitNode`."""
        return self.command("split", node=node, near_m=near_m)

    def delete(self, node: int) -> dict[str, Any]:
        """Delete an object: it does not come back from the same place and class."""
        return self.command("delete", node=node)

    def undo(self) -> dict[str, Any]:
        """Undo the newest edit that was not undone yet, of any user."""
        answer: dict[str, Any] = json.loads(self._call("undo", None))
        return answer

    def save(self) -> str:
        """Write the files of the node; returns a sentence."""
        return self._call("save", None)

    def clear(self) -> str:
        """Begin with an empty graph; returns a sentence."""
        return self._call("clear", None)

    def load(self, path: str) -> str:
        """Continue with a map file of the robot; returns a sentence."""
        return self._call("load", {"path": path})

    def command(self, service: str, **request: Any) -> dict[str, Any]:
        """Call a service that takes and answers JSON.

        Ids are those of the session of this copy. A node whose graph has begun anew refuses them.
        """
        session = self._replica.session
        if session and any(name in request for name in ("node", "nodes", "object")):
            request["session"] = session
        answer: dict[str, Any] = json.loads(self._call(service, request))
        return answer

    def _spin(self) -> None:
        while not self._stop.is_set() and self._context.ok():
            if not self._survives(self._executor.spin_once, SPIN_PERIOD_S):
                self._stop.wait(SPIN_PERIOD_S)  # an error that stays must not take a whole core

    def _survives(self, function: Callable[..., object], *arguments: object) -> bool:
        """Call a function, and log an exception: without its thread, a client has an old graph."""
        try:
            function(*arguments)
        except Exception as error:
            if not self._stop.is_set() and self._context.ok():  # else it is the end of the client
                self._node.get_logger().error(
                    f"the client goes on after {error!r}\n{traceback.format_exc()}",
                    throttle_duration_sec=LOG_PERIOD_S,
                )
            return False
        return True

    def _guarded(
        self, receive: Callable[[Any], bool], *, tells: bool = True
    ) -> Callable[[Any], None]:
        def call(message: Any) -> None:
            try:
                with self._changed:
                    changed = receive(message.data)
                    if changed:
                        self._is_outdated = True
                        self._changed.notify_all()
            except RefusedInput as refusal:
                self.refused += 1
                if self.on_refused is not None:
                    self.on_refused(refusal)
                    return
                logger = self._node.get_logger()
                logger.warning(visible(str(refusal)), throttle_duration_sec=LOG_PERIOD_S)
                return
            if changed and tells and self._callbacks:
                self._tell_changes()

        return call

    def _snapshot(self, text: str) -> bool:
        return self._follower.snapshot(wire.decode(text, wire.SceneGraphMessage))

    def _update(self, text: str) -> bool:
        return self._follower.update(wire.decode(text, wire.SceneGraphUpdateMessage))

    def _embeddings(self, text: str) -> bool:
        message = wire.decode(text, wire.EmbeddingsMessage)
        session = message.session if isinstance(message.session, str) else ""
        known = self._looks if session == self._looks_session else Looks("", {})
        try:
            self._looks = known.after(message)
        except ValueError as error:
            raise RefusedInput("invalid_message", f"embeddings: {error}") from error
        self._looks_session = session
        return self.has_graph

    def _tell_changes(self) -> None:
        before, graph = self._told, self.newest
        assert graph is not None
        self._told = graph
        changes = graph.changes_since(before or SceneGraph(GraphReplica().message()))
        for callback in self._callbacks:
            self._survives(callback, graph, changes)

    def _check_can_wait(self) -> None:
        """Raise ClientError if nothing can arrive any more while this thread waits."""
        if threading.current_thread() is self._thread:
            raise ClientError(
                "the client's own thread cannot wait for what it has to receive itself: call this "
                "from another thread"
            )
        if self._stop.is_set():
            raise ClientError("the client is closed")

    def _call(self, service: str, request: dict[str, Any] | None) -> str:
        try:
            return self._answer(service, request)
        except ClientError:
            raise
        except Exception:
            self._check_can_wait()  # without its node, a closed client has errors of ROS
            raise

    def _answer(self, service: str, request: dict[str, Any] | None) -> str:
        kind = TRIGGER_SERVICE if request is None else TEXT_SERVICE
        client = self._node.create_client(kind, self._find(service))
        try:
            message = kind.Request()
            if request is not None:
                message.load_namespace = json.dumps(request)
            end_s = time.monotonic() + TIMEOUT_S
            arrived = threading.Event()
            while not client.service_is_ready() and time.monotonic() < end_s:
                self._check_can_wait()
                time.sleep(0.02)
            future = client.call_async(message)
            future.add_done_callback(lambda _: arrived.set())
            while not arrived.wait(STEP_S):
                self._check_can_wait()
                if not client.service_is_ready():
                    raise ClientError(f"no answer of {client.srv_name}: its node has ended")
                if time.monotonic() > end_s:
                    raise ClientError(f"no answer of {client.srv_name} within {TIMEOUT_S:g} s")
            response = future.result()
        finally:
            self._node.destroy_client(client)
        if not response.success:
            raise ClientError(response.message)
        return str(response.message)

    def _is_of_others(self) -> bool:
        """Whether the graph is that of a fleet or a region: their nodes have no services."""
        topic = f"{self._namespace}/scene_graph"
        publishers = self._node.get_publishers_info_by_topic(topic)
        names = [info.node_name for info in publishers if info.node_name in OTHERS]
        return bool(publishers) and len(names) == len(publishers)

    def _find(self, service: str) -> str:
        """The name of a service of the node with the graph."""
        end_s = time.monotonic() + FIND_S
        names = [f"{self._namespace}/{node}/{service}" for node in NODES]
        while time.monotonic() < end_s:
            self._check_can_wait()
            known = dict(self._node.get_service_names_and_types())
            found = [name for name in names if name in known]
            if found:
                return found[0]
            if self._is_of_others():
                raise NoService(
                    f"{self._namespace}/scene_graph is published by another node than "
                    f"{' or '.join(NODES)}: it has no {service}"
                )
            time.sleep(0.05)
        raise NoService(
            f"no service {' or '.join(names)} within {FIND_S:g} s: is graph_node running, and are "
            "ROS_DOMAIN_ID and the namespace the same?"
        )


def _qos(depth: int) -> QoSProfile:
    """As graph_node publishes; the snapshot is latched."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if depth == 1 else DurabilityPolicy.VOLATILE,
    )


# --- A part of a graph: the objects of some classes around a point, and the relations between them.


@dataclass(frozen=True)
class Region:
    """Where, how far, and what.

    Attributes:
        center: world frame, metres; None = nowhere.
        radius_m: largest distance of the centre of an object's box.
        classes: names of classes, as in questions; empty = all.
    """

    center: Point | None
    radius_m: float
    classes: tuple[str, ...] = ()

    def contains(self, node: wire.NodeState) -> bool:
        """Whether an object is inside."""
        if self.center is None:
            return False
        x, y, z = (a - b for a, b in zip(box_of(node)[0], self.center))
        if x * x + y * y + z * z > self.radius_m**2:
            return False
        return not self.classes or any(is_class(name, node.label) for name in self.classes)


class RegionPart:
    """Follows a graph and keeps the part of it that is in a region.

    A message of the graph costs as much as it is long, `message` as much as the part is large. Only
    a change of the region looks at the whole graph.

    Args:
        region: may be replaced by `move`.
    """

    def __init__(self, region: Region) -> None:
        self._region = region
        self._begin(empty_scene_graph(""))

    def _begin(self, message: wire.SceneGraphMessage | wire.SceneGraphUpdateMessage) -> None:
        """Forget the graph. Ids of a new session are other objects, so the part begins one too."""
        self._source: wire.SceneGraphMessage = structs.replace(
            empty_scene_graph(message.frame_id), session=message.session, sequence=0
        )
        self._session, self._sequence = secrets.token_hex(8), 0
        self._nodes: dict[int, wire.NodeState] = {}
        self._edges: dict[int, dict[int, wire.EdgeState]] = {}
        self._inside: set[int] = set()
        self._has_changed = message.frame_id != ""

    @property
    def size(self) -> int:
        """Number of objects inside."""
        return len(self._inside)

    def move(self, region: Region) -> None:
        """Change the region."""
        if region != self._region:
            self._region = region
            before = self._inside
            self._inside = {i for i, node in self._nodes.items() if region.contains(node)}
            self._has_changed |= before != self._inside

    def add(self, message: wire.SceneGraphMessage | wire.SceneGraphUpdateMessage) -> None:
        """Follow the next whole graph or update, in the order of `SceneGraphClient.on_message`."""
        update = message if isinstance(message, wire.SceneGraphUpdateMessage) else None
        if update is None or update.since == 0 or update.session != self._source.session:
            self._begin(message)
        if update is not None:
            for removed in update.removed_nodes:
                self._nodes.pop(removed.id, None)
                self._take_out(removed.id)
            for pair in update.removed_edges:
                self._edges.get(pair.subject, {}).pop(pair.object, None)
                self._note({pair.subject, pair.object})
        for node in message.nodes:
            self._nodes[node.id] = node
            if self._region.contains(node):
                self._inside.add(node.id)
                self._has_changed = True
            else:
                self._take_out(node.id)
        for edge in message.edges:
            self._edges.setdefault(edge.subject, {})[edge.object] = edge
            self._note({edge.subject, edge.object})
        self._source = structs.replace(self._source, stamp=message.stamp, up=message.up)

    def message(self) -> wire.SceneGraphMessage | None:
        """The part as a numbered graph of a session of its own; None = as at the last call."""
        if not self._has_changed:
            return None
        self._has_changed = False
        self._sequence += 1
        inside = sorted(self._inside)
        return structs.replace(
            self._source,
            session=self._session,
            sequence=self._sequence,
            nodes=[self._nodes[i] for i in inside],
            edges=[
                edge
                for i in inside
                for other, edge in sorted(self._edges.get(i, {}).items())
                if other in self._inside
            ],
        )

    def _take_out(self, node_id: int) -> None:
        self._has_changed |= node_id in self._inside
        self._inside.discard(node_id)

    def _note(self, ends: Iterable[int]) -> None:
        """Note that the relation of two objects changed."""
        self._has_changed |= self._inside.issuperset(ends)
