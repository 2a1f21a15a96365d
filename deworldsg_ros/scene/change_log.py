"""A graph that tells what changed since any earlier number, however often a link was cut."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Iterable, Mapping
from typing import Any, TypeVar

from msgspec import UNSET

from deworldsg_ros.scene import wire

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
            self._graph, self._sequence = graph, graph.sequence
            nodes = {node.id: node for node in graph.nodes}
            edges = {(edge.subject, edge.object): edge for edge in graph.edges}
            self._nodes.replace(nodes, graph.sequence)
            self._edges.replace(edges, graph.sequence)

    def since(self, session: str | None, sequence: int) -> wire.SceneGraphUpdateMessage | None:
        """What a reader lacks; None = nothing, or there is no graph yet.

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
            )

    def _begin(self, session: Any, sequence: int) -> None:
        self._session, self._first = session, sequence
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
