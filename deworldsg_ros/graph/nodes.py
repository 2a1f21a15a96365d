"""The nodes of the global graph as parallel arrays, and their ids over its life."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Columns, Float32, Float64, Int64
from deworldsg_ros.scene.gaussian import (
    eigenvalue_bound,
    eigenvalue_bounds,
    log_determinant,
    log_determinants,
    transform,
)
from deworldsg_ros.scene.surface import add_flat, add_points, drop_points

# --- The ids of nodes over the life of a graph, and the nodes of past frames.

# With more removed ids than this, those that no remembered frame has are forgotten. An id takes 0.1
# kB.
PRUNE_ABOVE = 512
# The newest removed ids stay in any case: `FrameMemory` follows merges once in 256 frames, in which
# far fewer ids are removed, and names nodes that no remembered frame shows.
NEWEST_KEPT = 128


@dataclass(frozen=True)
class IdState:
    """Everything that `NodeIds` remembers.

    Attributes:
        next_id: id of the next node.
        successors: of each removed id, the id that replaced it; 0 = none.
        removals: ids removed since `NodeIds.take_removals` was last called.
        frames: node id of each row of a frame's local graph, by stamp in nanoseconds.
    """

    next_id: int = 1
    successors: Mapping[int, int] = field(default_factory=dict)
    removals: tuple[int, ...] = ()
    frames: Mapping[int, tuple[int, ...]] = field(default_factory=dict)


class NodeIds:
    """Gives out ids, follows merges, and remembers which node each row of a frame became.

    A removed id is forgotten when no remembered frame has it any more.

    Args:
        live: contains the ids of the live nodes.
        remembered_frames: number of newest frames that are remembered.
        state: from an earlier run.
    """

    def __init__(
        self, live: Container[object], remembered_frames: int, state: IdState | None = None
    ) -> None:
        state = state or IdState()
        self._live = live
        self._remembered_frames = remembered_frames
        self._next_id = state.next_id
        self._successors = dict(state.successors)
        self._removals = list(state.removals)
        self._frames = dict(state.frames)
        self._prune_above = PRUNE_ABOVE

    @property
    def next_id(self) -> int:
        """Id of the next node."""
        return self._next_id

    def state(self) -> IdState:
        """A copy of everything that is remembered."""
        return IdState(
            self._next_id, dict(self._successors), tuple(self._removals), dict(self._frames)
        )

    def take(self) -> int:
        """Take the next id; ids are never reused."""
        self._next_id += 1
        return self._next_id - 1

    def retire(self, node_id: int, successor: int) -> None:
        """Note that a node was removed, and which node replaces it; 0 = none."""
        self._successors[node_id] = successor
        self._removals.append(node_id)

    def resolve(self, node_id: int) -> int:
        """The live node that an id stands for, following merges; 0 = none."""
        if node_id in self._live:
            return node_id
        path = []
        while node_id in self._successors:
            path.append(node_id)
            node_id = self._successors[node_id]
        for passed in path[:-1]:  # later queries take one step
            self._successors[passed] = node_id
        return node_id if node_id in self._live else 0

    def take_removals(self) -> dict[int, int | None]:
        """Ids removed since the last call, each with the live node that it was merged into."""
        removals = {node_id: self.resolve(node_id) or None for node_id in self._removals}
        self._removals.clear()
        return removals

    def remember_frame(self, stamp_ns: int, node_ids: Iterable[int]) -> None:
        """Remember which node each row of a frame's local graph became."""
        self._frames.pop(stamp_ns, None)
        self._frames[stamp_ns] = tuple(node_ids)
        if len(self._frames) > self._remembered_frames:
            del self._frames[next(iter(self._frames))]
        if len(self._successors) > self._prune_above:
            self._prune()

    def _prune(self) -> None:
        """Forget the removed ids that nobody can ask for."""
        kept: set[int] = set()
        newest = list(self._successors)[-NEWEST_KEPT:]
        for node_id in itertools.chain(newest, self._removals, *self._frames.values()):
            while node_id in self._successors and node_id not in kept:
                kept.add(node_id)
                node_id = self._successors[node_id]
        self._successors = {old: new for old, new in self._successors.items() if old in kept}
        self._prune_above = max(PRUNE_ABOVE, 2 * len(kept))

    def nodes_of_frame(self, stamp_ns: int) -> list[int] | None:
        """The live node of each row of a frame (0 = removed); None = the frame is forgotten."""
        node_ids = self._frames.get(stamp_ns)
        return None if node_ids is None else [self.resolve(node_id) for node_id in node_ids]


# --- The nodes of the global graph as parallel, contiguous arrays.

# Surface points for which a table has room at first.
FIRST_POINTS = 64
# A covariance with a pivot below this fraction of its trace is singular up to rounding.
SINGULAR = 1e-13
# Saved columns of a node, beside its surface points; the other columns follow from these.
SAVED_COLUMNS = (
    "ids",
    "means",
    "covariances",
    "class_probabilities",
    "weights",
    "observations",
    "confirmed",
    "existence",
    "first_seen_ns",
    "last_seen_ns",
    "revisions",
)


@dataclass(frozen=True)
class Observations:
    """Observations to fuse into n nodes, one row for each node.

    Attributes:
        means_world: (n, 3) float64, metres.
        covariances_world: (n, 3, 3) float64, square metres.
        class_probabilities: (n, C) float64, rows sum to one.
        weights: (n,) float64, w of Eq. 7.
        counts: (n,) int64, number of frames in each row.
        surfaces: n arrays (k, 3) float32 of surface points, metres.
        first_seen_ns, last_seen_ns: time span of all rows.
    """

    means_world: Float64
    covariances_world: Float64
    class_probabilities: Float64
    weights: Float64
    counts: Int64
    surfaces: Sequence[Float32]
    first_seen_ns: int
    last_seen_ns: int


class NodeTable(Columns):
    """n nodes with distributions over C classes; see `Columns` for rows and ids.

    Attributes:
        ids: (n,) int64, stable, from 1.
        means: (n, 3) float64, metres, world frame.
        covariances: (n, 3, 3) float64, square metres, positive definite.
        class_probabilities: (n, C) float64, rows sum to one.
        weights: (n,) float64, w of Eq. 7: number of observations, or a rule's own weight.
        observations: (n,) int64, frames in which it was observed; class distributions average
            with these.
        confirmed: (n,) bool, whether it is published; false = hidden.
        log_determinants: (n,) float64, of the covariances.
        eigenvalue_bounds: (n,) float64, no smaller than the covariance's largest eigenvalue.
        first_seen_ns, last_seen_ns: (n,) int64.
        revisions: (n,) int64, graph revision at which the node last changed.
        existence: (n,) float64, probability that it is an object; -1 = not estimated.
        surface_points_world: (n, K, 3) float32, metres: a sample of each node's surface points, of
        surface_counts: (n,) int64 points; see `surface`. K grows up to the capacity.
        surface_revisions: (n,) int64, number of changes of the surface so far.
    """

    means: Float64
    covariances: Float64
    class_probabilities: Float64
    weights: Float64
    observations: Int64
    confirmed: Bool
    existence: Float64
    log_determinants: Float64
    eigenvalue_bounds: Float64
    first_seen_ns: Int64
    last_seen_ns: Int64
    revisions: Int64
    surface_points_world: Float32
    surface_counts: Int64
    surface_revisions: Int64

    def __init__(self, class_count: int, surface_point_capacity: int = 0) -> None:
        first_points = min(FIRST_POINTS, surface_point_capacity)
        super().__init__(
            {
                "means": (np.float64, (3,)),
                "covariances": (np.float64, (3, 3)),
                "class_probabilities": (np.float64, (class_count,)),
                "weights": (np.float64, ()),
                "observations": (np.int64, ()),
                "confirmed": (np.bool_, ()),
                "existence": (np.float64, ()),
                "log_determinants": (np.float64, ()),
                "eigenvalue_bounds": (np.float64, ()),
                "first_seen_ns": (np.int64, ()),
                "last_seen_ns": (np.int64, ()),
                "revisions": (np.int64, ()),
                "surface_points_world": (np.float32, (first_points, 3)),
                "surface_counts": (np.int64, ()),
                "surface_revisions": (np.int64, ()),
            }
        )
        self._surface_point_capacity = surface_point_capacity

    def put(
        self,
        row: int,
        mean_world: Float64,
        covariance_world: Float64,
        class_probabilities: Float64,
        weight: float,
        observations: int,
    ) -> None:
        """Replace a row's Gaussian, classes and counts, and the cached values of its covariance.

        Raises:
            ValueError: if the covariance is not positive definite; the row is unchanged.
        """
        self.log_determinants[row] = log_determinant(covariance_world)
        self.eigenvalue_bounds[row] = eigenvalue_bound(covariance_world)
        self.means[row] = mean_world
        self.covariances[row] = covariance_world
        self.class_probabilities[row] = class_probabilities
        self.weights[row] = weight
        self.observations[row] = observations

    def fuse(self, rows: Int64, seen: Observations) -> None:
        """Fuse one observation into each of n different rows (Eq. 7).

        Raises:
            ValueError: if a covariance is not positive definite; rows before it were fused.
        """
        refused = _fuse(
            rows,
            self.means,
            self.covariances,
            self.class_probabilities,
            self.weights,
            self.observations,
            self.log_determinants,
            self.eigenvalue_bounds,
            seen.means_world,
            seen.covariances_world,
            seen.class_probabilities,
            seen.weights,
            seen.counts,
        )
        if refused >= 0:
            raise ValueError(
                f"covariance {seen.covariances_world[refused].tolist()}, fused into node "
                f"{self.ids[rows[refused]]}, gives one that is not positive definite"
            )
        self._add_surfaces(rows, seen.surfaces)
        self.first_seen_ns[rows] = np.minimum(self.first_seen_ns[rows], seen.first_seen_ns)
        self.last_seen_ns[rows] = np.maximum(self.last_seen_ns[rows], seen.last_seen_ns)

    def merge(self, row: int, other: int) -> None:
        """Fuse everything that was observed of another row into a row."""
        self.fuse(np.array([row]), _observed(self, other))
        self.confirmed[row] |= self.confirmed[other]
        self.existence[row] = max(self.existence[row], self.existence[other])

    def take_over(self, row: int, other: int) -> None:
        """Give a row the Gaussian, surface and state of another one.

        Class distributions average with the numbers of observations, which add up.
        """
        counts = self.observations[[row, other]]
        classes = counts @ self.class_probabilities[[row, other]] / counts.sum()
        gaussian = self.means[other].copy(), self.covariances[other].copy()
        self.put(row, *gaussian, classes, float(self.weights[other]), int(counts.sum()))
        self.set_surface(row, self.surface(other))
        self.confirmed[row], self.existence[row] = self.confirmed[other], self.existence[other]
        self.last_seen_ns[row] = self.last_seen_ns[other]

    def move(self, row: int, T: Float64) -> None:
        """Apply a rigid transform (4, 4) to the Gaussian and the surface points of a row."""
        gaussian = transform(self.means[row], self.covariances[row], T)
        classes, weight = self.class_probabilities[row].copy(), float(self.weights[row])
        self.put(row, *gaussian, classes, weight, int(self.observations[row]))
        points = self.surface(row).astype(np.float64) @ T[:3, :3].T
        points += T[:3, 3]
        self.set_surface(row, points.astype(np.float32))

    def surface(self, row: int) -> Float32:
        """The surface points (k, 3) of a row, metres; a view."""
        return self.surface_points_world[row, : self.surface_counts[row]]

    def set_surface(self, row: int, points_world: Float32) -> None:
        """Replace the surface points of a row by a sample of these (k, 3)."""
        self.surface_counts[row] = 0
        self.surface_revisions[row] += 1
        self._add_surfaces(np.array([row]), [points_world])

    def drop_points(self, rows: Int64, dropped: Bool) -> Int64:
        """Remove some of the surface points of n rows, (n, K); but never all points of a row.

        Returns:
            The rows of which some were to be removed.
        """
        drop_points(self.surface_points_world, self.surface_counts, rows, dropped)
        changed = rows[dropped.any(axis=1)]
        self.surface_revisions[changed] += 1
        return changed

    def surface_points(self) -> Float32:
        """The surface points (m, 3) of all rows, one row after the other, metres."""
        known = np.arange(self.surface_points_world.shape[1]) < self.surface_counts[:, None]
        return self.surface_points_world[known]

    def restore(self, columns: Mapping[str, NDArray[Any]], points: Float32, counts: Int64) -> None:
        """Fill an empty table with saved columns and `surface_points`, some for each row."""
        self.extend(columns["ids"].tolist())
        for name in SAVED_COLUMNS:
            getattr(self, name)[:] = columns[name]
        self.log_determinants[:] = log_determinants(self.covariances)
        self.eigenvalue_bounds[:] = eigenvalue_bounds(self.covariances)
        self._make_room(int(counts.max(initial=0)))
        add_flat(self.surface_points_world, self.surface_counts, points, counts)

    def _make_room(self, count: int) -> None:
        """Make room for this many surface points in each row, or for as many as a row may have."""
        known = self._storage["surface_points_world"]
        if known.shape[1] < min(count, self._surface_point_capacity):
            larger = _widened(known, count, self._surface_point_capacity)
            larger[: len(self), : known.shape[1]] = known[: len(self)]
            self._storage["surface_points_world"] = larger
            self._show(len(self))

    def _add_surfaces(self, rows: Int64, point_sets: Sequence[Float32]) -> None:
        if self.surface_points_world.shape[1] < self._surface_point_capacity:
            counts = self.surface_counts[rows].tolist()
            self._make_room(max(map(operator.add, counts, map(len, point_sets)), default=0))
        surfaces = self.surface_points_world, self.surface_counts
        self.surface_revisions[rows] += add_points(*surfaces, rows, point_sets)


def _observed(table: NodeTable, row: int) -> Observations:
    """Everything that was observed of a row, as one observation."""
    one = [row]
    return Observations(
        table.means[one],
        table.covariances[one],
        table.class_probabilities[one],
        table.weights[one],
        table.observations[one],
        [table.surface(row)],
        int(table.first_seen_ns[row]),
        int(table.last_seen_ns[row]),
    )


def _widened(known: Float32, count: int, most: int) -> Float32:
    """Zeros for rows of at least this many points, or of `most`. Unwritten, they take no memory."""
    width = known.shape[1]
    while width < count:
        width *= 2
    return np.zeros((len(known), min(width, most), 3), np.float32)


@kernel
def _pivots(c: Float64) -> tuple[float, float]:
    """Second and third LDLᵀ pivot of a covariance (3, 3); 0 if the one before is not positive."""
    if not c[0, 0] > 0.0:
        return 0.0, 0.0
    pivot_1 = c[1, 1] - c[1, 0] / c[0, 0] * c[1, 0]
    if not pivot_1 > 0.0:
        return 0.0, 0.0
    rest = c[2, 1] - c[2, 0] / c[0, 0] * c[1, 0]
    return pivot_1, c[2, 2] - c[2, 0] / c[0, 0] * c[2, 0] - rest / pivot_1 * rest


@kernel
def _fuse(
    rows: Int64,
    means: Float64,
    covariances: Float64,
    classes: Float64,
    weights: Float64,
    observations: Int64,
    log_determinants: Float64,
    eigenvalue_bounds: Float64,
    new_means: Float64,
    new_covariances: Float64,
    new_classes: Float64,
    new_weights: Float64,
    new_observations: Int64,
) -> int:
    """`scene.gaussian.fuse` for each row, with cached values; the index refused, -1 = none.

    The operations are those of `fuse`, `log_determinant` and `eigenvalue_bound`, in the same order.
    """
    c = np.empty((3, 3))
    for index in range(len(rows)):
        row = rows[index]
        known, weight = weights[row], new_weights[index]
        total = known + weight
        cross = known * weight / (total * total)
        squares = 0.0
        for i in range(3):
            for j in range(3):
                apart = (means[row, i] - new_means[index, i]) * (
                    means[row, j] - new_means[index, j]
                )
                mixed = known * covariances[row, i, j] + weight * new_covariances[index, i, j]
                c[i, j] = mixed / total + cross * apart
                squares += c[i, j] * c[i, j]
        pivot_1, pivot_2 = _pivots(c)
        trace = c[0, 0] + c[1, 1] + c[2, 2]
        if not min(pivot_1, pivot_2) > SINGULAR * trace:
            # The sum of positive definite matrices is one; here rounding has made it singular.
            for i in range(3):
                c[i, i] += 10.0 * SINGULAR * trace
            pivot_1, pivot_2 = _pivots(c)
        if not (c[0, 0] > 0.0 and pivot_1 > 0.0 and pivot_2 > 0.0):
            return index
        log_determinants[row] = math.log(c[0, 0] * pivot_1 * pivot_2)
        eigenvalue_bounds[row] = math.sqrt(squares)
        seen, seen_now = observations[row], new_observations[index]
        for i in range(3):
            means[row, i] = (known * means[row, i] + weight * new_means[index, i]) / total
            for j in range(3):
                covariances[row, i, j] = c[i, j]
        for label in range(classes.shape[1]):
            classes[row, label] = (
                seen * classes[row, label] + seen_now * new_classes[index, label]
            ) / (seen + seen_now)
        weights[row] = total
        observations[row] = seen + seen_now
    return -1
