"""The messages of the nodes; only those of changed nodes are rebuilt."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.graph.extent import (
    DEFAULT_UP,
    POSITION_DECIMALS,
    Extent,
    NodeBoxes,
    rounded,
    rounded_gaussians,
    surface_bytes,
)
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.wire import messages as wire

# --- Distributions as messages list them: the best labels, the rest, and the entropy.

# Decimals of probabilities and entropies: more than their calibration.
DECIMALS = 4
_SCALE = 10.0**DECIMALS


class Listed(NamedTuple):
    """One distribution.

    Attributes:
        beliefs: the labels with the highest probabilities, the best first. Labels of equal
            probability stay in the order of the vocabulary.
        remainder: probability of all labels that are not listed.
        entropy_nats: of the whole distribution.
    """

    beliefs: list[wire.Belief]
    remainder: float
    entropy_nats: float


def listed(probabilities: Float64, names: Sequence[str], top_k: int) -> list[Listed]:
    """Distributions (n, R) over names, each with its best `top_k` labels."""
    probabilities = np.ascontiguousarray(probabilities, np.float64)
    found = _best(probabilities, probabilities.sum(axis=1), min(top_k, len(names)))
    order, shares, rests, entropies = (array.tolist() for array in found)
    return [
        Listed(list(map(wire.Belief, map(names.__getitem__, best), values)), rest, entropy)
        for best, values, rest, entropy in zip(order, shares, rests, entropies)
    ]


@kernel
def _rounded(value: float) -> float:
    """As `round(value, DECIMALS)`, for positive values.

    Means of rounded numbers often lie half-way between two numbers. The product alone does not tell
    on which side.
    """
    scaled = value * _SCALE
    whole = math.floor(scaled)
    over = scaled - whole - 0.5
    if over == 0.0:
        # What the product lost, by parts of the value that have exact products (Dekker).
        high = value * (2.0**27 + 1.0)
        high -= high - value
        over = high * _SCALE - scaled + (value - high) * _SCALE
    if over == 0.0:
        over = -0.5 + whole % 2
    return (whole + (over > 0.0)) / _SCALE


@kernel
def _best(
    probabilities: Float64, totals: Float64, top_k: int
) -> tuple[Int64, Float64, Float64, Float64]:
    """The best labels (n, k), their shares, the rests (n,) and the entropies (n,); rounded."""
    count, width = probabilities.shape
    order, shares = np.empty((count, top_k), np.int64), np.empty((count, top_k))
    rests, entropies = np.zeros(count), np.zeros(count)
    for row in range(count):
        kept = 0
        for label in range(width):
            value = probabilities[row, label]
            if value > 0.0:
                entropies[row] -= value * math.log(value)
            place = kept
            while place > 0 and probabilities[row, order[row, place - 1]] < value:
                if place < top_k:
                    order[row, place] = order[row, place - 1]
                place -= 1
            if place < top_k:
                order[row, place] = label
                kept = min(kept + 1, top_k)
        for place in range(top_k):
            shares[row, place] = _rounded(probabilities[row, order[row, place]])
            rests[row] += shares[row, place]
        rests[row] = _rounded(max(totals[row] - rests[row], 0.0))
        entropies[row] = _rounded(max(entropies[row], 0.0))
    return order, shares, rests, entropies


# --- Work that waits: a call takes what waits longest, and more of it if much waits.

# Work that waits is done after this many calls: messages lag by a second at 30 Hz.
MAX_CALLS = 32


def some_of(waiting: int, at_least: int) -> int:
    """How many of those that wait a call takes."""
    return max(at_least, waiting // MAX_CALLS)


def take_first(waiting: dict[int, None], at_most: int | None) -> list[int]:
    """Take the keys that a dictionary has had longest; None = all."""
    taken = list(islice(waiting, at_most))
    if len(taken) == len(waiting):
        waiting.clear()  # deleted keys would slow down the next search for the first ones
    else:
        for key in taken:
            del waiting[key]
    return taken


# --- The messages of the nodes; only those of changed nodes are rebuilt.

# The label of a node without a name that is probable enough.
UNNAMED = "object"
# Smaller turns of the estimated up direction change no box.
MIN_TURN_RAD = math.radians(1.0)


class NodeStates:
    """The newest message of each confirmed node, without surface points.

    The extent of a surface is most of the work. So a call may leave some first messages for the
    next one, and some extents of nodes that have one already. Everything else of a message is
    always the newest.

    Args:
        graph: of the nodes.
        top_k: number of labels of each node.
        min_name: least probability of the label of a node; below it, its label is UNNAMED.
        boxes: of the nodes; None = around all of their points.

    Attributes:
        up: unit vector against gravity, for the boxes.
        states: messages by id. Those of nodes that did not change are the same objects as before.
    """

    def __init__(
        self,
        graph: GlobalGraph,
        top_k: int,
        min_name: float,
        boxes: NodeBoxes | None = None,
    ) -> None:
        self._boxes = NodeBoxes(graph.nodes) if boxes is None else boxes
        self.states: dict[int, wire.NodeState] = {}
        self._graph = graph
        self._top_k, self._min_name = top_k, min_name
        self._even_gaussians = graph.even_gaussians
        self._touched = graph.watch_nodes()
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
        slot_of, confirmed = self._graph.nodes.slot_of, self._graph.nodes.confirmed
        gone, present = [], {}
        for node_id in sorted(self._touched):
            slot = slot_of.get(node_id)
            if slot is not None and confirmed[slot]:
                if node_id in self.states:
                    present[node_id] = slot
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
            present[node_id] = slot_of[node_id]
        extents = self._measure(present, at_most)
        for node_id in extents.keys() - present.keys():
            present[node_id] = slot_of[node_id]
        if present:
            self._make(present, extents)
        return [*gone, *present]

    def with_points(self, state: wire.NodeState) -> wire.NodeState:
        """A message with the surface points of its node."""
        nodes = self._graph.nodes
        points = nodes.surface(nodes.slot(state.id))
        return msgspec.structs.replace(state, surface_mm=surface_bytes(points, state.mean_m))

    def _measure(self, changed: Mapping[int, int], at_most: int | None) -> dict[int, Extent | None]:
        """Extents of the nodes that have none, and of some whose surface changed; by id.

        None = without points.
        """
        nodes, due = self._graph.nodes, []
        revisions = nodes.surface_revisions
        for node_id, slot in changed.items():
            known = self._measured.get(node_id)
            if known is None:
                due.append(node_id)
            elif known != revisions[slot]:
                self._stale[node_id] = None
        due += take_first(self._stale, at_most)
        if not due:
            return {}
        slots = nodes.slots_of(due)
        self._measured.update(zip(due, revisions[slots].tolist()))
        solid = nodes.surface_counts[slots] > 0
        found = iter(self._boxes.extents(slots[solid], self.up))
        return {
            node_id: next(found) if has_points else None
            for node_id, has_points in zip(due, solid.tolist())
        }

    def _make(self, present: Mapping[int, int], extents: Mapping[int, Extent | None]) -> None:
        """Write the messages of nodes, given by id and slot, with a new or the known extent."""
        nodes, slots = self._graph.nodes, np.array(list(present.values()), np.int64)
        vocabulary, labels = self._graph.vocabulary, self._graph.edits.labels
        columns = (nodes.observations, nodes.existence, nodes.first_seen_ns, nodes.last_seen_ns)
        for node_id, classes, pooled, colour, observations, existence, first_ns, last_ns in zip(
            present,
            listed(nodes.class_probabilities[slots], vocabulary.classes, self._top_k),
            rounded_gaussians(nodes.means, nodes.covariances, slots),
            _colours(nodes.colours[slots]),
            *(column[slots].tolist() for column in columns),
        ):
            label = labels.get(node_id)
            if label is not None:
                classes = Listed([wire.Belief(label, 1.0)], 0.0, 0.0)
            best = classes.beliefs[0]
            named = best.probability >= self._min_name
            extent = extents[node_id] if node_id in extents else self._known_extent(node_id)
            mean, covariance = pooled[:3], pooled[3:]
            if extent is not None and self._even_gaussians:
                mean, covariance = extent.mean_m, extent.covariance_m2
            self.states[node_id] = wire.NodeState(
                id=node_id,
                label=best.label if named else UNNAMED,
                named=named,
                classes=classes.beliefs,
                remainder=classes.remainder,
                mean_m=mean,
                covariance_m2=covariance,
                box=UNSET if extent is None else self._boxes.followed(node_id, extent.box),
                observations=observations,
                confirmed=True,
                existence=existence if existence >= 0 else UNSET,
                first_seen=wire.stamp_from_ns(first_ns),
                last_seen=wire.stamp_from_ns(last_ns),
                entropy_nats=classes.entropy_nats,
                label_provenance=UNSET if label is None else "operator",
                colour_lab=colour,
            )

    def _known_extent(self, node_id: int) -> Extent | None:
        state = self.states[node_id]
        if state.box is UNSET:
            return None
        return Extent(state.mean_m, state.covariance_m2, state.box)


def _colours(sums: Float64) -> list[list[float] | UnsetType]:
    """Mean colours of n nodes, by `NodeTable.colours`; CIELAB with one decimal."""
    means = (sums[:, :3] / np.maximum(sums[:, 3:], 1.0)).round(1) + 0.0
    return [mean if n else UNSET for mean, n in zip(means.tolist(), sums[:, 3].tolist())]


# Why a node that was published is hidden when its object is gone.
ABSENT = "absent from its position"


def hidden_node(graph: GlobalGraph, node_id: int, reason: str) -> wire.HiddenNode:
    """The message of a node that is not published."""
    nodes, slot = graph.nodes, graph.nodes.slot(node_id)
    best = int(nodes.class_probabilities[slot].argmax())
    return wire.HiddenNode(
        label=graph.vocabulary.classes[best],
        mean_m=rounded(nodes.means[slot], POSITION_DECIMALS),
        existence=max(0.0, float(nodes.existence[slot])),
        observations=int(nodes.observations[slot]),
        reason=reason,
    )
