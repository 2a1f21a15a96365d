"""The published graph: whole messages, and the updates between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.delta import diff, empty_scene_graph
from deworldsg_ros.scene.graph import SceneGraph


class Publication:
    """Numbered messages of a graph. An update contains the changes since the one before.

    Args:
        graph: to publish.
        edge_states: the messages of the edges between nodes, in order; unchanged messages are the
            same objects.
        top_k: number of labels of each node.
        include_surface_points: whether snapshots and updates contain surface points.
    """

    def __init__(
        self,
        graph: SceneGraph,
        edge_states: Callable[[Collection[int]], list[wire.EdgeState]],
        *,
        top_k: int,
        include_surface_points: bool,
    ) -> None:
        self._graph = graph
        self._edge_states = edge_states
        self._top_k = top_k
        self._include_surface_points = include_surface_points
        # Frames to come may be older than the newest one of a map.
        self._stamp_ns = int(graph.nodes.last_seen_ns.max(initial=0))
        # Clients cannot use associations of frames that the graph has forgotten.
        self._associations: deque[wire.Association] = deque(maxlen=graph.remembered_frames)
        self._published = empty_scene_graph(graph.frame_id)

    def note_frame(self, stamp_ns: int, node_ids: Sequence[int]) -> None:
        """Note a merged frame, and the node of each row of its local graph."""
        self._stamp_ns = stamp_ns
        self._associations.append(wire.Association(wire.stamp_from_ns(stamp_ns), list(node_ids)))

    def update(self) -> wire.SceneGraphUpdateMessage | None:
        """The changes since the last call; None if there are none."""
        current = self._message(self._published.sequence + 1, self._include_surface_points)
        removed = self._graph.take_removals()
        same = (current.nodes, current.edges) == (self._published.nodes, self._published.edges)
        if same and not removed:
            return None
        message = diff(self._published, current, removed, self._associations)
        self._associations.clear()
        self._published = current
        return message

    def snapshot(self) -> wire.SceneGraphMessage:
        """The graph after the last `update`."""
        return self._published

    def full(self) -> wire.SceneGraphMessage:
        """The present graph with surface points; the next `update` is unaffected."""
        return self._message(self._published.sequence, with_points=True)

    def _message(self, sequence: int, with_points: bool) -> wire.SceneGraphMessage:
        graph = self._graph
        nodes = graph.node_states(self._top_k, with_points)
        return wire.SceneGraphMessage(
            schema=wire.schema_of(wire.SceneGraphMessage),
            stamp=wire.stamp_from_ns(self._stamp_ns),
            frame_id=graph.frame_id,
            sequence=sequence,
            nodes=list(nodes.values()),
            edges=self._edge_states(nodes.keys()),
        )
