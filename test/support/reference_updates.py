"""The update between two snapshots, by comparison of everything: slow, and easy to check."""

from collections.abc import Iterable, Mapping

from deworldsg_ros.wire import messages as wire


def diff(
    previous: wire.SceneGraphMessage,
    current: wire.SceneGraphMessage,
    removed: Mapping[int, int | None] | None = None,
    associations: Iterable[wire.Association] = (),
) -> wire.SceneGraphUpdateMessage:
    """The update from one snapshot to the next.

    `removed` are ids removed since (`SceneGraph.take_removals`), also those that no snapshot
    contained: clients know these from the associations of the frames merged since.
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
