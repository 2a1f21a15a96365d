"""A client's copy of the scene graph, kept by snapshots and updates."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from msgspec import UNSET

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.delta import empty_scene_graph
from deworldsg_ros.scene.errors import RefusedInput


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

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Replace the copy by a snapshot."""
        self._stamp = snapshot.stamp
        self._frame_id = snapshot.frame_id
        self._session = snapshot.session
        self._up = snapshot.up
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
        )
