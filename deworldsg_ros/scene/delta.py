"""The changes between two snapshots of the scene graph."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from msgspec import UnsetType, structs

from deworldsg_ros.scene import wire


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


def diff(
    previous: wire.SceneGraphMessage,
    current: wire.SceneGraphMessage,
    removed: Mapping[int, int | None] | None = None,
    associations: Iterable[wire.Association] = (),
) -> wire.SceneGraphUpdateMessage:
    """The update from one snapshot to the next.

    Args:
        previous: snapshot of sequence n - 1.
        current: snapshot of sequence n.
        removed: ids removed since, each with the node it was merged into
            (`SceneGraph.take_removals`). They include ids that no snapshot contained, because
            clients know these from associations.
        associations: of the frames merged since.

    Raises:
        ValueError: if the sequence numbers are not consecutive.
    """
    if current.sequence != previous.sequence + 1:
        raise ValueError(
            f"snapshots {previous.sequence} and {current.sequence}: expected consecutive numbers"
        )
    known_nodes = {node.id: node for node in previous.nodes}
    known_edges = {(edge.subject, edge.object): edge for edge in previous.edges}
    node_ids = {node.id for node in current.nodes}
    pairs = {(edge.subject, edge.object) for edge in current.edges}
    # A live node that was hidden is removed from the snapshot.
    left: dict[int, int | None] = dict.fromkeys(known_nodes.keys() - node_ids)
    left.update(removed or {})
    return wire.SceneGraphUpdateMessage(
        schema=wire.schema_of(wire.SceneGraphUpdateMessage),
        stamp=current.stamp,
        frame_id=current.frame_id,
        sequence=current.sequence,
        removed_nodes=[wire.RemovedNode(node, left[node]) for node in sorted(left)],
        removed_edges=[wire.RemovedEdge(*pair) for pair in sorted(known_edges.keys() - pairs)],
        nodes=[node for node in current.nodes if not _same(known_nodes.get(node.id), node)],
        edges=[
            edge
            for edge in current.edges
            if not _same(known_edges.get((edge.subject, edge.object)), edge)
        ],
        associations=list(associations),
        up=current.up,
    )


def join(updates: Sequence[wire.SceneGraphUpdateMessage]) -> wire.SceneGraphUpdateMessage:
    """One update with the effect of several consecutive ones of a session; at least one."""
    first, last = updates[0], updates[-1]
    since = first.sequence - 1 if isinstance(first.since, UnsetType) else first.since
    gone: dict[int, wire.RemovedNode] = {}
    cut: dict[wire.RemovedEdge, None] = {}
    nodes: dict[int, wire.NodeState] = {}
    edges: dict[tuple[int, int], wire.EdgeState] = {}
    for update in updates:
        if update.since == 0:
            since, gone, cut, nodes, edges = 0, {}, {}, {}, {}
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
    )


def _same(known: object, now: object) -> bool:
    # Identity first: an unchanged message is usually the same object.
    return known is now or known == now
