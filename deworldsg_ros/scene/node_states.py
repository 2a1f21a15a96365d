"""The messages of the nodes; only those of changed nodes are rebuilt."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec import UNSET

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.beliefs import Listed, listed
from deworldsg_ros.scene.extent import (
    DEFAULT_UP,
    POSITION_DECIMALS,
    Extent,
    extents_of,
    rounded,
    rounded_gaussians,
    surface_bytes,
)
from deworldsg_ros.scene.node_store import NodeStore
from deworldsg_ros.scene.waiting import take_first

# Smaller turns of the estimated up direction change no box.
MIN_TURN_RAD = math.radians(1.0)


class NodeStates:
    """The newest message of each confirmed node, without surface points.

    The extent of a surface is most of the work. So a call may leave some first messages for the
    next one, and some extents of nodes that have one already. Everything else of a message is
    always the newest.

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
        # Confirmed nodes without a message.
        self._new: dict[int, None] = {}
        # Which surface the extent of a message is of, and the nodes whose extent is an older one.
        self._measured: dict[int, int] = {}
        self._stale: dict[int, None] = {}
        self.up: tuple[float, ...] = DEFAULT_UP
        self._up_world: Float64 | None = None

    @property
    def new(self) -> int:
        """Number of nodes whose first message waits for a call."""
        return len(self._new)

    @property
    def waiting(self) -> int:
        """Number of nodes whose extent waits for a call."""
        return len(self._stale)

    def set_up(self, up_world: Float64) -> None:
        """Set the direction against gravity (3,); smaller turns than `MIN_TURN_RAD` are ignored."""
        if up_world is self._up_world:  # the estimate is seldom another one
            return
        self._up_world = up_world
        if float(up_world @ self.up) < math.cos(MIN_TURN_RAD):
            self.up = tuple(rounded(up_world, POSITION_DECIMALS))
            self._stale.update(dict.fromkeys(sorted(self._measured)))

    def refresh(self, at_most: int | None = None, new_at_most: int | None = None) -> list[int]:
        """Follow the nodes; returns the ids that have another message now, or none.

        Args:
            at_most: number of extents to measure again, those that wait longest first; None = all.
            new_at_most: number of first messages; None = all.
        """
        places, confirmed = self._store.nodes.places, self._store.nodes.confirmed
        gone, present = [], {}
        for node_id in sorted(self._touched):
            row = places.get(node_id)
            if row is not None and confirmed[row]:
                if node_id in self.states:
                    present[node_id] = row
                else:
                    self._new[node_id] = None
                continue
            self._new.pop(node_id, None)
            if self.states.pop(node_id, None) is not None:
                gone.append(node_id)
                self._measured.pop(node_id, None)
                self._stale.pop(node_id, None)
        self._touched.clear()
        for node_id in take_first(self._new, new_at_most):
            present[node_id] = places[node_id]
        extents = self._measure(present, at_most)
        for node_id in extents.keys() - present.keys():
            present[node_id] = places[node_id]
        if present:
            self._make(present, extents)
        return [*gone, *present]

    def with_points(self, state: wire.NodeState) -> wire.NodeState:
        """A message with the surface points of its node."""
        nodes = self._store.nodes
        points = nodes.surface(nodes.row(state.id))
        return msgspec.structs.replace(state, surface_mm=surface_bytes(points, state.mean_m))

    def _measure(self, changed: Mapping[int, int], at_most: int | None) -> dict[int, Extent | None]:
        """Extents of the nodes that have none, and of some whose surface changed; by id.

        None = without points.
        """
        nodes, due = self._store.nodes, []
        revisions = nodes.surface_revisions
        for node_id, row in changed.items():
            known = self._measured.get(node_id)
            if known is None:
                due.append(node_id)
            elif known != revisions[row]:
                self._stale[node_id] = None
        due += take_first(self._stale, at_most)
        if not due:
            return {}
        rows = np.array([nodes.places[node_id] for node_id in due], np.int64)
        self._measured.update(zip(due, revisions[rows].tolist()))
        solid = nodes.surface_counts[rows] > 0
        surfaces = nodes.surface_points_world, nodes.surface_counts
        found = iter(extents_of(*surfaces, rows[solid], self.up))
        return {
            node_id: next(found) if has_points else None
            for node_id, has_points in zip(due, solid.tolist())
        }

    def _make(self, present: Mapping[int, int], extents: Mapping[int, Extent | None]) -> None:
        """Write the messages of nodes, given by id and row, with a new or the known extent."""
        nodes, rows = self._store.nodes, np.array(list(present.values()), np.int64)
        vocabulary, labels = self._store.vocabulary, self._store.edits.labels
        columns = (nodes.observations, nodes.existence, nodes.first_seen_ns, nodes.last_seen_ns)
        for node_id, classes, pooled, observations, existence, first_ns, last_ns in zip(
            present,
            listed(nodes.class_probabilities[rows], vocabulary.classes, self._top_k),
            rounded_gaussians(nodes.means, nodes.covariances, rows),
            *(column[rows].tolist() for column in columns),
        ):
            label = labels.get(node_id)
            if label is not None:
                classes = Listed([wire.Belief(label, 1.0)], 0.0, 0.0)
            extent = extents[node_id] if node_id in extents else self._known_extent(node_id)
            mean, covariance = pooled[:3], pooled[3:]
            if extent is not None and self._even_gaussians:
                mean, covariance = extent.mean_m, extent.covariance_m2
            self.states[node_id] = wire.NodeState(
                id=node_id,
                label=classes.beliefs[0].label,
                classes=classes.beliefs,
                remainder=classes.remainder,
                mean_m=mean,
                covariance_m2=covariance,
                box=UNSET if extent is None else extent.box,
                observations=observations,
                confirmed=True,
                existence=existence if existence >= 0 else UNSET,
                first_seen=wire.stamp_from_ns(first_ns),
                last_seen=wire.stamp_from_ns(last_ns),
                entropy_nats=classes.entropy_nats,
                label_provenance=UNSET if label is None else "operator",
            )

    def _known_extent(self, node_id: int) -> Extent | None:
        state = self.states[node_id]
        if state.box is UNSET:
            return None
        return Extent(state.mean_m, state.covariance_m2, state.box)


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
