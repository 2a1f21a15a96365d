"""Copies of nodes, for edits that an operator may undo."""

from __future__ import annotations

from collections.abc import Collection

from deworldsg_ros.scene.arrays import Float32
from deworldsg_ros.scene.extent import even_moments
from deworldsg_ros.scene.graph import SceneGraph


def copy_node(
    graph: SceneGraph,
    node_id: int,
    without: Collection[int] = (),
    points_world: Float32 | None = None,
) -> int:
    """Add a copy of a live node, with its edges and votes; returns its id.

    Args:
        graph: changed.
        node_id: of the node.
        without: nodes to which the copy has no edges.
        points_world: (k, 3) float32, the part of the node's surface points that the copy gets, with
            the Gaussian of these points; None = everything.
    """
    nodes, row = graph.nodes, graph.nodes.row(node_id)
    mean, covariance = nodes.means[row].copy(), nodes.covariances[row].copy()
    surface, weight = nodes.surface(row).copy(), float(nodes.weights[row])
    if points_world is not None:
        mean, covariance = even_moments(points_world)
        surface, weight = points_world, weight * len(points_world) / len(surface)
    classes, first_ns = nodes.class_probabilities[row].copy(), int(nodes.first_seen_ns[row])
    confirmed = bool(nodes.confirmed[row])
    new_id = graph.add_node(mean, covariance, classes, first_ns, surface, weight, confirmed)
    new = nodes.row(new_id)
    for name in ("class_probabilities", "observations", "existence", "last_seen_ns"):
        getattr(nodes, name)[new] = getattr(nodes, name)[row]
    graph.copy_relations(node_id, new_id, without)
    return new_id
