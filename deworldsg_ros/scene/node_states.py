"""The messages of the nodes; only those of changed nodes are rebuilt."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import UNSET

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.nodes import NodeTable
from deworldsg_ros.scene.surface import even_moments

# Form of a message: top k, with surface points.
_Form = tuple[int, bool]


class NodeStateCache:
    """The newest message of each node in each requested form, with its revision.

    Args:
        even_gaussians: show the `even_moments` of a node's surface instead of the pooled Gaussian.
    """

    def __init__(self, even_gaussians: bool = False) -> None:
        self._even_gaussians = even_gaussians
        self._known: dict[_Form, dict[int, tuple[int, wire.NodeState]]] = {}

    def states(
        self,
        nodes: NodeTable,
        classes: tuple[str, ...],
        top_k: int,
        with_points: bool,
    ) -> dict[int, wire.NodeState]:
        """Messages by ascending id of the confirmed nodes."""
        known = self._known.setdefault((top_k, with_points), {})
        states = {}
        rows = np.flatnonzero(nodes.confirmed)
        rows = rows[np.argsort(nodes.ids[rows])]
        ids, revisions = nodes.ids[rows].tolist(), nodes.revisions[rows].tolist()
        for row, node_id, revision in zip(rows.tolist(), ids, revisions):
            entry = known.get(node_id)
            if entry is None or entry[0] != revision:
                state = _state(nodes, row, classes, top_k, with_points, self._even_gaussians)
                entry = (revision, state)
                known[node_id] = entry
            states[node_id] = entry[1]
        return states

    def forget(self, node_id: int) -> None:
        """Drop the messages of a removed node."""
        for known in self._known.values():
            known.pop(node_id, None)


def best_beliefs(probabilities: Float64, names: Sequence[str], top_k: int) -> list[wire.Belief]:
    """The labels with the highest probabilities (n,), the best first, at most `top_k`."""
    # A stable sort: labels of equal probability stay in the order of the vocabulary.
    order = np.argsort(-probabilities, kind="stable")[:top_k].tolist()
    return [wire.Belief(names[index], float(probabilities[index])) for index in order]


def _state(
    nodes: NodeTable, row: int, classes: tuple[str, ...], top_k: int, with_points: bool, even: bool
) -> wire.NodeState:
    probabilities = nodes.class_probabilities[row]
    beliefs = best_beliefs(probabilities, classes, top_k)
    possible = probabilities[probabilities > 0]
    points = nodes.surface(row)
    mean, covariance = nodes.means[row], nodes.covariances[row]
    if even and len(points):
        mean, covariance = even_moments(points)
    return wire.NodeState(
        id=int(nodes.ids[row]),
        label=beliefs[0].label,
        classes=beliefs,
        mean_m=mean.tolist(),
        covariance_m2=covariance.ravel().tolist(),
        observations=int(nodes.observations[row]),
        confirmed=bool(nodes.confirmed[row]),
        existence=float(existence) if (existence := nodes.existence[row]) >= 0 else UNSET,
        first_seen=wire.stamp_from_ns(int(nodes.first_seen_ns[row])),
        last_seen=wire.stamp_from_ns(int(nodes.last_seen_ns[row])),
        surface_points_m=points.tolist() if with_points else [],
        entropy_nats=max(0.0, -float(possible @ np.log(possible))),
    )
