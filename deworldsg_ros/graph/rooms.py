"""Rooms and storeys: where the free space that the camera saw is divided by walls and doorways.

Each storey has cells, as a floor plan: the air that views saw, and walls. What stands lower than a
wall is part of a room. The distance of each cell from the nearest wall has a ridge in every room
and a saddle in every doorway. Cells belong to the ridge that they ascend to, and ridges are joined
in the order of their saddles, the widest first, unless a saddle is a doorway: narrow, and narrower
than both sides. This is the segmentation by distance transform and critical points (Thrun,
"Learning metric-topological maps for indoor mobile robot navigation", 1998; compared by Bormann et
al., "Room segmentation: survey, implementation, and analysis", ICRA 2016), with the saddles in the
order of persistent homology, as in Hydra (Hughes et al., IJRR 2024).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.files import parse_json
from deworldsg_ros.graph.extent import horizontal_axes, rounded
from deworldsg_ros.graph.floor_plan import LOWEST_M, fans, rays_of
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.checks import checked, holds, within
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.limits import MAX_GRAPH_COORDINATE_M, MAX_INT, MAX_ROOMS, check_labels
from deworldsg_ros.scene.vocabulary import ROOM_KINDS, ROOM_PRIOR, THINGS_OF_ROOMS, plain
from deworldsg_ros.wire import messages as wire

CELL_M = 0.05
# The air of a room is looked at up to here: below lintels. What is higher than `TALL_M` is a wall,
# or furniture that divides a room as one.
TALL_M, TOP_M = 1.2, 1.9
# A cell has a wall from so many points on; fewer may be errors at the edges of things.
LEAST_POINTS = 3
# Of the rows of an image, one of so many is looked at for air.
ROWS = 3
# Floors are so far apart at least, and a camera is so high above its own.
STOREY_M, LOWEST_CAMERA_M, HIGHEST_CAMERA_M = 2.0, 0.3, 2.3
MOST_STOREYS = 100
# A floor is a layer of this height with this part of the points of the largest one. Levels of one
# storey differ by less than `STEP_M`.
LAYER_M, FLOOR_PART, STEP_M = 0.05, 0.25, 0.4
# A doorway is at most so wide, and so much narrower than both of its sides.
DOORWAY_M, NARROWING = 1.4, 0.75
# Gaps of what the views saw, up to so wide, are closed; smaller rooms are part of their neighbours.
GAP_M, LEAST_M2 = 0.2, 1.5
# Rooms have a floor: this part of them at least was seen. Behind a window is no room.
LEAST_FLOOR = 0.2
# Larger places are cut off: so far from the middle of the views.
REACH_M = 75.0
# A room keeps the id of the room before with which it shares most cells, from this part of the
# smaller one on.
SAME = 0.3
# Axes of a plan that turned by more are other axes: all begins anew.
SAME_UP = math.cos(math.radians(3.0))
# An object is in a room by the cells below its box, each off by up to this: the error of the box
# and of the walls. It may stand on no cell of a room, as what is in a wall: then the nearest room
# within `BESIDE_M` counts.
OFF_M, BESIDE_M = 0.1, 0.8
LEAST_IN = 0.05
# A kind is a name from this probability on.
LEAST_NAME = 0.5
# Things of a room come together: a second one tells less than if it were independent.
SHARED = 0.7


@dataclass
class Storey:
    """The cells of a storey. Row and column 0 are at the whole numbers `corner`, in cells.

    Attributes:
        floor_m: height of its floor along up.
        corner: (2,) int64, column and row of the first cell on the lattice of the plan.
        free: (rows, columns) bool, a view saw through its air.
        wall: (rows, columns) bool.
        floor: (rows, columns) bool, a view saw its floor.
        visited: (rows, columns) bool, a camera was there.
        ids: (rows, columns) int64, the room of each cell; 0 = none.
    """

    floor_m: float
    corner: Int64
    free: Bool
    wall: Bool
    floor: Bool
    visited: Bool
    ids: Int64

    @property
    def seen(self) -> Bool:
        """Cells that a view tells something of."""
        return self.free | self.wall | self.floor

    @cached_property
    def nearest(self) -> Int64:
        """The room in or beside which each cell is; 0 = none."""
        from scipy.ndimage import distance_transform_edt  # slow to import

        away, (rows, columns) = distance_transform_edt(self.ids == 0, return_indices=True)
        return np.where(away * CELL_M <= BESIDE_M, self.ids[rows, columns], 0)


def storeys_of(space: SeenSpace, axes: Float64) -> list[Storey]:
    """The storeys that views show, the lowest first; none without depth.

    Args:
        space: the views.
        axes: (3, 3) of the plan, see `horizontal_axes`.
    """
    cameras = space.poses[:, :3, 3] @ axes.T
    near = np.abs(cameras - np.median(cameras, axis=0)).max(axis=1) < REACH_M if len(space) else []
    views = []
    for (depth_mm, _, intrinsics, pose), is_near in zip(space.views(), near):
        if is_near:
            rays = rays_of(intrinsics, depth_mm.shape) @ (axes @ pose[:3, :3]).T
            views.append((axes @ pose[:3, 3], rays, 1e-3 * depth_mm.astype(np.float64)))
    floors = floors_m(views)
    found = []
    for number, floor in enumerate(floors):
        above = floors[number + 1] if number + 1 < len(floors) else np.inf
        own = [view for view in views if floor + LOWEST_CAMERA_M / 2 < view[0][2]]
        own = [view for view in own if view[0][2] < above + LOWEST_CAMERA_M / 2]
        if own:
            found.append(_cells(own, floor))
    return found


_View = tuple[Float64, Float64, Float64]  # camera (3,), rays (h, w, 3), depth (h, w); plan frame


def floors_m(views: Sequence[_View]) -> list[float]:
    """Heights of the floors, the lowest first: large layers below cameras, a storey apart."""
    heights = []
    for camera, rays, depth in views:
        z = camera[2] + (rays[..., 2] * depth)[depth > 0]
        below = camera[2] - z
        heights.append(z[(below > LOWEST_CAMERA_M) & (below < HIGHEST_CAMERA_M)])
    all_heights = np.concatenate([*heights, np.zeros(0)])
    if not len(all_heights):
        return []
    low = float(all_heights.min())
    layers = np.bincount(((all_heights - low) / LAYER_M).astype(np.int64))
    pairs = layers + np.append(layers[1:], 0)  # a floor may lie on the border of two layers
    found: list[float] = []
    for layer in np.flatnonzero(pairs >= FLOOR_PART * pairs.max()):
        middle = low + (int(layer) + 1) * LAYER_M
        if not found or middle - found[-1] > STOREY_M:
            inside = np.abs(all_heights - middle) <= LAYER_M
            found.append(float(np.median(all_heights[inside])))
    return found


def _cells(views: Sequence[_View], floor: float) -> Storey:
    """What views of one storey show in its cells."""
    import cv2  # slow to import, and only for plans

    points = np.concatenate([_points(*view) for view in views])
    points = points[(points[:, 2] > floor - STEP_M) & (points[:, 2] < floor + TOP_M)]
    plan = np.concatenate([points[:, :2], [camera[:2] for camera, _, _ in views]])
    middle = np.median(plan, axis=0)
    plan = np.clip(plan, middle - REACH_M, middle + REACH_M)
    corner = np.floor(plan.min(axis=0) / CELL_M).astype(np.int64) - 2
    columns, rows = np.floor(plan.max(axis=0) / CELL_M).astype(np.int64) - corner + 3
    free, tall_free = np.zeros((2, rows, columns), np.uint8)
    origin = corner * CELL_M
    for camera, rays, depth in views:
        some, closed = rays[::ROWS], _without_gaps(depth[::ROWS])
        for image, low in ((free, LOWEST_M), (tall_free, TALL_M)):
            for fan in fans(camera, some, closed, (floor + low, floor + TOP_M)):
                cv2.fillPoly(image, [np.floor((fan - origin) / CELL_M).astype(np.int32)], 1)
    levels = points[:, 2] - floor
    at = np.floor(points[:, :2] / CELL_M).astype(np.int64) - corner
    standing, tall, on_floor = (
        _counted(at[inside], (rows, columns))
        for inside in (
            (levels > LOWEST_M) & (levels < TALL_M),
            levels > TALL_M,
            np.abs(levels) < LOWEST_M,
        )
    )
    # A camera that sees a wall from near and below does not see it up there.
    wall = (tall >= LEAST_POINTS) | ((standing >= LEAST_POINTS) & (tall_free == 0))
    cameras = np.array([camera[:2] for camera, _, _ in views])
    visited = _counted(np.floor(cameras / CELL_M).astype(np.int64) - corner, (rows, columns))
    no_rooms = np.zeros((rows, columns), np.int64)
    seen_free = (free > 0) & ~wall
    return Storey(floor, corner, seen_free, wall, on_floor > 0, visited > 0, no_rooms)


def _without_gaps(depth: Float64) -> Float64:
    """Depth with single lost pixels as near as the nearer neighbour: a gap divides a fan."""
    sides = np.pad(depth, ((0, 0), (1, 1)))
    return np.where(depth > 0, depth, np.minimum(sides[:, :-2], sides[:, 2:]))


def _points(camera: Float64, rays: Float64, depth: Float64) -> Float64:
    """The points (n, 3) of a view, without those at the edges of things."""
    flat = np.ones(depth.shape, np.bool_)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis))
        edge = step > 0.1 * np.minimum(np.delete(depth, 0, axis), np.delete(depth, -1, axis)) + 0.05
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 0)
        flat &= ~np.pad(edge, pad)
        pad[axis] = (0, 1)
        flat &= ~np.pad(edge, pad)
    kept = flat & (depth > 0)
    return np.asarray(camera + rays[kept] * depth[kept, None])


def _counted(at: Int64, shape: tuple[int, int]) -> Int64:
    """Number of points (n, 2), by column and row, in each cell."""
    columns, rows = at.T
    inside = (columns >= 0) & (columns < shape[1]) & (rows >= 0) & (rows < shape[0])
    numbers = np.bincount((rows * shape[1] + columns)[inside], minlength=shape[0] * shape[1])
    return np.asarray(numbers.reshape(shape))


def interior(storey: Storey) -> Bool:
    """The cells of rooms (rows, columns): air or floor that was seen, without gaps or walls."""
    import cv2

    free = (storey.free | storey.floor).astype(np.uint8)
    size = 2 * round(GAP_M / 2 / CELL_M) + 1
    closed = cv2.morphologyEx(free, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    wall = storey.wall
    # A few cells alone are no wall.
    _, parts, stats, _ = cv2.connectedComponentsWithStats(wall.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] * CELL_M**2 > 0.05
    large[0] = False
    return np.asarray((closed > 0) & ~large[parts])


def divided(inside: Bool) -> tuple[Int64, Float32]:
    """The parts of free space that doorways and walls bound.

    Args:
        inside: (rows, columns), cells of rooms, False at the border.

    Returns:
        The part of each cell (rows, columns), from 1, 0 = none; and the distance (rows, columns) to
        what bounds it, metres.
    """
    import cv2

    exact = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Without small maxima of a ridge.
    distance = (cv2.GaussianBlur(exact * CELL_M, (0, 0), 1.0) * inside).astype(np.float32)
    roots = _roots(distance)
    names, labels = np.unique(roots[inside.ravel()], return_inverse=True)
    basins = np.full(inside.shape, -1, np.int64)
    basins[inside] = labels
    areas = CELL_M**2 * np.bincount(labels, minlength=len(names)).astype(np.float64)
    pairs, passes, _ = _saddles(basins, distance)
    joined = _joined(distance.ravel()[names], areas, pairs, passes)
    parts = np.zeros(inside.shape, np.int64)
    parts[inside] = (np.unique(joined, return_inverse=True)[1] + 1)[labels]
    return parts, distance


def _roots(height: Float32) -> Int64:
    """For each cell, the index of the local maximum that the steepest ascent leads to."""
    rows, columns = height.shape
    padded = np.pad(height, 1, constant_values=-1.0)
    best, parents = height.copy(), np.arange(height.size).reshape(height.shape)
    numbers = np.pad(parents, 1)
    for row in range(3):
        for column in range(3):
            near = padded[row : row + rows, column : column + columns]
            higher = near > best
            best[higher] = near[higher]
            parents[higher] = numbers[row : row + rows, column : column + columns][higher]
    found = parents.ravel()
    while True:
        further = found[found]
        if np.array_equal(further, found):
            return found
        found = further


def _saddles(parts: Int64, height: Float32) -> tuple[Int64, Float64, Int64]:
    """Where parts touch; parts below 0 do not count.

    Returns:
        Pairs (n, 2) of parts, the height (n,) of the highest pass of each, and its cell (n,).
    """
    count = int(parts.max(initial=-1)) + 1
    numbers = np.arange(parts.size).reshape(parts.shape)
    keys, values, cells = [], [], []
    for a, b in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
        (np.s_[:-1, :-1], np.s_[1:, 1:]),
        (np.s_[:-1, 1:], np.s_[1:, :-1]),
    ):
        one, other = parts[a], parts[b]
        meet = (one != other) & (one >= 0) & (other >= 0)
        low, high = np.minimum(one, other)[meet], np.maximum(one, other)[meet]
        keys.append(low * count + high)
        values.append(np.minimum(height[a], height[b])[meet])
        cells.append(numbers[a][meet])
    key, value = np.concatenate(keys), np.concatenate(values).astype(np.float64)
    order = np.lexsort((value, key))
    key = key[order]
    last = np.flatnonzero(np.append(key[1:] != key[:-1], np.ones(min(len(key), 1), np.bool_)))
    pairs = np.stack(np.divmod(key[last], max(count, 1)), axis=1)
    return pairs, value[order][last], np.concatenate(cells)[order][last]


def _joined(peaks: Float32, areas: Float64, pairs: Int64, passes: Float64) -> Int64:
    """The basin that each one (n,) belongs to, after those without a doorway are joined."""
    parents = np.arange(len(peaks))
    peaks, areas = peaks.copy(), areas.copy()

    def root(basin: int) -> int:
        while parents[basin] != basin:
            parents[basin] = parents[parents[basin]]
            basin = int(parents[basin])
        return basin

    def join(a: int, b: int) -> None:
        parents[b] = a
        peaks[a], areas[a] = max(peaks[a], peaks[b]), areas[a] + areas[b]

    order = np.argsort(-passes, kind="stable")
    for index in order:
        a, b = (root(int(basin)) for basin in pairs[index])
        is_doorway = 2 * passes[index] <= DOORWAY_M
        is_doorway &= passes[index] < NARROWING * min(peaks[a], peaks[b])
        if a != b and not is_doorway:
            join(a, b)
    # Niches, and gaps between furniture, are part of the room that they open to.
    for index in order:
        a, b = (root(int(basin)) for basin in pairs[index])
        if a != b and min(areas[a], areas[b]) < LEAST_M2:
            join(a, b)
    return np.array([root(basin) for basin in range(len(peaks))], np.int64)


# --- Rooms whose ids stay while views become more.


class _Saved(msgspec.Struct):
    """What a map has of rooms besides the cells of storey k, the array ``room_cells.k``."""

    axes: Annotated[list[float], msgspec.Meta(min_length=9, max_length=9)]
    floors_m: list[float]
    corners: list[Annotated[list[int], msgspec.Meta(min_length=2, max_length=2)]]
    names: dict[int, str]
    next_id: Annotated[int, msgspec.Meta(ge=1, le=MAX_INT)]


@dataclass(frozen=True)
class RoomMap:
    """The rooms of a graph so far. It never changes: `found_in` makes the next one.

    A graph keeps a bounded number of views. Cells that none of them shows stay as they were.

    Attributes:
        storeys: with the rooms in their cells, the lowest first.
        axes: (3, 3) of the plan, see `horizontal_axes`; None before the first views.
        names: by the operator, by id of the room.
        next_id: ids from here on were never given to a room.
    """

    storeys: tuple[Storey, ...] = ()
    axes: Float64 | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    next_id: int = 1

    @property
    def ids(self) -> set[int]:
        """The ids of the rooms."""
        return {int(room) for storey in self.storeys for room in np.unique(storey.ids) if room}

    def found_in(self, space: SeenSpace, up: Sequence[float]) -> RoomMap:
        """The rooms after these views; it takes a second or two for 128 of them.

        Args:
            space: the views.
            up: against gravity, world.
        """
        axes = horizontal_axes(up)
        known = list(self.storeys)
        if self.axes is not None and self.axes[2] @ axes[2] >= SAME_UP:
            axes = self.axes  # cells stay where they are
        else:
            known = []
        for storey in storeys_of(space, axes):
            same = [one for one in known if abs(one.floor_m - storey.floor_m) < STOREY_M / 2]
            for one in same:
                known.remove(one)
                storey = _continued(one, storey)
            known.append(storey)
        storeys, next_id = [], self.next_id
        for storey in sorted(known, key=lambda one: one.floor_m)[:MOST_STOREYS]:
            ids, next_id = _identified(storey, next_id)
            storeys.append(replace(storey, ids=ids))
        return replace(self, storeys=tuple(storeys), axes=axes, next_id=next_id)

    def named(self, room_id: int, name: str) -> RoomMap:
        """The same with a name by the operator; an empty one takes it back.

        Raises:
            RefusedInput: ``invalid_request`` if there is no such room.
        """
        if room_id not in self.ids:
            known = ", ".join(map(str, sorted(self.ids))) or "none"
            raise RefusedInput("invalid_request", f"room {room_id} is unknown; rooms: {known}")
        names = {key: value for key, value in self.names.items() if key != room_id}
        return replace(self, names={**names, room_id: name} if name else names)

    def states(self, nodes: Sequence[wire.NodeState]) -> list[wire.RoomState]:
        """The messages of the rooms, by id, with the objects that are in them."""
        if self.axes is None:
            return []
        contents = self._contents(nodes)
        beliefs = {node.id: node for node in nodes}
        found = []
        for number, storey in enumerate(self.storeys):
            for shape in _shapes(storey, self.axes):
                inside = [(beliefs[node_id], share) for node_id, share in contents[shape.id]]
                kinds = kinds_of(inside, len(shape.doorways), shape.width_m)
                name = self.names.get(shape.id)
                is_named = name is not None or kinds[0].probability >= LEAST_NAME
                found.append(
                    wire.RoomState(
                        id=shape.id,
                        label=name or (kinds[0].label if is_named else UNNAMED),
                        kinds=kinds[:MOST_KINDS],
                        storey=number,
                        outline_m=shape.outline_m,
                        area_m2=shape.area_m2,
                        doorways=shape.doorways,
                        objects=[wire.RoomObject(node.id, round(p, 3)) for node, p in inside],
                        named=is_named,
                        label_provenance=msgspec.UNSET if name is None else "operator",
                    )
                )
        return sorted(found, key=lambda room: room.id)[:MAX_ROOMS]

    @property
    def floors_m(self) -> list[float]:
        """Heights of the floors along up, the lowest first."""
        return [round(storey.floor_m, 3) for storey in self.storeys]

    def _contents(self, nodes: Sequence[wire.NodeState]) -> dict[int, list[tuple[int, float]]]:
        """The objects of each room, with the probability that they are in it."""
        from scipy.spatial.transform import Rotation  # slow to import

        found: dict[int, list[tuple[int, float]]] = defaultdict(list)
        boxed = [node for node in nodes if isinstance(node.box, wire.GravityBox)]
        if not boxed or not self.storeys or self.axes is None:
            return found
        boxes = [node.box for node in boxed if isinstance(node.box, wire.GravityBox)]
        turns = Rotation.from_quat([box.orientation_xyzw for box in boxes]).as_matrix()
        half = 0.5 * np.array([box.size_m for box in boxes])
        centers = np.array([box.center_m for box in boxes])
        grid = np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, 5)] * 2), axis=2).reshape(-1, 2)
        offsets = np.einsum("nij,nkj->nki", turns[:, :, :2], grid * half[:, None, :2])
        plan = (centers[:, None] + offsets) @ self.axes[:2].T
        steps = OFF_M * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
        plan = (plan[:, :, None] + steps).reshape(len(boxes), -1, 2)
        bottoms = centers @ self.axes[2] - half[:, 2]
        floors = np.array([storey.floor_m for storey in self.storeys])
        levels = np.maximum(np.searchsorted(floors, bottoms + STEP_M) - 1, 0)
        for level, storey in enumerate(self.storeys):
            rows = np.flatnonzero(levels == level)
            at = np.floor(plan[rows] / CELL_M).astype(np.int64) - storey.corner
            inside = ((at >= 0) & (at < np.array(storey.ids.shape)[::-1])).all(axis=2)
            at = np.where(inside[..., None], at, 0)
            rooms = np.where(inside, storey.nearest[at[..., 1], at[..., 0]], 0)
            for row, own in zip(rows, rooms):
                for room, count in zip(*np.unique(own[own > 0], return_counts=True)):
                    share = float(count) / len(own)
                    if share >= LEAST_IN:
                        found[int(room)].append((boxed[row].id, share))
        return found

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays by name, for `restored`; empty without rooms."""
        if self.axes is None:
            return {}
        saved = _Saved(
            self.axes.ravel().tolist(),
            [storey.floor_m for storey in self.storeys],
            [storey.corner.tolist() for storey in self.storeys],
            dict(self.names),
            self.next_id,
        )
        cells = {
            f"room_cells.{number}": (
                storey.free | storey.wall * 2 | storey.floor * 4 | storey.visited * 8
            ).astype(np.uint32)
            | (storey.ids << 4).astype(np.uint32)
            for number, storey in enumerate(self.storeys)
        }
        return {"rooms": np.frombuffer(msgspec.json.encode(saved), np.uint8), **cells}

    @classmethod
    def restored(cls, arrays: Mapping[str, NDArray[Any]]) -> RoomMap:
        """Continue with the `arrays` of an earlier run; ValueError if they are none."""
        if "rooms" not in arrays:  # a map of an older release
            return cls()
        saved = parse_json(checked(arrays, "rooms", np.uint8, None).tobytes(), _Saved)
        axes = np.array(saved.axes).reshape(3, 3)
        holds("rooms (axes)", bool(np.allclose(axes @ axes.T, np.eye(3), atol=1e-6)), "unit axes")
        holds("rooms (storeys)", len(saved.corners) == len(saved.floors_m), "a corner a storey")
        within(
            "rooms (floors)",
            np.array(saved.floors_m),
            -MAX_GRAPH_COORDINATE_M,
            MAX_GRAPH_COORDINATE_M,
        )
        check_labels(list(saved.names.values()))
        storeys = []
        for number, (floor, corner) in enumerate(zip(saved.floors_m, saved.corners)):
            name = f"room_cells.{number}"
            cells = checked(arrays, name, np.uint32, None, None)
            ids = (cells >> 4).astype(np.int64)
            holds(name, bool(ids.max(initial=0) < saved.next_id), "rooms below the next id")
            holds("rooms (corner)", max(map(abs, corner)) < 1e10, "cells of the world")
            free, wall, seen_floor, visited = ((cells & bit) > 0 for bit in (1, 2, 4, 8))
            at = np.array(corner, np.int64)
            storeys.append(Storey(floor, at, free, wall, seen_floor, visited, ids))
        return cls(tuple(storeys), axes, saved.names, saved.next_id)


def _continued(before: Storey, now: Storey) -> Storey:
    """A storey with what is not seen any more, as it was."""
    low = np.minimum(before.corner, now.corner)
    high = np.maximum(*(one.corner + one.free.shape[::-1] for one in (before, now)))
    if (high - low).max() * CELL_M > 4 * REACH_M:
        return now
    shape = tuple((high - low)[::-1])

    def placed(one: Storey, values: NDArray[Any]) -> NDArray[Any]:
        whole = np.zeros(shape, values.dtype)
        column, row = one.corner - low
        whole[row : row + values.shape[0], column : column + values.shape[1]] = values
        return whole

    seen = placed(now, now.seen)
    free, wall = (
        np.where(seen, placed(now, new), placed(before, old))
        for new, old in ((now.free, before.free), (now.wall, before.wall))
    )
    floor, visited = (
        placed(now, new) | placed(before, old)
        for new, old in ((now.floor, before.floor), (now.visited, before.visited))
    )
    return Storey(now.floor_m, low, free, wall, floor, visited, placed(before, before.ids))


def _identified(storey: Storey, next_id: int) -> tuple[Int64, int]:
    """The room of each cell (rows, columns), with the ids that they had; and the next id."""
    parts, _ = divided(interior(storey))
    count = int(parts.max(initial=0)) + 1
    areas = np.bincount(parts.ravel(), minlength=count)
    floors = np.bincount(parts[storey.floor], minlength=count)
    visits = np.bincount(parts[storey.visited], minlength=count)
    # Behind a window is no room.
    is_room = (areas * CELL_M**2 >= LEAST_M2) & ((floors >= LEAST_FLOOR * areas) | (visits > 0))
    is_room[0] = False
    both = is_room[parts] & (storey.ids > 0)
    pairs, shared = np.unique(np.stack([parts[both], storey.ids[both]]), axis=1, return_counts=True)
    old_areas = dict(zip(*np.unique(storey.ids, return_counts=True)))
    ids = np.zeros(count, np.int64)
    for index in np.argsort(-shared, kind="stable"):
        part, room = pairs[:, index]
        is_same = shared[index] >= SAME * min(areas[part], old_areas[room])
        if is_same and not ids[part] and room not in ids:
            ids[part] = room
    for part in np.flatnonzero(is_room & (ids == 0)):
        ids[part], next_id = next_id, next_id + 1
    return ids[parts], next_id


@dataclass(frozen=True)
class _Shape:
    """The shape of a room in its message, and the width of its widest part."""

    id: int
    outline_m: list[list[float]]
    area_m2: float
    width_m: float
    doorways: list[wire.Doorway]


def _shapes(storey: Storey, axes: Float64) -> list[_Shape]:
    import cv2

    names, rows = np.unique(storey.ids, return_inverse=True)
    parts = rows.reshape(storey.ids.shape) - (names[0] == 0)  # -1 = none
    names = names[names > 0]
    inside = np.pad(parts >= 0, 1)
    distance = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance = distance[1:-1, 1:-1] * CELL_M

    def world(columns: Float64, rows: Float64) -> list[list[float]]:
        plan = (storey.corner + np.stack([columns, rows], axis=1) + 0.5) * CELL_M
        points = np.column_stack([plan, np.full(len(plan), storey.floor_m)]) @ axes
        return [rounded(point, 3) for point in points]

    doorways: dict[int, list[wire.Doorway]] = defaultdict(list)
    for (a, b), half_m, cell in zip(*_saddles(parts, distance)):
        row, column = np.divmod(np.array([cell]), parts.shape[1])
        (where,) = world(column, row)
        for one, other in ((a, b), (b, a)):
            passage = wire.Doorway(int(names[other]), where, round(2 * float(half_m), 2))
            doorways[int(one)].append(passage)
    found = []
    for part, name in enumerate(names.tolist()):
        mask = (parts == part).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        contour = cv2.approxPolyDP(max(contours, key=cv2.contourArea), 1.5, True)[:, 0]
        width = 2 * float(distance[mask > 0].max())
        area = round(float(mask.sum()) * CELL_M**2, 2)
        outline = world(contour[:, 0], contour[:, 1])
        found.append(_Shape(name, outline, area, width, doorways[part]))
    return found


# --- What kind of room it is, by what is in it.

UNNAMED, MOST_KINDS = "room", 4
# A long room with many doors is a hallway.
NARROW_M, MANY_DOORWAYS = 2.0, 3
_SHAPE = (6, 3, 3, 4, 4, 3, 60, 5)


def kinds_of(
    inside: Iterable[tuple[wire.NodeState, float]], doorways: int, width_m: float
) -> list[wire.Belief]:
    """The kinds of a room with their probabilities, which sum to one; the most probable first.

    Args:
        inside: objects, each with the probability that it is in the room. Several of one class
            count once; an object counts by the probability that it exists and is of the class.
        doorways: number of doorways.
        width_m: of its widest part.
    """
    absent: dict[str, float] = {}
    for node, share in inside:
        exists = node.existence if isinstance(node.existence, float) else 1.0
        for belief in node.classes:
            name = plain(belief.label)
            if name in THINGS_OF_ROOMS:
                present = min(share * exists * belief.probability, 1.0)
                absent[name] = absent.get(name, 1.0) * (1.0 - present)
    prior = np.array(ROOM_PRIOR)
    score = np.log(prior)
    for name, missing in absent.items():
        ratios = THINGS_OF_ROOMS[name] / (prior @ THINGS_OF_ROOMS[name])
        score += SHARED * np.log((1.0 - missing) * ratios + missing)
    if width_m < NARROW_M and doorways >= MANY_DOORWAYS:
        score += np.log(np.array(_SHAPE) / 100.0)
    chances = np.exp(score - score.max())
    chances /= chances.sum()
    order = np.argsort(-chances, kind="stable")
    return [wire.Belief(ROOM_KINDS[at], round(float(chances[at]), 4)) for at in order]
