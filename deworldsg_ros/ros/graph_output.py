"""Topics of a graph besides its updates: the whole graph, markers, detections, /tf."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterable
from contextlib import suppress
from importlib import import_module
from itertools import groupby
from typing import TYPE_CHECKING, Any

import msgspec
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from deworldsg_ros.graph.embeddings import embeddings_message
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.ros.threads import Worker
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
