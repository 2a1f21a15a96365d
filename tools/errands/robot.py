"""A disc robot in a home: its camera, odometry, floor grid, planner, and how it drives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from home import CELL_M, RADIUS_M, ROBOT_M, Home
from raster import Triangles
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from bench.furnished import pose
from deworldsg_ros.graph.floor_plan import fans, rays_of
from deworldsg_ros.poses.trajectory import Perturbation, PoseNoise
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame, invert_pose, rigid_motion

if TYPE_CHECKING:
    from mujoco_view import MujocoView

RATE_HZ = 5.0
SPEED_M_S, TURN_RAD_S = 0.9, math.radians(100)
CAMERA_M, TILT_RAD = 1.2, math.radians(22)
CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
RANGE_M = 5.0
NOISE_SPARE = 256
# What is higher hides what is behind it, but for what is so near to the target, such as its wall.
TALL_M, NEAR_TARGET_M = 1.1, 0.3
# Odometry drifts; every few metres the localisation of the robot takes that back, but for a rest.
DRIFT = PoseNoise(jitter_m=0.003, jitter_deg=0.1, drift_m_per_m=0.01, drift_deg_per_m=0.3)
CORRECTED_EVERY_M, REST_M, REST_RAD = 3.0, 0.02, math.radians(0.4)


def looking(x: float, y: float, yaw: float) -> np.ndarray:
    """T_world_camera (4, 4) of the robot's camera when the robot is at a pose."""
    return pose(x, y, CAMERA_M, yaw, TILT_RAD)


def plan_pose(T_world_camera: np.ndarray) -> np.ndarray:
    """x, y and yaw (3,) of a robot with that camera pose."""
    ahead = T_world_camera[:3, 2]
    return np.array([*T_world_camera[:2, 3], math.atan2(ahead[1], ahead[0])])


class Camera:
    """The robot's camera: colours, depth with noise, and which object each pixel shows.

    Args:
        home: what it sees.

    Attributes:
        view: renders the colours; None = plain ones, for true boxes.
    """

    def __init__(self, home: Home, view: MujocoView | None = None) -> None:
        self._triangles, self.view = Triangles(home), view
        size = CAMERA.height + NOISE_SPARE, CAMERA.width + NOISE_SPARE
        self._noise = np.random.default_rng(0).standard_normal(size, np.float32)

    def move(self) -> None:
        """See all objects where the home has them now."""
        self._triangles.move()
        if self.view is not None:
            self.view.move()

    def instances(self, T_world_camera: np.ndarray) -> np.ndarray:
        """The number of the object that each pixel shows (h, w) uint16; 0 = none."""
        return self._triangles.render(T_world_camera, CAMERA)[2]

    def shoot(
        self, T_world_camera: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """RGB (h, w, 3) uint8, noisy depth (h, w) float32 in metres, and the true objects."""
        rgb, depth, instances = self._triangles.render(T_world_camera, CAMERA)
        if self.view is not None:
            rgb = self.view.render(T_world_camera)
        # A part of a larger image of noise: fresh noise for each frame takes as long as its masks.
        row, column = rng.integers(0, NOISE_SPARE, 2)
        noise = self._noise[row : row + depth.shape[0], column : column + depth.shape[1]]
        depth = depth + (0.0012 + 0.0019 * (depth - 0.4) ** 2) * noise
        bend = np.abs(cv2.Laplacian(depth, cv2.CV_32F)) > np.maximum(0.05, 0.03 * depth)
        bend[bend] = rng.random(int(bend.sum())) < 0.5
        depth[bend | (depth > RANGE_M) | (depth < 0.25)] = 0.0
        return rgb, depth, instances


class Odometry:
    """Camera poses as the robot believes them: they drift, and are corrected now and then."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 1])
        self._drift = Perturbation(DRIFT)
        self._T_map_odom, self._left_m = np.eye(4), CORRECTED_EVERY_M
        self._before: np.ndarray | None = None

    def pose(self, T_true: np.ndarray) -> np.ndarray:
        """The pose (4, 4) that belongs to a true one."""
        T_odom = self._drift.apply(T_true)
        if self._before is not None:
            self._left_m -= float(np.linalg.norm(T_true[:3, 3] - self._before))
        self._before = T_true[:3, 3].copy()
        if self._left_m < 0.0:
            self._left_m = CORRECTED_EVERY_M
            turn = self._rng.normal(0, REST_RAD, 3) * [0.2, 0.2, 1.0]
            rest = rigid_motion(self._rng.normal(0, REST_M, 3) * [1.0, 1.0, 0.3], turn)
            self._T_map_odom = T_true @ rest @ invert_pose(T_odom)
        return self._T_map_odom @ T_odom


@dataclass
class Grid:
    """The occupancy grid that the robot keeps from its depth images, as a costmap does.

    Attributes:
        corner: (2,) of the first cell, metres.
        hits, passes: (rows, columns) how often each cell was seen occupied, and free.
        tall: (rows, columns) how often something was seen there as high as the camera.
    """

    corner: np.ndarray
    hits: np.ndarray
    passes: np.ndarray
    tall: np.ndarray

    @classmethod
    def around(cls, home: Home) -> Grid:
        """Cells that are enough for a home."""
        x0, y0, x1, y1 = home.extent()
        shape = int((y1 - y0 + 2) / CELL_M), int((x1 - x0 + 2) / CELL_M)
        return cls(np.array([x0 - 1, y0 - 1]), *(np.zeros(shape) for _ in range(3)))

    def see(self, depth_m: np.ndarray, T_map_camera: np.ndarray) -> None:
        """Add a depth image."""
        small = cv2.resize(depth_m, (80, 60), interpolation=cv2.INTER_NEAREST)
        rays = rays_of(np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]) / 8, small.shape)
        rays = rays @ T_map_camera[:3, :3].T
        points = T_map_camera[:3, 3] + rays * small[..., None]
        seen = (small > 0) & (points[..., 2] > 0.1)
        hit = self._cells_of(points[seen & (points[..., 2] < ROBOT_M)])
        self.tall += self._cells_of(points[seen & (points[..., 2] > TALL_M)])
        free = np.zeros(self.hits.shape, np.uint8)
        # Every second row of rays leaves no gap.
        rays, ends = rays[::2], small[::2].astype(np.float64)
        for fan in fans(T_map_camera[:3, 3], rays, ends, (0.05, ROBOT_M)):
            cv2.fillPoly(free, [np.floor((fan - self.corner) / CELL_M).astype(np.int32)], 1)
        self.hits += hit
        # What is seen through at one height may be occupied at another one.
        self.passes += 0.3 * ((free > 0) & (hit == 0))

    def _cells_of(self, points: np.ndarray) -> np.ndarray:
        """The cells (rows, columns) uint8 in which points (n, 3) are: 1, else 0."""
        cells = np.zeros(self.hits.shape, np.uint8)
        columns, rows = np.floor((points[:, :2] - self.corner) / CELL_M).astype(int).T
        inside = (rows >= 0) & (columns >= 0) & (rows < len(cells)) & (columns < cells.shape[1])
        cells[rows[inside], columns[inside]] = 1
        return cells

    def touch(self, place: np.ndarray, yaw: float) -> None:
        """Note that a robot at a place (2,) touched something ahead, so that it plans round it."""
        edge = place + (RADIUS_M + CELL_M) * np.array([math.cos(yaw), math.sin(yaw)])
        self.hits += 20 * self._cells_of(np.array([[*edge, 0.0]]))

    def hides(self, places: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Whether a wall, or what is as high, is between places and targets (n, 2).

        A line that leaves the grid is behind the walls.
        """
        ways = targets - places
        far_m = np.linalg.norm(ways, axis=1)
        shares = np.maximum(far_m - NEAR_TARGET_M, 0.0) / np.maximum(far_m, 1e-9)
        steps = np.linspace(0.0, 1.0, 2 + int(far_m.max(initial=0.0) / (CELL_M / 2)))
        lines = places[:, None] + (steps * shares[:, None])[..., None] * ways[:, None]
        columns, rows = np.moveaxis(np.floor((lines - self.corner) / CELL_M).astype(int), -1, 0)
        shape = self.tall.shape
        inside = (np.minimum(rows, columns) >= 0) & (rows < shape[0]) & (columns < shape[1])
        walls = self.tall[np.where(inside, rows, 0), np.where(inside, columns, 0)] >= 3
        return (walls | ~inside).any(axis=1)

    def clearance(self) -> np.ndarray:
        """Distance (rows, columns) of each free cell from what is occupied or unknown, metres."""
        occupied = (self.hits >= 2) & (self.hits >= 0.5 * self.passes)
        free = (self.passes > 0) & ~occupied
        return CELL_M * cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, 5)


_STEPS = [(0, 1, 1.0), (1, 0, 1.0), (1, 1, math.sqrt(2)), (1, -1, math.sqrt(2))]


class Planner:
    """Shortest paths of a disc on a grid of clearances (Dijkstra; the same lengths as A*)."""

    def __init__(self, clearance_m: np.ndarray, corner: np.ndarray, radius_m: float) -> None:
        # Pockets that are cut off, such as between chairs, are no places to be or to go to.
        _, parts = cv2.connectedComponents((clearance_m > radius_m).astype(np.uint8))
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        self.corner, self.free = corner, (parts == sizes.argmax()) & (parts > 0)
        # A little farther from walls where that costs little.
        self._cost = 1.0 + 0.6 * np.clip((radius_m + 0.2 - clearance_m) / 0.2, 0.0, 1.0)
        self._numbers = np.arange(self.free.size).reshape(self.free.shape)
        ends = []
        for down, right, length in _STEPS:
            rows, columns = self.free.shape
            a = np.s_[: rows - down, max(0, -right) : columns - max(0, right)]
            b = np.s_[down:, max(0, right) : columns + min(0, right)]
            both = self.free[a] & self.free[b]
            cost = length * (self._cost[a] + self._cost[b])[both] / 2
            ends.append((self._numbers[a][both], self._numbers[b][both], cost))
        one, other, cost = (np.concatenate(part) for part in zip(*ends))
        size = self.free.size
        self._graph = coo_matrix((cost, (one, other)), (size, size)).tocsr()

    def cell(self, point: np.ndarray) -> tuple[int, int]:
        """Row and column of a point."""
        column, row = np.floor((np.asarray(point[:2]) - self.corner) / CELL_M).astype(int)
        return int(row), int(column)

    def near(self, point: np.ndarray, reach_m: float) -> int | None:
        """The number of the free cell nearest to a point, at most so far away."""
        row, column = self.cell(point)
        reach = int(reach_m / CELL_M) + 1
        top, left = max(row - reach, 0), max(column - reach, 0)
        rows, columns = np.nonzero(self.free[top : row + reach + 1, left : column + reach + 1])
        if not len(rows):
            return None
        gaps = np.hypot(rows + top - row, columns + left - column)
        best = int(gaps.argmin())
        if gaps[best] * CELL_M > reach_m + CELL_M:
            return None
        return int(self._numbers[rows[best] + top, columns[best] + left])

    def point(self, number: int) -> np.ndarray:
        """The middle (2,) of a cell."""
        row, column = divmod(int(number), self.free.shape[1])
        return self.corner + CELL_M * (np.array([column, row]) + 0.5)

    def paths(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Costs of all cells from a point, and the cell before each; None if it is not free."""
        first = self.near(start, 0.4)
        if first is None:
            return None
        costs, before = dijkstra(
            self._graph, directed=False, indices=first, return_predecessors=True
        )
        return costs, before

    def path(self, start: np.ndarray, goal: np.ndarray, reach_m: float = 0.15) -> np.ndarray | None:
        """Points (n, 2) from start to goal; None if it cannot be reached."""
        found, last = self.paths(start), self.near(goal, reach_m)
        if found is None or last is None or not np.isfinite(found[0][last]):
            return None
        cells = [last]
        while found[1][cells[-1]] >= 0:
            cells.append(int(found[1][cells[-1]]))
        return self._straight(np.array([self.point(cell) for cell in cells[::-1]]))

    def _straight(self, points: np.ndarray) -> np.ndarray:
        """The path with straight lines where they are free."""
        kept, at = [0], 0
        while at < len(points) - 1:
            to = len(points) - 1
            while to > at + 1 and not self._sees(points[at], points[to]):
                to = at + max(1, (to - at) // 2)
            kept.append(to)
            at = to
        return points[kept]

    def _sees(self, a: np.ndarray, b: np.ndarray) -> bool:
        count = int(np.linalg.norm(b - a) / (CELL_M / 2)) + 2
        line = a + np.linspace(0, 1, count)[:, None] * (b - a)
        columns, rows = np.floor((line - self.corner) / CELL_M).astype(int).T
        return bool(self.free[rows, columns].all() and (self._cost[rows, columns] < 1.45).all())


def length_m(points: np.ndarray | None) -> float:
    """Length of a path (n, 2)."""
    return 0.0 if points is None else float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


class Robot:
    """A disc that drives itself in a home.

    Attributes:
        pose: true x, y and yaw.
        T_map_camera: the pose of the camera as the robot believes it.
        path_m: length of its way so far.
        trail: true positions so far.
        bumps: how often it touched something.
        depth_m, instances: newest depth image, and its true objects.
    """

    def __init__(
        self, home: Home, seed: int, start: np.ndarray, view: MujocoView | None = None
    ) -> None:
        self.home, self.camera, self.odometry = home, Camera(home, view), Odometry(seed)
        self.pose = np.array(start, np.float64)
        self.grid = Grid.around(home)
        self.rng = np.random.default_rng([seed, 2])
        self.stamp_ns, self.path_m, self.bumps, self.frames = 10**9, 0.0, 0, 0
        self.trail = [self.pose.copy()]
        self.instances = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
        self.depth_m = np.zeros((CAMERA.height, CAMERA.width), np.float32)
        self._free, self._corner = home.room_free()
        self.T_map_camera = self.odometry.pose(looking(*self.pose))

    def look(self) -> RgbdFrame:
        """A frame from where it is."""
        T_true = looking(*self.pose)
        rgb, self.depth_m, self.instances = self.camera.shoot(T_true, self.rng)
        self.stamp_ns += int(1e9 / RATE_HZ)
        self.frames += 1
        self.grid.see(self.depth_m, self.T_map_camera)
        return RgbdFrame(self.stamp_ns, rgb, self.depth_m, CAMERA, self.T_map_camera, "map")

    @property
    def believed(self) -> np.ndarray:
        """x, y and yaw (3,) where it believes to be."""
        return plan_pose(self.T_map_camera)

    def planner(self) -> Planner:
        """A planner on the grid as it is now; a bolder one if the robot is close to something."""
        clearance_m = self.grid.clearance()
        for spare_m in (0.03, -0.03, -0.08):
            planner = Planner(clearance_m, self.grid.corner, RADIUS_M + spare_m)
            if planner.near(self.believed, 0.3) is not None:
                break
        return planner

    def step(self, target: np.ndarray) -> bool:
        """Drive towards a point (2,) for the time of a frame; false if something is in the way."""
        x, y, yaw = self.believed
        left_s = 1.0 / RATE_HZ
        way = target - [x, y]
        error = _turn(math.atan2(way[1], way[0]) - yaw)
        turn = float(np.clip(error, -TURN_RAD_S * left_s, TURN_RAD_S * left_s))
        ahead = 0.0
        if abs(error) < 0.9:
            ahead = min(SPEED_M_S * left_s * max(0.1, math.cos(error)), float(np.linalg.norm(way)))
        self.pose[2] = _turn(self.pose[2] + turn)
        new = self.pose[:2] + ahead * np.array([math.cos(self.pose[2]), math.sin(self.pose[2])])
        row, column = np.floor((new[::-1] - self._corner[::-1]) / CELL_M).astype(int)
        moved = bool(self._free[row, column] > RADIUS_M - 0.06)
        if moved:
            self.path_m += float(np.linalg.norm(new - self.pose[:2]))
            self.pose[:2] = new
        else:
            self.bumps += 1
            self.grid.touch(np.array([x, y]), yaw + turn)
        self.trail.append(self.pose.copy())
        self.T_map_camera = self.odometry.pose(looking(*self.pose))
        return moved

    def turn(self, yaw: float) -> bool:
        """Turn towards a heading for the time of a frame; whether it is reached."""
        error = _turn(yaw - self.believed[2])
        step = float(np.clip(error, -TURN_RAD_S / RATE_HZ, TURN_RAD_S / RATE_HZ))
        self.pose[2] = _turn(self.pose[2] + step)
        self.T_map_camera = self.odometry.pose(looking(*self.pose))
        return abs(error - step) < 0.03


def _turn(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi
