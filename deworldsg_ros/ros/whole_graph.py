"""The whole graph on /scene_graph and as markers, slowly and in the background.

Clients that follow the graph use its updates. The whole graph is for those that join late or have
lost an update, and for RViz.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterable
from itertools import groupby
from typing import TYPE_CHECKING, Any

import msgspec
from builtin_interfaces.msg import Time
from visualization_msgs.msg import MarkerArray

from deworldsg_ros.ros.detections import TOPIC, VISION_MSGS, detection_array
from deworldsg_ros.ros.markers import marker_array
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.ros.worker import Worker
from deworldsg_ros.scene import wire

if TYPE_CHECKING:
    from deworldsg_ros.ros.object_transforms import ObjectTransforms

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
            from deworldsg_ros.ros.object_transforms import ObjectTransforms

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
