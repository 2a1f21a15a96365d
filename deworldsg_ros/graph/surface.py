"""The surface of the room: coloured points, made of the depth grids of different views.

It is for people and planners, and no part of the paper's method: it changes nothing in the graph.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import islice

import numpy as np

from deworldsg_ros.graph.provenance import SeenSpace, seen_in
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int8, Int64, UInt8, UInt16
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.wire import messages as wire

# A cell has one point. Those of larger rooms are wider, by this factor once or more.
CELL_M, WIDER = 0.02, 1.3
MOST_POINTS = 150_000
# A pixel is left out if fewer than two of its four neighbours have about its depth: it lies on an
# edge, between two surfaces.
LEAST_ALIKE, ALIKE_M, ALIKE_FRACTION = 2, 0.03, 0.05
# Each view that sees a point adds a vote, up to this number; each that sees through it takes one
# away. A point without votes goes.
MOST_VOTES = 4
# A point belongs to an object up to so far outside of its box: the error of both.
BOX_MARGIN_M = 0.02
# Bits of a coordinate of a cell, and the cell at the origin.
_BITS, _MIDDLE = 21, 1 << 20


class Surface:
    """The n points of a room. Points that later views saw through are marked as gone.

    Points are only added at the end: who has the first k of them needs the rest alone, and
    `gone`. When cells become wider, all begins anew.

    Attributes:
        cell_m: width of a cell.
        points: (n, 3) float32, world, metres.
        colours: (n, 3) uint8 RGB.
        sides: (n, 3) int8, from the point to the camera that saw it, of length 127: the side of the
            surface that is known.
        gone: (n,) bool, seen through since.
        begun: how often all began anew.
    """

    def __init__(self, most_points: int = MOST_POINTS) -> None:
        self.cell_m = CELL_M
        self.begun = 0
        self._most_points = most_points
        self._empty()

    def __len__(self) -> int:
        return len(self.points)

    def clear(self) -> None:
        """Forget all points."""
        self.begun += 1
        self._empty()

    def add(self, depth_mm: UInt16, rgb: UInt8, camera: Float64, T_world_camera: Float64) -> None:
        """Add what a view shows, and take away what it sees through.

        Args:
            depth_mm: (h, w) uint16, 0 = invalid.
            rgb: (h, w, 3) uint8.
            camera: (4,) fx, fy, cx, cy in pixels of these images.
            T_world_camera: (4, 4).
        """
        self._vote(depth_mm, camera, T_world_camera)
        fx, fy, cx, cy = camera
        rows, columns = np.nonzero(_is_smooth(depth_mm))
        z = 0.001 * depth_mm[rows, columns]
        # The centre of pixel c of the grid is at c + 1/2, as in `SeenSpace.look`.
        x, y = (columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z
        rays = np.stack([x, y, z], axis=1) @ T_world_camera[:3, :3].T
        sides = -127 * rays / np.linalg.norm(rays, axis=1, keepdims=True)
        points = (rays + T_world_camera[:3, 3]).astype(np.float32)
        self._extend(points, rgb[rows, columns], np.round(sides).astype(np.int8))
        while len(self.points) > self._most_points:
            self._widen()

    def kept(self) -> tuple[Float32, UInt8, Int8]:
        """The points that no later view saw through, (m, 3), with their colours and sides."""
        kept = ~self.gone
        return self.points[kept], self.colours[kept], self.sides[kept]

    def _empty(self) -> None:
        self.points: Float32 = np.zeros((0, 3), np.float32)
        self.colours: UInt8 = np.zeros((0, 3), np.uint8)
        self.sides: Int8 = np.zeros((0, 3), np.int8)
        self.gone: Bool = np.zeros(0, np.bool_)
        self._votes: Int8 = np.zeros(0, np.int8)
        self._cells: Int64 = np.zeros(0, np.int64)  # sorted, of the points that are not gone

    def _extend(self, points: Float32, colours: UInt8, sides: Int8) -> None:
        cells = self._cells_of(points)
        cells, first = np.unique(cells, return_index=True)
        places = np.searchsorted(self._cells, cells)
        known = np.zeros(len(cells), np.bool_)
        inside = places < len(self._cells)
        known[inside] = self._cells[places[inside]] == cells[inside]
        new = first[~known]
        self.points = np.concatenate([self.points, points[new]])
        self.colours = np.concatenate([self.colours, colours[new]])
        self.sides = np.concatenate([self.sides, sides[new]])
        self.gone = np.concatenate([self.gone, np.zeros(len(new), np.bool_)])
        self._votes = np.concatenate([self._votes, np.ones(len(new), np.int8)])
        self._cells = np.insert(self._cells, places[~known], cells[~known])

    def _vote(self, depth_mm: UInt16, camera: Float64, T_world_camera: Float64) -> None:
        """Count for each point whether the view sees it, or through it."""
        left = np.flatnonzero(~self.gone)
        inside, through, seen = seen_in(self.points[left], depth_mm, camera, T_world_camera)
        at = left[inside]
        votes = self._votes[at] - through + seen
        self._votes[at] = np.minimum(votes, MOST_VOTES)
        lost = at[votes <= 0]
        if len(lost):
            self.gone[lost] = True
            self._cells = np.setdiff1d(self._cells, self._cells_of(self.points[lost]))

    def _widen(self) -> None:
        kept = self.kept()
        self.cell_m *= WIDER
        self.clear()
        self._extend(*kept)

    def _cells_of(self, points: Float32) -> Int64:
        """A number of the cell of each point; those of other rooms repeat."""
        parts = np.floor(points / self.cell_m).astype(np.int64) + _MIDDLE
        parts &= (1 << _BITS) - 1
        return np.asarray((parts[:, 0] << 2 * _BITS) | (parts[:, 1] << _BITS) | parts[:, 2])


class SurfaceOfSpace:
    """The surface of a graph whose views become more: only new views are added.

    The points of the oldest views stay when these are dropped. Views that moved make all anew.
    """

    def __init__(self) -> None:
        self._surface = Surface()
        self._poses: Float64 = np.zeros((0, 4, 4))
        self._stamps_ns: Int64 = np.zeros(0, np.int64)

    def of(self, space: SeenSpace) -> Surface:
        """The surface of these views; the next call changes it."""
        dropped = int(np.searchsorted(self._stamps_ns, space.stamps_ns[:1]).sum())
        count = len(self._stamps_ns) - dropped
        if not (
            count
            and np.array_equal(self._stamps_ns[dropped:], space.stamps_ns[:count])
            and np.array_equal(self._poses[dropped:], space.poses[:count])
        ):
            self._surface, count = Surface(), 0
        for view in islice(space.views(), count, None):
            self._surface.add(*view)
        self._poses, self._stamps_ns = space.poses, space.stamps_ns
        return self._surface


def surface_of(space: SeenSpace | None, most_points: int = MOST_POINTS) -> Surface:
    """The surface that the views of a graph show, the oldest first."""
    surface = Surface(most_points)
    if space is not None:
        for view in space.views():
            surface.add(*view)
    return surface


def objects_at(points: Float32, nodes: Iterable[wire.NodeState]) -> Int64:
    """The id of the object whose box has each point (n, 3); 0 = none, of several the smallest box.

    Args:
        points: world, metres.
        nodes: of a message.
    """
    ids = np.zeros(len(points), np.int64)
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]
    boxes = [(node.id, node.box) for node in nodes if isinstance(node.box, wire.GravityBox)]
    for node_id, box in sorted(boxes, key=lambda item: -math.prod(item[1].size_m)):
        half = np.asarray(box.size_m) / 2 + BOX_MARGIN_M
        center, reach = np.asarray(box.center_m), float(np.linalg.norm(half))
        first, last = np.searchsorted(x, (center[0] - reach, center[0] + reach))
        near = order[first:last]
        T_world_box = pose_from_quaternion(center, np.asarray(box.orientation_xyzw))
        local = (points[near] - center) @ T_world_box[:3, :3]
        ids[near[(np.abs(local) <= half).all(axis=1)]] = node_id
    return ids


def _is_smooth(depth_mm: UInt16) -> Bool:
    """(h, w): the pixels with a depth that at least two of their neighbours share."""
    depth = depth_mm.astype(np.float32)
    limit = 1000 * ALIKE_M + ALIKE_FRACTION * depth
    alike = np.zeros(depth.shape, np.int8)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis))
        first = tuple(slice(None, -1) if i == axis else slice(None) for i in (0, 1))
        last = tuple(slice(1, None) if i == axis else slice(None) for i in (0, 1))
        alike[first] += step < limit[first]
        alike[last] += step < limit[last]
    return (depth_mm > 0) & (alike >= LEAST_ALIKE)
