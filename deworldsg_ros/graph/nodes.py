"""The nodes of the global graph as parallel arrays, and their ids over its life."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.gaussian import (
    eigenvalue_bound,
    eigenvalue_bounds,
    log_determinant,
    log_determinants,
)
from deworldsg_ros.scene.surface import add_flat, add_points, drop_points, greatest_hashes

# --- The ids of nodes over the life of a graph, and the nodes of past frames.

# The largest id: pairs keep theirs in 32 bits.
MAX_ID = 2**31 - 1
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

    def skip_to(self, next_id: int) -> None:
        """Give out no id below this one: those may be known for other nodes."""
        self._next_id = max(self._next_id, min(next_id, MAX_ID + 1))

    def state(self) -> IdState:
        """A copy of everything that is remembered."""
        return IdState(
            self._next_id, dict(self._successors), tuple(self._removals), dict(self._frames)
        )

    def take(self) -> int:
        """Take the next id; ids are never reused.

        Raises:
            RefusedInput: ``no_ids_left`` after `MAX_ID`.
        """
        if self._next_id > MAX_ID:
            raise RefusedInput("no_ids_left", f"node {MAX_ID} exists: clear the graph")
        self._next_id += 1
        return self._next_id - 1

    def give_back(self) -> None:
        """The id that was taken last has no node."""
        self._next_id -= 1

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


# --- The nodes of the global graph as parallel arrays.

# Slots for which a table has room at first, and surface points of each.
FIRST_SLOTS = 64
FIRST_POINTS = 64
# Positions of a mean that differ by less are one: the noise of a depth camera, and cells of 3 cm.
ALIKE_M = 0.005
# Fewer points have no covariance. It gets a ridge: they may lie on a plane.
LEAST_POINTS, RIDGE_M2 = 4, 1e-6
# A covariance with a pivot below this fraction of its trace is singular up to rounding.
SINGULAR = 1e-13
# Saved arrays of the nodes, beside their surface points; the other arrays follow from these.
SAVED = (
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
    "colours",
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
        keyframes: (m,) uint16, of the m points of all surfaces; None = the present one.
    """

    means_world: Float64
    covariances_world: Float64
    class_probabilities: Float64
    weights: Float64
    counts: Int64
    surfaces: Sequence[Float32]
    first_seen_ns: int
    last_seen_ns: int
    keyframes: UInt16 | None = None


class _Gaussians(NamedTuple):
    """Arrays that Eq. 7 fuses."""

    means: Float64
    covariances: Float64
    classes: Float64
    weights: Float64
    observations: Int64


class NodeTable:
    """The nodes, each in a slot of parallel arrays.

    A node keeps its slot as long as it lives. Other modules have arrays by slot, too. The slot of a
    removed node is used again. All values in a free slot are 0, also the id. A new node may replace
    the arrays by larger ones, so do not keep them.

    Args:
        class_count: C.
        surface_point_capacity: maximum number of surface points of a node.

    Attributes:
        ids: (n,) int64, from 1; 0 = a free slot.
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
        existence: (n,) float64, probability that it is an object; -1 = not estimated.
        surface_points_world: (n, K, 3) float32, metres: a sample of each node's surface points, of
        surface_counts: (n,) int64 points; see `surface`. K grows up to the capacity.
        surface_keyframes: (n, K) uint16, from which keyframe each point was seen; 0 = not known.
            Without points, the first is the keyframe that saw the node.
        surface_revisions: (n,) int64, number of changes of the surface so far.
        colours: (n, 4) float64, sums over the frames of w L, w a, w b (CIELAB), and w, the number
            of pixels; 0 = not known.
        slot_of: the slot of each id; read only.
        keyframe: number of the present keyframe (`provenance.Trail`), that of points to come.
    """

    ids: Int64
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
    surface_points_world: Float32
    surface_keyframes: UInt16
    surface_counts: Int64
    surface_revisions: Int64
    colours: Float64

    def __init__(self, class_count: int, surface_point_capacity: int = 0) -> None:
        points = min(FIRST_POINTS, surface_point_capacity)
        layout: dict[str, tuple[DTypeLike, tuple[int, ...]]] = {
            "ids": (np.int64, ()),
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
            "surface_points_world": (np.float32, (points, 3)),
            "surface_keyframes": (np.uint16, (points,)),
            "surface_counts": (np.int64, ()),
            "surface_revisions": (np.int64, ()),
            "colours": (np.float64, (4,)),
        }
        # With room for more; the attributes are views of the slots that were ever used.
        self._storage: dict[str, NDArray[Any]] = {
            name: np.zeros((FIRST_SLOTS, *shape), dtype) for name, (dtype, shape) in layout.items()
        }
        self.slot_of: dict[int, int] = {}
        self.keyframe = 0
        self._surface_point_capacity = surface_point_capacity
        self._free: list[int] = []
        self._show(0)

    def __len__(self) -> int:
        return len(self.slot_of)

    def __contains__(self, node_id: object) -> bool:
        return node_id in self.slot_of

    @property
    def slots(self) -> Int64:
        """The slots of all nodes, ascending."""
        return np.flatnonzero(self.ids)

    def slot(self, node_id: int) -> int:
        """The slot of a node; KeyError if there is no such node."""
        try:
            return self.slot_of[node_id]
        except KeyError:
            raise KeyError(f"node {node_id} is not in the graph") from None

    def slots_of(self, ids: Sequence[int]) -> Int64:
        """The slot (n,) of each node; KeyError if there is no such node."""
        try:
            return np.fromiter(map(self.slot_of.__getitem__, ids), np.int64, len(ids))
        except KeyError as missing:
            raise KeyError(f"node {missing} is not in the graph") from None

    def add(self, node_id: int) -> int:
        """Give a new node a slot, of zeros."""
        slot = self._free.pop() if self._free else len(self.ids)
        if slot == len(self.ids):
            self._make_slots(slot + 1)
        self.slot_of[node_id] = slot
        self.ids[slot] = node_id
        return slot

    def remove(self, node_id: int) -> None:
        """Free the slot of a node."""
        slot = self.slot(node_id)
        for values in self._storage.values():
            values[slot] = 0
        del self.slot_of[node_id]
        self._free.append(slot)

    def put(
        self,
        slot: int,
        mean_world: Float64,
        covariance_world: Float64,
        class_probabilities: Float64,
        weight: float,
        observations: int,
    ) -> None:
        """Replace a node's Gaussian, classes and counts, and the cached values of its covariance.

        Raises:
            ValueError: if the covariance is not positive definite; the node is unchanged.
        """
        self.log_determinants[slot] = log_determinant(covariance_world)
        self.eigenvalue_bounds[slot] = eigenvalue_bound(covariance_world)
        self.means[slot] = mean_world
        self.covariances[slot] = covariance_world
        self.class_probabilities[slot] = class_probabilities
        self.weights[slot] = weight
        self.observations[slot] = observations

    def fuse(self, slots: Int64, seen: Observations) -> None:
        """Fuse one observation into each of n different nodes (Eq. 7).

        Raises:
            ValueError: if a covariance is not positive definite; nodes before it were fused.
        """
        known = _Gaussians(
            self.means,
            self.covariances,
            self.class_probabilities,
            self.weights,
            self.observations,
        )
        new = _Gaussians(
            seen.means_world,
            seen.covariances_world,
            seen.class_probabilities,
            seen.weights,
            seen.counts,
        )
        refused = _fuse(slots, known, self.log_determinants, self.eigenvalue_bounds, new)
        if refused >= 0:
            raise ValueError(
                f"covariance {seen.covariances_world[refused].tolist()}, fused into node "
                f"{self.ids[slots[refused]]}, gives one that is not positive definite"
            )
        self._add_surfaces(slots, seen.surfaces, seen.keyframes)
        self.first_seen_ns[slots] = np.minimum(self.first_seen_ns[slots], seen.first_seen_ns)
        self.last_seen_ns[slots] = np.maximum(self.last_seen_ns[slots], seen.last_seen_ns)

    def merge(self, slot: int, other: int) -> None:
        """Fuse everything that was observed of another node into a node."""
        self.fuse(np.array([slot]), self._observed(other))
        self.colours[slot] += self.colours[other]
        self.confirmed[slot] |= self.confirmed[other]
        self.existence[slot] = max(self.existence[slot], self.existence[other])

    def take_over(self, slot: int, other: int) -> None:
        """Give a node the Gaussian, surface and state of another one.

        Class distributions average with the numbers of observations, which add up. So do colours.
        """
        counts = self.observations[[slot, other]]
        classes = counts @ self.class_probabilities[[slot, other]] / counts.sum()
        gaussian = self.means[other].copy(), self.covariances[other].copy()
        self.put(slot, *gaussian, classes, float(self.weights[other]), int(counts.sum()))
        self.set_surface(slot, self.surface(other), self.keyframes(other))
        self.colours[slot] += self.colours[other]
        self.confirmed[slot], self.existence[slot] = self.confirmed[other], self.existence[other]
        self.last_seen_ns[slot] = self.last_seen_ns[other]

    def move(self, slots: Int64, T_new_old: Float64) -> Float64:
        """Move nodes, their surfaces point by point, as the keyframes that saw them have moved.

        A Gaussian moves rigidly if all points of its node do, by less than `ALIKE_M` otherwise. If
        not, it gets the covariance of the points.

        Args:
            slots: (n,) of different nodes.
            T_new_old: (k, 4, 4) rigid transforms by the number of the keyframe.

        Returns:
            (n, 4, 4), the transform of the keyframe that saw most of each node.
        """
        counts = self.surface_counts[slots]
        used = np.arange(self.surface_points_world.shape[1]) < counts[:, None]
        points, keyframes = self.surface_points_world[slots], self.surface_keyframes[slots]
        points, keyframes = points[used], keyframes[used]
        starts = np.append(0, np.cumsum(counts))
        old, T = points.astype(np.float64), T_new_old[keyframes]
        new = (T[:, :3, :3] @ old[:, :, None])[:, :, 0] + T[:, :3, 3]
        main = self._move_gaussians(slots, T_new_old, keyframes, starts, (old, new))
        greatest = greatest_hashes(self.surface_points_world, self.surface_counts, slots)
        self.surface_counts[slots] = 0
        self.surface_revisions[slots] += 1
        samples = self.surface_points_world, self.surface_keyframes, self.surface_counts
        add_flat(samples, slots, new.astype(np.float32), keyframes, starts, greatest)
        return main

    def _move_gaussians(
        self,
        slots: Int64,
        T_new_old: Float64,
        keyframes: UInt16,
        starts: Int64,
        points: tuple[Float64, Float64],
    ) -> Float64:
        """Move the Gaussians of nodes as their points (m, 3), before and after; see `move`."""
        main = np.broadcast_to(np.eye(4), (len(slots), 4, 4)).copy()
        counts = np.diff(starts)
        # The keyframes of each node, and the one that saw most of its points.
        rows = np.append(np.repeat(np.arange(len(slots)), counts), np.flatnonzero(counts == 0))
        of_empty = self.surface_keyframes[slots[counts == 0], :1].ravel()
        keyframes = np.append(keyframes, of_empty)
        kinds, sizes = np.unique(rows << 16 | keyframes, return_counts=True)
        rows, T = kinds >> 16, T_new_old[kinds & 0xFFFF]
        order = np.lexsort((sizes, rows))
        last = np.flatnonzero(np.diff(rows[order], append=-1))
        main[rows[order][last]] = T[order][last]
        means, covariances = self.means[slots], self.covariances[slots]
        there = (T[:, :3, :3] @ means[rows, :, None])[:, :, 0] + T[:, :3, 3]
        moved = (main[:, :3, :3] @ means[:, :, None])[:, :, 0] + main[:, :3, 3]
        covariances = main[:, :3, :3] @ covariances @ main[:, :3, :3].swapaxes(1, 2)
        apart = np.abs(there - moved[rows]).max(axis=1) > ALIKE_M
        mixed = np.zeros(len(slots), np.bool_)
        mixed[rows[apart]] = True
        mixed &= counts > LEAST_POINTS
        for index in np.flatnonzero(mixed).tolist():
            part = slice(starts[index], starts[index + 1])
            before, after = (values[part].mean(axis=0) for values in points)
            moved[index] = after + main[index, :3, :3] @ (means[index] - before)
            spread = points[1][part] - after
            covariances[index] = spread.T @ spread / (counts[index] - 1) + RIDGE_M2 * np.eye(3)
        covariances = (covariances + covariances.swapaxes(1, 2)) / 2
        self.means[slots], self.covariances[slots] = moved, covariances
        self.log_determinants[slots] = log_determinants(covariances)
        self.eigenvalue_bounds[slots] = eigenvalue_bounds(covariances)
        return main

    def surface(self, slot: int) -> Float32:
        """The surface points (k, 3) of a node, metres; a view."""
        return self.surface_points_world[slot, : self.surface_counts[slot]]

    def keyframes(self, slot: int) -> UInt16:
        """The keyframe (k,) of each surface point of a node; a view."""
        return self.surface_keyframes[slot, : self.surface_counts[slot]]

    def halve_keyframes(self) -> None:
        """Number the keyframes anew, two as one; see `provenance.Trail.note`."""
        numbers = self.surface_keyframes
        numbers[:] = (numbers >> 1) + (numbers & 1)

    def set_surface(
        self, slot: int, points_world: Float32, keyframes: UInt16 | None = None
    ) -> None:
        """Replace the surface points of a node by a sample of these (k, 3), with keyframes (k,)."""
        self.surface_counts[slot] = 0
        self.surface_revisions[slot] += 1
        self._add_surfaces(np.array([slot]), [points_world], keyframes)
        if not len(points_world):  # then the first place is that of the node
            self.surface_keyframes[slot, :1] = self.keyframe

    def drop_points(self, slots: Int64, dropped: Bool) -> Int64:
        """Remove some of the surface points of n nodes, (n, K); but never all points of a node.

        Returns:
            The slots of those of which some were to be removed.
        """
        surfaces = self.surface_points_world, self.surface_keyframes, self.surface_counts
        drop_points(*surfaces, slots, dropped)
        changed = slots[dropped.any(axis=1)]
        self.surface_revisions[changed] += 1
        return changed

    def restore(
        self,
        saved: Mapping[str, NDArray[Any]],
        points: Float32,
        keyframes: UInt16,
        counts: Int64,
    ) -> None:
        """Fill an empty table with `SAVED` arrays, and some of the points for each node."""
        ids = saved["ids"].tolist()
        self._make_slots(len(ids))
        self.slot_of = dict(zip(ids, range(len(ids))))
        for name in SAVED:
            getattr(self, name)[:] = saved[name]
        self.log_determinants[:] = log_determinants(self.covariances)
        self.eigenvalue_bounds[:] = eigenvalue_bounds(self.covariances)
        self._make_point_room(int(counts.max(initial=0)))
        starts = np.append(0, np.cumsum(counts))
        samples = self.surface_points_world, self.surface_keyframes, self.surface_counts
        if self.surface_points_world.size:
            add_flat(samples, np.arange(len(counts)), points, keyframes, starts)

    def _make_slots(self, used: int) -> None:
        """Use this many slots; the new ones are zeros."""
        known = capacity = len(self._storage["ids"])
        while capacity < used:
            capacity *= 2
        for name, values in self._storage.items() if capacity > known else ():
            # Zeros that were never written take no memory; a copy of zeros would.
            larger = np.zeros((capacity, *values.shape[1:]), values.dtype)
            larger[: len(self.ids)] = values[: len(self.ids)]
            self._storage[name] = larger
        self._show(used)

    def _show(self, used: int) -> None:
        for name, values in self._storage.items():
            setattr(self, name, values[:used])

    def widen(self, class_count: int) -> None:
        """Make room for more classes; the new ones have probability 0."""
        known, used = self._storage["class_probabilities"], len(self.ids)
        # Zeros that were never written take no memory; a copy of zeros would.
        wider = np.zeros((len(known), class_count))
        wider[:used, : known.shape[1]] = known[:used]
        self._storage["class_probabilities"] = wider
        self._show(used)

    def _make_point_room(self, count: int) -> None:
        """Make room for this many surface points of a node, or for as many as one may have."""
        used, width = len(self.ids), self.surface_points_world.shape[1]
        if width < min(count, self._surface_point_capacity):
            for name in ("surface_points_world", "surface_keyframes"):
                known = self._storage[name]
                larger = _widened(known, count, self._surface_point_capacity)
                larger[:used, :width] = known[:used]
                self._storage[name] = larger
            self._show(used)

    def _add_surfaces(
        self, slots: Int64, point_sets: Sequence[Float32], keyframes: UInt16 | None
    ) -> None:
        if self.surface_points_world.shape[1] < self._surface_point_capacity:
            counts = self.surface_counts[slots].tolist()
            self._make_point_room(max(map(operator.add, counts, map(len, point_sets)), default=0))
        if keyframes is None:
            keyframes = np.full(sum(map(len, point_sets)), self.keyframe, np.uint16)
        surfaces = self.surface_points_world, self.surface_keyframes, self.surface_counts
        self.surface_revisions[slots] += add_points(*surfaces, slots, point_sets, keyframes)

    def _observed(self, slot: int) -> Observations:
        """Everything that was observed of a node, as one observation."""
        one = [slot]
        return Observations(
            self.means[one],
            self.covariances[one],
            self.class_probabilities[one],
            self.weights[one],
            self.observations[one],
            [self.surface(slot)],
            int(self.first_seen_ns[slot]),
            int(self.last_seen_ns[slot]),
            self.keyframes(slot).copy(),
        )


def _widened(known: NDArray[Any], count: int, most: int) -> NDArray[Any]:
    """Zeros for slots of at least this many points, or of `most`; unwritten, without memory."""
    width = known.shape[1]
    while width < count:
        width *= 2
    return np.zeros((len(known), min(width, most), *known.shape[2:]), known.dtype)


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
    slots: Int64,
    nodes: _Gaussians,
    log_determinants: Float64,
    eigenvalue_bounds: Float64,
    new: _Gaussians,
) -> int:
    """`scene.gaussian.fuse` for each slot, with cached values; the index refused, -1 = none.

    The operations are those of `fuse`, `log_determinant` and `eigenvalue_bound`, in the same order.
    """
    means, covariances = nodes.means, nodes.covariances
    c = np.empty((3, 3))
    for index in range(len(slots)):
        slot = slots[index]
        known, weight = nodes.weights[slot], new.weights[index]
        total = known + weight
        cross = known * weight / (total * total)
        squares = 0.0
        for i in range(3):
            for j in range(3):
                apart = (means[slot, i] - new.means[index, i]) * (
                    means[slot, j] - new.means[index, j]
                )
                mixed = known * covariances[slot, i, j] + weight * new.covariances[index, i, j]
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
        log_determinants[slot] = math.log(c[0, 0] * pivot_1 * pivot_2)
        eigenvalue_bounds[slot] = math.sqrt(squares)
        for i in range(3):
            means[slot, i] = (known * means[slot, i] + weight * new.means[index, i]) / total
            for j in range(3):
                covariances[slot, i, j] = c[i, j]
        seen, seen_now = nodes.observations[slot], new.observations[index]
        for label in range(nodes.classes.shape[1]):
            nodes.classes[slot, label] = (
                seen * nodes.classes[slot, label] + seen_now * new.classes[index, label]
            ) / (seen + seen_now)
        nodes.weights[slot] = total
        nodes.observations[slot] = seen + seen_now
    return -1
