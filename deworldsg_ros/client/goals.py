"""Where to stand to look at an object, as far as the graph knows what is in the way."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from deworldsg_ros.client.boxes import Footprint, point_gaps_m, polygon_gap_m
from deworldsg_ros.client.objects import Point, SceneObject
from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.errors import ClientError

# Directions around an object that are tried.
DIRECTIONS = 72
# Farther away, no camera sees an object of a room.
MAX_DISTANCE_M = 10.0
# No robot that this is for is larger.
MAX_RADIUS_M, MAX_HEIGHT_M = 5.0, 10.0
# Heights above the floor at which the seen space is looked at; below, the floor itself is seen.
LOWEST_M, HEIGHT_STEP_M = 0.2, 0.3
# A line of sight is looked at in such steps, at this share of the robot's height: a wall is thicker
# than a step, most furniture lower, and a camera that looks down sees walls no higher.
SIGHT_STEP_M, SIGHT_HEIGHT = 0.05, 0.75
# It passes so far above the target, which would else be seen there itself.
SIGHT_ABOVE_M = 0.15
# Something is at a spot if more than this share of the robot's volume was seen as occupied.
MAX_OCCUPIED = 0.05
# The floor is this quantile of the bottoms of all boxes: few objects seem to be below it.
FLOOR_QUANTILE = 0.05


@dataclass(frozen=True)
class Robot:
    """The robot, or the person, that is to stand there; ClientError for impossible sizes.

    Attributes:
        radius_m: half of its width.
        height_m: its height. A box above it is not in its way.
    """

    radius_m: float = 0.3
    height_m: float = 1.5

    def __post_init__(self) -> None:
        if not 0 < self.radius_m <= MAX_RADIUS_M or not 0 < self.height_m <= MAX_HEIGHT_M:
            raise ClientError(
                f"radius {self.radius_m} and height {self.height_m} of the robot: expected "
                f"positive metres, at most {MAX_RADIUS_M:g} and {MAX_HEIGHT_M:g}"
            )


class Posed(Protocol):
    """A pose in the world at a time: a `Goal`, or a `NextView`."""

    @property
    def position_m(self) -> Point:
        """On the floor, world frame."""

    @property
    def orientation_xyzw(self) -> tuple[float, float, float, float]:
        """X axis ahead, z axis up."""

    @property
    def frame_id(self) -> str:
        """The world frame."""

    @property
    def stamp_ns(self) -> int:
        """Of the graph."""


def pose_fields(goal: Posed) -> dict[str, Any]:
    """The fields of a geometry_msgs/PoseStamped, for JSON."""
    position = dict(zip("xyz", (round(value, 3) + 0.0 for value in goal.position_m)))
    turn = dict(zip("xyzw", (round(value, 5) + 0.0 for value in goal.orientation_xyzw)))
    sec, nanosec = divmod(goal.stamp_ns, 10**9)
    return {
        "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": goal.frame_id},
        "pose": {"position": position, "orientation": turn},
    }


def pose_stamped(goal: Posed) -> Any:
    """The pose as geometry_msgs/PoseStamped; needs ROS 2."""
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
    from std_msgs.msg import Header

    sec, nanosec = divmod(goal.stamp_ns, 10**9)
    x, y, z = goal.position_m
    qx, qy, qz, qw = goal.orientation_xyzw
    position, turn = Point(x=x, y=y, z=z), Quaternion(x=qx, y=qy, z=qz, w=qw)
    return PoseStamped(
        header=Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=goal.frame_id),
        pose=Pose(position=position, orientation=turn),
    )


@dataclass(frozen=True)
class Goal:
    """A pose on the floor from which an object is in view.

    Attributes:
        target: the object.
        position_m: on the floor, world frame.
        orientation_xyzw: x axis towards the object, z axis up.
        frame_id: the world frame.
        stamp_ns: of the graph.
        distance_m: horizontal distance from the box of the object.
        clearance_m: gap from the edge of the robot to the nearest other box that is as low as the
            robot; infinite without one.
        seen_share: share of the object's surface points on this side, 0.5 = no difference. The
            camera was on the side of the visible surface, so this side was free of walls.
        covariance_m2: covariance (3, 3) of the object's Gaussian.
        along_std_m, across_std_m: its standard deviation along the view, and horizontally across.
        bearing_std_rad: angle of `across_std_m` as seen from here.
        blocked_by: an object that reaches into the line of sight, or None.
        in_known_area: the pose is between the objects of the graph. Outside, there may be a wall.
        seen_free: share of the robot's volume there that the camera has seen as free; None = the
            depth images of the run are not at hand.
    """

    target: SceneObject
    position_m: Point
    orientation_xyzw: tuple[float, float, float, float]
    frame_id: str
    stamp_ns: int
    distance_m: float
    clearance_m: float
    seen_share: float
    covariance_m2: tuple[Point, Point, Point]
    along_std_m: float
    across_std_m: float
    bearing_std_rad: float
    blocked_by: SceneObject | None
    in_known_area: bool
    seen_free: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with the fields of a geometry_msgs/PoseStamped."""
        return {
            **pose_fields(self),
            "target": {"id": self.target.id, "label": self.target.label},
            "target_probability": round(self.target.probability, 3),
            "distance_m": round(self.distance_m, 3),
            "clearance_m": None if math.isinf(self.clearance_m) else round(self.clearance_m, 3),
            "seen_share": round(self.seen_share, 2),
            "along_std_m": round(self.along_std_m, 3),
            "across_std_m": round(self.across_std_m, 3),
            "bearing_std_deg": round(math.degrees(self.bearing_std_rad), 1),
            "blocked_by": None
            if self.blocked_by is None
            else {"id": self.blocked_by.id, "label": self.blocked_by.label},
            "in_known_area": self.in_known_area,
            "seen_free": None if self.seen_free is None else round(self.seen_free, 2),
        }

    def pose_stamped(self) -> Any:
        """The pose as geometry_msgs/PoseStamped; needs ROS 2."""
        return pose_stamped(self)


def goal_near(
    target: SceneObject,
    others: Iterable[SceneObject],
    distance: float,
    stamp_ns: int,
    *,
    robot: Robot = Robot(),
    towards: Point | None = None,
    space: SeenSpace | None = None,
) -> Goal:
    """A pose at a distance from the box of an object, facing it, on a free side.

    Every direction around the object is tried. A direction is free if a disc of the robot's radius
    touches no other box that is lower than the robot. Of the free ones, the best sees the side of
    the object whose surface was seen, past no other object that hides it, is between the objects of
    the graph, and is nearest to `towards`. Walls are no objects: they are known only from `space`.
    Then a direction is not free, either, if the camera has seen something there; and what is behind
    a wall is taken last.

    Args:
        target: to look at.
        others: the other objects of the graph; the target itself is skipped.
        distance: horizontal distance from its box, metres.
        stamp_ns: of the graph.
        robot: that is to stand there.
        towards: preferred position, e.g. where the robot is.
        space: what the camera has seen as free; None = not known.

    Raises:
        ClientError: if the distance is not positive or too large, or no direction is free.
    """
    if not 0 < distance <= MAX_DISTANCE_M:
        raise ClientError(
            f"distance {distance}: expected a positive number of metres, at most {MAX_DISTANCE_M:g}"
        )
    obstacles = [item for item in others if item.id != target.id]
    floor = floor_m([target, *obstacles])
    low = [item for item in obstacles if item.footprint.low < floor + robot.height_m]
    area = _hull(np.concatenate([item.footprint.corners for item in [target, *obstacles]]))
    boxes = np.array([item.footprint.corners for item in low]).reshape(-1, 4, 2)
    rays = _rays()
    spots = _spots(target.footprint, rays, distance)
    clearances = [float(point_gaps_m(s, boxes).min(initial=math.inf)) for s in spots]
    free = np.flatnonzero(np.array(clearances) > robot.radius_m)
    in_sight = _in_sight(target, obstacles)
    goals: list[Goal] = []
    for row, seen_free in zip(free, _seen_free(space, target, spots[free], floor, robot)):
        if seen_free is not None and seen_free < 0.0:
            continue
        ray, spot, clearance = rays[row], spots[row], clearances[row] - robot.radius_m
        blocker = _blocker(target, in_sight, spot)
        known = area is not None and bool(point_gaps_m(spot, area[None])[0] == 0.0)
        goal = _goal(target, ray, spot, floor, stamp_ns, clearance, blocker, known)
        goals.append(replace(goal, seen_free=seen_free))
    if not goals:
        raise ClientError(
            f"no free side of {target.name} at {distance:g} m: other objects are within "
            f"{robot.radius_m:g} m of every pose; try another distance, or a smaller radius"
        )
    goals.sort(key=lambda goal: -_score(goal, towards))
    # A look along 72 lines costs far more than along the few that lead to the best one.
    level_m = floor + SIGHT_HEIGHT * robot.height_m
    axes = horizontal_axes(target.up)
    seen = (g for g in goals if not _is_behind_wall(space, target, axes @ g.position_m, level_m))
    return next(seen, goals[0])


def _score(goal: Goal, towards: Point | None) -> float:
    """The better, the higher: the order of importance is that of the numbers, chosen by hand."""
    score = 1.0 * goal.in_known_area - 0.5 * (goal.blocked_by is not None) + goal.seen_share
    score += 0.2 * min(goal.clearance_m, 1.0) + (goal.seen_free or 0.0)
    if towards is not None:
        score -= 0.1 * float(np.linalg.norm(np.subtract(goal.position_m, towards)))
    return score


def free_direction(
    of: SceneObject, others: Iterable[SceneObject], towards: Point | None, room: float
) -> Point:
    """The horizontal direction (unit vector, world) in which there is room beside an object.

    Args:
        of: the object.
        others: the other objects; those wholly above or below it are not in the way.
        towards: the nearest free direction to this point is chosen; None = the one with the
            largest gap.
        room: free length beside the box, metres, in the width of the box seen from there.

    Raises:
        ClientError: if there is no room on any side.
    """
    own = of.footprint
    level = [
        item
        for item in others
        if item.id != of.id and item.footprint.high > own.low and item.footprint.low < own.high
    ]
    wish = None if towards is None else _plan(towards, of.up) - own.center
    best: tuple[float, Float64] | None = None
    for ray in _rays():
        lane = _lane(own, ray, room)
        gap = min((polygon_gap_m(lane, item.footprint.corners) for item in level), default=1e3)
        if gap <= 0.0:
            continue
        score = gap if wish is None else float(ray @ wish)
        if best is None or score > best[0] + 1e-9:
            best = (score, ray)
    if best is None:
        raise ClientError(f"{of.name} has no free side with {room:g} m of room")
    x, y, z = (best[1] @ horizontal_axes(of.up)[:2] + 0.0).tolist()
    return x, y, z


def _seen_free(
    space: SeenSpace | None, target: SceneObject, spots: Float64, floor: float, robot: Robot
) -> list[float | None]:
    """Share of the robot's volume at each spot that was seen as free; -1 = something is there."""
    if space is None or not len(space) or not len(spots):
        return [None] * len(spots)
    disc = np.concatenate([np.zeros((1, 2)), robot.radius_m * _rays()[::9]])
    lowest_m = min(LOWEST_M, robot.height_m / 2.0)
    heights = floor + np.arange(lowest_m, robot.height_m, HEIGHT_STEP_M)
    plan = np.repeat((spots[:, None] + disc).reshape(-1, 2), len(heights), axis=0)
    levels = np.tile(heights, len(spots) * len(disc))
    volume = np.column_stack([plan, levels]) @ horizontal_axes(target.up)
    free, occupied = (seen.reshape(len(spots), -1).mean(axis=1) for seen in space.look(volume))
    return np.where(occupied > MAX_OCCUPIED, -1.0, free).tolist()


def _is_behind_wall(
    space: SeenSpace | None, target: SceneObject, spot: Float64, level_m: float
) -> bool:
    """Whether something was seen between a spot and the target, above what is low there."""
    if space is None or not len(space):
        return False
    level, own = max(level_m, target.footprint.high + SIGHT_ABOVE_M), target.footprint.center
    count = int(np.linalg.norm(spot[:2] - own) / SIGHT_STEP_M) + 2
    line = spot[:2] + np.linspace(0.0, 1.0, count)[:, None] * (own - spot[:2])
    points = np.column_stack([line, np.full(count, level)]) @ horizontal_axes(target.up)
    return bool(space.look(points)[1].sum() > 1)


def floor_m(items: Sequence[SceneObject]) -> float:
    """Height of the floor: that of the lowest objects."""
    return float(np.quantile([item.footprint.low for item in items], FLOOR_QUANTILE))


def _goal(
    target: SceneObject,
    ray: Float64,
    spot: Float64,
    floor: float,
    stamp_ns: int,
    clearance: float,
    blocker: SceneObject | None,
    known: bool,
) -> Goal:
    axes = horizontal_axes(target.up)
    position = np.array([*spot, floor]) @ axes
    forward, left = np.array([*-ray, 0.0]) @ axes, np.array([ray[1], -ray[0], 0.0]) @ axes
    turn = quaternion_from_rotation(np.stack([forward, left, axes[2]], axis=1)).tolist()
    covariance = np.array(target.covariance_m2)
    along, across = (math.sqrt(max(float(v @ covariance @ v), 0.0)) for v in (forward, left))
    view_m = float(np.linalg.norm(spot - target.footprint.center))
    x, y, z = position.tolist()
    return Goal(
        target=target,
        position_m=(x, y, z),
        orientation_xyzw=(turn[0], turn[1], turn[2], turn[3]),
        frame_id=target.frame_id,
        stamp_ns=stamp_ns,
        distance_m=float(point_gaps_m(spot, target.footprint.corners[None])[0]),
        clearance_m=clearance,
        seen_share=_seen_share(target, ray),
        covariance_m2=target.covariance_m2,
        along_std_m=along,
        across_std_m=across,
        bearing_std_rad=math.atan2(across, view_m),
        blocked_by=blocker,
        in_known_area=known,
    )


def _rays() -> Float64:
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _plan(point: Point, up: Point) -> Float64:
    return np.asarray(horizontal_axes(up)[:2] @ np.array(point))


def _spots(box: Footprint, rays: Float64, distance: float) -> Float64:
    """The points (n, 2) at a distance from a box, in directions (n, 2) from its centre."""
    low, high = np.zeros((2, len(rays), 1))
    high += distance + float(np.ptp(box.corners, axis=0).sum())
    boxes, center = np.repeat(box.corners[None], len(rays), axis=0), box.center
    for _ in range(20):  # the gap grows along the ray; 20 halvings give micrometres
        middle = (low + high) / 2
        is_near = point_gaps_m((center + middle * rays)[:, None], boxes)[:, None] < distance
        low, high = np.where(is_near, middle, low), np.where(is_near, high, middle)
    return np.asarray(center + high * rays)


def _hull(points: Float64) -> Float64 | None:
    """The corners (k, 2) of the convex hull of points (n, 2); None if they are on one line."""
    from scipy.spatial import ConvexHull, QhullError  # slow to import, and only for goals

    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return None


def _in_sight(
    target: SceneObject, obstacles: Sequence[SceneObject]
) -> list[tuple[SceneObject, Float64]]:
    """What is as high as the target's centre and not around it, with the corners of its box."""
    own = target.footprint
    height = (own.low + own.high) / 2
    level = [(item, item.footprint) for item in obstacles]
    return [
        (item, box.corners)
        for item, box in level
        if box.low < height < box.high and point_gaps_m(own.center, box.corners[None])[0] > 0.0
    ]


def _blocker(
    target: SceneObject, in_sight: list[tuple[SceneObject, Float64]], spot: Float64
) -> SceneObject | None:
    """The first object of `_in_sight` that is between a spot and the target."""
    line = np.array([spot, target.footprint.center])
    low, high = line.min(axis=0), line.max(axis=0)
    for item, corners in in_sight:
        is_beside = (corners.max(axis=0) < low).any() or (corners.min(axis=0) > high).any()
        if not is_beside and polygon_gap_m(line, corners) == 0.0:
            return item
    return None


def _seen_share(target: SceneObject, ray: Float64) -> float:
    """Share of the surface points that are on the side of a direction, seen from the centre."""
    points = target.surface_m
    if not len(points):
        return 0.5
    sides = (points @ horizontal_axes(target.up)[:2].T - target.footprint.center) @ ray
    return float((sides > 0).mean())


def _lane(box: Footprint, ray: Float64, room: float) -> Float64:
    """The free rectangle (4, 2) that is wanted beside a box, as wide as the box."""
    across = np.array([-ray[1], ray[0]])
    offsets = box.corners - box.center
    start, width = float((offsets @ ray).max()) + 1e-3, float((offsets @ across).max())
    near, far = box.center + start * ray, box.center + (start + room) * ray
    return np.array(
        [near - width * across, far - width * across, far + width * across, near + width * across]
    )
