"""Nodes whose object is absent from its position, and their recognition elsewhere."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.gaussian import hellinger_distance
from deworldsg_ros.scene.graph import SceneGraph

# Maximum Hellinger distance of two Gaussians with the same mean whose shapes are similar.
SHAPE_THRESHOLD = 0.6


class LostNodes:
    """Keeps lost nodes, hidden, for a while. A new node may turn out to be one of them.

    Args:
        memory_s: time in which a lost node may be recognised.
    """

    def __init__(self, memory_s: float) -> None:
        self._memory_ns = int(memory_s * 1e9)
        self._lost_ns: dict[int, int] = {}

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._lost_ns

    def __len__(self) -> int:
        return len(self._lost_ns)

    def add(self, node_id: int, stamp_ns: int) -> None:
        """Add a node whose object is absent."""
        self._lost_ns[node_id] = stamp_ns

    def match(self, graph: SceneGraph, node_id: int) -> int | None:
        """The lost node that is the same object as a new node; None if there is not exactly one."""
        nodes = graph.nodes
        first_ns = nodes.first_seen_ns[nodes.row(node_id)]
        similar = [
            lost_id
            for lost_id in self._lost_ns
            if nodes.last_seen_ns[nodes.row(lost_id)] < first_ns
            and _are_similar(graph, lost_id, node_id)
        ]
        return similar[0] if len(similar) == 1 else None

    def remove(self, node_id: int) -> None:
        """Remove a lost node that was recognised."""
        del self._lost_ns[node_id]

    def take_expired(self, stamp_ns: int) -> list[int]:
        """Remove and return the nodes that have been lost for too long."""
        expired = [
            node_id
            for node_id, lost_ns in self._lost_ns.items()
            if stamp_ns - lost_ns > self._memory_ns
        ]
        for node_id in expired:
            del self._lost_ns[node_id]
        return expired


def moved_object(graph: SceneGraph, lost_id: int) -> int | None:
    """The confirmed node that is the object of a lost node at its new position.

    It was first seen after the lost node was last seen, and has the same class and a similar shape.
    None if there is not exactly one.
    """
    nodes = graph.nodes
    last_ns = nodes.last_seen_ns[nodes.row(lost_id)]
    later = nodes.ids[nodes.confirmed & (nodes.first_seen_ns > last_ns)].tolist()
    similar = [node_id for node_id in later if _are_similar(graph, lost_id, node_id)]
    return similar[0] if len(similar) == 1 else None


def _are_similar(graph: SceneGraph, a_id: int, b_id: int) -> bool:
    """Whether two nodes have the same class and similar shapes."""
    nodes = graph.nodes
    a, b = nodes.row(a_id), nodes.row(b_id)
    if nodes.class_probabilities[a].argmax() != nodes.class_probabilities[b].argmax():
        return False
    origin = np.zeros(3)
    distance = hellinger_distance(origin, nodes.covariances[a], origin, nodes.covariances[b])
    return bool(distance < SHAPE_THRESHOLD)
