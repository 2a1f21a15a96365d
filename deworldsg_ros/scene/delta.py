"""The changes between two snapshots of the scene graph."""

from __future__ import annotations

from collections.abc import Sequence

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
