"""Matching of the objects of a frame with the nodes that their surfaces overlap."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.scene.arrays import Bool, Float64, Int64, areas, shared_areas
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.vocabulary import ALONE_IN_PLACE

# --- The one-to-one assignment with the greatest total score.
#
# `scipy.optimize.linear_sum_assignment` gives the same, but takes a fourth of the start of
# graph_node to import.


def assign(scores: Float64) -> Int64:
    """Column of each row, one to one, with the greatest total score; -1 = none.

    Args:
        scores: (n, k) float64, finite. All rows have a column if n <= k, else all columns have one.
    """
    count, width = scores.shape
    if count <= width:
        return _columns_of_rows(np.ascontiguousarray(-scores))
    columns = np.full(count, -1)
    columns[_columns_of_rows(np.ascontiguousarray(-scores.T))] = np.arange(width)
    return columns


@kernel
def _columns_of_rows(costs: Float64) -> Int64:
    """The assignment of n <= k rows with the least total cost.

    Shortest augmenting paths in the order of scipy: D. F. Crouse, "On implementing 2D rectangular
    assignment algorithms", IEEE Transactions on Aerospace and Electronic Systems 52(4), 2016.
    """
    count, width = costs.shape
    row_prices, column_prices = np.zeros(count, np.float64), np.zeros(width, np.float64)
    column_of, row_of = np.empty(count, np.int64), np.empty(width, np.int64)
    for index in range(width):
        row_of[index] = -1
    paths, lengths = np.empty(width, np.int64), np.empty(width, np.float64)
    open_columns, closed = np.empty(width, np.int64), np.empty(width, np.bool_)
    for first in range(count):
        column_of[first] = -1
        for index in range(width):
            lengths[index], closed[index] = np.inf, False
            open_columns[index] = width - 1 - index
        row, length, end = first, 0.0, -1
        for left in range(width, 0, -1):
            nearest, shortest = 0, np.inf
            for index in range(left):
                column = open_columns[index]
                through = length + costs[row, column] - row_prices[row] - column_prices[column]
                if through < lengths[column]:
                    paths[column], lengths[column] = row, through
                found = lengths[column]
                if found < shortest or (found == shortest and row_of[column] == -1):
                    nearest, shortest = index, found
            length, column = shortest, open_columns[nearest]
            closed[column], open_columns[nearest] = True, open_columns[left - 1]
            if row_of[column] == -1:
                end = column
                break
            row = row_of[column]
        row_prices[first] += length
        for column in range(width):
            if closed[column]:
                if column != end:
                    row_prices[row_of[column]] += length - lengths[column]
                column_prices[column] -= length - lengths[column]
        while True:
            row = paths[end]
            row_of[end] = row
            column_of[row], end = end, column_of[row]
            if row == first:
                break
    return column_of


# --- Matching of the objects of a frame with the nodes that their surfaces overlap.

# Minimum overlap of a match whose classes differ. Without a match of different classes, labels that
# flip create nodes of their own (docs/dev/notebook.md).
OVERLAP_THRESHOLD_OTHER_CLASS = 0.55
# If the classes differ, at least this fraction of the object lies on the node, and of what is seen
# of the node in the object: a book on a chair covers less of it. With all faults at once, a
# rendered room keeps 50 % of its relations at 0.15, 61 % at 0.25 and 60 % at 0.4.
MIN_FRACTION_OTHER_CLASS = 0.25
# Classes agree if two labels, one drawn from each distribution, are equal with this probability.
CLASS_AGREEMENT = 0.3
# Weights of the agreement of classes and of Gaussians in the match score; the overlap fraction has
# weight 1. Objects in a row touch each other's cells: then the Gaussians disambiguate.
CLASS_WEIGHT = 0.5
GAUSSIAN_WEIGHT = 0.5
# Maximum distance of the means of a match, in standard deviations of the object's or of the node's
# Gaussian. The mean of a part of an evenly observed object lies within 3.
MAX_DEVIATIONS = 4.0


# Means, covariances and class distributions of n objects or nodes.
_Items = tuple[Float64, Float64, Float64]


class Matches(NamedTuple):
    """How n objects of a frame match k nodes.

    Attributes:
        slots: (k,) int64, of the nodes.
        on_nodes: (n, k) float64, fraction of each object's cells that lie on each node.
        scores: (n, k) float64, 0 = no match possible.
        touching: (n, k) bool, whether the surfaces touch and the classes agree.
        columns: column of the node that each object matched, one to one; -1 = none.
    """

    slots: Int64
    on_nodes: Float64
    scores: Float64
    touching: Bool
    columns: list[int]


def match(
    local: LocalGraph,
    nodes: NodeTable,
    slots: Int64,
    on_nodes: Float64,
    covered: Float64,
    overlap_threshold: float,
    cell_m: float,
) -> Matches:
    """Match the objects of a frame with some nodes.

    The score of a match is overlap + CLASS_WEIGHT · Σ p q + GAUSSIAN_WEIGHT · exp(-BD), where BD is
    the Bhattacharyya distance of the two Gaussians, both blurred by the size of a cell. The overlap
    is the larger of two fractions: of the object on the node, and of the node in the object. Either
    may be a partial view of the other. If the classes differ, the smaller fraction counts, too: a
    thing on a larger one lies wholly on it.

    Args:
        local: n objects.
        nodes: the nodes of the graph.
        slots: (k,) of the nodes to compare with.
        on_nodes: (n, k) fraction of each object's cells that lie on each node.
        covered: (n, k) fraction of each node's surface that lies in each object.
        overlap_threshold: minimum overlap of a match whose classes agree.
        cell_m: edge of a cell, metres.
    """
    scores, touching = _match_scores(
        (local.means_world, local.covariances_world, local.class_probabilities),
        (nodes.means, nodes.covariances, nodes.class_probabilities),
        slots,
        on_nodes,
        covered,
        overlap_threshold,
        # Variance of a point in a cell along each axis, if only the cell is known.
        cell_m**2 / 12,
    )
    return Matches(slots, on_nodes, scores, touching, one_to_one(scores))


def match_nodes(
    nodes: NodeTable,
    slots: Int64,
    overlaps: tuple[Int64, Float64, Float64],
    overlap_threshold: float,
    cell_m: float,
) -> Float64:
    """Scores (n, k) of matches of n nodes with the k that their surfaces meet; 0 = no match.

    Args:
        nodes: of the graph.
        slots: (n,) of the nodes.
        overlaps: `VoxelMap.overlaps` of their surfaces.
        overlap_threshold: as `match`.
        cell_m: as `match`.
    """
    others, on_nodes, covered = overlaps
    columns = nodes.means, nodes.covariances, nodes.class_probabilities
    items = nodes.means[slots], nodes.covariances[slots], nodes.class_probabilities[slots]
    scores: Float64 = _match_scores(
        items, columns, others, on_nodes, covered, overlap_threshold, cell_m**2 / 12
    )[0]
    return np.where(others == slots[:, None], 0.0, scores)


def one_to_one(scores: Float64) -> list[int]:
    """One-to-one assignment with the greatest total score: column of each row, -1 = none."""
    columns: list[int] = assign(scores).tolist()
    return [c if c >= 0 and scores[row, c] > 0 else -1 for row, c in enumerate(columns)]


@kernel
def _solve(covariance: Float64, d0: float, d1: float, d2: float) -> tuple[float, float]:
    """|Σ| and dᵀΣ⁻¹d by the LDLᵀ pivots of a covariance."""
    c00 = covariance[0, 0]
    l10 = covariance[1, 0] / c00
    l20 = covariance[2, 0] / c00
    pivot_1 = covariance[1, 1] - l10 * covariance[1, 0]
    rest = covariance[2, 1] - l20 * covariance[1, 0]
    pivot_2 = covariance[2, 2] - l20 * covariance[2, 0] - rest / pivot_1 * rest
    y1 = d1 - l10 * d0
    y2 = d2 - l20 * d0 - rest / pivot_1 * y1
    squared = d0 * d0 / c00 + y1 * y1 / pivot_1 + y2 * y2 / pivot_2
    return c00 * pivot_1 * pivot_2, squared


@kernel
def _match_scores(
    objects: _Items,
    nodes: _Items,
    rows: Int64,
    on_nodes: Float64,
    covered: Float64,
    overlap_threshold: float,
    blur_m2: float,
) -> tuple[Float64, Bool]:
    means, covariances, classes = objects
    node_means, node_covariances, node_classes = nodes
    scores = np.zeros(on_nodes.shape, np.float64)
    touching = np.zeros(on_nodes.shape, np.bool_)
    a, b = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    both = np.empty((3, 3), np.float64)
    for index in range(len(on_nodes)):
        for column in range(len(rows)):
            on_node, cover = on_nodes[index, column], covered[index, column]
            if on_node == 0.0:
                continue
            row = rows[column]
            agreement = 0.0
            for label in range(classes.shape[1]):
                agreement += classes[index, label] * node_classes[row, label]
            agree = agreement > CLASS_AGREEMENT
            touching[index, column] = agree
            overlap = max(on_node, cover)
            if not agree and min(on_node, cover) < MIN_FRACTION_OTHER_CLASS:
                continue
            if overlap < (overlap_threshold if agree else OVERLAP_THRESHOLD_OTHER_CLASS):
                continue
            for i in range(3):
                for j in range(3):
                    blur = blur_m2 if i == j else 0.0
                    a[i, j] = covariances[index, i, j] + blur
                    b[i, j] = node_covariances[row, i, j] + blur
                    both[i, j] = (a[i, j] + b[i, j]) / 2
            d0 = means[index, 0] - node_means[row, 0]
            d1 = means[index, 1] - node_means[row, 1]
            d2 = means[index, 2] - node_means[row, 2]
            determinant_a, squared_a = _solve(a, d0, d1, d2)
            determinant_b, squared_b = _solve(b, d0, d1, d2)
            if min(squared_a, squared_b) > MAX_DEVIATIONS**2:
                continue
            determinant, squared = _solve(both, d0, d1, d2)
            likeness = math.exp(-squared / 8) * math.sqrt(
                math.sqrt(determinant_a * determinant_b) / determinant
            )
            scores[index, column] = overlap + CLASS_WEIGHT * agreement + GAUSSIAN_WEIGHT * likeness
    return scores, touching


# --- Evidence that two nodes are parts of one object, or two objects.

Pair = tuple[int, int]

# Weight of a frame in which an object that matched one node touched the other. Sides of one object
# that no view shows together touch, but so do neighbours.
TOUCHING_WEIGHT = 1
# Weight of a frame in which the object overlapped both nodes enough for a match. A frame that shows
# two objects, one of them unsure, weighs as much for two.
OVERLAPPING_WEIGHT = 3
# Two nodes are merged at this sum: three frames in which an object overlapped both.
MERGE_THRESHOLD = 9
# A frame that shows both as two objects outweighs ten in which one object overlapped both. A
# detector seldom makes two objects of one, but it often detects only one of two that touch.
SEPARATE_WEIGHT = 30
# With evidence of about three viewpoints that show both, two objects are two, whatever place they
# stand in: the mask of a chair may take in the one beside it for many frames.
TWO_OBJECTS = 3 * SEPARATE_WEIGHT
# A detection with a lower score is unsure. An object lies on a node if at least this fraction of
# its cells does. With NanoDet (scores from 0.2; a rendered room and the shipped recording), 36 % of
# 1253 pairs of one frame and class with an unsure detection were one object if one lay on the
# other's node, and 9 % of 1385 if not. So the former count as touching: a detector often puts a
# second box on an object. Of pairs with two sure detections 3 of 18 were one object, and 0 of 390
# with recorded masks.
SURE_SCORE = 0.45
NESTED_FRACTION = 0.7
# Two sure boxes of one class say nothing if one object lies on the other's node, this fraction of
# one box in the other, and one score is lower than CERTAIN_SCORE: a second box on an object. With
# the pair of embedded detectors (scores from 0.5; office, two rendered rooms and the recording), 60
# of 259 such pairs were one object, and 14 of 961 that touch nowhere and whose boxes lie apart.
INSIDE_FRACTION = 0.6
CERTAIN_SCORE = 0.75
# After a step of this length, a frame counts as three: its errors are not those of the last frame.
# In a room at 10 Hz, nine steps of ten are shorter than 0.1 m. Frames nearer than that show one
# picture: together they say at most one merge, or once that there are two objects.
WIDE_STEP_M = 0.2
WIDE_STEP_FACTOR = 3


# --- Nodes that are several objects.
#
# A mask that takes in the chair beside its own makes one node of two. Later, both are detected, and
# both lie on it: 898 of 924 such pairs were two objects (rendered rooms and shipped recording, with
# faults). One viewpoint may be mistaken; two seldom make the same mistake.

# A node is several objects if so many viewpoints show it.
SEVERAL_VIEWPOINTS = 2


def several_on_one(local: LocalGraph, matches: Matches) -> list[tuple[int, list[int]]]:
    """The nodes (columns) on which several objects of a frame lie, with their rows.

    The objects have their class, sure scores, and none has its box within that of another.
    """
    on = (matches.on_nodes >= NESTED_FRACTION) & matches.touching
    on &= (local.scores >= SURE_SCORE)[:, None]
    columns = np.flatnonzero(on.sum(axis=0) > 1).tolist()
    if not columns:
        return []
    is_second = are_second(local.boxes_xyxy)
    np.fill_diagonal(is_second, False)
    found = []
    for column in columns:
        rows = np.flatnonzero(on[:, column])
        rows = rows[~is_second[np.ix_(rows, rows)].any(axis=1)]
        if len(rows) > 1:
            found.append((column, rows.tolist()))
    return found


def are_second(boxes_xyxy: Float64) -> Bool:
    """Of which pairs (n, n) of boxes (n, 4) one lies mostly in the other."""
    sizes = areas(boxes_xyxy)
    smaller = np.minimum.outer(sizes, sizes)
    shared = shared_areas(boxes_xyxy, boxes_xyxy)
    return np.asarray(shared >= INSIDE_FRACTION * np.maximum(smaller, 1))


# --- Nodes of one class that stand in one place.
#
# A detector that sees the back of a chair, and later its seat, gives two nodes whose surfaces do
# not meet. No two chairs stand one over the other: nodes of such a class whose footprints overlap
# are one object.

# Of the area of the smaller footprint.
FOOTPRINT_OVERLAP = 0.3
# The larger footprint does not grow by more: the mask of a row of chairs takes in none beside it.
GROWTH_M = 0.2
# The footprint is between these quantiles of the surface.
FOOTPRINT_QUANTILES = (0.04, 0.96)
# Footprints farther apart than this many standard deviations of both do not overlap.
FAR = 2.5


def in_one_place(graph: GlobalGraph, found: Sequence[int], others: Int64) -> list[Pair]:
    """Pairs of nodes that stand in one place.

    Args:
        graph: the nodes and up.
        found: slots of the nodes that the frame has detected: one of each pair is of these. Two
            of these are no pair: the frame would make two nodes of them again.
        others: slots of the nodes in view.
    """
    nodes = graph.nodes
    slots = np.union1d(np.asarray(found, np.int64), others)
    slots = slots[nodes.surface_counts[slots] > 0]
    labels = nodes.class_probabilities[slots].argmax(axis=1)
    names = graph.vocabulary.classes  # thousands, with a detector of free text
    alone = np.array([names[label] in ALONE_IN_PLACE for label in labels.tolist()], np.bool_)
    slots, labels = slots[alone], labels[alone]
    plane = np.linalg.svd(graph.up_world[None])[2][1:]
    means = nodes.means[slots] @ plane.T
    spread_m = np.sqrt(np.trace(nodes.covariances[slots], axis1=1, axis2=2))
    distance_m = np.linalg.norm(means[:, None] - means[None], axis=2)
    near = (distance_m < FAR * (spread_m[:, None] + spread_m[None])) & (labels[:, None] == labels)
    is_found = np.isin(slots, found)
    pairs = np.argwhere(np.triu(near & (is_found[:, None] ^ is_found[None]), 1)).tolist()
    bounds = {
        row: np.quantile(nodes.surface(slots[row]) @ plane.T, FOOTPRINT_QUANTILES, axis=0)
        for row in {row for pair in pairs for row in pair}
    }
    return [(int(slots[a]), int(slots[b])) for a, b in pairs if _is_one_place(bounds[a], bounds[b])]


def _is_one_place(a: Float64, b: Float64) -> bool:
    """Whether two footprints, lower and upper corners (2, 2), are of one object."""
    larger = np.maximum(a[1] - a[0], b[1] - b[0])
    hull = np.maximum(a[1], b[1]) - np.minimum(a[0], b[0])
    shared = np.maximum(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0.0).prod()
    smaller = min((a[1] - a[0]).prod(), (b[1] - b[0]).prod())
    return bool((hull <= larger + GROWTH_M).all() and shared > FOOTPRINT_OVERLAP * smaller)


class JointEvidence:
    """Sums, for the slots of two nodes, the frames for and against one object.

    A frame that shows two objects counts wherever they are in it. If later a mask covers both, or a
    pose is wrong, they are known to be two.
    """

    def __init__(self) -> None:
        # Evidence for one object minus evidence for two: by the smaller slot, then the greater.
        self._balances: defaultdict[int, dict[int, int]] = defaultdict(dict)
        # The smaller slots that have evidence about a greater one.
        self._smaller: defaultdict[int, set[int]] = defaultdict(set)
        self._due: list[Pair] = []
        self._camera_world = np.full(3, np.nan)
        # Where the present viewpoint began, and what it has said of each pair for one object and
        # for two.
        self._viewpoint_world = np.full(3, np.nan)
        self._for: dict[Pair, int] = {}
        self._against: dict[Pair, int] = {}
        # Viewpoints that showed a node as several objects, and where the last one was.
        self._several: dict[int, tuple[int, Float64]] = {}

    @property
    def balances(self) -> dict[Pair, int]:
        """Evidence for one object minus evidence for two, of each pair (smaller slot first)."""
        return {(a, b): row[b] for a, row in sorted(self._balances.items()) for b in sorted(row)}

    def restore(self, balances: dict[Pair, int]) -> None:
        """Continue with the `balances` of an earlier run."""
        for (a, b), balance in balances.items():
            self._balances[min(a, b)][max(a, b)] = balance
            self._smaller[max(a, b)].add(min(a, b))

    def add_frame(
        self,
        object_slots: list[int],
        matches: Matches,
        detection_scores: Float64,
        boxes_xyxy: Float64,
        camera_world: Float64,
    ) -> None:
        """Add one frame of n objects that met k nodes.

        Args:
            object_slots: slot of the node of each object, matched or new.
            matches: of the objects and the k nodes.
            detection_scores: (n,) scores of the objects.
            boxes_xyxy: (n, 4) boxes of the objects, pixels.
            camera_world: (3,) camera position, metres.
        """
        slots = matches.slots.tolist()
        sure = dict(zip(object_slots, (detection_scores >= SURE_SCORE).tolist()))
        rows = {slot: row for row, slot in enumerate(object_slots)}
        is_second = are_second(boxes_xyxy)
        is_second &= np.minimum.outer(detection_scores, detection_scores) < CERTAIN_SCORE
        evidence: dict[Pair, int] = {}
        taken = set(matches.columns)
        met = (matches.touching | (matches.scores > 0)).nonzero()
        nested = matches.touching[met] & (matches.on_nodes[met] >= NESTED_FRACTION)
        for row, column, score, is_nested in zip(
            *(places.tolist() for places in met), matches.scores[met].tolist(), nested.tolist()
        ):
            a, b = object_slots[row], slots[column]
            pair = (a, b) if a < b else (b, a)
            if column not in taken:
                if matches.columns[row] >= 0:
                    weight = OVERLAPPING_WEIGHT if score else TOUCHING_WEIGHT
                    evidence[pair] = max(evidence.get(pair, 0), weight)
            elif is_nested and a != b and not (sure[a] and sure[b]):
                evidence[pair] = TOUCHING_WEIGHT
            elif is_nested and a != b and is_second[row, rows[b]]:
                evidence[pair] = 0
        step_m = math.dist(camera_world, self._camera_world)
        factor = WIDE_STEP_FACTOR if step_m > WIDE_STEP_M else 1
        self._camera_world = camera_world.copy()
        if not math.dist(camera_world, self._viewpoint_world) <= WIDE_STEP_M:
            self._viewpoint_world = self._camera_world
            self._for.clear()
            self._against.clear()
        self._separate(sure, evidence)
        for (a, b), weight in evidence.items():
            said = self._for.get((a, b), 0)
            self._for[a, b] = min(said + weight * factor, MERGE_THRESHOLD)
            self._add(a, b, self._for[a, b] - said)
            if self._balances[a][b] >= MERGE_THRESHOLD:
                self._due.append((a, b))

    def are_two(self, a: int, b: int) -> bool:
        """Whether viewpoints enough have shown the nodes of two slots as two objects."""
        return self.balance(a, b) <= -TWO_OBJECTS

    def add_several(self, slot: int, camera_world: Float64) -> bool:
        """Add a frame that shows the node of a slot as several objects.

        Returns:
            Whether viewpoints enough have shown it so.
        """
        count, last = self._several.get(slot, (0, camera_world + np.inf))
        if math.dist(camera_world, last) <= WIDE_STEP_M:
            return False
        self._several[slot] = count + 1, camera_world.copy()
        return count + 1 >= SEVERAL_VIEWPOINTS

    def balance(self, a: int, b: int) -> int:
        """Evidence that the nodes of two slots are one object minus evidence that they are two."""
        return self._balances[min(a, b)].get(max(a, b), 0)

    def next_merge(self) -> Pair | None:
        """The next pair that is one object; the caller has to merge it. None = no more."""
        while self._due:
            a, b = self._due.pop()
            # An earlier merge may have changed the evidence since the pair became due.
            if self._balances[a].get(b, 0) >= MERGE_THRESHOLD:
                return a, b
        return None

    def merge(self, kept: int, removed: int) -> None:
        """Combine the evidence against one object of two nodes that are one."""
        against = {b: balance for b, balance in self._balances[removed].items() if balance < 0}
        for a in self._smaller[removed]:
            balance = self._balances[a].get(removed, 0)
            if balance < 0:
                against[a] = balance
        self.forget(removed)
        for other, balance in against.items():
            if other != kept:
                self._add(min(kept, other), max(kept, other), balance)

    def move(self, slot: int, to: int) -> None:
        """A node has another slot, which has no evidence."""
        known = dict(self._balances[slot])
        known.update((a, self._balances[a][slot]) for a in self._smaller[slot])
        self.forget(slot)
        for other, balance in known.items():
            self._add(min(to, other), max(to, other), balance)

    def forget(self, slot: int) -> None:
        """Drop the evidence of a removed node."""
        self.forget_several(slot)
        for b in self._balances.pop(slot, ()):
            self._smaller[b].discard(slot)
        for a in self._smaller.pop(slot, ()):
            self._balances[a].pop(slot, None)
        for said in (self._for, self._against):
            for pair in [pair for pair in said if slot in pair]:
                del said[pair]

    def forget_several(self, slot: int) -> None:
        """The node of a slot is one object from now on."""
        self._several.pop(slot, None)

    def _add(self, a: int, b: int, balance: int) -> None:
        row = self._balances[a]
        row[b] = row.get(b, 0) + balance
        self._smaller[b].add(a)

    def _separate(self, sure: dict[int, bool], nested: Collection[Pair]) -> None:
        """Count the pairs of a frame as two objects, except some."""
        ascending = sorted(sure.items())
        for position, (a, a_sure) in enumerate(ascending):
            row = self._balances[a]
            for b, b_sure in ascending[position + 1 :]:
                if nested and (a, b) in nested:
                    continue
                balance = row.get(b)
                if balance is None:
                    self._smaller[b].add(a)
                    balance = 0
                weight = SEPARATE_WEIGHT if a_sure and b_sure else OVERLAPPING_WEIGHT
                said = self._against.get((a, b), 0)
                self._against[a, b] = min(said + weight, SEPARATE_WEIGHT)
                row[b] = balance - self._against[a, b] + said
