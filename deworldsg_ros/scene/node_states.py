"""The messages of the nodes; only those of changed nodes are rebuilt."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec import UNSET

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.extent import DEFAULT_UP, box_of, rounded, surface_bytes
from deworldsg_ros.scene.node_store import NodeStore
from deworldsg_ros.scene.surface import even_moments

# Decimals of numbers in messages: positions to 0.1 mm, variances to (0.3 mm)², so that a thin
# object keeps its thickness; probabilities and entropies to more than their calibration.
POSITION_DECIMALS, VARIANCE_DECIMALS, DECIMALS = 4, 7, 4
# Smaller turns of the estimated up direction change no box.
MIN_TURN_RAD = math.radians(1.0)


class NodeStates:
    """The newest message of each confirmed node, without surface points.

    Args:
        store: the nodes.
        top_k: number of labels of each node.
        even_gaussians: show the `even_moments` of a node's surface instead of the pooled Gaussian.

    Attributes:
        up: unit vector against gravity, for the boxes.
        states: messages by id. Those of nodes that did not change are the same objects as before.
    """

    def __init__(self, store: NodeStore, top_k: int, even_gaussians: bool) -> None:
        self.states: dict[int, wire.NodeState] = {}
        self._store = store
        self._top_k = top_k
        self._even_gaussians = even_gaussians
        self._touched = store.watch_nodes()
        self.up: tuple[float, ...] = DEFAULT_UP

    def set_up(self, up_world: Float64) -> None:
        """Set the direction against gravity (3,); smaller turns than `MIN_TURN_RAD` are ignored."""
        if float(up_world @ self.up) < math.cos(MIN_TURN_RAD):
            self.up = tuple(rounded(up_world, POSITION_DECIMALS))
            self._touched.update(self._store.nodes.ids.tolist())

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
        points = nodes.surface(nodes.row(state.id))
        return msgspec.structs.replace(state, surface_mm=surface_bytes(points, state.mean_m))

    def _state(self, row: int) -> wire.NodeState:
        nodes = self._store.nodes
        probabilities = nodes.class_probabilities[row]
        beliefs = best_beliefs(probabilities, self._store.vocabulary.classes, self._top_k)
        label = self._store.edits.labels.get(int(nodes.ids[row]))
        if label is not None:
            probabilities, beliefs = np.ones(1), [wire.Belief(label, 1.0)]
        possible = probabilities[probabilities > 0]
        mean, covariance = nodes.means[row], nodes.covariances[row]
        points = nodes.surface(row)
        if self._even_gaussians and len(points):
            mean, covariance = even_moments(points)
        return wire.NodeState(
            id=int(nodes.ids[row]),
            label=beliefs[0].label,
            classes=beliefs,
            remainder=rest_of(probabilities, beliefs),
            mean_m=rounded(mean, POSITION_DECIMALS),
            covariance_m2=rounded(covariance, VARIANCE_DECIMALS),
            box=box_of(points, self.up) if len(points) else UNSET,
            observations=int(nodes.observations[row]),
            confirmed=True,
            existence=float(existence) if (existence := nodes.existence[row]) >= 0 else UNSET,
            first_seen=wire.stamp_from_ns(int(nodes.first_seen_ns[row])),
            last_seen=wire.stamp_from_ns(int(nodes.last_seen_ns[row])),
            entropy_nats=round(max(0.0, -float(possible @ np.log(possible))), DECIMALS),
            label_provenance=UNSET if label is None else "operator",
        )


def hidden_node(store: NodeStore, node_id: int, reason: str) -> wire.HiddenNode:
    """The message of a node that is not published."""
    nodes, row = store.nodes, store.nodes.row(node_id)
    best = int(nodes.class_probabilities[row].argmax())
    return wire.HiddenNode(
        label=store.vocabulary.classes[best],
        mean_m=rounded(nodes.means[row], POSITION_DECIMALS),
        existence=max(0.0, float(nodes.existence[row])),
        observations=int(nodes.observations[row]),
        reason=reason,
    )


def best_beliefs(probabilities: Float64, names: Sequence[str], top_k: int) -> list[wire.Belief]:
    """The labels with the highest probabilities (n,), the best first, at most `top_k`."""
    # A stable sort: labels of equal probability stay in the order of the vocabulary.
    order = (-probabilities).argsort(kind="stable")[:top_k]
    return [
        wire.Belief(names[index], round(probability, DECIMALS))
        for index, probability in zip(order.tolist(), probabilities[order].tolist())
    ]


def rest_of(probabilities: Float64, listed: Sequence[wire.Belief]) -> float:
    """The probability of all labels that are not listed."""
    rest = float(probabilities.sum()) - sum(belief.probability for belief in listed)
    return round(max(rest, 0.0), DECIMALS)
