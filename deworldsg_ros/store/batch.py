"""Messages that are not in the database yet, joined into one change of it."""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter

import msgspec

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.store.database import Database, Head
from deworldsg_ros.store.history import History
from deworldsg_ros.store.journal import GraphMessage


class Batch:
    """The changes since the last `clear`.

    Args:
        head: what the database contains.
        history: the stays of the objects in the database.

    Attributes:
        head: what it will contain.
    """

    def __init__(self, head: Head, history: History) -> None:
        self.head = head
        self._history = history
        self._stored = set(history.current)
        self.clear()

    def __bool__(self) -> bool:
        return self._changed

    def clear(self) -> None:
        """Forget the changes: they are in the database."""
        self._changed = self._is_whole = False
        self._nodes: dict[int, wire.NodeState | None] = {}
        self._edges: dict[tuple[int, int], wire.EdgeState | None] = {}

    def follows(self, message: GraphMessage) -> bool:
        """Whether a message is the next one; False if it is known. Raises as `StoreWriter.add`."""
        head, session = self.head, _session(message)
        is_known = session == head.session and message.sequence <= head.sequence
        if session and is_known:
            return False
        if message.nodes and head.frame_id not in ("", message.frame_id):
            raise RefusedInput(
                "wrong_frame", f"graph is in frame '{message.frame_id}': expected '{head.frame_id}'"
            )
        if isinstance(message, wire.SceneGraphUpdateMessage) and not self._begins(message):
            if session == head.session and _before(message) <= head.sequence:
                return True
            raise RefusedInput(
                "lost_updates",
                f"update {message.sequence} of session '{session}' after {head.sequence} of "
                f"'{head.session}': expected the next one, or the whole graph",
            )
        stamp_ns = wire.ns_from_stamp(message.stamp)
        if stamp_ns < head.stamp_ns:
            raise RefusedInput(
                "old_graph",
                f"graph of {stamp_ns / 1e9:.3f} s is older than the newest one of the store, "
                f"{head.stamp_ns / 1e9:.3f} s: expected graphs in the order of their time",
            )
        return True

    def add(self, message: GraphMessage) -> None:
        """Add the next message."""
        # Within a session, a late frame may have an earlier stamp.
        stamp_ns = max(wire.ns_from_stamp(message.stamp), self.head.stamp_ns)
        removed = set()
        if self._begins(message):
            self._is_whole = True
            self._nodes, self._edges = {}, {}
            removed = set(self._history.current) - {node.id for node in message.nodes}
        if isinstance(message, wire.SceneGraphUpdateMessage):
            removed.update(node.id for node in message.removed_nodes)
            for pair in message.removed_edges:
                self._edges[pair.subject, pair.object] = None
        for node_id in removed:
            self._history.end(node_id, stamp_ns)
            self._nodes[node_id] = None
        for node in message.nodes:
            self._history.see(node, stamp_ns)
            self._nodes[node.id] = node
        self._edges.update(zip(map(attrgetter("subject", "object"), message.edges), message.edges))
        self.head = Head(
            self.head.position,
            stamp_ns,
            message.frame_id,
            _session(message),
            message.sequence,
        )
        self._changed = True

    def write(self, database: Database) -> None:
        """Write the changes; the caller has begun a transaction."""
        nodes = {i: node for i, node in self._nodes.items() if node is not None}
        edges = [edge for edge in self._edges.values() if edge is not None]
        if self._is_whole:
            database.replace_graph(nodes, edges)
            self._stored = set(nodes)
        else:
            gone = self._nodes.keys() - nodes.keys()
            cut = [pair for pair, edge in self._edges.items() if edge is None]
            database.remove(gone & self._stored, cut)
            new = [node for i, node in nodes.items() if i not in self._stored]
            changed = [node for i, node in nodes.items() if i in self._stored]
            database.put(new, changed, edges)
            self._stored = (self._stored - gone) | nodes.keys()
        database.put_stays(*self._history.take())
        database.write_head(replace(self.head))

    def _begins(self, message: GraphMessage) -> bool:
        """Whether a message replaces the graph: a whole one, or the first update of a session."""
        if isinstance(message, wire.SceneGraphMessage) or message.since == 0:
            return True
        return _before(message) == 0 and _session(message) != self.head.session


def _before(update: wire.SceneGraphUpdateMessage) -> int:
    """Number of the update that this one follows."""
    return update.sequence - 1 if isinstance(update.since, msgspec.UnsetType) else update.since


def _session(message: GraphMessage) -> str:
    return "" if isinstance(message.session, msgspec.UnsetType) else message.session
