"""The messages of the nodes; only those of changed nodes are rebuilt."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec import UNSET

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.node_store import NodeStore
from deworldsg_ros.scene.surface import even_moments


class NodeStates:
    """The newest message of each confirmed node, without surface points.

    Args:
        store: the nodes.
        top_k: number of labels of each node.
        even_gaussians: show the `even_moments` of a node's surface instead of the pooled Gaussian.

    Attributes:
        states: messages by id. Those of nodes that did not change are the same objects as before.
    """

    def __init__(self, store: NodeStore, top_k: int, even_gaussians: bool) -> None:
        self.states: dict[int, wire.NodeState] = {}
        self._store = store
        self._top_k = top_k
        self._even_gaussians = even_gaussians
        self._touched = store.watch_nodes()

    def refresh(self) -> list[int]:
        """Follow the nodes; returns the ids that have another message now, or none."""
        nodes = self._store.nodes
        ids = sorted(self._touched)
        self._touched.clear()
        changed = []
        for node_id in ids:
            if node_id in nodes and nodes.confirmed[row := nodes.row(node_id)]:
                self.states[node_id] = self._state(row)
            elif self.states.pop(node_id, None) is None:
                continue
            changed.append(node_id)
        return changed

    def with_points(self, state: wire.NodeState) -> wire.NodeState:
        """A message with the surface points of its node."""
        nodes = self._store.nodes
        points = nodes.surface(nodes.row(state.id)).tolist()
        return msgspec.structs.replace(state, surface_points_m=points)

    def _state(self, row: int) -> wire.NodeState:
        nodes = self._store.nodes
        probabilities = nodes.class_probabilities[row]
        beliefs = best_beliefs(probabilities, self._store.vocabulary.classes, self._top_k)
        possible = probabilities[probabilities > 0]
        mean, covariance = nodes.means[row], nodes.covariances[row]
        if self._even_gaussians and nodes.surface_counts[row]:
            mean, covariance = even_moments(nodes.surface(row))
        return wire.NodeState(
            id=int(nodes.ids[row]),
            label=beliefs[0].label,
            classes=beliefs,
            mean_m=mean.tolist(),
            covariance_m2=covariance.ravel().tolist(),
            observations=int(nodes.observations[row]),
            confirmed=True,
            existence=float(existence) if (existence := nodes.existence[row]) >= 0 else UNSET,
            first_seen=wire.stamp_from_ns(int(nodes.first_seen_ns[row])),
            last_seen=wire.stamp_from_ns(int(nodes.last_seen_ns[row])),
            surface_points_m=[],
            entropy_nats=max(0.0, -float(possible @ np.log(possible))),
        )


def best_beliefs(probabilities: Float64, names: Sequence[str], top_k: int) -> list[wire.Belief]:
    """The labels with the highest probabilities (n,), the best first, at most `top_k`."""
    # A stable sort: labels of equal probability stay in the order of the vocabulary.
    order = (-probabilities).argsort(kind="stable")[:top_k]
    return [
        wire.Belief(names[index], probability)
        for index, probability in zip(order.tolist(), probabilities[order].tolist())
    ]
