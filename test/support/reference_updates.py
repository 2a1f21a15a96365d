"""The update between two snapshots, by comparison of everything: slow, and easy to check."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from deworldsg_ros.wire import messages as wire


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
        nodes=[node for node in current.nodes if known_nodes.get(node.id) != node],
        edges=[
            edge for edge in current.edges if known_edges.get((edge.subject, edge.object)) != edge
        ],
        associations=list(associations),
        up=current.up,
    )
