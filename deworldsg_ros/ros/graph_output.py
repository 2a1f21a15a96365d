"""Topics of a graph besides its updates: the whole graph, markers, detections, /tf."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import suppress
from copy import copy
from importlib import import_module
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple, Union

import msgspec
import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from deworldsg_ros.graph.embeddings import embeddings_message
from deworldsg_ros.graph.extent import DEFAULT_UP
from deworldsg_ros.graph.floor_plan import FloorPlan, FoundThings, floor_plan
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph.rooms import RoomMap
from deworldsg_ros.graph.surface import Surface, SurfaceOfSpace, objects_at
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.ros.threads import Worker
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import ChangeLog

if TYPE_CHECKING:
    from deworldsg_ros.ros.transforms import ObjectTransforms

# --- A graph that is made as a whole, on topics like those of graph_node.

# The whole graph is for those who join late, as that of graph_node.
WHOLE_PERIOD_S = 1.0


class GraphTopics:
    """Publishes `PREFIX/scene_graph`, once a second, and `PREFIX/scene_graph/updates`, at once.

    A `SceneGraphClient` with the namespace ``/PREFIX`` follows them.

    Args:
        node: publishes.
        prefix: of the topics.

    Attributes:
        log: the graph that was published last.
    """

    def __init__(self, node: StageNode, prefix: str) -> None:
        self.log = ChangeLog()
        self._sequence = 0
        self._session: str | None = None
        self._publish_whole = node.text_publisher(f"{prefix}/scene_graph", 1, latched=True)
        self._whole: wire.SceneGraphMessage | None = None
        node.every(WHOLE_PERIOD_S, self._tell_whole)
        self._publish_update = node.json_publisher(f"{prefix}/scene_graph/updates", 50)

    def publish(self, graph: wire.SceneGraphMessage) -> None:
        """Publish a graph, if it has a new number."""
        self.log.set(graph)
        update = self.log.since(self._session, self._sequence)
        if update is None:
            return
        self._session, self._sequence = update.session or None, update.sequence
        self._publish_update(update)
        self._whole = graph

    def _tell_whole(self) -> None:
        graph, self._whole = self._whole, None
        if graph is not None:
            self._publish_whole(wire.encode(graph))


# --- Markers of `view.markers` as ROS messages.

KINDS = {"sphere": Marker.SPHERE, "text": Marker.TEXT_VIEW_FACING, "arrow": Marker.ARROW}


def marker_array(markers: Iterable[Any], frame_id: str, stamp: Any) -> MarkerArray:
    """All markers of the graph, after a marker that deletes the previous ones.

    A viewer that joins late or loses messages thus shows the same as any other.

    Args:
        markers: as `view.markers.Marker`.
        frame_id: world frame.
        stamp: builtin_interfaces/Time.
    """
    clear = Marker(action=Marker.DELETEALL)
    clear.header.frame_id, clear.header.stamp = frame_id, stamp
    array = MarkerArray(markers=[clear])
    for item in markers:
        marker = Marker(type=KINDS[item.kind], action=Marker.ADD, ns=item.namespace, id=item.id)
        marker.header.frame_id, marker.header.stamp = frame_id, stamp
        position, orientation = marker.pose.position, marker.pose.orientation
        position.x, position.y, position.z = map(float, item.position)
        orientation.x, orientation.y, orientation.z, orientation.w = map(float, item.quat_xyzw)
        marker.scale.x, marker.scale.y, marker.scale.z = map(float, item.scale)
        colour = marker.color
        colour.r, colour.g, colour.b, colour.a = map(float, item.rgba)
        marker.text = item.text
        marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in item.points]
        array.markers.append(marker)
    return array


# --- The objects of the graph as vision_msgs/Detection3DArray, where that package is installed.

# The messages of the package vision_msgs; None = it is not installed.
VISION_MSGS: Any = None
with suppress(ImportError):
    VISION_MSGS = import_module("vision_msgs.msg")

TOPIC = "scene_graph/detections"


def detection_array(graph: wire.SceneGraphMessage, stamp: Any, messages: Any = VISION_MSGS) -> Any:
    """All objects that have a box.

    The score of a class is its probability times that of existence. The pose of a hypothesis is the
    mean of the visible surface, with the covariance of the Gaussian.

    Args:
        graph: a snapshot.
        stamp: builtin_interfaces/Time.
        messages: the package vision_msgs.msg.
    """
    array = messages.Detection3DArray()
    array.header.frame_id, array.header.stamp = graph.frame_id, stamp
    for node in graph.nodes:
        if not isinstance(node.box, wire.GravityBox):
            continue
        detection = messages.Detection3D(id=str(node.id))
        detection.header.frame_id, detection.header.stamp = graph.frame_id, stamp
        _set(detection.bbox.center.position, "xyz", node.box.center_m)
        _set(detection.bbox.center.orientation, "xyzw", node.box.orientation_xyzw)
        _set(detection.bbox.size, "xyz", node.box.size_m)
        existence = node.existence if isinstance(node.existence, float) else 1.0
        for belief in node.classes:
            result = messages.ObjectHypothesisWithPose()
            result.hypothesis.class_id = belief.label
            result.hypothesis.score = existence * belief.probability
            _set(result.pose.pose.position, "xyz", node.mean_m)
            result.pose.pose.orientation.w = 1.0
            result.pose.covariance = _six_by_six(node.covariance_m2)
            detection.results.append(result)
        array.detections.append(detection)
    return array


def _set(target: Any, names: str, values: list[float]) -> None:
    for name, value in zip(names, values):
        setattr(target, name, float(value))


def _six_by_six(covariance_m2: list[float]) -> list[float]:
    """(36,) row by row: position first; the orientation has no covariance."""
    rows = [covariance_m2[3 * row : 3 * row + 3] + [0.0] * 3 for row in range(3)]
    return [float(value) for row in [*rows, *([[0.0] * 6] * 3)] for value in row]


# --- The embeddings of the nodes, for those who want them.

EMBEDDINGS_TOPIC = "deworldsg/embeddings"
EMBEDDINGS_PERIOD_S = 1.0


class EmbeddingTopic:
    """Publishes embeddings of a graph that have changed, once a second, while somebody listens.

    A new subscriber gets all of them.
    """

    def __init__(self, node: StageNode) -> None:
        self._publisher = node.create_publisher(String, EMBEDDINGS_TOPIC, reliable(1, latched=True))
        self._listeners, self._session = 0, ""
        self._is_needed, self._due_s = False, 0.0

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until `publish` looks again, 0 = now; None for a graph without embeddings."""
        return max(0.0, self._due_s - now_s) if self._is_needed else None

    def publish(self, builder: GraphBuilder | None, session: str, now_s: float) -> None:
        """Publish what is due."""
        self._is_needed = builder is not None and bool(builder.graph.embeddings.model)
        if builder is None or not self._is_needed or now_s < self._due_s:
            return
        self._due_s = now_s + EMBEDDINGS_PERIOD_S
        listeners = self._publisher.get_subscription_count()
        whole = listeners > self._listeners or session != self._session
        self._listeners = listeners
        graph = builder.graph
        if not listeners:
            graph.embeddings.changed.clear()  # the next subscriber gets all
            return
        self._session = session
        message = embeddings_message(graph.embeddings, whole, builder.newest_ns, graph.frame_id)
        if message is not None:
            message.session = session
            self._publisher.publish(String(data=wire.encode(message)))
            self._due_s += (time.monotonic() - now_s) / MAX_SHARE


# --- The room: its surface as coloured points, and its floor plan, for those who want them.

POINTS_TOPIC, MAP_TOPIC = "scene_graph/points", "scene_graph/map"
ROOM_PERIOD_S = 2.0
# Fields of a point: `rgb` as PCL and RViz read it, and the id of the object that it belongs to.
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("object", "<u4")])


def point_cloud(
    surface: Surface, nodes: Sequence[wire.NodeState], frame_id: str, stamp: Any
) -> PointCloud2:
    """The kept points of a surface, with colours and ids of objects (0 = none).

    Args:
        surface: of the room.
        nodes: of the graph.
        frame_id: world frame.
        stamp: builtin_interfaces/Time.
    """
    points, colours, _ = surface.kept()
    values = np.zeros(len(points), POINT)
    for axis, name in enumerate("xyz"):
        values[name] = points[:, axis]
    values["rgb"] = colours.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    values["object"] = objects_at(points, nodes)
    kinds = {"object": PointField.UINT32}
    offsets: Any = POINT.fields
    cloud = PointCloud2(
        height=1, width=len(values), point_step=POINT.itemsize, row_step=values.nbytes
    )
    cloud.header.frame_id, cloud.header.stamp = frame_id, stamp
    cloud.is_dense = True
    cloud.fields = [
        PointField(
            name=name,
            offset=int(offsets[name][1]),
            datatype=kinds.get(name, PointField.FLOAT32),
            count=1,
        )
        for name in POINT.names or ()
    ]
    cloud.data = array("B", values.tobytes())
    return cloud


def occupancy_grid(plan: FloorPlan, frame_id: str, stamp: Any) -> OccupancyGrid:
    """A floor plan; its origin turns if the world's z axis does not point up."""
    grid = OccupancyGrid()
    grid.header.frame_id, grid.header.stamp = frame_id, stamp
    grid.info.map_load_time = stamp
    grid.info.resolution = plan.cell_m
    grid.info.height, grid.info.width = plan.cells.shape
    _set(grid.info.origin.position, "xyz", plan.T_world_plan[:3, 3].tolist())
    turn = quaternion_from_rotation(plan.T_world_plan[:3, :3])
    _set(grid.info.origin.orientation, "xyzw", turn.tolist())
    grid.data = array("b", plan.cells.tobytes())
    return grid


class _Room(NamedTuple):
    """What is to be published, and for whom."""

    space: SeenSpace
    snapshot: wire.SceneGraphMessage
    points: bool
    height_m: float  # of the robot; 0 = the plan has no subscriber


class RoomTopics:
    """Publishes the room when it has changed, while somebody listens, and to new subscribers.

    The surface is made in a thread of its own, of the views that the graph keeps; it costs nothing
    without subscribers.
    """

    def __init__(self, node: StageNode) -> None:
        self._node = node
        self._points = node.create_publisher(PointCloud2, POINTS_TOPIC, reliable(1, latched=True))
        self._plan = node.create_publisher(OccupancyGrid, MAP_TOPIC, reliable(1, latched=True))
        # What was published last, and for whom.
        self._known = SeenSpace()
        self._wanted: tuple[float, ...] = ()
        self._due_s, self._is_needed = 0.0, False
        self._surface = SurfaceOfSpace()
        self._worker: Worker[_Room] = Worker(
            "room", self._work, size=1, on_overrun=lambda room: None
        )

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until `publish` looks again, 0 = now; None for a graph without views."""
        return max(0.0, self._due_s - now_s) if self._is_needed else None

    def publish(self, builder: GraphBuilder | None, now_s: float) -> None:
        """Publish what is due."""
        self._is_needed = builder is not None and len(builder.space) > 0
        if builder is None or not self._is_needed or now_s < self._due_s:
            return
        self._due_s = now_s + ROOM_PERIOD_S
        listeners = [p.get_subscription_count() for p in (self._points, self._plan)]
        if not any(listeners):
            self._wanted = ()
            return
        space = copy(builder.space)  # its arrays are replaced, and never changed
        known, wanted = self._known, (self._node.parameters.output.robot_height_m, *listeners)
        is_same = space.stamps_ns is known.stamps_ns and space.poses is known.poses
        if (is_same and wanted == self._wanted) or not self._worker.wait_idle(0.0):
            return
        self._known, self._wanted = space, wanted
        height_m = wanted[0] if listeners[1] else 0.0
        self._worker.submit(_Room(space, builder.snapshot(), listeners[0] > 0, height_m))

    def close(self) -> None:
        """End the thread."""
        self._worker.stop()

    def _work(self, room: _Room) -> None:
        started_s = time.monotonic()
        snapshot = room.snapshot
        stamp = Time(sec=snapshot.stamp.sec, nanosec=snapshot.stamp.nanosec)
        up = snapshot.up if isinstance(snapshot.up, list) else DEFAULT_UP
        with self._node.refusing():
            surface = self._surface.of(room.space)
            if room.points:
                cloud = point_cloud(surface, snapshot.nodes, snapshot.frame_id, stamp)
                self._points.publish(cloud)
            if room.height_m:
                plan = floor_plan(room.space, up, room.height_m, surface)
                if plan is not None:
                    self._plan.publish(occupancy_grid(plan, snapshot.frame_id, stamp))
        now_s = time.monotonic()
        self._due_s = max(self._due_s, now_s + (now_s - started_s) / MAX_SHARE)


# --- Rooms, and things that no detector fires at, found in the background.

# A change of the views or of the objects is in the rooms after this time, or later: they and the
# things cost at most `ROOMS_SHARE` of a core.
ROOMS_PERIOD_S, ROOMS_SHARE = 5.0, 0.05

Search = Callable[[], FoundThings]


class RoomFinder:
    """Finds the rooms of a graph, and its things, anew when its views or objects have changed.

    Args:
        node: counts errors.
        found: called in the thread of this, with the graph, the rooms that it had, the new
            ones with their messages, and the things.
    """

    def __init__(
        self,
        node: StageNode,
        found: Callable[[GraphBuilder, RoomMap, RoomMap, list[wire.RoomState], FoundThings], None],
    ) -> None:
        self._node, self._found = node, found
        self._due_s, self._is_needed = 0.0, False
        # Of what the rooms were found in last.
        self._known: tuple[Any, Any, int] = None, None, -1
        self._worker: Worker[tuple[GraphBuilder, SeenSpace | None, Any, Search]] = Worker(
            "rooms", self._work, size=1, on_overrun=lambda job: None
        )

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until `look` looks again, 0 = now; None for a graph without views."""
        return max(0.0, self._due_s - now_s) if self._is_needed else None

    def look(self, builder: GraphBuilder | None, now_s: float) -> None:
        """Begin to find the rooms if it is time and something has changed."""
        self._is_needed = builder is not None and builder.has_rooms
        if builder is None or not self._is_needed or now_s < self._due_s:
            return
        self._due_s = now_s + ROOMS_PERIOD_S
        space, snapshot = copy(builder.space), builder.snapshot()  # neither changes any more
        is_same = space.stamps_ns is self._known[0] and space.poses is self._known[1]
        if (is_same and snapshot.sequence == self._known[2]) or not self._worker.wait_idle(0.0):
            return
        self._known = space.stamps_ns, space.poses, snapshot.sequence
        search = builder.search(snapshot.nodes)
        self._worker.submit((builder, None if is_same else space, snapshot, search))

    def close(self) -> None:
        """End the thread."""
        self._worker.stop()

    def _work(self, job: tuple[GraphBuilder, SeenSpace | None, Any, Search]) -> None:
        started_s, (builder, space, snapshot, search) = time.monotonic(), job
        before = builder.rooms
        with self._node.refusing():
            up = snapshot.up if isinstance(snapshot.up, list) else DEFAULT_UP
            rooms = before if space is None else before.found_in(space, up)
            states, things = rooms.states(snapshot.nodes), search()
            self._found(builder, before, rooms, states, things)
        now_s = time.monotonic()
        self._due_s = max(self._due_s, now_s + (now_s - started_s) / ROOMS_SHARE)


# --- The whole graph on /scene_graph and as markers, slowly and in the background.
#
# Clients that follow the graph use its updates. The whole graph is for those that join late or have
# lost an update, and for RViz.

# A client that joins waits for at most this time, and RViz redraws at this rate.
PERIOD_S = 1.0
# Of a core. A large graph is published less often: 10 000 nodes are 31 MB of JSON.
MAX_SHARE = 0.1
# Objects with neighbouring ids are encoded together, as most of them change at the same time or not
# at all. Smaller pieces cost more memory, larger ones more time.
PIECE_IDS = 16

MakeMarkers = Callable[[wire.SceneGraphMessage], Iterable[Any]]
# Objects and their JSON, separated by commas, by the key of the piece.
_Pieces = dict[Hashable, tuple[list[Any], bytes]]


class PiecewiseEncoder:
    """JSON of the whole graph; encodes only the pieces that changed since the last call.

    Unchanged nodes and edges are the same objects in each snapshot.
    """

    def __init__(self) -> None:
        self._nodes: _Pieces = {}
        self._edges: _Pieces = {}

    def encode(self, message: wire.SceneGraphMessage) -> str:
        """The same text as `wire.encode`."""
        self._nodes = _encoded(message.nodes, lambda node: node.id // PIECE_IDS, self._nodes)
        self._edges = _encoded(message.edges, lambda edge: edge.subject // PIECE_IDS, self._edges)
        pieces: Any = {
            "nodes": [msgspec.Raw(text) for _, text in self._nodes.values()],
            "edges": [msgspec.Raw(text) for _, text in self._edges.values()],
        }
        return wire.encode(msgspec.structs.replace(message, **pieces))


def _encoded(objects: Iterable[Any], key: Callable[[Any], Hashable], known: _Pieces) -> _Pieces:
    pieces: _Pieces = {}
    for name, group in groupby(objects, key):
        piece = list(group)
        before = known.get(name)
        # Comparing lists compares identities first.
        if before is None or before[0] != piece:
            before = (piece, msgspec.json.encode(piece)[1:-1])
        pieces[name] = before
    return pieces


class WholeGraph:
    """Publishes snapshots in its own thread; if they come too fast, the newest.

    Args:
        node: publishes, and counts errors.
        markers: the markers of a snapshot (`view.markers`).

    Raises:
        ConfigurationError: if TF is configured and tf2_msgs is not installed.
    """

    def __init__(self, node: StageNode, markers: MakeMarkers) -> None:
        self._node = node
        self._make_markers = markers
        self._encoder = PiecewiseEncoder()
        self._publish_text = node.text_publisher("scene_graph", 1, latched=True)
        self._markers = node.create_publisher(
            MarkerArray, "scene_graph/markers", reliable(1, latched=True)
        )
        self._detections: Any = None
        if VISION_MSGS is not None:
            self._detections = node.create_publisher(
                VISION_MSGS.Detection3DArray, TOPIC, reliable(1, latched=True)
            )
        self._transforms: ObjectTransforms | None = None
        if node.parameters.output.publish_tf:
            # Rare, and it imports OpenCV and the messages of cameras.
            from deworldsg_ros.ros.transforms import ObjectTransforms

            self._transforms = ObjectTransforms(node)
        self._changed = False
        self._due_s = 0.0
        self._worker = Worker("whole graph", self._work, size=1, on_overrun=lambda snapshot: None)

    def changed(self, is_changed: bool = True) -> None:
        """Note that the graph differs from the last snapshot; False: nothing is to be published."""
        self._changed = is_changed

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until the next snapshot is due, 0 = now; None without a change."""
        return max(0.0, self._due_s - now_s) if self._changed else None

    def publish(self, snapshot: wire.SceneGraphMessage, now_s: float) -> None:
        """Publish a snapshot in the background. Nobody may change it any more."""
        self._changed = False
        self._due_s = now_s + PERIOD_S
        self._worker.submit(snapshot)

    def close(self) -> None:
        """End the thread."""
        self._worker.stop()

    def _work(self, snapshot: wire.SceneGraphMessage) -> None:
        started_s = time.monotonic()
        with self._node.refusing():
            self._publish_text(self._encoder.encode(snapshot))
            stamp = Time(sec=snapshot.stamp.sec, nanosec=snapshot.stamp.nanosec)
            self._markers.publish(
                marker_array(self._make_markers(snapshot), snapshot.frame_id, stamp)
            )
            if self._detections is not None:
                self._detections.publish(detection_array(snapshot, stamp))
            if self._transforms is not None:
                self._transforms.publish(snapshot, stamp)
        now_s = time.monotonic()
        self._due_s = max(self._due_s, now_s + (now_s - started_s) / MAX_SHARE)


# --- Another node that publishes a graph on the same topics.

UPDATES_TOPIC = "scene_graph/updates"
# It has ended if it is silent for this time.
RIVAL_SILENT_S = 10.0


class _Named(msgspec.Struct):
    """What is read of an update."""

    session: Union[str, msgspec.UnsetType] = msgspec.UNSET


class Rivals:
    """Notices another node that publishes updates on the topic of this one: clients see two graphs.

    The middleware also lists publishers of a node that was killed, for a while. So the topic is
    listened to while it has several publishers, and a message of another session counts.

    Args:
        node: publishes the updates.
        session: of its messages.
        tell: publishes the whole graph, for clients that followed the other node.
    """

    def __init__(
        self, node: StageNode, session: Callable[[], str], tell: Callable[[], None]
    ) -> None:
        self._node, self._session, self._tell = node, session, tell
        self._topic = node.resolve_topic_name(UPDATES_TOPIC)
        self._subscription: Any = None
        self._heard_s = -math.inf

    def problems(self) -> list[str]:
        """That there is one, in words. Call it about once a second, in the executor's thread."""
        several = self._node.count_publishers(self._topic) > 1
        if time.monotonic() - self._heard_s < RIVAL_SILENT_S:
            self._tell()
        if several and self._subscription is None:
            listen = self._node.guarded(self._hear)
            self._subscription = self._node.create_subscription(
                String, self._topic, listen, reliable(5)
            )
        elif not several and self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
        if time.monotonic() - self._heard_s > RIVAL_SILENT_S:
            return []
        return [
            f"another node publishes a graph on {self._topic}: end one of the two, or give it a "
            "namespace"
        ]

    def _hear(self, message: Any) -> None:
        try:
            session = msgspec.json.decode(message.data, type=_Named).session
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            session = msgspec.UNSET
        if session != self._session():
            self._heard_s = time.monotonic()
            self._node.drop("other_session", f"a message of another node on {self._topic}")
