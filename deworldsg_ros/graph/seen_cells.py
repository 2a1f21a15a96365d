"""What the camera has seen, in cells, where a robot can get there, and what it would see.

The cells remember all views that they were given. A graph keeps the newest 128.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.floor_plan import floor_height_m, rays_of
from deworldsg_ros.graph.provenance import MIN_DEPTH_M, MOVED_M, TURNED_RAD, SeenSpace
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from deworldsg_ros.scene.errors import ClientError

CELL_M = 0.125
# Farther away, a view tells nothing of small things, and depth cameras little.
RANGE_M = 6.0
# Cells from so far below the first camera to so far above it. Of a camera that is higher or
# lower by more, it is another storey.
BELOW_M, ABOVE_M, STOREY_M = 2.6, 1.0, 1.2
MOST_CELLS = 20_000_000  # a place of 100 m by 100 m, 60 MB
# A view tells all of what is so near; of what is farther, less, by the square of the distance.
CLEAR_M = 2.5
# But at most this part: a detector finds in one view what it missed in another.
ONE_VIEW = 0.6
UNSEEN, FREE, OCCUPIED = 0, 1, 2
# Cells are horizontal if up is turned by less than a degree.
MOST_TILT = math.cos(math.radians(1.0))
# A cell in which the floor is, and one over it, may have points of the floor.
FLOOR_M = 0.05
MOST = 255


def clarity(distance_m: Any) -> Any:
    """How much of what is at distances a view tells, 0 to 1: by the area of its image."""
    return np.minimum(1.0, (CLEAR_M / np.maximum(distance_m, 1e-3)) ** 2)


class SeenCells:
    """What views have shown of each cell. It remembers views that a graph has forgotten.

    Cells are cubes of `CELL_M` in the frame of `horizontal_axes`, beside the origin.

    Args:
        up: against gravity, world.

    Attributes:
        first: (3,) number of the first cell along each axis.
        free, hits: (x, y, z) uint8: how many views saw through a cell, and how many saw something.
        clear: (x, y, z) uint8: how much of it the views have told, times 255: each one `ONE_VIEW`
            times its `clarity` of what was left.
        poses, cameras: (k, 4, 4) and (k, 4) of the views, as in `SeenSpace`.
        shape: (h, w) of the images.
    """

    def __init__(self, up: Sequence[float]) -> None:
        self.up = tuple(up)
        self.axes = horizontal_axes(up)
        self._begin()

    def _begin(self) -> None:
        self.first: Int64 = np.zeros(3, np.int64)
        self.free, self.hits, self.clear = (np.zeros((0, 0, 0), np.uint8) for _ in range(3))
        self.poses: Float64 = np.zeros((0, 4, 4))
        self.cameras: Float64 = np.zeros((0, 4))
        self.shape: tuple[int, ...] = (1, 1)
        self._known: dict[int, Float64] = {}
        self._heights: list[Float64] = []

    def fits(self, up: Sequence[float]) -> bool:
        """Whether up is nearly that of the cells; it is estimated, and changes."""
        return float(np.dot(self.axes[2], up)) > MOST_TILT * float(np.linalg.norm(up))

    def add(self, space: SeenSpace) -> SeenCells:
        """Take in the views that are new and of the storey of the newest.

        All are taken in anew if the poses of known ones have moved, or the storey is another one.
        """
        if not len(space):
            return self
        stamps_ns = space.stamps_ns.tolist()
        levels_m = space.poses[:, :3, 3] @ self.axes[2]
        if (self.hits.size and abs(levels_m[-1] - self._level_m) > STOREY_M) or any(
            stamp in self._known and not np.array_equal(self._known[stamp], pose)
            for stamp, pose in zip(stamps_ns, space.poses)
        ):
            self._begin()
        new = [row for row, stamp in enumerate(stamps_ns) if stamp not in self._known]
        self._known.update({stamps_ns[row]: space.poses[row] for row in new})
        new = [row for row in new if abs(levels_m[row] - levels_m[-1]) <= STOREY_M]
        for row in new:
            self._add(space.depths_mm[row], space.cameras[row], space.poses[row])
        if new:
            self.poses = np.concatenate([self.poses, space.poses[new]])
            self.cameras = np.concatenate([self.cameras, space.cameras[new]])
            self.shape = space.depths_mm.shape[1:]
        return self

    def _add(self, depth_mm: UInt16, camera: Float64, pose: Float64) -> None:
        turn, start = self.axes @ pose[:3, :3], self.axes @ pose[:3, 3]
        depth = 1e-3 * depth_mm.astype(np.float32)
        shows = (depth > MIN_DEPTH_M) & (depth < RANGE_M)
        rays = rays_of(camera, depth.shape).astype(np.float32)[shows].T
        points = turn.astype(np.float32) @ rays * depth[shows] + start.astype(np.float32)[:, None]
        if not points.size:
            return
        low = np.minimum(points.min(axis=1), start)
        high = np.maximum(points.max(axis=1), start)
        if not self._grow(low, high, float(start[2])):
            return
        heights = points[2, :: max(1, points.shape[1] // 150)].astype(np.float64)
        self._heights.append(heights[heights < start[2]])
        x, y, z = np.floor(points / np.float32(CELL_M)).astype(np.int32) - self.first[:, None]
        inside = (z >= 0) & (z < self.hits.shape[2])
        flat = ((x * self.hits.shape[1] + y) * self.hits.shape[2] + z)[inside]
        told = ONE_VIEW * clarity(depth[shows] * np.sqrt((rays * rays).sum(axis=0)))[inside]
        # A view counts once in a cell: of equal rows, one is written.
        hits, clear = self.hits.reshape(-1), self.clear.reshape(-1)
        clear[flat] += ((MOST - clear[flat]) * told).astype(np.uint8)
        hits[flat] = np.minimum(hits[flat], MOST - 1) + 1
        self._carve(depth, camera, turn, start, (low, high))

    def _grow(self, low: Float64, high: Float64, level_m: float) -> bool:
        """Make room for a view; false if the cells would be too many."""
        if not self.hits.size:
            self._level_m = level_m
        low, high = low.copy(), high.copy()
        low[2], high[2] = self._level_m - BELOW_M, self._level_m + ABOVE_M
        first, last = (np.floor(end / CELL_M).astype(np.int64) for end in (low, high))
        if self.hits.size:
            first = np.minimum(first, self.first)
            last = np.maximum(last, self.first + self.hits.shape - 1)
        if np.prod(last - first + 1.0) > MOST_CELLS:
            return False
        if self.hits.size:
            ends = np.stack([self.first - first, last - self.first - self.hits.shape + 1], axis=1)
            if ends.any():
                room = np.where(ends > 0, ends + 8, 0)  # a little more: it grows often
                room[2] = 0
                self.free, self.hits, self.clear = (
                    np.pad(values, room) for values in (self.free, self.hits, self.clear)
                )
                self.first = self.first - room[:, 0]
        else:
            self.first = first
            shape = tuple((last - first + 1).tolist())
            self.free, self.hits, self.clear = (np.zeros(shape, np.uint8) for _ in range(3))
        return True

    def _carve(
        self,
        depth: Float32,
        camera: Float64,
        turn: Float64,
        start: Float64,
        ends: tuple[Float64, Float64],
    ) -> None:
        """Count the cells that a view saw through, between the ends of what it shows."""
        shape = self.free.shape
        low, high = (np.floor(end / CELL_M).astype(np.int64) - self.first for end in ends)
        low, high = np.clip(low, 0, shape), np.clip(high + 1, 0, shape)
        sides = [
            ((np.arange(low[k], high[k]) + self.first[k] + 0.5) * CELL_M - start[k]).astype(
                np.float32
            )
            for k in range(3)
        ]
        x, y, z = (
            (sides[0] * turn[0, k])[:, None, None]
            + (sides[1] * turn[1, k])[:, None]
            + sides[2] * turn[2, k]
            for k in range(3)
        )
        at = np.flatnonzero((z > MIN_DEPTH_M) & (z < RANGE_M))
        ahead = z.reshape(-1)[at]
        fx, fy, cx, cy = camera
        u = (x.reshape(-1)[at] * (fx / ahead) + cx).astype(np.int32)
        v = (y.reshape(-1)[at] * (fy / ahead) + cy).astype(np.int32)
        height, width = depth.shape
        # Casts round towards 0: what is a little outside is in the first pixel.
        shown = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        at, ahead = at[shown], ahead[shown]
        through = depth[v[shown], u[shown]] > ahead + 0.25 * CELL_M
        block = self.free[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
        added = np.zeros(block.size, np.bool_)
        added[at[through]] = True
        block += added.reshape(block.shape) & (block < MOST)

    @property
    def state(self) -> UInt8:
        """UNSEEN, FREE or OCCUPIED of each cell."""
        found = (self.hits > 0) & (2 * self.hits.astype(np.int16) >= self.free)
        return np.where(found, OCCUPIED, (self.free > 0).astype(np.uint8)).astype(np.uint8)

    @property
    def floor_m(self) -> float:
        """Height of the floor along up."""
        heights = np.concatenate(self._heights) if self._heights else np.zeros(0)
        if not len(heights):
            return self._level_m - 1.0
        return floor_height_m(heights.astype(np.float32), np.ones(len(heights)))

    def layers(self, low_m: float, high_m: float) -> slice:
        """The layers of cells that lie between two heights."""
        low, high = math.ceil(low_m / CELL_M), math.floor(high_m / CELL_M)
        low, high = (int(np.clip(k - self.first[2], 0, self.hits.shape[2])) for k in (low, high))
        return slice(low, max(high, low))


@dataclass(frozen=True)
class Reach:
    """Where a robot can get on the floor that was seen.

    Attributes:
        first: (2,) number of the first cell.
        free: (x, y) where something was seen and nothing is in the way, for a point.
        stands: (x, y) where it can stand.
        way_m: (x, y) length of the way from where it is; infinite = it cannot get there.
        before: (x, y) the cell before on this way, as a flat number; negative = none.
    """

    first: Int64
    free: Bool
    stands: Bool
    way_m: Float64
    before: Int64

    def centers(self, cells: Int64) -> Float64:
        """Places (n, 2) of cells (n, 2), metres in the frame of the cells."""
        return np.asarray((cells + self.first + 0.5) * CELL_M)

    def path_to(self, cell: Sequence[int]) -> Float64:
        """The places (n, 2) on the way to a cell."""
        at = int(np.ravel_multi_index(tuple(cell), self.free.shape))
        cells = [at]
        while self.before.reshape(-1)[at] >= 0:
            at = int(self.before.reshape(-1)[at])
            cells.append(at)
        return self.centers(np.stack(np.unravel_index(cells[::-1], self.free.shape), axis=1))


def reach(
    cells: SeenCells, state: UInt8, radius_m: float, height_m: float, start: Float64 | None
) -> Reach:
    """Where a robot gets from a place (2,) on its floor; None = from the middle of the widest."""
    import cv2  # slow to import, and only for goals
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    floor = cells.floor_m
    band = state[:, :, cells.layers(floor + FLOOR_M, floor + max(height_m, 3 * CELL_M))]
    free = (band == FREE).any(axis=2) & ~(band == OCCUPIED).any(axis=2)
    apart = np.full(free.shape, np.inf)
    if start is not None:
        x, y = (
            (np.arange(n) + cells.first[k] + 0.5) * CELL_M - start[k]
            for k, n in enumerate(free.shape)
        )
        apart = np.hypot(x[:, None], y)
    # It stands there, whatever its camera sees of its feet.
    free |= (apart < radius_m + CELL_M) & ~(band == OCCUPIED).any(axis=2)
    wide = np.pad(free.astype(np.uint8), 1)
    gaps = cv2.distanceTransform(wide, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1] - 0.5
    stands = (gaps * CELL_M >= radius_m) | (free & (apart < radius_m))
    nearest = gaps.argmax() if start is None else apart.argmin()
    here = np.unravel_index(int(nearest), free.shape)
    stands[here] = True
    numbers = np.arange(free.size).reshape(free.shape)
    links = []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = (slice(None, -1 if dx else None), slice(1 if dy < 0 else None, -1 if dy > 0 else None))
        b = (slice(1 if dx else None, None), slice(1 if dy > 0 else None, -1 if dy < 0 else None))
        both = stands[a] & stands[b]
        links.append((numbers[a][both], numbers[b][both], np.full(both.sum(), math.hypot(dx, dy))))
    rows, columns, lengths = (np.concatenate(part) for part in zip(*links))
    net = csr_matrix((lengths * CELL_M, (rows, columns)), (free.size, free.size))
    way_m, before = dijkstra(
        net, directed=False, indices=int(numbers[here]), return_predecessors=True
    )
    return Reach(
        cells.first[:2],
        free,
        stands,
        way_m.reshape(free.shape),
        before.reshape(free.shape).astype(np.int64),
    )


def enclosed(
    up: Sequence[float],
    areas: Sequence[Float64],
    floor_m: float,
    boxes: Sequence[tuple[Float64, float, float]],
) -> SeenCells | None:
    """Cells where no view is known: areas are free, all beyond is not, nor are boxes.

    Args:
        up: against gravity, world.
        areas: corners (n, 2) of each, in the frame of the cells.
        floor_m: height of their floor.
        boxes: corners (4, 2), bottom and top of each.

    Returns:
        None if there were too many cells.
    """
    import cv2  # slow to import, and only for goals

    cells = SeenCells(up)
    ends = np.concatenate(areas)
    low, high = (
        np.append(ends.min(axis=0) - 0.5, floor_m),
        np.append(ends.max(axis=0) + 0.5, floor_m),
    )
    if not cells._grow(low, high, floor_m + BELOW_M / 2):
        return None
    cells._heights.append(np.full(1, floor_m))

    def filled(polygons: Sequence[Float64]) -> Bool:
        inside = np.zeros(cells.free.shape[:2], np.uint8)
        for polygon in polygons:
            numbers = np.floor(polygon / CELL_M).astype(np.int64) - cells.first[:2]
            cv2.fillPoly(inside, [np.ascontiguousarray(numbers[:, ::-1]).astype(np.int32)], 1)
        return np.asarray(inside > 0)

    cells.free[filled(areas)] = 1
    for corners, bottom, top in boxes:
        layers = cells.layers(bottom - CELL_M / 2, top + CELL_M / 2)
        cells.free[:, :, layers][filled([corners])] = 0
    cells.hits[cells.free == 0] = 1
    cells.clear[:] = MOST
    return cells


# --- What a camera on a robot would see from places on the floor.

# Directions of rays around a place, and up and down within the view.
AZIMUTHS, ELEVATIONS, YAWS = 48, 7, 24
# Things stand below this height above the floor.
WORTH_M = 1.8
# In space that was never seen, a ray ends after about so much.
FREE_PATH_M = 4.0
# Views are alike that are so near and turned by so little, as of `SeenSpace`; up to twice as far,
# they are in part.
LIKE_M, LIKE_RAD = 1.2 * MOVED_M, 1.2 * TURNED_RAD


@dataclass(frozen=True)
class ViewCamera:
    """The camera on the robot.

    Attributes:
        height_m: above the floor.
        down_rad: by how much it looks down.
        width_rad, tall_rad: its field of view.
    """

    height_m: float = 1.2
    down_rad: float = 0.2
    width_rad: float = 1.05
    tall_rad: float = 0.8

    def __post_init__(self) -> None:
        if not (
            0.0 < self.height_m <= 5.0
            and abs(self.down_rad) < 1.5
            and 0.0 < self.width_rad < 6.3
            and 0.0 < self.tall_rad < 3.1
        ):
            raise ClientError(
                f"camera {self.height_m:g} m above the floor, {self.down_rad:g} rad down, view of "
                f"{self.width_rad:g} by {self.tall_rad:g} rad: expected at most 5 m, 1.5 rad, and "
                "a view of less than 6.3 by 3.1 rad"
            )

    @classmethod
    def of(cls, cells: SeenCells) -> ViewCamera:
        """The camera of the newest view; the default without views."""
        if not len(cells.poses):
            return cls()
        pose, (fx, fy, _, _) = cells.poses[-1], cells.cameras[-1].tolist()
        height, width = cells.shape
        place, ahead = cells.axes @ pose[:3, 3], cells.axes @ pose[:3, 2]
        return cls(
            height_m=float(np.clip(place[2] - cells.floor_m, 0.1, 5.0)),
            down_rad=float(np.clip(math.asin(np.clip(-ahead[2], -1.0, 1.0)), -1.4, 1.4)),
            width_rad=2.0 * math.atan(width / 2.0 / fx),
            tall_rad=2.0 * math.atan(height / 2.0 / fy),
        )


class Looks:
    """Looks from places among cells: what is in the way, and how much is beyond.

    Args:
        cells: that were seen.
        state: of `cells`.
        camera: on the robot.
        floor_m: height of the floor along up.
    """

    def __init__(self, cells: SeenCells, state: UInt8, camera: ViewCamera, floor_m: float) -> None:
        self.camera, self.floor_m = camera, floor_m
        self.axes, self.height_m = cells.axes, floor_m + camera.height_m
        self._pad = math.ceil(RANGE_M / CELL_M) + 1
        ends = ((self._pad, self._pad), (self._pad, self._pad), (0, 0))
        self._state, self._clear = np.pad(state, ends), np.pad(cells.clear, ends)
        self._first = cells.first - [self._pad, self._pad, 0]
        worth = cells.layers(floor_m, floor_m + WORTH_M)
        self.seen_m3 = float((state[:, :, worth] != UNSEEN).sum()) * CELL_M**3
        ahead = cells.poses[:, :3, 2] @ cells.axes.T
        yaws = np.arctan2(ahead[:, 1], ahead[:, 0])
        self._had = np.column_stack([(cells.poses[:, :3, 3] @ cells.axes.T)[:, :2], yaws])
        self._fan()

    def _fan(self) -> None:
        """The samples of all rays from a place, as differences of flat cells, and their weights."""
        azimuths = (np.arange(AZIMUTHS) + 0.5) * 2.0 * np.pi / AZIMUTHS
        tall, down = self.camera.tall_rad, self.camera.down_rad
        elevations = ((np.arange(ELEVATIONS) + 0.5) / ELEVATIONS - 0.5) * tall - down
        self.distances = (np.arange(math.floor(RANGE_M / CELL_M)) + 0.5) * CELL_M
        flat = np.cos(elevations)[:, None] * self.distances
        z = self.height_m + np.sin(elevations)[:, None] * self.distances
        x, y = (f(azimuths)[:, None, None] * flat for f in (np.cos, np.sin))
        columns = np.floor(z / CELL_M).astype(np.int64) - self._first[2]
        _, ny, nz = self._state.shape
        steps = [np.floor(side / CELL_M + 0.5).astype(np.int64) for side in (x, y)]
        self._table = (steps[0] * ny + steps[1]) * nz + np.clip(columns, 0, nz - 1)
        self._table = self._table.reshape(AZIMUTHS * ELEVATIONS, -1).astype(np.int32)
        angle = 2.0 * np.pi / AZIMUTHS * tall / ELEVATIONS * np.cos(elevations)
        told = angle[:, None] * self.distances**2
        told = told * ((z > self.floor_m) & (z < self.floor_m + WORTH_M)) * (columns < nz)
        told = np.broadcast_to(told, x.shape).reshape(len(self._table), -1)
        self._volumes_m3 = (told * clarity(self.distances) * CELL_M).astype(np.float32)
        self._areas_m2 = told.astype(np.float32)
        self._offsets = np.stack(
            [np.broadcast_to(side, x.shape).reshape(len(self._table), -1) for side in (x, y, z)],
            axis=2,
        )

    def unseen(self, places: Float64) -> tuple[Float64, Float64]:
        """What a view from places (n, 2) would tell of space, by azimuth.

        A ray goes through space that was not seen with a chance of exp(-way / `FREE_PATH_M`).

        Returns:
            (n, AZIMUTHS) cubic metres that were not seen, and square metres of surface that was
            seen from farther away; both times the `clarity` that is gained.
        """
        volumes = np.zeros((len(places), AZIMUTHS))
        areas = np.zeros((len(places), AZIMUTHS))
        clarities = clarity(self.distances).astype(np.float32)
        for row in range(0, len(places), 8):
            part = slice(row, row + 8)
            told, (of, ray, step), better = self._shown(places[part], clarities)
            volumes[part] = told.sum(axis=2).reshape(-1, AZIMUTHS, ELEVATIONS).sum(axis=2)
            np.add.at(areas, (row + of, ray // ELEVATIONS), better * self._areas_m2[ray, step])
        return volumes, areas

    def _shown(
        self, places: Float64, clarities: Float32
    ) -> tuple[Float32, tuple[Int64, ...], Float32]:
        """The volumes of the samples of all rays, where rays end, and the clarity gained there."""
        at = self._flat(places)[:, None, None] + self._table
        state = self._state.reshape(-1)[at]
        ends = np.maximum.accumulate(state == OCCUPIED, axis=2)
        unseen = state == UNSEEN
        before = np.cumsum(unseen, axis=2, dtype=np.int16)
        chance = np.exp(-CELL_M / FREE_PATH_M * np.arange(len(clarities) + 1)).astype(np.float32)
        told = np.where(unseen & ~ends, chance[before - unseen] * self._volumes_m3, np.float32(0.0))
        first = ends.argmax(axis=2)
        hit = np.nonzero(np.take_along_axis(ends, first[..., None], axis=2)[..., 0])
        step = first[hit]
        cell = at[(*hit, step)]
        had = self._clear.reshape(-1)[cell] * np.float32(1.0 / MOST)
        better = np.maximum(clarities[step] - had, 0.0) * chance[before[(*hit, step)]]
        return told, (*hit, step), better

    def _flat(self, places: Float64) -> Int64:
        x, y = (np.floor(places[:, k] / CELL_M).astype(np.int64) - self._first[k] for k in range(2))
        _, ny, nz = self._state.shape
        return np.asarray((x * ny + y) * nz)

    def middle(self, place: Float64, yaw: float) -> Float64:
        """The middle (3,) of where a view meets the volume that it would show anew."""
        told, _, _ = self._shown(place[None], clarity(self.distances).astype(np.float32))
        azimuths = np.repeat((np.arange(AZIMUTHS) + 0.5) * 2.0 * np.pi / AZIMUTHS, ELEVATIONS)
        weights = told[0].sum(axis=1) * self._within(azimuths, yaw)
        meets = self._offsets[np.arange(len(weights)), (told[0] > 0.0).argmax(axis=1)]
        return np.asarray(np.append(place, 0.0) + weights @ meets / max(weights.sum(), 1e-9))

    def _within(self, azimuths: Float64, yaw: Any) -> Bool:
        turn = (azimuths - yaw + np.pi) % (2.0 * np.pi) - np.pi
        return np.asarray(np.abs(turn) < self.camera.width_rad / 2.0)

    def by_yaw(self, azimuths: Float64) -> Bool:
        """Whether (n, YAWS) each azimuth is in view, for each yaw."""
        return self._within(azimuths[:, None], np.arange(YAWS) * 2.0 * np.pi / YAWS)

    def unlike_views(self, places: Float64) -> Float64:
        """How little (n, YAWS) views from places are like one that was had, 0 to 1.

        What such a view did not show will not be seen from there: it is too near, or does not
        reflect.
        """
        like = np.zeros((len(places), YAWS))
        apart = np.linalg.norm(places[:, None] - self._had[:, :2], axis=2)
        at, view = np.nonzero(apart < 2.0 * LIKE_M)
        yaws = np.arange(YAWS) * 2.0 * np.pi / YAWS
        turn = (yaws - self._had[view, 2][:, None] + np.pi) % (2.0 * np.pi) - np.pi
        near = np.clip(2.0 - apart[at, view] / LIKE_M, 0.0, 1.0)[:, None]
        np.maximum.at(like, at, near * np.clip(2.0 - np.abs(turn) / LIKE_RAD, 0.0, 1.0))
        return np.asarray(1.0 - like)

    def clear(self, starts: Float64, ends: Float64, radii: Float64) -> Bool:
        """Whether nothing is in the way from starts to ends (n, 3), up to radii (n,) before."""
        ways = ends - starts
        lengths = np.linalg.norm(ways, axis=1)
        steps = np.arange(1, math.ceil(lengths.max(initial=0.0) / CELL_M) + 1) * CELL_M
        points = (
            starts[:, None] + (ways / np.maximum(lengths, 1e-6)[:, None])[:, None] * steps[:, None]
        )
        cells = np.floor(points / CELL_M).astype(np.int64) - self._first
        inside = ((cells >= 0) & (cells < self._state.shape)).all(axis=2)
        cells = np.clip(cells, 0, np.array(self._state.shape) - 1)
        met = self._state[cells[..., 0], cells[..., 1], cells[..., 2]] == OCCUPIED
        before = steps < (lengths - radii - 1.5 * CELL_M)[:, None]
        return np.asarray(~(met & inside & before).any(axis=1))
