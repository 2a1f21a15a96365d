"""Nodes whose object has gone from its place, and how it is known again elsewhere."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.gaussian import hellinger_distance
from deworldsg_ros.scene.graph import SceneGraph

# Shapes agree below this Hellinger distance of the two Gaussians laid on one another.
SHAPE_THRESHOLD = 0.6


class LostNodes:
    """Keeps lost nodes, hidden, for a while; a new node may turn out to be one of them.

    Args:
        memory_s: how long a lost node may be found again.
    """

    def __init__(self, memory_s: float) -> None:
        self._memory_ns = int(memory_s * 1e9)
        self._lost_ns: dict[int, int] = {}

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._lost_ns

    def add(self, node_id: int, stamp_ns: int) -> None:
        """Note that a node's object is no longer where it was."""
        self._lost_ns[node_id] = stamp_ns

    def match(self, graph: SceneGraph, node_id: int) -> int | None:
        """The one lost node that a new node is: same label, same shape, and no other so alike."""
        alike = [lost_id for lost_id in self._lost_ns if _alike(graph, lost_id, node_id)]
        return alike[0] if len(alike) == 1 else None

    def found(self, node_id: int) -> None:
        """Note that a lost node was found again."""
        del self._lost_ns[node_id]

    def take_expired(self, stamp_ns: int) -> list[int]:
        """Nodes that have been lost for too long; they are forgotten here."""
        expired = [
            node_id
            for node_id, lost_ns in self._lost_ns.items()
            if stamp_ns - lost_ns > self._memory_ns
        ]
        for node_id in expired:
            del self._lost_ns[node_id]
        return expired


def alike_elsewhere(graph: SceneGraph, lost_id: int) -> int | None:
    """The one confirmed node first seen after another was last seen, that looks like it."""
    nodes = graph.nodes
    last_ns = nodes.last_seen_ns[nodes.row(lost_id)]
    later = nodes.ids[nodes.confirmed & (nodes.first_seen_ns > last_ns)].tolist()
    alike = [node_id for node_id in later if _alike(graph, lost_id, node_id)]
    return alike[0] if len(alike) == 1 else None


def _alike(graph: SceneGraph, a_id: int, b_id: int) -> bool:
    nodes = graph.nodes
    a, b = nodes.row(a_id), nodes.row(b_id)
    if nodes.class_probabilities[a].argmax() != nodes.class_probabilities[b].argmax():
        return False
    origin = np.zeros(3)
    distance = hellinger_distance(origin, nodes.covariances[a], origin, nodes.covariances[b])
    return bool(distance < SHAPE_THRESHOLD)
