"""The messages of the nodes, and their boxes; only those of changed nodes are rebuilt."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.graph.extent import (
    BOX_DECIMALS,
    DEFAULT_UP,
    FEW_POINTS,
    HEADINGS,
    POSITION_DECIMALS,
    Extent,
    extents_of,
    rounded,
    rounded_gaussians,
    surface_bytes,
)
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.camera import invert_pose, pose_from_quaternion
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph
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


# --- The boxes of nodes: which of their sides end where they say.
#
# A side of a box ends where a view shows what is beyond. The object may go on if the border of the
# image cuts it, if something is before it, or if it is behind the object itself.

# Which surface points (n, K) the images show as those of n slots; None = not known.
ShownSurfaces = Callable[[Int64], Bool | None]
# The two ends of an axis.
_SIGNS = np.array([-1.0, 1.0])
# A frame shows where a side of a box ends if it shows what is beyond this fraction at least of the
# points so near its end: what is so far beyond them is in the image, and nothing is before it by
# the noise of a camera.
END_M, BEYOND_M = 0.04, 0.06
SEEN_FRACTION = 0.3
BEFORE_M, BEFORE_FRACTION = 0.03, 0.01
# Points are of a box up to this distance from it.
AROUND_M = 0.02
# Ends of two boxes are the same within `END_M` if their axes are within this.
SAME_COS = math.cos(math.radians(15.0))
# A side may go on if at least MIN_CUT frames do not show its end, and at most MAX_SEEN of all do:
# masks and depth are wrong in some. It may also go on if as many frames show the object beyond it
# as show something else there, or if no frame shows this end and MIN_ELSEWHERE show another one.
MIN_CUT, MAX_SEEN, MIN_ELSEWHERE = 2, 0.1, 5
# An object rests on what at least MIN_RESTS of the last RESTS frames show, less than `BEYOND_M`
# below its points: masks end a little above. A frame counts if it shows it below at least MIN_BELOW
# points.
MIN_RESTS, RESTS, MIN_BELOW = 3, 9, 3
# No object hangs in the air. If one was seen from all sides, and at least MIN_HANGING frames show
# free space just below it, its masks lack a lower part, such as the legs of a chair.
MIN_HANGING = 4
# The heading of a room is that of most objects with a side so long, if their headings agree so
# much: 1 is all of them.
MIN_VOTING_M, MIN_VOTES, MIN_AGREEMENT = 0.4, 3, 0.5
# The box of a node is measured again after this fraction of its frames more, within these limits.
AGAIN_FRACTION, LEAST_FRAMES, MOST_FRAMES = 0.5, 4, 32


@lru_cache(maxsize=1024)
def _axes_of(orientation_xyzw: tuple[float, ...]) -> Float64:
    """The axes (3, 3) of a box, one a row: most boxes are asked for again as they are."""
    return pose_from_quaternion(np.zeros(3), np.array(orientation_xyzw))[:3, :3].T


@dataclass
class Ends:
    """A box, and the frames that show where it ends.

    Attributes:
        center: (3,), half: (3,) metres; axes: (3, 3) rows.
        counts: (3, 2, 3), by axis and end: frames that show what is beyond, that do not, and in
            which the object goes on.
        due: number of observations of the node from which on it is measured again.
        rests_m: heights along the third axis, from the origin, of what frames show just below.
    """

    center: Float64
    half: Float64
    axes: Float64
    counts: Int64
    due: int = 0
    rests_m: tuple[float, ...] = ()

    @classmethod
    def of(cls, box: wire.GravityBox) -> Ends:
        """Those of a new box."""
        axes = _axes_of(tuple(box.orientation_xyzw))
        half = np.array(box.size_m) / 2.0
        return cls(np.array(box.center_m), half, axes, np.zeros((3, 2, 3), np.int64))

    def on_its_rest(self, box: wire.GravityBox) -> wire.GravityBox:
        """A box of the node down to what it rests on; as it is if that is not known or not near."""
        if len(self.rests_m) < MIN_RESTS:
            return box
        center, size = np.array(box.center_m), list(box.size_m)
        rest_m = sorted(self.rests_m)[len(self.rests_m) // 2]
        gap_m = round(float(self.axes[2] @ center) - size[2] / 2 - rest_m, BOX_DECIMALS)
        if not 0 < gap_m <= BEYOND_M:
            return box
        center -= 0.5 * gap_m * self.axes[2]
        size[2] = round(size[2] + gap_m, BOX_DECIMALS)
        center_m = rounded(center, POSITION_DECIMALS)
        return msgspec.structs.replace(box, center_m=center_m, size_m=size)

    def open_sides(self, box: wire.GravityBox) -> list[bool] | UnsetType:
        """Which sides (3,) of a box of the node may go on; none if that is UNSET."""
        other = Ends.of(box)
        same, shared = self.same_axes(other), self.shared(other)
        seen, cut, on = (self.counts * shared[:, :, None]).transpose(2, 0, 1)
        open_ = (cut >= MIN_CUT) & (seen <= MAX_SEEN * (seen + cut))
        open_ |= (on >= MIN_CUT) & (on >= seen)
        open_ |= same[:, None] & (seen == 0) & (self.counts[..., 0].max() >= MIN_ELSEWHERE)
        # Nothing hangs in the air, but for what is fixed to a wall, which hides its back.
        hangs = len(self.rests_m) < MIN_RESTS and seen[2, 0] >= MIN_HANGING
        open_[2, 0] |= hangs and (seen[:2] >= cut[:2]).all()
        sides: list[bool] = open_.any(axis=1).tolist()
        return sides if any(sides) else UNSET

    def same_axes(self, other: Ends) -> Bool:
        """Which axes (3,) of another box are about those of this one."""
        return np.asarray((self.axes * other.axes).sum(axis=1) > SAME_COS)

    def shared(self, other: Ends) -> Bool:
        """Which ends (3, 2) of another box are those of this one, too."""
        apart = np.abs(self.axes @ (self.center - other.center))[:, None]
        apart = apart * [1.0, 1.0] + np.abs(self.half - other.half)[:, None]
        return np.asarray((apart < END_M) & self.same_axes(other)[:, None])


class RoomHeading:
    """The heading of the room, by the votes of its large objects."""

    def __init__(self) -> None:
        # By node: the long side, turned by four times its heading, so that quarter turns are the
        # same.
        self._votes: dict[int, complex] = {}
        # Of all votes, and what it would be if all were the same.
        self._sum, self._most = 0j, 0.0

    @property
    def step(self) -> int | None:
        """The heading, in `HEADINGS`; None = not known."""
        if len(self._votes) < MIN_VOTES or abs(self._sum) < MIN_AGREEMENT * self._most:
            return None
        return round(cmath.phase(self._sum) / (2.0 * math.pi) * HEADINGS) % HEADINGS

    def vote(self, node_ids: Iterable[int], extents: Iterable[Extent]) -> None:
        """Take the votes of nodes, in place of older ones."""
        for node_id, extent in zip(node_ids, extents):
            vote = cmath.rect(extent.side_m, 2.0 * math.pi * extent.step / HEADINGS)
            self._set(node_id, vote if extent.side_m >= MIN_VOTING_M else 0j)

    def forget(self, node_ids: Iterable[int]) -> None:
        """Nodes that are gone have no say."""
        for node_id in node_ids:
            self._set(node_id, 0j)

    def _set(self, node_id: int, vote: complex) -> None:
        old = self._votes.pop(node_id, 0j)
        if vote:
            self._votes[node_id] = vote
        self._sum, self._most = self._sum + vote - old, self._most + abs(vote) - abs(old)


class NodeBoxes:
    """Measures the boxes of nodes, and follows where they end.

    Args:
        nodes: of the graph.
        shown: of their surfaces; None = boxes are around all points.
    """

    def __init__(self, nodes: NodeTable, shown: ShownSurfaces | None = None) -> None:
        self._nodes = nodes
        self._shown = shown
        self._ends: dict[int, Ends] = {}
        # Of the boxes whose ends are followed, which does not depend on when messages are made.
        self._heading = RoomHeading()

    def extents(self, slots: Int64, up: Sequence[float], heading: RoomHeading) -> list[Extent]:
        """Extents of the surfaces of some slots, which have points, and vote for the heading."""
        nodes, shown = self._nodes, None if self._shown is None else self._shown(slots)
        known = nodes.surface_points_world, nodes.surface_counts, slots, up, shown
        before = heading.step
        found = extents_of(*known, before)
        if shown is None:
            return found
        heading.vote(nodes.ids[slots].tolist(), found)
        return found if heading.step == before else extents_of(*known, heading.step)

    def move(self, node_ids: Sequence[int], T_new_old: Float64) -> None:
        """Move the ends of boxes with their nodes, each by a rigid transform (n, 4, 4)."""
        for node_id, T in zip(node_ids, T_new_old):
            if (ends := self._ends.get(node_id)) is not None:
                height_m = ends.axes[2] @ ends.center
                ends.center = T[:3, :3] @ ends.center + T[:3, 3]
                ends.axes = ends.axes @ T[:3, :3].T
                risen_m = float(ends.axes[2] @ ends.center - height_m)
                ends.rests_m = tuple(rest_m + risen_m for rest_m in ends.rests_m)

    def followed(self, node_id: int, box: wire.GravityBox) -> wire.GravityBox:
        """The box of a node, down to what it rests on, with the sides that may go on."""
        known = self._ends.get(node_id)
        sides = UNSET if known is None else known.open_sides(box)
        if sides != box.at_least:
            box = msgspec.structs.replace(box, at_least=sides)
        return box if known is None else known.on_its_rest(box)

    def observe(
        self, local: LocalGraph, node_ids: Sequence[int], up_world: Callable[[], Float64]
    ) -> None:
        """Take in what a merged frame shows of the published nodes of its rows.

        `up_world` estimates the direction against gravity (3,), where boxes are measured.
        """
        self._measure(node_ids, up_world)
        rows = [row for row, node_id in enumerate(node_ids) if node_id in self._ends]
        grid = local.depth_grid
        if grid is None or grid.instances is None or not grid.depth_mm.size or not rows:
            return
        known = [self._ends[node_ids[row]] for row in rows]
        surfaces = [local.surface_points_world[row] for row in rows]
        of = np.repeat(np.arange(len(rows)), [len(points) for points in surfaces])
        points = np.concatenate(surfaces).astype(np.float64)
        axes = np.array([ends.axes for ends in known])[of]
        half = np.array([ends.half for ends in known])[of]
        along = points - np.array([ends.center for ends in known])[of]
        along = (axes * along[:, None]).sum(axis=2)
        inside = (np.abs(along) <= half + AROUND_M).all(axis=1)
        near = half[:, :, None] - along[:, :, None] * _SIGNS < END_M
        places, sides, at = np.nonzero(near & inside[:, None, None])
        beyond = points[places] + BEYOND_M * _SIGNS[at, None] * axes[places, sides]
        bears = (sides == 2) & (at == 0)
        values = local.instance_ids[rows][of[places]]
        *seen, way = _seen_beyond(local, grid, points[places], beyond, bears, values)
        size = 6 * len(rows)
        cells = 6 * of[places] + 2 * sides + at
        total = np.maximum(np.bincount(cells, minlength=size), 1)
        parts = [np.bincount(cells, kind, size) >= SEEN_FRACTION * total for kind in seen]
        shown, cut, goes_on = np.reshape(parts, (3, len(rows), 3, 2))
        for ends, *kinds in zip(known, shown & ~goes_on, cut & ~shown & ~goes_on, goes_on):
            ends.counts += np.stack(kinds, axis=2)
        # Where the rays to the places below the objects end, above the origin.
        below = bears & seen[0]
        camera = local.T_world_camera[:3, 3]
        ends_at = camera + way[below, None] * (beyond[below] - camera)
        up = axes[places[below], 2]
        heights_m = (up * ends_at).sum(axis=1)
        drops_m = (up * points[places[below]]).sum(axis=1) - heights_m
        near_below = (drops_m > -BEFORE_M) & (drops_m <= BEYOND_M)
        rows_below, heights_m = of[places[below]][near_below], heights_m[near_below]
        for row in np.flatnonzero(np.bincount(rows_below, minlength=1) >= MIN_BELOW):
            beneath = np.sort(heights_m[rows_below == row])  # np.median takes ten times as long
            rest_m = float(beneath[len(beneath) // 2])
            known[row].rests_m = (*known[row].rests_m, rest_m)[-RESTS:]

    def _measure(self, node_ids: Sequence[int], up_world: Callable[[], Float64]) -> None:
        """Measure the boxes of nodes anew that have been observed often enough since."""
        nodes, due = self._nodes, []
        for node_id in node_ids:
            slot = nodes.slot_of.get(node_id, -1)
            if slot < 0 or not nodes.confirmed[slot] or not nodes.surface_counts[slot]:
                continue
            known = self._ends.get(node_id)
            if known is None or nodes.observations[slot] >= known.due:
                due.append(slot)
        if not due:
            return
        slots = np.unique(due)
        up = tuple(rounded(up_world(), POSITION_DECIMALS))
        before = self._heading.step
        extents = self.extents(slots, up, self._heading)
        if self._heading.step != before:
            for ends in self._ends.values():
                ends.due = 0
        for slot, extent in zip(slots.tolist(), extents):
            ends, node_id = Ends.of(extent.box), int(nodes.ids[slot])
            known, count = self._ends.get(node_id), int(nodes.observations[slot])
            if known is not None:
                shared = known.shared(ends)
                ends.counts = known.counts * shared[:, :, None]
                ends.rests_m = known.rests_m if shared[2, 0] else ()
            wait = min(max(int(AGAIN_FRACTION * count), LEAST_FRAMES), MOST_FRAMES)
            ends.due, self._ends[node_id] = count + wait, ends
        if len(self._ends) > 2 * len(nodes) + FEW_POINTS:
            self._heading.forget([i for i in self._ends if i not in nodes])
            self._ends = {i: ends for i, ends in self._ends.items() if i in nodes}


def _seen_beyond(
    local: LocalGraph,
    grid: DepthGrid,
    points: Float64,
    beyond: Float64,
    bears: Bool,
    values: Int64,
) -> tuple[Bool, Bool, Bool, Float64]:
    """Whether a frame shows what is beyond points (n, 3), hides it, or shows more of the object.

    Each (n,) bool. None of them: there is no depth, or the object before or behind. The last (n,)
    is what the depth image shows there: its distance, as a part of that of the place beyond.

    Args:
        local: the frame, and
        grid: its depth grid, with instances.
        points: of objects.
        beyond: (n, 3) points beyond these.
        bears: (n,) bool, whether a surface between both bears the object, and hides nothing.
        values: (n,) of the objects in the instances.
    """
    T, camera, per_px = invert_pose(local.T_world_camera), grid.intrinsics, 1.0 / grid.stride_px
    x, y, z = T[:3, :3] @ beyond.T + T[:3, 3:]
    own_z = T[2, :3] @ points.T + T[2, 3]
    ahead = np.maximum(z, 1e-3)
    rows = np.floor((camera.fy * y / ahead + camera.cy) * per_px)
    columns = np.floor((camera.fx * x / ahead + camera.cx) * per_px)
    height, width = grid.depth_mm.shape
    inside = (z > 1e-3) & (rows >= 0) & (columns >= 0) & (rows < height) & (columns < width)
    at = np.where(inside, rows, 0).astype(np.int64), np.where(inside, columns, 0).astype(np.int64)
    depth_m = 0.001 * grid.depth_mm[at]
    limit_m = np.where(bears, np.minimum(own_z, z), z) - BEFORE_M - BEFORE_FRACTION * ahead
    hidden, known = depth_m < limit_m, depth_m > 0
    assert grid.instances is not None
    shown = inside & known & ~hidden & (grid.instances[at] != values)
    own = inside & known & (grid.instances[at] == values)
    own &= np.abs(depth_m - z) <= BEFORE_M + BEFORE_FRACTION * ahead
    cut = ~inside | (known & hidden)
    return np.asarray(shown), np.asarray(cut), np.asarray(own), np.asarray(depth_m / ahead)


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
        heading: of the room, by the boxes of these messages.
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
        self.heading = RoomHeading()
        self._step: int | None = None

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
        self.heading.forget(gone)
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
        extents: dict[int, Extent | None] = {}
        # All boxes that are measured may tell another heading of the room, and then are again.
        for _ in range(2 if at_most is None else 1):
            if self.heading.step != self._step:
                self._step = self.heading.step
                self._stale.update(dict.fromkeys(sorted(self._measured)))
            due += take_first(self._stale, at_most)
            if not due:
                break
            slots = nodes.slots_of(due)
            self._measured.update(zip(due, revisions[slots].tolist()))
            solid = nodes.surface_counts[slots] > 0
            found = iter(self._boxes.extents(slots[solid], self.up, self.heading))
            for node_id, has_points in zip(due, solid.tolist()):
                extents[node_id] = next(found) if has_points else None
            due = []
        return extents

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
        return Extent(state.mean_m, state.covariance_m2, state.box, 0.0, 0)


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
