"""What changed between two snapshots of the scene graph."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from deworldsg_ros.scene import wire


def empty_scene_graph(frame_id: str, stamp_ns: int = 0) -> wire.SceneGraphMessage:
    """The snapshot before the first update: sequence 0, nothing in it."""
    return wire.SceneGraphMessage(
        schema=wire.schema_of(wire.SceneGraphMessage),
        stamp=wire.stamp_from_ns(stamp_ns),
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
    """The update that turns one snapshot into the next.

    Args:
        previous: snapshot of sequence n - 1.
        current: snapshot of sequence n.
        removed: ids gone since, each with the node it was merged into (`SceneGraph.take_removals`);
            ids that no snapshot showed are told too, for clients that know them by association.
        associations: of the frames integrated since.

    Raises:
        ValueError: where the sequence numbers do not follow each other.
    """
    if current.sequence != previous.sequence + 1:
        raise ValueError(
            f"snapshots {previous.sequence} and {current.sequence}: wanted consecutive ones"
        )
    known_nodes = {node.id: node for node in previous.nodes}
    known_edges = {(edge.subject, edge.object): edge for edge in previous.edges}
    node_ids = {node.id for node in current.nodes}
    pairs = {(edge.subject, edge.object) for edge in current.edges}
    # A node that was filtered out of the snapshot is gone for clients though it lives.
    gone: dict[int, int | None] = dict.fromkeys(known_nodes.keys() - node_ids)
    gone.update(removed or {})
    return wire.SceneGraphUpdateMessage(
        schema=wire.schema_of(wire.SceneGraphUpdateMessage),
        stamp=current.stamp,
        frame_id=current.frame_id,
        sequence=current.sequence,
        removed_nodes=[wire.RemovedNode(node, gone[node]) for node in sorted(gone)],
        removed_edges=[wire.RemovedEdge(*pair) for pair in sorted(known_edges.keys() - pairs)],
        nodes=[node for node in current.nodes if not _same(known_nodes.get(node.id), node)],
        edges=[
            edge
            for edge in current.edges
            if not _same(known_edges.get((edge.subject, edge.object)), edge)
        ],
        associations=list(associations),
    )


def _same(known: object, now: object) -> bool:
    # Identity first: what did not change is the same object where it was cached.
    return known is now or known == now
