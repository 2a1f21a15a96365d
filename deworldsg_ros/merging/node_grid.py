"""Which nodes a frame may show: a grid over the means of the nodes.

Space is divided into cubes. A frame is compared with the cubes that have nodes, and then with the
nodes of the cubes in view. So its cost follows the nodes in view, and a fraction of a microsecond
for each cube elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.merging.views import NEAR_M, THROUGH_FRACTION, THROUGH_M, FrameArrays
from deworldsg_ros.scene.arrays import Float64, Int64

# Edge of a cube: about a room, so that few cubes are in view, and few nodes of them are not.
CUBE_M = 4.0
# A node is compared if a ball of this many standard deviations around its mean may be in view.
BALL_DEVIATIONS = 3.0

# Of a frame: the principal point from the right and the lower side of the image, and the lengths of
# the normals of its four sides.
_Sides = tuple[float, float, float, float, float, float]


class NodeGrid:
    """Owners by the cube that contains the mean of their node."""

    def __init__(self) -> None:
        self._cube_of: dict[tuple[int, ...], int] = {}
        # Of each cube: its place in cubes, a ball around the balls of all nodes ever in it, and its
        # first owner.
        self._keys, self._cubes = np.zeros((16, 3)), np.zeros((16, 4))
        self._firsts = np.full(16, -1)
        # Of each owner: the ball of its node, its cube, and the owners before and after it there.
        self._balls = np.zeros((64, 4))
        self._links = np.full((64, 3), -1)

    def put(
        self,
        owners: Sequence[int],
        rows: Int64,
        means_world: Float64,
        eigenvalue_bounds: Float64,
    ) -> None:
        """Set the Gaussians of n owners, new or known.

        Args:
            owners: n owners.
            rows: (n,) row of each in
            means_world: (N, 3) metres, and
            eigenvalue_bounds: (N,) square metres, see `NodeTable`.
        """
        if not len(owners):
            return
        while max(owners) >= len(self._balls):
            self._balls = np.concatenate((self._balls, np.zeros_like(self._balls)))
            self._links = np.concatenate((self._links, np.full_like(self._links, -1)))
        moved = np.zeros(len(owners), np.int64)
        at = np.array(owners, np.int64)
        known = self._keys, self._cubes, self._balls, self._links
        count = _stay(*known, at, rows, means_world, eigenvalue_bounds, moved)
        if count:
            moved = moved[:count]
            keys = np.floor(means_world[rows[moved]] / CUBE_M).astype(np.int64)
            cube_of = self._cube_of
            cubes = np.array(
                [
                    cube_of[key] if key in cube_of else self._cube(key)
                    for key in map(tuple, keys.tolist())
                ]
            )
            _put(self._cubes, self._firsts, self._balls, self._links, at[moved], cubes)

    def remove(self, owner: int) -> None:
        """Remove an owner, if it is in the grid."""
        if owner < len(self._links):
            _remove(self._firsts, self._links, owner)

    def in_view(self, frame: FrameArrays) -> Int64:
        """Owners whose nodes a frame may show, in any order.

        Their balls are not wholly behind the camera, beyond one side of the image, or farther than
        all measured depth.
        """
        known = len(self._cube_of)
        return _in_view(self._cubes[:known], self._firsts, self._balls, self._links, frame)

    def _cube(self, key: tuple[int, ...]) -> int:
        cube = self._cube_of.get(key)
        if cube is None:
            cube = self._cube_of[key] = len(self._cube_of)
            if cube == len(self._cubes):
                self._keys = np.concatenate((self._keys, np.zeros_like(self._keys)))
                self._cubes = np.concatenate((self._cubes, np.zeros_like(self._cubes)))
                self._firsts = np.concatenate((self._firsts, np.full_like(self._firsts, -1)))
            self._keys[cube] = key
            self._cubes[cube, :3] = [CUBE_M * (index + 0.5) for index in key]
        return cube


@kernel
def _remove(firsts: Int64, links: Int64, owner: int) -> None:
    cube, before, after = links[owner]
    if cube < 0:
        return
    if before >= 0:
        links[before, 2] = after
    else:
        firsts[cube] = after
    if after >= 0:
        links[after, 1] = before
    links[owner] = -1


@kernel
def _stay(
    keys: Float64,
    cubes: Float64,
    balls: Float64,
    links: Int64,
    owners: Int64,
    rows: Int64,
    means: Float64,
    eigenvalue_bounds: Float64,
    moved: Int64,
) -> int:
    """Set the balls of owners. The number of those in another cube; their places are written."""
    count = 0
    for index in range(len(owners)):
        owner, row, is_same = owners[index], rows[index], True
        cube = links[owner, 0]
        for axis in range(3):
            balls[owner, axis] = means[row, axis]
            is_same &= cube >= 0 and math.floor(means[row, axis] / CUBE_M) == keys[cube, axis]
        balls[owner, 3] = BALL_DEVIATIONS * math.sqrt(eigenvalue_bounds[row])
        if is_same:
            reach = math.sqrt(0.75) * CUBE_M + balls[owner, 3]
            cubes[cube, 3] = max(cubes[cube, 3], reach)
        else:
            moved[count] = index
            count += 1
    return count


@kernel
def _put(
    cubes: Float64,
    firsts: Int64,
    balls: Float64,
    links: Int64,
    owners: Int64,
    new_cubes: Int64,
) -> None:
    """Put owners, whose balls are known, into other cubes."""
    for index in range(len(owners)):
        owner, cube = owners[index], new_cubes[index]
        reach = math.sqrt(0.75) * CUBE_M + balls[owner, 3]
        cubes[cube, 3] = max(cubes[cube, 3], reach)
        if links[owner, 0] == cube:
            continue
        _remove(firsts, links, owner)
        links[owner, 0], links[owner, 2] = cube, firsts[cube]
        if firsts[cube] >= 0:
            links[firsts[cube], 1] = owner
        firsts[cube] = owner


@kernel
def _may_show(ball: Float64, frame: FrameArrays, sides: _Sides, far_m: float) -> bool:
    """Whether a ball, centre and radius, may be in view."""
    T, _, _, (fx, fy, cx, cy) = frame
    right, below, leftwards, rightwards, upwards, downwards = sides
    x, y, z, radius = ball
    ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    # Some points may lie outside the ball: near the far end, twice its radius counts.
    if ahead < NEAR_M - radius or ahead > far_m + 2.0 * radius:
        return False
    across = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    return not (
        fx * across + cx * ahead < -radius * leftwards
        or fx * across + right * ahead > radius * rightwards
        or fy * down + cy * ahead < -radius * upwards
        or fy * down + below * ahead > radius * downwards
    )


@kernel
def _in_view(
    cubes: Float64, firsts: Int64, balls: Float64, links: Int64, frame: FrameArrays
) -> Int64:
    depth_mm, farthest = frame[1], np.uint16(0)
    for row in range(depth_mm.shape[0]):
        for column in range(depth_mm.shape[1]):
            farthest = max(farthest, depth_mm[row, column])
    _, _, _, (fx, fy, cx, cy) = frame
    right, below = cx - depth_mm.shape[1], cy - depth_mm.shape[0]
    lengths = math.hypot(fx, cx), math.hypot(fx, right), math.hypot(fy, cy), math.hypot(fy, below)
    sides = right, below, *lengths
    # Beyond this, no measured depth is within the tolerance of a point.
    far_m = (0.001 * farthest + THROUGH_M) / (1.0 - THROUGH_FRACTION)
    owners, count = np.empty(64, np.int64), 0
    for cube in range(len(cubes)):
        owner = firsts[cube]
        if owner < 0 or not _may_show(cubes[cube], frame, sides, far_m):
            continue
        while owner >= 0:
            if count == len(owners):
                owners = np.concatenate((owners, owners))
            owners[count] = owner
            count += int(_may_show(balls[owner], frame, sides, far_m))
            owner = links[owner, 2]
    return owners[:count].copy()
