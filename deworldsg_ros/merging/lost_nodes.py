"""Nodes whose object is absent from its position, and their recognition elsewhere."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Int64
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
        rows = np.array([nodes.row(lost_id) for lost_id in self._lost_ns], np.int64)
        earlier = rows[nodes.last_seen_ns[rows] < nodes.first_seen_ns[nodes.row(node_id)]]
        similar = earlier[_are_similar(graph, node_id, earlier)]
        return int(nodes.ids[similar[0]]) if len(similar) == 1 else None

    def remove(self, node_id: int) -> None:
        """Remove a lost node that was recognised."""
        del self._lost_ns[node_id]

    def take_expired(self, stamp_ns: int) -> list[int]:
        """Remove and return the nodes that have been lost for too long."""
        if stamp_ns - min(self._lost_ns.values(), default=stamp_ns) <= self._memory_ns:
            return []
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
    later = np.flatnonzero(nodes.confirmed & (nodes.first_seen_ns > last_ns))
    similar = later[_are_similar(graph, lost_id, later)]
    return int(nodes.ids[similar[0]]) if len(similar) == 1 else None


def _are_similar(graph: SceneGraph, node_id: int, rows: Int64) -> Bool:
    """Whether a node and each of some rows (n,) have the same class and similar shapes."""
    nodes = graph.nodes
    row = nodes.row(node_id)
    label = nodes.class_probabilities[row].argmax()
    similar: Bool = nodes.class_probabilities[rows].argmax(axis=1) == label
    if similar.any():
        origin, alike = np.zeros(3), rows[similar]
        similar[similar] = (
            hellinger_distance(origin, nodes.covariances[row], origin, nodes.covariances[alike])
            < SHAPE_THRESHOLD
        )
    return similar
