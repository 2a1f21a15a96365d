"""The state of the global graph that the choice of clips needs, from memory or from messages."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from msgspec import UNSET, UnsetType

from deworldsg_ros.relations.evidence import entropy_nats, visual_distribution
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.beliefs import DECIMALS
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.replica import GraphReplica

# Frames whose nodes are remembered: 34 s at 30 frames/s. Clips wait for a few seconds.
REMEMBERED_FRAMES = 1024
# Removed nodes whose successors are remembered, to bound memory.
REMEMBERED_REMOVALS = 65536


class NodeView(NamedTuple):
    """A confirmed node.

    Attributes:
        label: name of its most probable class.
        observations: number of frames in which it was detected.
    """

    label: str
    observations: int


class GraphView(Protocol):
    """The queries that the choice of clips makes on the graph."""

    @property
    def generation(self) -> int:
        """A counter that changes when a new graph, with new node ids, replaces the old one."""
        ...

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest frame that the graph has processed; None = no graph is known."""
        ...

    def nodes_of_frame(self, stamp_ns: int) -> Sequence[int] | None:
        """The current node id of each row of a frame, 0 = removed; None = frame not known."""
        ...

    def node(self, node_id: int) -> NodeView | None:
        """A published node; None if it is hidden."""
        ...

    def visual_entropy_nats(self, a_id: int, b_id: int) -> float:
        """Entropy of P_vis (Eq. 9) of a pair: the greater one of its two directions.

        Directions without visual evidence are ignored; infinite if both have none.
        """
        ...


class LiveGraph:
    """The graph of the same process."""

    def __init__(self, graph: SceneGraph) -> None:
        self.generation = 0
        # In one process a frame is merged before its clips are ranked: no frame is still to come.
        self.newest_ns = sys.maxsize
        self._graph = graph

    def nodes_of_frame(self, stamp_ns: int) -> Sequence[int] | None:
        """See `GraphView`."""
        return self._graph.nodes_of_frame(stamp_ns)

    def node(self, node_id: int) -> NodeView | None:
        """See `GraphView`."""
        nodes = self._graph.nodes
        row = nodes.row(node_id)
        if not nodes.confirmed[row]:
            return None
        names = self._graph.vocabulary
        classes = self._graph.edits.believed_classes(nodes, names, [row])
        label = names.classes[int(classes.argmax())]
        return NodeView(label, int(nodes.observations[row]))

    def visual_entropy_nats(self, a_id: int, b_id: int) -> float:
        """See `GraphView`."""
        edges = [self._graph.edges.get(pair) for pair in ((a_id, b_id), (b_id, a_id))]
        return max(
            (
                round(float(entropy_nats(visual_distribution(edge.visual_logits))), DECIMALS)
                for edge in edges
                if edge is not None and edge.frames
            ),
            default=math.inf,
        )


class PublishedGraph:
    """A copy of another process's graph, kept up to date from `/scene_graph/updates`.

    It needs a snapshot when it starts late and after lost updates, and keeps its last state until
    the snapshot arrives. Another session, or sequence numbers that start again, mean a new graph,
    which replaces the old one.

    Attributes:
        wants_snapshot: whether it needs a snapshot, by `reset`.
    """

    def __init__(self) -> None:
        self.generation = 0
        self.newest_ns: int | None = None
        self.wants_snapshot = True
        self._replica = GraphReplica()
        self._last_sequence = 0
        self._session: str | UnsetType = UNSET
        self._frames: dict[int, list[int]] = {}
        # The node that each removed node was merged into; 0 = none.
        self._successors: dict[int, int] = {}

    def apply(self, update: wire.SceneGraphUpdateMessage) -> None:
        """Apply an update; call it in the order of publication."""
        if update.session != self._session or update.sequence <= self._last_sequence:
            if self._last_sequence:
                self.generation += 1
            self._replica = GraphReplica()
            self._frames.clear()
            self._successors.clear()
            self._session = update.session
        self._last_sequence = update.sequence
        for removed in update.removed_nodes:
            self._successors[removed.id] = removed.merged_into or 0
        # A node that is hidden is published as removed. It may return under the same id.
        for node in update.nodes:
            self._successors.pop(node.id, None)
        for association in update.associations:
            self._frames[wire.ns_from_stamp(association.stamp)] = association.nodes
        _forget_oldest(self._successors, REMEMBERED_REMOVALS)
        _forget_oldest(self._frames, REMEMBERED_FRAMES)
        self.newest_ns = wire.ns_from_stamp(update.stamp)
        try:
            self._replica.apply(update)
            self.wants_snapshot = False
        except RefusedInput:
            self.wants_snapshot = True

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Take the nodes and edges of a snapshot; ignore one older than the last update.

        A snapshot of another session than the last update is ignored, too: one of both is old.
        """
        if self._last_sequence and (
            snapshot.session != self._session or snapshot.sequence < self._last_sequence
        ):
            return
        self._session = snapshot.session
        self._replica.reset(snapshot)
        self.wants_snapshot = False
        if self.newest_ns is None:
            self.newest_ns = wire.ns_from_stamp(snapshot.stamp)

    def nodes_of_frame(self, stamp_ns: int) -> Sequence[int] | None:
        """See `GraphView`."""
        node_ids = self._frames.get(stamp_ns)
        return None if node_ids is None else [self._resolve(node_id) for node_id in node_ids]

    def node(self, node_id: int) -> NodeView | None:
        """See `GraphView`."""
        state = self._replica.nodes.get(node_id)
        if state is None or not state.confirmed:
            return None
        return NodeView(state.label, state.observations)

    def visual_entropy_nats(self, a_id: int, b_id: int) -> float:
        """See `GraphView`. Every edge with visual evidence is published."""
        edges = [self._replica.edges.get(pair) for pair in ((a_id, b_id), (b_id, a_id))]
        seen = [edge.entropy_nats for edge in edges if edge is not None and edge.observations]
        return max(seen, default=math.inf)

    def _resolve(self, node_id: int) -> int:
        passed = set()
        # graph_node never sends a circle of merges, but somebody else may.
        while node_id in self._successors and node_id not in passed:
            passed.add(node_id)
            node_id = self._successors[node_id]
        return node_id


def _forget_oldest(remembered: dict[int, Any], count: int) -> None:
    while len(remembered) > count:
        del remembered[next(iter(remembered))]
