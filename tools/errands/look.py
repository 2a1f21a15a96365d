"""What the robot has in view, what of the furniture it has looked at, and where to look next."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from home import CELL_M
from robot import CAMERA, CAMERA_M, TILT_RAD, Planner, Robot
from scipy.spatial.transform import Rotation

from deworldsg_ros.client.boxes import point_gaps_m
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.scene.camera import invert_pose

# Where a thing may have been put, and what it stands on below the top of the box: a seat.
SURFACES = ("dining table", "desk", "counter", "cabinet", "stand", "couch", "bed")
SEATS = ("couch", "bed")
# A place on a surface: so high above it, and of so many by so many.
ABOVE_M, PLACES = 0.08, 4
# A place is looked at if it was in view from so near in as many frames, and if nothing was found,
# once more from nearer. What stands on it may be as thick.
LOOKED_M, NEARER_M, LOOKED_FRAMES, THICK_M = 3.3, 1.9, 2, 0.15
# From nearer, what lies flat is not seen along its surface.
FLAT_RAD = math.radians(12)
# Candidates for the next view; a step without way costs as much as so many metres.
EVERY, STEP_M = 5, 1.5
# The least share of a surface that is worth a way.
LEAST_GAIN = 0.2
# Steepest ray of the camera below the horizon, with a margin.
DOWN_RAD = TILT_RAD + math.radians(20)
# A thing is in view from so near, if so many pixels show it.
IN_VIEW_M, FROM_FAR_M, IN_VIEW_PX = 1.42, 2.5, 150
MARGIN_M, BOTTOM_M = 0.03, 0.01


def box_frame(item: SceneObject, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) from the frame of the graph to that of a box."""
    rotation = Rotation.from_quat(item.orientation_xyzw).as_matrix()
    return (points - np.array(item.position_m)) @ rotation


def gap_m(item: SceneObject, place: np.ndarray) -> float:
    """Distance of a place (2,) from the outline of a box."""
    return float(point_gaps_m(place[:2], item.footprint.corners[None])[0])


def pixels_of(item: SceneObject, robot: Robot, T_graph_map: np.ndarray) -> int:
    """How many pixels of the robot's newest depth image are in a box, its bottom left out."""
    every = 2
    depth_m = robot.depth_m[::every, ::every]
    v, u = np.nonzero(depth_m)
    points = CAMERA.back_project(every * u, every * v, depth_m[v, u].astype(np.float64))
    T = T_graph_map @ robot.T_map_camera
    local = box_frame(item, points @ T[:3, :3].T + T[:3, 3])
    half = np.array(item.size_m) / 2
    # What the thing stands on is no part of it.
    inside = (np.abs(local) < half + MARGIN_M).all(axis=1) & (local[:, 2] > BOTTOM_M - half[2])
    return every**2 * int(inside.sum())


def places_on(item: SceneObject) -> np.ndarray:
    """Places (n, 3) on a piece of furniture, in the frame of the graph."""
    steps = (np.arange(PLACES) + 0.5) / PLACES - 0.5
    x, y = np.meshgrid(steps, steps)
    top = np.full(x.size, 0.0 if item.label in SEATS else 0.5)
    local = np.stack([x.ravel(), y.ravel(), top], axis=1) * np.array(item.size_m)
    turn = Rotation.from_quat(item.orientation_xyzw).as_matrix()
    return np.array(item.position_m) + local @ turn.T + [0.0, 0.0, ABOVE_M]


class Looked:
    """The places on furniture that the robot has looked at since it was asked.

    Args:
        robot: its frames and its floor grid.
        reach_m: a place is looked at from so near.
    """

    def __init__(self, robot: Robot, reach_m: float = LOOKED_M) -> None:
        self._robot, self._frames, self.reach_m = robot, dict[int, np.ndarray](), reach_m

    def note(self, items: Sequence[SceneObject], T_graph_map: np.ndarray) -> None:
        """Note what the newest frame shows of furniture."""
        T_camera_graph = invert_pose(T_graph_map @ self._robot.T_map_camera)
        if not items:
            return
        places = np.concatenate([places_on(item) for item in items])
        points = places @ T_camera_graph[:3, :3].T + T_camera_graph[:3, 3]
        near = np.linalg.norm(points, axis=1) < reaches(places, self.reach_m)
        for item, shown in zip(items, np.split(near & self._shown(points), len(items))):
            self._frames[item.id] = self._of(item) + shown

    def _of(self, item: SceneObject) -> np.ndarray:
        return self._frames.get(item.id, np.zeros(PLACES**2, int))

    def _shown(self, points: np.ndarray) -> np.ndarray:
        """Whether the newest frame shows points (n, 3) of its camera."""
        ahead = points[:, 2] > 0.1
        z = np.where(ahead, points[:, 2], 1.0)
        u = np.round(CAMERA.fx * points[:, 0] / z + CAMERA.cx)
        v = np.round(CAMERA.fy * points[:, 1] / z + CAMERA.cy)
        inside = ahead & (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
        depth_m = np.zeros(len(points))
        depth_m[inside] = self._robot.depth_m[v[inside].astype(int), u[inside].astype(int)]
        return inside & (depth_m > z - THICK_M)

    def left(self, items: Sequence[SceneObject]) -> np.ndarray:
        """The places (n, 3) on furniture that were not looked at; not those above the camera."""
        found = [np.zeros((0, 3))]
        found += [places_on(item)[self._of(item) < LOOKED_FRAMES] for item in items]
        places = np.concatenate(found)
        return places[places[:, 2] < CAMERA_M]

    def give_up(
        self, items: Sequence[SceneObject], place: np.ndarray, T_map_graph: np.ndarray
    ) -> None:
        """Take as looked at what should have been in view from a place (2,)."""
        for item in items:
            points = places_on(item) @ T_map_graph[:3, :3].T + T_map_graph[:3, 3]
            seen = views(self._robot, place[None], points, self.reach_m)[0]
            self._frames[item.id] = self._of(item) + LOOKED_FRAMES * seen

    def next_view(self, items: Sequence[SceneObject], T_map_graph: np.ndarray) -> np.ndarray | None:
        """The path (n, 2) to the place that shows most for its way; None = no place is worth it."""
        points = self.left(items)
        if not len(points):
            return None
        points = points @ T_map_graph[:3, :3].T + T_map_graph[:3, 3]
        planner = self._robot.planner()
        found = reachable(planner, self._robot.believed)
        if found is None:
            return None
        places, ways_m = found
        gains = views(self._robot, places, points, self.reach_m).sum(axis=1) / PLACES**2
        gains[gains < LEAST_GAIN] = 0.0
        best = int(np.argmax(gains / (ways_m + STEP_M)))
        return planner.path(self._robot.believed, places[best]) if gains[best] else None


def reachable(planner: Planner, start: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Places (n, 2) that a robot can go to, and the lengths (n,) of the ways there, metres."""
    found = planner.paths(start)
    if found is None:
        return None
    costs = found[0].reshape(planner.free.shape)
    some = np.zeros(planner.free.shape, bool)
    some[::EVERY, ::EVERY] = True
    some.flat[planner.near(start, 0.4)] = True
    rows, columns = np.nonzero(some & planner.free & np.isfinite(costs))
    places = planner.corner + CELL_M * (np.stack([columns, rows], axis=1) + 0.5)
    return places, CELL_M * costs[rows, columns]


def views(robot: Robot, places: np.ndarray, points: np.ndarray, reach_m: float) -> np.ndarray:
    """Whether a robot at places (n, 2) that turns round has points (m, 3) in view, (n, m)."""
    far = np.linalg.norm(places[:, None] - points[None, :, :2], axis=2)
    below = np.maximum(CAMERA_M - points[:, 2], 0.0)
    seen = (far < reaches(points, reach_m) - 0.2) & (far > below / math.tan(DOWN_RAD))
    one, other = np.nonzero(seen)
    seen[one, other] = ~robot.grid.hides(places[one], points[other, :2])
    return seen


def reaches(points: np.ndarray, reach_m: float) -> np.ndarray:
    """From how near places (n, 3) are looked at, metres (n,)."""
    if reach_m >= LOOKED_M:
        return np.full(len(points), reach_m)
    below = np.maximum(CAMERA_M - points[:, 2], 0.0)
    return np.clip(below / math.tan(FLAT_RAD), 0.9, reach_m)


def way_before(item: SceneObject, robot: Robot, T_map_graph: np.ndarray) -> np.ndarray | None:
    """The path (n, 2) to the nearest place that shows a thing; if need be, from far."""
    planner = robot.planner()
    found = reachable(planner, robot.believed)
    if found is None:
        return None
    places, ways_m = found
    T_graph_map = invert_pose(T_map_graph)
    own = (T_map_graph @ [*item.position_m, 1.0])[:3]
    in_graph = np.c_[places, np.zeros(len(places))] @ T_graph_map[:3, :3].T + T_graph_map[:3, 3]
    gaps_m = np.array([gap_m(item, place) for place in in_graph])
    in_view = views(robot, places, own[None], LOOKED_M)[:, 0]
    for reach_m in (IN_VIEW_M, FROM_FAR_M):
        near = in_view & (gaps_m < reach_m)
        if near.any():
            return planner.path(robot.believed, places[np.where(near, ways_m, math.inf).argmin()])
    return None
