"""The published graph: whole messages, and the updates between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

import msgspec
from msgspec import UNSET

from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import NodeBoxes, NodeStates, some_of
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import empty_scene_graph

# Surfaces that changed and are measured anew in a call that may leave some for the next one.
MEASURED_A_CALL = 2
# First messages of nodes that a call makes, and first pairs of nodes that it judges. So many take
# about 35 ms. A frame has fewer; a large map has more.
NEW_A_CALL = 1024

Key = TypeVar("Key", int, Pair)
Message = TypeVar("Message", wire.NodeState, wire.EdgeState)
# Brings the messages of the edges up to date; returns the pairs whose message is another, and
# whether the first messages of the edges are all there.
EdgeRefresh = Callable[[bool], tuple[Iterable[Pair], bool]]


class Publication:
    """Numbered messages of a graph. An update contains the changes since the one before.

    Args:
        graph: to publish.
        edges: the messages of its edges by pair, kept up to date by
        refresh_edges: its argument says whether nothing may wait.
        boxes: of the nodes.
        top_k: number of labels of each node, and
        min_name: least probability of its label; see `NodeStates`.
        include_surface_points: whether snapshots and updates contain surface points.
    """

    def __init__(
        self,
        graph: GlobalGraph,
        edges: Mapping[Pair, wire.EdgeState],
        refresh_edges: EdgeRefresh,
        boxes: NodeBoxes,
        *,
        top_k: int,
        min_name: float,
        include_surface_points: bool,
    ) -> None:
        self._graph = graph
        self._edges = edges
        self._refresh_edges = refresh_edges
        self._include_surface_points = include_surface_points
        self._nodes = NodeStates(graph, top_k, min_name, boxes)
        # Frames to come may be older than the newest one of a map.
        self._stamp_ns = int(graph.nodes.last_seen_ns.max(initial=0))
        # Clients cannot use associations of frames that the graph has forgotten.
        self._associations: deque[wire.Association] = deque(maxlen=graph.remembered_frames)
        # What clients know, and which parts may differ from it now.
        self._known_nodes: dict[int, wire.NodeState] = {}
        self._known_edges: dict[Pair, wire.EdgeState] = {}
        self._touched_nodes: set[int] = set()
        self._touched_edges: set[Pair] = set()
        # Rooms and storeys, and whether clients do not have them yet.
        self._rooms: tuple[wire.Rooms, wire.Storeys] = UNSET, UNSET
        self._new_rooms = False
        # The head of the last update; the snapshot gets its nodes and edges when it is asked for.
        self._updated = self._snapshot = empty_scene_graph(graph.frame_id)

    def note_frame(self, stamp_ns: int, node_ids: Sequence[int]) -> None:
        """Note a merged frame, and the node of each row of its local graph."""
        self._stamp_ns = stamp_ns
        self._associations.append(wire.Association(wire.stamp_from_ns(stamp_ns), list(node_ids)))

    def set_up(self, up_world: Float64) -> None:
        """Set the direction against gravity (3,)."""
        self._nodes.set_up(up_world)

    def set_rooms(self, rooms: list[wire.RoomState], floors_m: list[float]) -> None:
        """Set the rooms and the heights of the floors."""
        self._new_rooms |= self._rooms != (rooms, floors_m)
        self._rooms = rooms, floors_m

    @property
    def waiting(self) -> int:
        """Number of nodes that the next updates measure; `full` leaves none."""
        return self._nodes.new + self._nodes.waiting

    def update(self) -> wire.SceneGraphUpdateMessage | None:
        """The changes since the last call; None without any, or while a large map is prepared.

        It costs as much as what changed, however large the graph is. Of many surfaces that
        changed, some are left for the next calls.
        """
        if not self._refresh(whole=False):
            return None
        nodes, gone_nodes = _take(self._touched_nodes, self._known_nodes, self._touched_states())
        edges, gone_edges = _take(self._touched_edges, self._known_edges, self._edges)
        removed = self._graph.take_removals()
        if not (nodes or edges or gone_nodes or gone_edges or removed or self._new_rooms):
            return None
        # A live node that was hidden is removed from the snapshot. Clients know ids that no
        # snapshot contained from associations.
        replaced = self._graph.edits.replaced
        left = {**{node: replaced.get(node) or None for node in gone_nodes}, **removed}
        self._updated = self._message(self._updated.sequence + 1, [], [])
        message = wire.SceneGraphUpdateMessage(
            schema=wire.schema_of(wire.SceneGraphUpdateMessage),
            stamp=self._updated.stamp,
            frame_id=self._updated.frame_id,
            sequence=self._updated.sequence,
            removed_nodes=[wire.RemovedNode(node, left[node]) for node in sorted(left)],
            removed_edges=[wire.RemovedEdge(*pair) for pair in gone_edges],
            nodes=nodes,
            edges=edges,
            associations=list(self._associations),
            up=self._updated.up,
        )
        if self._new_rooms:
            message.rooms, message.storeys_m = self._rooms
            self._new_rooms = False
        self._associations.clear()
        return message

    def snapshot(self) -> wire.SceneGraphMessage:
        """The graph after the last `update`, whatever was merged since."""
        if self._snapshot.sequence != self._updated.sequence:
            self._snapshot = msgspec.structs.replace(
                self._updated, nodes=_ordered(self._known_nodes), edges=_ordered(self._known_edges)
            )
        return self._snapshot

    def full(self) -> wire.SceneGraphMessage:
        """The present graph with surface points; the next `update` is unaffected."""
        self._refresh(whole=True)
        nodes = [self._nodes.with_points(node) for node in _ordered(self._nodes.states)]
        return self._message(self._updated.sequence, nodes, _ordered(self._edges))

    def _refresh(self, whole: bool) -> bool:
        """Bring the messages up to date; false if a part of the first ones is missing."""
        limits = some_of(self._nodes.waiting, MEASURED_A_CALL), NEW_A_CALL
        self._touched_nodes.update(self._nodes.refresh(*((None, None) if whole else limits)))
        edges, all_edges = self._refresh_edges(whole)
        self._touched_edges.update(edges)
        return all_edges and not self._nodes.new

    def _touched_states(self) -> dict[int, wire.NodeState]:
        """Messages of the touched nodes as they are published."""
        states = self._nodes.states
        found = {node: states[node] for node in self._touched_nodes if node in states}
        if not self._include_surface_points:
            return found
        return {node: self._nodes.with_points(state) for node, state in found.items()}

    def _message(
        self, sequence: int, nodes: list[wire.NodeState], edges: list[wire.EdgeState]
    ) -> wire.SceneGraphMessage:
        return wire.SceneGraphMessage(
            schema=wire.schema_of(wire.SceneGraphMessage),
            stamp=wire.stamp_from_ns(self._stamp_ns),
            frame_id=self._graph.frame_id,
            sequence=sequence,
            nodes=nodes,
            edges=edges,
            up=list(self._nodes.up),
            rooms=self._rooms[0],
            storeys_m=self._rooms[1],
        )


def _ordered(states: Mapping[Key, Message]) -> list[Message]:
    return [states[key] for key in sorted(states)]


def _take(
    touched: set[Key], known: dict[Key, Message], present: Mapping[Key, Message]
) -> tuple[list[Message], list[Key]]:
    """Messages that differ from the known ones, and keys that are gone; they are known then."""
    changed, gone = [], []
    for key in sorted(touched):
        now = present.get(key)
        if now is None:
            if known.pop(key, None) is not None:
                gone.append(key)
            continue
        before = known.get(key)
        # Identity first: an unchanged message is usually the same object. Then a number: a frame
        # that shows something adds one, and to compare all takes longer.
        if before is now:
            continue
        if before is None or before.observations != now.observations or before != now:
            known[key] = now
            changed.append(now)
    touched.clear()
    return changed, gone
