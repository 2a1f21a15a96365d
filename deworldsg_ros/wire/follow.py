"""Following a graph from its messages: snapshots, numbered updates, and gaps between them."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

from msgspec import UNSET, UnsetType, structs

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import messages as wire

# --- The changes between two snapshots of the scene graph.


def empty_scene_graph(frame_id: str) -> wire.SceneGraphMessage:
    """The empty snapshot before the first update: sequence 0."""
    return wire.SceneGraphMessage(
        schema=wire.schema_of(wire.SceneGraphMessage),
        stamp=wire.stamp_from_ns(0),
        frame_id=frame_id,
        sequence=0,
        nodes=[],
        edges=[],
    )


def join(updates: Sequence[wire.SceneGraphUpdateMessage]) -> wire.SceneGraphUpdateMessage:
    """One update with the effect of several consecutive ones of a session; at least one."""
    first, last = updates[0], updates[-1]
    since = first.sequence - 1 if isinstance(first.since, UnsetType) else first.since
    gone: dict[int, wire.RemovedNode] = {}
    cut: dict[wire.RemovedEdge, None] = {}
    nodes: dict[int, wire.NodeState] = {}
    edges: dict[tuple[int, int], wire.EdgeState] = {}
    rooms: tuple[Any, Any] = UNSET, UNSET
    for update in updates:
        if update.since == 0:
            since, gone, cut, nodes, edges = 0, {}, {}, {}, {}
        if update.since == 0 or update.rooms is not UNSET:
            rooms = update.rooms, update.storeys_m
        for removed in update.removed_nodes:
            gone[removed.id] = removed
            nodes.pop(removed.id, None)
        for pair in update.removed_edges:
            cut[pair] = None
            edges.pop((pair.subject, pair.object), None)
        nodes.update((node.id, node) for node in update.nodes)
        edges.update(((edge.subject, edge.object), edge) for edge in update.edges)
    return structs.replace(
        last,
        since=since,
        removed_nodes=list(gone.values()),
        removed_edges=list(cut),
        nodes=list(nodes.values()),
        edges=list(edges.values()),
        associations=[item for update in updates for item in update.associations],
        rooms=rooms[0],
        storeys_m=rooms[1],
    )


# --- A client's copy of the scene graph, kept by snapshots and updates.


class GraphReplica:
    """Rebuilds `/scene_graph` from `/scene_graph/updates`, exactly.

    A client that receives every update from the first one needs no snapshot. A client that joins
    later, or that lost an update, calls `reset` with the newest `/scene_graph` and continues with
    the updates; those that the snapshot already contains are skipped.

    Sequence numbers start again when graph_node restarts. Its messages then have a new session: the
    first update of a session replaces the copy, and later ones require a `reset`.
    """

    def __init__(self) -> None:
        self.reset(empty_scene_graph(""))

    @property
    def sequence(self) -> int:
        """Number of the last update in this copy."""
        return self._sequence

    @property
    def session(self) -> str | None:
        """The session of the graph; None = its messages name none."""
        return None if self._session is UNSET else self._session

    @property
    def nodes(self) -> Mapping[int, wire.NodeState]:
        """The nodes by id, read only."""
        return MappingProxyType(self._nodes)

    @property
    def edges(self) -> Mapping[tuple[int, int], wire.EdgeState]:
        """The edges by subject and object, read only."""
        return MappingProxyType(self._edges)

    @property
    def stamp_ns(self) -> int:
        """Time of the last update, nanoseconds."""
        return wire.ns_from_stamp(self._stamp)

    @property
    def frame_id(self) -> str:
        """The world frame; empty before the first message."""
        return self._frame_id

    @property
    def up(self) -> list[float] | None:
        """Unit vector (3,) against gravity; None = the messages do not tell it."""
        return self._up if isinstance(self._up, list) else None

    @property
    def rooms(self) -> list[wire.RoomState]:
        """The rooms; empty if the messages tell none."""
        return self._rooms[0] if isinstance(self._rooms[0], list) else []

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Replace the copy by a snapshot."""
        self._stamp = snapshot.stamp
        self._frame_id = snapshot.frame_id
        self._session = snapshot.session
        self._up = snapshot.up
        self._rooms = snapshot.rooms, snapshot.storeys_m
        self._sequence = snapshot.sequence
        self._nodes = {node.id: node for node in snapshot.nodes}
        self._edges = {(edge.subject, edge.object): edge for edge in snapshot.edges}

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; returns False for one that this copy already contains.

        Raises:
            RefusedInput: ``lost_updates`` if updates in between are missing, ``other_session`` for
                a later update of another session; the copy is unchanged and needs a `reset`.
        """
        before = update.sequence - 1 if update.since is UNSET else update.since
        if update.session != self._session:
            if before > 0:
                raise RefusedInput(
                    "other_session",
                    f"update {update.sequence} is of session {update.session!r}: expected "
                    f"{self._session!r}. graph_node was restarted: reset from /scene_graph",
                )
            self.reset(empty_scene_graph(update.frame_id))
            self._session = update.session
        if update.sequence <= self._sequence:
            return False
        if before > self._sequence:
            raise RefusedInput(
                "lost_updates",
                f"update {update.sequence} after {self._sequence}: "
                f"{before - self._sequence} lost, reset from /scene_graph",
            )
        if update.since == 0:
            self._nodes, self._edges = {}, {}
        for node in update.removed_nodes:
            self._nodes.pop(node.id, None)
        for edge in update.removed_edges:
            self._edges.pop((edge.subject, edge.object), None)
        self._nodes.update((node.id, node) for node in update.nodes)
        self._edges.update(((edge.subject, edge.object), edge) for edge in update.edges)
        self._stamp = update.stamp
        self._frame_id = update.frame_id
        self._up = update.up
        if update.since == 0 or update.rooms is not UNSET:
            self._rooms = update.rooms, update.storeys_m
        self._sequence = update.sequence
        return True

    def message(self) -> wire.SceneGraphMessage:
        """The graph as a snapshot, equal to the publisher's: nodes by id, edges by pair."""
        return wire.SceneGraphMessage(
            schema=wire.schema_of(wire.SceneGraphMessage),
            stamp=self._stamp,
            frame_id=self._frame_id,
            session=self._session,
            sequence=self._sequence,
            nodes=[self._nodes[node_id] for node_id in sorted(self._nodes)],
            edges=[self._edges[pair] for pair in sorted(self._edges)],
            up=self._up,
            rooms=self._rooms[0],
            storeys_m=self._rooms[1],
        )


# --- A graph that tells what changed since any earlier number, however often a link was cut.

# Removed nodes and edges that are remembered; a reader that is further behind gets the whole graph.
MOST_REMOVED = 10_000

Key = TypeVar("Key", bound=Hashable)


class ChangeLog:
    """The newest graph, with the number at which each of its parts last changed.

    A reader asks with the session and the number that it has. Nothing is queued for it, and no
    change is sent twice: a node that changed a hundred times since is sent once. Safe to use from
    several threads.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._graph: wire.SceneGraphMessage | None = None
        self._sequence = 0
        self._begin(UNSET, 0)

    def set(self, graph: wire.SceneGraphMessage) -> None:
        """Replace the graph; its sequence number has to grow within a session."""
        with self._lock:
            is_known = self._graph is not None and graph.session == self._session
            if is_known and graph.sequence <= self._sequence:
                return
            if not is_known:
                self._begin(graph.session, graph.sequence)
            if self._graph is None or self._graph.rooms != graph.rooms:
                self._new_rooms = graph.sequence
            self._graph, self._sequence = graph, graph.sequence
            nodes = {node.id: node for node in graph.nodes}
            edges = {(edge.subject, edge.object): edge for edge in graph.edges}
            self._nodes.replace(nodes, graph.sequence)
            self._edges.replace(edges, graph.sequence)

    def since(self, session: str | None, sequence: int) -> wire.SceneGraphUpdateMessage | None:
        """The updates that a reader lacks; None = none, or there is no graph yet.

        Args:
            session: of the graph that the reader has; None = none.
            sequence: number that it has.

        Returns:
            The changes; the whole graph, with ``since`` 0, for a reader of another session or of a
            number that is too old.
        """
        with self._lock:
            graph = self._graph
            if graph is None or not graph.sequence:
                return None
            is_known = session == (None if self._session is UNSET else self._session)
            if is_known and sequence >= self._sequence:
                return None
            first = max(self._first, self._nodes.forgotten, self._edges.forgotten)
            since = sequence if is_known and sequence >= first else 0
            return wire.SceneGraphUpdateMessage(
                schema=wire.schema_of(wire.SceneGraphUpdateMessage),
                stamp=graph.stamp,
                frame_id=graph.frame_id,
                session=self._session,
                sequence=self._sequence,
                since=since,
                removed_nodes=[wire.RemovedNode(node) for node in self._nodes.removed(since)],
                removed_edges=[wire.RemovedEdge(*pair) for pair in self._edges.removed(since)],
                nodes=self._nodes.changed(since),
                edges=self._edges.changed(since),
                associations=[],
                up=graph.up,
                rooms=graph.rooms if self._new_rooms > since else UNSET,
                storeys_m=graph.storeys_m if self._new_rooms > since else UNSET,
            )

    def _begin(self, session: Any, sequence: int) -> None:
        self._session, self._first, self._new_rooms = session, sequence, sequence
        self._nodes: _Parts[int] = _Parts()
        self._edges: _Parts[tuple[int, int]] = _Parts()


class _Parts(dict[Key, tuple[Any, int]]):
    """The message of each part, and the number at which it last changed.

    Attributes:
        forgotten: a reader of an older number may have missed a removal.
    """

    def __init__(self) -> None:
        super().__init__()
        self.forgotten = 0
        self._removed: dict[Key, int] = {}

    def replace(self, parts: Mapping[Key, Any], sequence: int) -> None:
        """Note what differs; identity first, because an unchanged message is the same object."""
        for key in self.keys() - parts.keys():
            del self[key]
            self._removed[key] = sequence
        for key, part in parts.items():
            known = self.get(key)
            if known is None or (known[0] is not part and known[0] != part):
                self._removed.pop(key, None)
                self[key] = part, sequence
        while len(self._removed) > MOST_REMOVED:
            self.forgotten = max(self.forgotten, self._removed.pop(next(iter(self._removed))))

    def changed(self, since: int) -> list[Any]:
        """Messages of the parts that changed after a number."""
        return [part for part, number in self.values() if number > since]

    def removed(self, since: int) -> Iterable[Key]:
        """Keys of the parts that went after a number; none for a reader that gets all."""
        return [key for key, number in self._removed.items() if number > since > 0]


# --- Following a graph from its topics: the latched snapshot, the numbered updates, and gaps.

# Updates that wait for a snapshot; graph_node's publisher keeps as many.
MOST_WAITING = 50
# After another session has begun, messages of the one before may still be under way for this time.
# Later ones are of a second node. A session has ended when it is silent for SILENT_S.
LATE_S, SILENT_S = 2.0, 10.0


class Copy(Protocol):
    """A copy of a graph, such as `GraphReplica`."""

    @property
    def session(self) -> str | None:
        """The session of the graph."""
        ...

    @property
    def sequence(self) -> int:
        """Number of the last update in the copy."""
        ...

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Replace the copy by a snapshot."""
        ...

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; raises RefusedInput if others are missing before it."""
        ...


class GraphFollower:
    """Keeps a copy up to date. After a gap it waits for the next snapshot, about a second.

    A new session is followed: the node was restarted, or its graph replaced. If the session before
    goes on, two nodes publish on the topics: the first one is followed then, and messages of the
    other are refused, as long as the first is not silent.

    Args:
        copy: an empty copy.
        clock: seconds.

    Attributes:
        gaps: number of times that updates were lost.
        has_graph: whether the copy has a graph.
    """

    def __init__(self, copy: Copy, clock: Callable[[], float] = time.monotonic) -> None:
        self.gaps = 0
        self.has_graph = False
        self._copy = copy
        self._clock = clock
        # The session that is followed, when it was heard, and the one before; and another node's.
        self._session: Any = None
        self._heard_s = self._left_s = -math.inf
        self._left: Any = None
        self._others: set[Any] = set()
        self._waiting: deque[wire.SceneGraphUpdateMessage] = deque(maxlen=MOST_WAITING)

    def snapshot(self, snapshot: wire.SceneGraphMessage) -> bool:
        """Take a message of `/scene_graph`; returns whether the copy has changed.

        Raises:
            RefusedInput: ``other_session`` for one of a second node.
        """
        if not self._is_followed(snapshot.session):
            return False
        same = self.has_graph and (snapshot.session or None) == self._copy.session
        if same and snapshot.sequence <= self._copy.sequence:
            return False
        self._copy.reset(snapshot)
        self.has_graph = True
        # Updates that came during the gap, and are newer than the snapshot.
        waiting, self._waiting = self._waiting, deque(maxlen=MOST_WAITING)
        for update in waiting:
            if update.session == snapshot.session:
                self.update(update)
        return True

    def update(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Take a message of `/scene_graph/updates`; returns whether the copy has changed.

        Raises:
            RefusedInput: ``other_session`` for one of a second node.
        """
        if not self._is_followed(update.session):
            return False
        try:
            applied = self._copy.apply(update)
        except RefusedInput:
            self.gaps += self.has_graph and not self._waiting
            self._waiting.append(update)
            return False
        self.has_graph |= applied
        return applied

    def _is_followed(self, session: Any) -> bool:
        """Whether to take a message of a session; false for a late one of the session before."""
        now_s = self._clock()
        if session != self._session and self._heard_s > -math.inf:
            if session in self._others and now_s - self._heard_s < SILENT_S:
                raise RefusedInput(
                    "other_session",
                    f"session {session!r} is of a second node that publishes a graph on the same "
                    f"topics; session {self._session!r} is followed. End one of the two nodes, or "
                    "give it a namespace",
                )
            if session == self._left:
                if now_s - self._left_s < LATE_S:
                    return False
                self._others.add(self._session)
            self._others.discard(session)
            self._left, self._left_s = self._session, now_s
        self._session, self._heard_s = session, now_s
        return True
