"""The extent of a surface: even moments, a gravity-aligned box, and its points as compact bytes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.camera import invert_pose, pose_from_quaternion, quaternion_from_rotation
from deworldsg_ros.scene.checks import check_array
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph
from deworldsg_ros.scene.limits import MAX_GRAPH_COORDINATE_M
from deworldsg_ros.wire import messages as wire

# Radius in which the density of points is counted: half a cell of the surface map.
EVEN_RADIUS_M = 0.015
# A point is an outlier if its third neighbour is farther away than this many times the
# median of that distance. Mixed pixels at depth edges lie apart from the surface. Chosen on the two
# rendered rooms: 1.5 cuts corners off, 3 keeps mixed pixels.
OUTLIER_FACTOR = 2.0
# Where the images tell which points are the node's, a point so near its third neighbour is never an
# outlier: the seat of a chair behind a table is in few views, and its points lie far apart.
NEAR_ENOUGH_M = 0.06
# So few points have no outliers.
FEW_POINTS = 6
# A part of a surface so far from the rest, horizontally, and with so much fewer points than the
# largest one, belongs to something else: the legs of a chair are nearer to one another.
PART_GAP_M, SMALL_PART = 0.12, 0.1
# With fewer points that the images show as the node's, its box is around all points.
MIN_SHOWN_POINTS = 8
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
# as show something else there.
MIN_CUT, MAX_SEEN = 2, 0.1
# An object rests on what at least MIN_RESTS of the last RESTS frames show, less than `BEYOND_M`
# below its points: masks end a little above. A frame counts if it shows it below at least MIN_BELOW
# points.
MIN_RESTS, RESTS, MIN_BELOW = 3, 9, 3
# Weights of points with these many points around.
_EVEN_WEIGHTS = np.append(0.0, np.arange(1.0, 4097.0) ** -0.5)
# Headings of a box, over 90 degrees. The smallest rectangle around two sides of a cabinet lies
# along its diagonal; the one whose sides are nearest to the points does not.
_HEADINGS = 0.5 * math.pi * np.arange(45) / 45
_COSINES = np.array([math.cos(heading) for heading in _HEADINGS])
_SINES = np.array([math.sin(heading) for heading in _HEADINGS])
# Bounds of all headings, in whole cache lines: across lines, they take up to twice the time.
ALIGNED_HEADINGS = 48
# Points of a box, the first ones: surfaces are stored in random order, and have no more in a graph.
# With 256, ten of 154 boxes lose a part that few views show. Without images, which tell the points
# of other objects apart, that many are enough.
MOST_POINTS, FEWER_POINTS = 512, 256
# The up of the world frame if nothing tells it (REP 103).
DEFAULT_UP = (0.0, 0.0, 1.0)
# Points that spread less are at one place: the number of buckets for each metre stays finite.
LEAST_SPREAD_M = 1e-12
# Decimals of numbers in messages: positions to 0.1 mm, variances to (0.3 mm)², so that a thin
# object keeps its thickness.
POSITION_DECIMALS, VARIANCE_DECIMALS = 4, 7
BOX_DECIMALS, QUATERNION_DECIMALS = 3, 4
# Of mean, covariance, centre, size and quaternion.
_DECIMALS = [POSITION_DECIMALS] * 3 + [VARIANCE_DECIMALS] * 9 + [BOX_DECIMALS] * 6
_SCALES = 10.0 ** np.array([*_DECIMALS, *[QUATERNION_DECIMALS] * 4])
# Points in messages are int16 millimetres.
_MOST_MM = 32767


class Extent(NamedTuple):
    """The extent of one surface, as messages have it.

    Attributes:
        mean_m: (3,) and
        covariance_m2: (9,); see `even_moments`.
        box: without outliers.
    """

    mean_m: list[float]
    covariance_m2: list[float]
    box: wire.GravityBox


def extents_of(
    points_world: Float32,
    counts: Int64,
    rows: Int64,
    up: Sequence[float],
    shown: Bool | None = None,
) -> list[Extent]:
    """Extents of the surfaces of some rows.

    Args:
        points_world: (S, K, 3) metres; the first `counts` of each row are used.
        counts: (S,) 1 or more in the rows.
        rows: (n,).
        up: unit vector against gravity.
        shown: (n, K) bool, points that the images show as the node's. The boxes are around these;
            None = not known.
    """
    frame, measured = _frame_of(tuple(up)), np.empty((len(rows), 22))
    for index, (row, count) in enumerate(zip(rows.tolist(), counts[rows].tolist())):
        columns, result = _columns(points_world[row, :count]), measured[index]
        _even_moments(columns, result[:12])
        if shown is not None and shown[index, :count].sum() >= MIN_SHOWN_POINTS:
            columns = np.ascontiguousarray(columns[:, shown[index, :count]])
        _box_around(columns, *frame, shown is None, result[12:])
    return [
        Extent(row[:3], row[3:12], wire.GravityBox(row[12:15], row[15:18], row[18:]))
        for row in _rounded(measured).tolist()
    ]


def _box_around(
    columns: Float64, axes: Float64, quat_axes: Float64, is_smallest: bool, box: Float64
) -> None:
    """Write the box around columns (3, n) without outliers, see `_box`.

    The smallest one is around all parts of fewer points.
    """
    if is_smallest:
        columns = columns[:, :FEWER_POINTS].copy()
    upright, squared = _third_neighbours(columns, axes)
    limit = OUTLIER_FACTOR**2 * float(np.median(squared))
    if not is_smallest:
        limit = max(limit, NEAR_ENOUGH_M**2)
    upright = upright[:, squared <= limit]
    if not is_smallest:
        upright = upright[:, _in_main_parts(np.ascontiguousarray(upright))]
    _box(np.ascontiguousarray(upright), axes, quat_axes, is_smallest, box)


def rounded_gaussians(means: Float64, covariances: Float64, rows: Int64) -> list[list[float]]:
    """Mean and covariance (12,) of some rows of (N, 3) and (N, 3, 3), as messages have them."""
    gaussians = np.concatenate([means[rows], covariances[rows].reshape(-1, 9)], axis=1)
    found: list[list[float]] = _rounded(gaussians).tolist()
    return found


def _rounded(numbers: Float64) -> Float64:
    """The first columns of (n, 22) as `rounded`, each with its decimals."""
    scales = _SCALES[: numbers.shape[1]]
    return np.asarray(np.rint(numbers * scales) / scales + 0.0)


def even_moments(points_world: Float32) -> tuple[Float64, Float64]:
    """Mean (3,) and covariance (3, 3) of a surface with uneven point density.

    Points (n, 3), n >= 1, are dense on parts that were seen longer or from nearby. The weight of a
    point is the inverse square root of the number of points within `EVEN_RADIUS_M`. The inverse
    itself would give a stray point the weight of a whole patch. The covariance of a ball of that
    radius is added.

    Raises:
        ValueError: without points, or for one that is not finite or out of reach.
    """
    _check_points(points_world)
    moments = np.empty(12)
    _even_moments(_columns(points_world), moments)
    return moments[:3], moments[3:].reshape(3, 3)


def box_of(points_world: Float32 | Float64, up: Sequence[float]) -> wire.GravityBox:
    """The box around points (n, 3), n >= 1, without outliers.

    Args:
        points_world: metres.
        up: unit vector against gravity.

    Raises:
        ValueError: without points, or for one that is not finite or out of reach.
    """
    _check_points(points_world)
    box = np.empty(10)
    _box_around(_columns(points_world), *_frame_of(tuple(up)), True, box)
    return wire.GravityBox(
        rounded(box[:3], BOX_DECIMALS),
        rounded(box[3:6], BOX_DECIMALS),
        rounded(box[6:], QUATERNION_DECIMALS),
    )


def _check_points(points_world: Float32 | Float64) -> None:
    """The kernels take their indices from the points."""
    if not len(points_world):
        raise ValueError("a surface without points: expected at least one")
    # Corners of a box around a Gaussian may lie outside of the limit of its mean.
    check_array("points", points_world, (len(points_world), 3), 4 * MAX_GRAPH_COORDINATE_M)


def _columns(points: Float32 | Float64) -> Float64:
    """Points (n, 3) as the kernels take them: (3, n) float64."""
    return np.ascontiguousarray(points.T, np.float64)


def horizontal_axes(up: Sequence[float]) -> Float64:
    """Rows (3, 3): two horizontal unit vectors and up, right-handed; the identity for +z."""
    third = np.asarray(up, np.float64) / np.linalg.norm(up)
    first = np.eye(3)[0 if abs(third[0]) < 0.9 else 1]
    first = first - third * (first @ third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


@lru_cache(maxsize=4)
def _frame_of(up: tuple[float, ...]) -> tuple[Float64, Float64]:
    """`horizontal_axes`, and their quaternion: every box needs them, and up changes seldom."""
    axes = horizontal_axes(up)
    # A column of eigenvectors has another layout than its opposite: one kernel is enough.
    return axes, np.ascontiguousarray(quaternion_from_rotation(axes.T))


@lru_cache(maxsize=1024)
def _axes_of(orientation_xyzw: tuple[float, ...]) -> Float64:
    """The axes (3, 3) of a box, one a row: most boxes are asked for again as they are."""
    return pose_from_quaternion(np.zeros(3), np.array(orientation_xyzw))[:3, :3].T


def rounded(values: Float64, decimals: int) -> list[float]:
    """Flat list of rounded values, without negative zeros."""
    flat: list[float] = (np.round(values, decimals) + 0.0).ravel().tolist()
    return flat


def surface_bytes(points_world: Float32, mean_m: Sequence[float]) -> bytes:
    """Points (n, 3) for `NodeState.surface_mm`; points farther than 32 m are left out."""
    offsets = np.rint((points_world.astype(np.float64) - mean_m) * 1e3)
    offsets = offsets[(np.abs(offsets) <= _MOST_MM).all(axis=1)]
    return offsets.astype("<i2").tobytes()


def surface_points(node: wire.NodeState) -> Float64:
    """The surface points (n, 3) of a message of any version, metres; (0, 3) without them."""
    if isinstance(node.surface_mm, bytes):
        whole = len(node.surface_mm) // 6 * 6
        offsets = np.frombuffer(node.surface_mm[:whole], "<i2").reshape(-1, 3)
        return np.asarray(offsets * 1e-3 + np.array(node.mean_m))
    points = node.surface_points_m if isinstance(node.surface_points_m, list) else []
    return np.array(points, np.float64).reshape(-1, 3)


# --- The boxes of nodes: which of their sides end where they say.
#
# A side of a box ends where a view shows what is beyond. The object may go on if the border of the
# image cuts it, if something is before it, or if it is behind the object itself.

# Which surface points (n, K) the images show as those of n slots; None = not known.
ShownSurfaces = Callable[[Int64], Bool | None]
# The two ends of an axis.
_SIGNS = np.array([-1.0, 1.0])
# The box of a node is measured again after this fraction of its frames more, within these limits.
AGAIN_FRACTION, LEAST_FRAMES, MOST_FRAMES = 0.5, 4, 32


@dataclass
class _Ends:
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
    def of(cls, box: wire.GravityBox) -> _Ends:
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

    def shared(self, other: _Ends) -> Bool:
        """Which ends (3, 2) of another box are those of this one, too."""
        apart = np.abs(self.axes @ (self.center - other.center))[:, None]
        apart = apart * [1.0, 1.0] + np.abs(self.half - other.half)[:, None]
        same = (self.axes * other.axes).sum(axis=1) > SAME_COS
        return np.asarray((apart < END_M) & same[:, None])


class NodeBoxes:
    """Measures the boxes of nodes, and follows where they end.

    Args:
        nodes: of the graph.
        shown: of their surfaces; None = boxes are around all points.
    """

    def __init__(self, nodes: NodeTable, shown: ShownSurfaces | None = None) -> None:
        self._nodes = nodes
        self._shown = shown
        self._ends: dict[int, _Ends] = {}

    def extents(self, slots: Int64, up: Sequence[float]) -> list[Extent]:
        """Extents of the surfaces of some slots, which have points."""
        nodes, shown = self._nodes, None if self._shown is None else self._shown(slots)
        return extents_of(nodes.surface_points_world, nodes.surface_counts, slots, up, shown)

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
        known, sides = self._ends.get(node_id), UNSET
        if known is not None:
            seen, cut, on = known.counts.transpose(2, 0, 1)
            open_ = (cut >= MIN_CUT) & (seen <= MAX_SEEN * (seen + cut))
            open_ |= (on >= MIN_CUT) & (on >= seen)
            if open_.any():
                open_ &= known.shared(_Ends.of(box))
            if open_.any():
                sides = open_.any(axis=1).tolist()
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
        for slot, extent in zip(slots.tolist(), self.extents(slots, up)):
            ends, node_id = _Ends.of(extent.box), int(nodes.ids[slot])
            known, count = self._ends.get(node_id), int(nodes.observations[slot])
            if known is not None:
                shared = known.shared(ends)
                ends.counts = known.counts * shared[:, :, None]
                ends.rests_m = known.rests_m if shared[2, 0] else ()
            wait = min(max(int(AGAIN_FRACTION * count), LEAST_FRAMES), MOST_FRAMES)
            ends.due, self._ends[node_id] = count + wait, ends
        if len(self._ends) > 2 * len(nodes) + FEW_POINTS:
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


@kernel
def _along_widest(columns: Float64) -> tuple[Float64, int]:
    """Points, columns (3, n), in the order of the coordinate that spreads most; and its axis."""
    count = columns.shape[1]
    widest, low, spread = 0, 0.0, -1.0
    for axis in range(3):
        least, most = columns[axis, 0], columns[axis, 0]
        for place in range(1, count):
            least, most = min(least, columns[axis, place]), max(most, columns[axis, place])
        if most - least > spread:
            widest, low, spread = axis, least, most - least
    # As many buckets as points; then each point is near its place.
    per_m = (count - 1) / spread if spread > LEAST_SPREAD_M else 0.0
    starts = np.zeros(count + 1, np.int64)
    for place in range(count):
        starts[int((columns[widest, place] - low) * per_m) + 1] += 1
    for bucket in range(count):
        starts[bucket + 1] += starts[bucket]
    order = np.empty(count, np.int64)
    for place in range(count):
        bucket = int((columns[widest, place] - low) * per_m)
        order[starts[bucket]] = place
        starts[bucket] += 1
    for index in range(1, count):
        place, at = order[index], index
        while at > 0 and columns[widest, order[at - 1]] > columns[widest, place]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = place
    ordered = np.empty((3, count), np.float64)
    for axis in range(3):
        for index in range(count):
            ordered[axis, index] = columns[axis, order[index]]
    return ordered, widest


@kernel
def _even_moments(columns: Float64, moments: Float64) -> None:
    """Write `even_moments` of columns (3, n): the mean and the covariance, (12,)."""
    ordered, widest = _along_widest(columns)
    x, y, z, along = ordered[0], ordered[1], ordered[2], ordered[widest]
    count = len(along)
    weights = np.empty(count, np.float64)
    first, last, total = 0, 0, 0.0
    for a in range(count):
        while along[a] - along[first] > EVEN_RADIUS_M:
            first += 1
        while last < count and along[last] - along[a] <= EVEN_RADIUS_M:
            last += 1
        # The compiler makes vectors of this.
        xs, ys, zs, near = x[first:last], y[first:last], z[first:last], 0
        for b in range(len(xs)):
            step_x, step_y, step_z = x[a] - xs[b], y[a] - ys[b], z[a] - zs[b]
            squared = step_x * step_x + step_y * step_y + step_z * step_z
            near += int(squared <= EVEN_RADIUS_M * EVEN_RADIUS_M)
        weights[a] = _EVEN_WEIGHTS[min(near, len(_EVEN_WEIGHTS) - 1)]
        total += weights[a]
    # One pass for all sums: the processor adds to them at the same time.
    mean_x = mean_y = mean_z = 0.0
    for a in range(count):
        weights[a] = weights[a] / total
        mean_x += weights[a] * x[a]
        mean_y += weights[a] * y[a]
        mean_z += weights[a] * z[a]
    xx = yy = zz = EVEN_RADIUS_M**2 / 5
    xy = xz = yz = 0.0
    for a in range(count):
        step_x, step_y, step_z = x[a] - mean_x, y[a] - mean_y, z[a] - mean_z
        by_x, by_y = weights[a] * step_x, weights[a] * step_y
        xx += by_x * step_x
        xy += by_x * step_y
        xz += by_x * step_z
        yy += by_y * step_y
        yz += by_y * step_z
        zz += weights[a] * step_z * step_z
    moments[0], moments[1], moments[2] = mean_x, mean_y, mean_z
    moments[3], moments[7], moments[11] = xx, yy, zz
    moments[4] = moments[6] = xy
    moments[5] = moments[9] = xz
    moments[8] = moments[10] = yz


@kernel
def _third_neighbours(columns: Float64, axes: Float64) -> tuple[Float64, Float64]:
    """The first of columns (3, n), turned to axes, and squared distances from the third neighbour.

    Of few points, all distances are 0.
    """
    count = min(columns.shape[1], MOST_POINTS)
    upright, squared = np.zeros((3, count), np.float64), np.zeros(count, np.float64)
    for axis in range(3):
        for k in range(3):
            if axes[axis, k] != 0.0:
                for place in range(count):
                    upright[axis, place] += axes[axis, k] * columns[k, place]
    ordered, widest = _along_widest(upright)
    x, y, z, along = ordered[0], ordered[1], ordered[2], ordered[widest]
    for row in range(count if count > FEW_POINTS else 0):
        # Squared distances of the three nearest points so far. Without branches: on new points, no
        # processor predicts them.
        near_1 = near_2 = near_3 = np.inf
        for step in (1, -1):
            other = row + step
            while 0 <= other < count:
                apart = along[other] - along[row]
                if apart * apart >= near_3:
                    break
                step_x, step_y, step_z = x[other] - x[row], y[other] - y[row], z[other] - z[row]
                found = step_x * step_x + step_y * step_y + step_z * step_z
                near_3 = min(near_3, max(near_2, found))
                near_2 = min(near_2, max(near_1, found))
                near_1 = min(near_1, found)
                other += step
        squared[row] = near_3
    return ordered, squared


@kernel
def _in_main_parts(upright: Float64) -> Bool:
    """Which of points (3, n) belong to a part of the footprint that is not small; (n,) bool.

    Points within `PART_GAP_M` of one another, horizontally, are of one part.
    """
    count, parts = upright.shape[1], 0
    part_of, sizes = np.full(count, -1), np.zeros(count, np.int64)
    waiting = np.empty(count, np.int64)
    for first in range(count):
        if part_of[first] >= 0:
            continue
        part_of[first], waiting[0], last = parts, first, 1
        while last > 0:
            last -= 1
            place = waiting[last]
            sizes[parts] += 1
            for other in range(count):
                step_x = upright[0, other] - upright[0, place]
                step_y = upright[1, other] - upright[1, place]
                near = step_x * step_x + step_y * step_y <= PART_GAP_M * PART_GAP_M
                if near and part_of[other] < 0:
                    part_of[other], waiting[last] = parts, other
                    last += 1
        parts += 1
    large: Bool = sizes[part_of] >= SMALL_PART * sizes.max()
    return large


@kernel
def _box(
    upright: Float64, axes: Float64, quat_axes: Float64, is_smallest: bool, box: Float64
) -> None:
    """Write the box around upright points (3, n): centre, size and quaternion, (10,).

    Its footprint is the smallest, or the one whose sides are nearest to the points.
    """
    # Vertical bounds, and horizontal ones along the axes of each heading.
    low, high, bounds = np.inf, -np.inf, np.empty((4, ALIGNED_HEADINGS), np.float64)
    lefts, rights, backs, fronts = bounds[0], bounds[1], bounds[2], bounds[3]
    for step in range(len(_HEADINGS)):
        lefts[step], rights[step], backs[step], fronts[step] = np.inf, -np.inf, np.inf, -np.inf
    for place in range(upright.shape[1]):
        x, y, z = upright[0, place], upright[1, place], upright[2, place]
        low, high = min(low, z), max(high, z)
        # The compiler makes vectors of this.
        for step in range(len(_HEADINGS)):
            u = _COSINES[step] * x + _SINES[step] * y
            v = _COSINES[step] * y - _SINES[step] * x
            lefts[step], rights[step] = min(lefts[step], u), max(rights[step], u)
            backs[step], fronts[step] = min(backs[step], v), max(fronts[step], v)
    costs = np.zeros(ALIGNED_HEADINGS, np.float64)
    for step in range(len(_HEADINGS) if is_smallest else 0):
        costs[step] = (rights[step] - lefts[step]) * (fronts[step] - backs[step])
    for place in range(0 if is_smallest else upright.shape[1]):
        x, y = upright[0, place], upright[1, place]
        for step in range(len(_HEADINGS)):
            u = _COSINES[step] * x + _SINES[step] * y
            v = _COSINES[step] * y - _SINES[step] * x
            apart = min(u - lefts[step], rights[step] - u)
            costs[step] += min(apart, v - backs[step], fronts[step] - v) / upright.shape[1]
    best = 0
    for step in range(1, len(_HEADINGS)):
        # Ties go to the axes of the world.
        if costs[step] < costs[best] - 1e-12:
            best = step
    left, right, back, front = lefts[best], rights[best], backs[best], fronts[best]
    box[3], box[4], box[5] = right - left, front - back, high - low
    u, v, w = (left + right) / 2, (back + front) / 2, (low + high) / 2
    cos, sin = _COSINES[best], _SINES[best]
    for axis in range(3):
        box[axis] = (
            (cos * u - sin * v) * axes[0, axis]
            + (sin * u + cos * v) * axes[1, axis]
            + w * axes[2, axis]
        )
    # The turn about the third axis, after the axes.
    qx, qy, qz, qw = quat_axes[0], quat_axes[1], quat_axes[2], quat_axes[3]
    cos, sin = math.cos(_HEADINGS[best] / 2), math.sin(_HEADINGS[best] / 2)
    sign = -1.0 if qw * cos - qz * sin < 0 else 1.0
    box[6], box[7] = sign * (qx * cos + qy * sin), sign * (qy * cos - qx * sin)
    box[8], box[9] = sign * (qz * cos + qw * sin), sign * (qw * cos - qz * sin)
