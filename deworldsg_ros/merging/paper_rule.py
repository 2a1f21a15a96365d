"""The paper's rule: an object matches the nearest node that passes Eq. 5-6, or creates a node."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from deworldsg_ros.base.array_file import Arrays
from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.edits import EditRequest
from deworldsg_ros.graph.floor_plan import FoundThings
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import NodeStates
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging.editing import Editor, EditReply, may_merge
from deworldsg_ros.merging.life_cycle import DELETED
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.frame_graph import LocalGraph, Vocabulary
from deworldsg_ros.scene.gaussian import eigenvalue_bound, log_determinant

# --- Search for the nearest node that passes Eq. 5 and 6, compiled: one pass over all nodes.
#
# The kernel compares Bhattacharyya distances BD = dᵀS⁻¹d/8 + ½ ln(|S| / √(|A||B|)), S = (A + B)/2.
# The Hellinger distance is a monotone function of BD. Both terms are >= 0, so a node is rejected as
# soon as one term is too large. The cheapest test comes first:
#
# 1. |d|² / (4 (λ_a + λ_b)) <= dᵀS⁻¹d/8 with λ >= the largest eigenvalue: needs no inverse.
# 2. dᵀS⁻¹d/8 from the pivots of S: needs no logarithm.
# 3. BD itself.
# 4. D_c, which reads the whole class distribution: only for a node that would be the nearest.

# Rounding must not let a bound reject a node that passes the exact comparison.
_SLACK = 1.0 + 1e-9


class Observed(NamedTuple):
    """An object or node for which a matching node is searched.

    Attributes:
        mean: (3,) float64, metres, world frame.
        covariance: (3, 3) float64, square metres, positive definite.
        log_determinant: of the covariance, by `scene.gaussian.log_determinant`.
        eigenvalue_bound: of the covariance, by `scene.gaussian.eigenvalue_bound`.
        class_probabilities: (C,) float64, sum one.
    """

    mean: Float64
    covariance: Float64
    log_determinant: float
    eigenvalue_bound: float
    class_probabilities: Float64


# The fields of `Observed`, and the arrays of a `NodeTable` that the kernel reads, as plain tuples:
# numba is slower to call with named tuples.
_ItemArrays = tuple[Float64, Float64, float, float, Float64]
_NodeArrays = tuple[Int64, Float64, Float64, Float64, Float64, Float64]


def bhattacharyya_bound(hellinger_threshold: float) -> float:
    """B with HD < δ ⇔ BD < B: B = -ln(1 - δ²), since HD = √(1 - exp(-BD))."""
    return -math.log1p(-(hellinger_threshold**2))


def observed(mean: Float64, covariance: Float64, class_probabilities: Float64) -> Observed:
    """An object by its Gaussian, metres, world frame, and its class distribution (C,)."""
    return Observed(
        mean,
        covariance,
        log_determinant(covariance),
        eigenvalue_bound(covariance),
        class_probabilities,
    )


def nearest_slot(
    item: Observed,
    nodes: NodeTable,
    bhattacharyya_bound: float,
    class_distance_threshold: float,
    skipped: int = -1,
) -> int:
    """Slot of the node with the smallest Hellinger distance among those that pass Eq. 6.

    Args:
        item: the object or node.
        nodes: the nodes to compare with.
        bhattacharyya_bound: of the threshold δ_g.
        class_distance_threshold: δ_c.
        skipped: slot that is not compared; -1 = none.

    Returns:
        The slot; among equal distances that of the smallest id; -1 if no node passes.
    """
    table = (
        nodes.ids,
        nodes.means,
        nodes.covariances,
        nodes.log_determinants,
        nodes.eigenvalue_bounds,
        nodes.class_probabilities,
    )
    return int(_nearest(item[:], table, skipped, bhattacharyya_bound, class_distance_threshold))


def warm_up() -> None:
    """Compile the kernel, or load it from the cache."""
    nodes = NodeTable(1)
    nodes.put(nodes.add(1), np.zeros(3), np.eye(3), np.ones(1), 1.0, 1)
    nearest_slot(observed(np.zeros(3), np.eye(3), np.ones(1)), nodes, 1.0, 1.0)


@kernel
def _nearest(  # pragma: no cover - compiled
    item: _ItemArrays,
    nodes: _NodeArrays,
    skipped: int,
    bhattacharyya_bound: float,
    class_distance_threshold: float,
) -> int:
    mean, covariance, log_determinant, eigenvalue_bound, classes = item
    ids, means, covariances, log_determinants, eigenvalue_bounds, node_classes = nodes
    a00, a10, a11 = covariance[0, 0], covariance[1, 0], covariance[1, 1]
    a20, a21, a22 = covariance[2, 0], covariance[2, 1], covariance[2, 2]
    best_slot = -1
    best = bhattacharyya_bound
    best_slack = best * _SLACK
    for slot in range(len(ids)):
        d0 = mean[0] - means[slot, 0]
        d1 = mean[1] - means[slot, 1]
        d2 = mean[2] - means[slot, 2]
        squared = d0 * d0 + d1 * d1 + d2 * d2
        if squared > 4.0 * best_slack * (eigenvalue_bound + eigenvalue_bounds[slot]):
            continue
        if slot == skipped or ids[slot] == 0:
            continue
        # LDLᵀ of S; the operations are those of scene.gaussian.log_determinant.
        s00 = (a00 + covariances[slot, 0, 0]) / 2
        s10 = (a10 + covariances[slot, 1, 0]) / 2
        s11 = (a11 + covariances[slot, 1, 1]) / 2
        s20 = (a20 + covariances[slot, 2, 0]) / 2
        s21 = (a21 + covariances[slot, 2, 1]) / 2
        s22 = (a22 + covariances[slot, 2, 2]) / 2
        l10 = s10 / s00
        l20 = s20 / s00
        pivot_1 = s11 - l10 * s10
        rest = s21 - l20 * s10
        l21 = rest / pivot_1
        pivot_2 = s22 - l20 * s20 - l21 * rest
        y1 = d1 - l10 * d0
        y2 = d2 - l20 * d0 - l21 * y1
        mahalanobis = d0 * d0 / s00 + y1 * y1 / pivot_1 + y2 * y2 / pivot_2
        if mahalanobis > 8.0 * best_slack:
            continue
        log_mixed = math.log(s00 * pivot_1 * pivot_2)
        log_ratio = log_mixed - (log_determinant + log_determinants[slot]) / 2
        distance = max(mahalanobis / 8 + log_ratio / 2, 0.0)
        # Among equal distances the smallest id wins; slots are in no order.
        if distance > best or (distance == best and (best_slot < 0 or ids[slot] > ids[best_slot])):
            continue
        inner = 0.0
        for index in range(len(classes)):
            inner += classes[index] * node_classes[slot, index]
        if 1.0 - inner < class_distance_threshold:
            best_slot = slot
            best = distance
            best_slack = best * _SLACK
    return best_slot


# --- The paper's rule: an object matches the nearest node that passes Eq. 5-6, or creates a node.


class PaperMerging:
    """Merges local graphs into a scene graph by the rule of Eq. 5-7."""

    def __init__(self, config: MergingConfig) -> None:
        self.configure(config)

    def configure(self, config: MergingConfig) -> None:
        """Use other thresholds from the next frame on."""
        self._bound = bhattacharyya_bound(config.hellinger_threshold)
        self._class_threshold = config.class_distance_threshold

    def publish_from(self, graph: GlobalGraph, min_existence: float) -> None:
        """Nothing: all nodes are published."""

    def warm_up(self) -> None:
        """Compile the kernels before the first frame."""
        warm_up()
        graph = GlobalGraph(Vocabulary(("class",), ("predicate",)), "world")
        observation = (np.zeros(3), np.eye(3), np.ones(1), 1, np.zeros((1, 3), np.float32))
        graph.observe(graph.add_node(*observation), *observation)
        NodeStates(graph, 1, 0.0).refresh()

    def merge(self, graph: GlobalGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph; see `Merging.merge`.

        Objects are processed in row order. An object may match a node that an earlier row of the
        same frame created. Relations are added when all objects have a node.
        """
        local = graph.admit(local)
        assigned = [self._assign(graph, local, row) for row in range(len(local))]
        node_ids = [graph.resolve(node_id) for node_id in assigned]
        graph.remember_frame(local.stamp_ns, node_ids)
        graph.add_relations(local, node_ids)
        return node_ids

    def things(self) -> set[int]:
        """See `Merging.things`."""
        return set()

    def add(self, graph: GlobalGraph, found: FoundThings) -> None:
        """See `Merging.add`."""
        raise AssertionError("the paper's rule has no nodes that were never detected")

    def hidden(self, graph: GlobalGraph) -> dict[int, str]:
        """The deleted nodes; all others are published."""
        return dict.fromkeys(sorted(graph.edits.deleted), DELETED)

    def shown(self, nodes: NodeTable, slots: Int64) -> Bool | None:
        """See `Merging.shown`."""
        return None

    def edit(self, graph: GlobalGraph, request: EditRequest, stamp_ns: int) -> EditReply:
        """See `Merging.edit`."""
        return Editor().apply(graph, request, stamp_ns)

    def memory(self) -> Arrays:
        """Empty: the rule has no state besides the graph."""
        return {}

    def restore(self, graph: GlobalGraph, memory: Arrays) -> None:
        """Does nothing: the rule has no state besides the graph."""

    def move(
        self, graph: GlobalGraph, slots: Int64, T_new_old: Float64, due: Collection[int]
    ) -> Float64:
        """See `Merging.move`; nodes merge by Eq. 6."""
        main = graph.move_nodes(slots, T_new_old)
        if not due:  # the search compares all nodes
            for node_id in sorted(graph.nodes.slot_of):
                if node_id in graph:
                    self._merge_repeatedly(graph, node_id)
        return main

    def _assign(self, graph: GlobalGraph, local: LocalGraph, row: int) -> int:
        """Fuse an object into its node, or create a node; returns the node's id."""
        observation = (
            local.means_world[row],
            local.covariances_world[row],
            local.class_probabilities[row],
        )
        seen = (local.stamp_ns, local.surface_points_world[row])
        match = self._nearest(graph, observed(*observation))
        if match is None:
            return graph.add_node(*observation, *seen)
        graph.observe(match, *observation, *seen)
        return self._merge_repeatedly(graph, match)

    def _merge_repeatedly(self, graph: GlobalGraph, node_id: int) -> int:
        """Merge a changed node with its nearest match until no node matches (Eq. 6)."""
        nodes = graph.nodes
        while True:
            slot = nodes.slot(node_id)
            node = Observed(
                nodes.means[slot],
                nodes.covariances[slot],
                float(nodes.log_determinants[slot]),
                float(nodes.eigenvalue_bounds[slot]),
                nodes.class_probabilities[slot],
            )
            other_id = self._nearest(graph, node, skipped=slot)
            if other_id is None or (graph.edits and not may_merge(graph, node_id, other_id)):
                return node_id
            node_id = graph.merge_nodes(node_id, other_id)

    def _nearest(self, graph: GlobalGraph, item: Observed, skipped: int = -1) -> int | None:
        """Id of the nearest node that passes Eq. 6; None if there is none."""
        slot = nearest_slot(item, graph.nodes, self._bound, self._class_threshold, skipped)
        return None if slot < 0 else int(graph.nodes.ids[slot])
