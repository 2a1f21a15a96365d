"""The messages of the nodes; only those of changed nodes are rebuilt."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Union

import msgspec
import numpy as np
from msgspec import UNSET

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.beliefs import Listed, listed
from deworldsg_ros.scene.extent import (
    DEFAULT_UP,
    boxes,
    extents_of,
    rounded,
    rounded_rows,
    surface_bytes,
)
from deworldsg_ros.scene.node_store import NodeStore
from deworldsg_ros.scene.waiting import take_first

# Decimals of numbers in messages: positions to 0.1 mm, variances to (0.3 mm)², so that a thin
# object keeps its thickness.
POSITION_DECIMALS, VARIANCE_DECIMALS = 4, 7
# Smaller turns of the estimated up direction change no box.
MIN_TURN_RAD = math.radians(1.0)

# Mean, covariance and box of a surface, as messages have them; None and UNSET without points.
_Extent = tuple[
    Union[list[float], None], Union[list[float], None], Union[wire.GravityBox, msgspec.UnsetType]
]
_NO_EXTENT: _Extent = (None, None, UNSET)


class NodeStates:
    """The newest message of each confirmed node, without surface points.

    The extent of a surface is most of the work. So a call may leave some extents for the next one:
    those of nodes that have one already. Everything else of a message is always the newest.

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
        # Which surface the extent of a message is of, and the nodes whose extent is an older one.
        self._measured: dict[int, int] = {}
        self._stale: dict[int, None] = {}
        self.up: tuple[float, ...] = DEFAULT_UP

    @property
    def waiting(self) -> int:
        """Number of nodes whose extent waits for a call."""
        return len(self._stale)

    def set_up(self, up_world: Float64) -> None:
        """Set the direction against gravity (3,); smaller turns than `MIN_TURN_RAD` are ignored."""
        if float(up_world @ self.up) < math.cos(MIN_TURN_RAD):
            self.up = tuple(rounded(up_world, POSITION_DECIMALS))
            self._stale.update(dict.fromkeys(sorted(self._measured)))

    def refresh(self, at_most: int | None = None) -> list[int]:
        """Follow the nodes; returns the ids that have another message now, or none.

        Args:
            at_most: number of extents to measure again, those that wait longest first; None = all.
        """
        nodes = self._store.nodes
        gone, present = [], {}
        for node_id in sorted(self._touched):
            if node_id in nodes and nodes.confirmed[row := nodes.row(node_id)]:
                present[node_id] = row
            elif self.states.pop(node_id, None) is not None:
                gone.append(node_id)
                self._measured.pop(node_id, None)
                self._stale.pop(node_id, None)
        self._touched.clear()
        extents = self._measure(present, at_most)
        for node_id in extents.keys() - present.keys():
            present[node_id] = nodes.row(node_id)
        if present:
            self._make(present, extents)
        return [*gone, *present]

    def with_points(self, state: wire.NodeState) -> wire.NodeState:
        """A message with the surface points of its node."""
        nodes = self._store.nodes
        points = nodes.surface(nodes.row(state.id))
        return msgspec.structs.replace(state, surface_mm=surface_bytes(points, state.mean_m))

    def _measure(self, changed: Mapping[int, int], at_most: int | None) -> dict[int, _Extent]:
        """Extents of the nodes that have none, and of some whose surface changed; by id."""
        nodes, due = self._store.nodes, []
        for node_id, row in changed.items():
            known = self._measured.get(node_id)
            if known is None:
                due.append(node_id)
            elif known != nodes.surface_revisions[row]:
                self._stale[node_id] = None
        due += take_first(self._stale, at_most)
        rows = np.array([nodes.row(node_id) for node_id in due], np.int64)
        self._measured.update(zip(due, nodes.surface_revisions[rows].tolist()))
        solid = np.flatnonzero(nodes.surface_counts[rows])
        extents = dict.fromkeys(due, _NO_EXTENT)
        if len(solid):
            surfaces = nodes.surface_points_world, nodes.surface_counts
            found = extents_of(*surfaces, rows[solid], self.up)
            for index, mean, covariance, box in zip(
                solid.tolist(),
                rounded_rows(found.means, POSITION_DECIMALS),
                rounded_rows(found.covariances, VARIANCE_DECIMALS),
                boxes(found),
            ):
                extents[due[index]] = mean, covariance, box
        return extents

    def _make(self, present: Mapping[int, int], extents: Mapping[int, _Extent]) -> None:
        """Write the messages of nodes, given by id and row, with a new or the known extent."""
        nodes, rows = self._store.nodes, np.array(list(present.values()), np.int64)
        vocabulary, labels = self._store.vocabulary, self._store.edits.labels
        means, covariances = nodes.means[rows], nodes.covariances[rows]
        columns = (nodes.observations, nodes.existence, nodes.first_seen_ns, nodes.last_seen_ns)
        for node_id, classes, *pooled, observations, existence, first_ns, last_ns in zip(
            present,
            listed(nodes.class_probabilities[rows], vocabulary.classes, self._top_k),
            rounded_rows(means, POSITION_DECIMALS),
            rounded_rows(covariances, VARIANCE_DECIMALS),
            *(column[rows].tolist() for column in columns),
        ):
            label = labels.get(node_id)
            if label is not None:
                classes = Listed([wire.Belief(label, 1.0)], 0.0, 0.0)
            mean, covariance, box = extents.get(node_id) or self._known_extent(node_id)
            if mean is None or covariance is None or not self._even_gaussians:
                mean, covariance = pooled
            self.states[node_id] = wire.NodeState(
                id=node_id,
                label=classes.beliefs[0].label,
                classes=classes.beliefs,
                remainder=classes.remainder,
                mean_m=mean,
                covariance_m2=covariance,
                box=box,
                observations=observations,
                confirmed=True,
                existence=existence if existence >= 0 else UNSET,
                first_seen=wire.stamp_from_ns(first_ns),
                last_seen=wire.stamp_from_ns(last_ns),
                entropy_nats=classes.entropy_nats,
                label_provenance=UNSET if label is None else "operator",
            )

    def _known_extent(self, node_id: int) -> _Extent:
        state = self.states[node_id]
        return _NO_EXTENT if state.box is UNSET else (state.mean_m, state.covariance_m2, state.box)


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
