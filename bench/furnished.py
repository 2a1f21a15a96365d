"""Synthetic rooms of boxes with class names, and what a depth camera and a detector tell of them.

Everything here is made up: furniture is boxes, the detector misses objects, confuses look-alikes
for whole viewpoints, and cuts masks; depth has the noise of structured light. Rooms draw from the
same furniture of the same sizes, so that different rooms look alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np

from deworldsg_ros.scene.camera import Intrinsics, invert_pose, rigid_motion
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph, Relations, Vocabulary

# Class: width, depth and height in metres; stands on the floor, on a wall, or on something.
FURNITURE = {
    "dining table": (1.5, 0.9, 0.75), "chair": (0.45, 0.45, 0.9), "couch": (1.9, 0.9, 0.8),
    "bed": (2.0, 1.5, 0.5), "desk": (1.3, 0.7, 0.74), "cabinet": (0.9, 0.45, 1.1),
    "refrigerator": (0.6, 0.65, 1.8), "shelf": (0.9, 0.3, 1.9), "potted plant": (0.4, 0.4, 0.9),
    "bin": (0.3, 0.3, 0.4), "stool": (0.35, 0.35, 0.5), "lamp": (0.35, 0.35, 1.5),
}  # fmt: skip
ON_WALLS = {"picture": (0.6, 0.04, 0.45), "clock": (0.3, 0.05, 0.3), "window": (1.2, 0.06, 1.1)}
SMALL = {
    "book": (0.2, 0.14, 0.05), "cup": (0.09, 0.09, 0.1), "bottle": (0.08, 0.08, 0.28),
    "laptop": (0.34, 0.24, 0.22), "tv": (0.9, 0.12, 0.55), "vase": (0.14, 0.14, 0.3),
    "bowl": (0.22, 0.22, 0.09), "box": (0.3, 0.25, 0.2), "toaster": (0.3, 0.18, 0.2),
    "teddy bear": (0.25, 0.2, 0.3),
}  # fmt: skip
BEARING = ("dining table", "desk", "cabinet", "bed", "couch", "shelf", "refrigerator")
CLASSES = (*FURNITURE, *ON_WALLS, *SMALL)
ALIKE = {
    "dining table": "desk", "desk": "dining table", "chair": "stool", "stool": "chair",
    "couch": "bed", "bed": "couch", "cabinet": "shelf", "shelf": "cabinet", "bin": "box",
    "box": "bin", "vase": "bottle", "bottle": "vase", "cup": "bowl", "bowl": "cup",
    "picture": "window", "window": "picture", "lamp": "potted plant", "potted plant": "vase",
    "laptop": "tv", "tv": "laptop", "book": "box", "toaster": "box", "refrigerator": "cabinet",
    "clock": "picture", "teddy bear": "vase",
}  # fmt: skip
VOCABULARY = Vocabulary(CLASSES, ("on", "near"))
CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
STRIDE_PX = 8
RATE_HZ = 10.0
HEIGHT_M = 2.6


@dataclass(frozen=True)
class Box:
    """A thing in a room: centre (3,), size (3,), heading; the row of what bears it, or -1."""

    label: str
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    heading: float
    on: int = -1


@dataclass(frozen=True)
class Room:
    """Floor size in metres, and its things; the floor is z = 0, the middle the origin."""

    width: float
    depth: float
    things: tuple[Box, ...]


def furnish(seed: int) -> Room:
    """A room of 20 to 45 things."""
    rng = np.random.default_rng(seed)
    room = Room(*rng.uniform(3.6, 6.5, 2), ())
    kinds = rng.choice(list(FURNITURE), int(rng.integers(7, 13))).tolist()
    for kind in kinds:
        room = _with(room, _on_floor(room, kind, rng))
        if kind in ("dining table", "desk") and room.things and room.things[-1].label == kind:
            table = room.things[-1]
            for side in range(int(rng.integers(1, 5))):
                room = _with(room, _beside(table, side, rng))
    for kind in rng.choice(list(ON_WALLS), int(rng.integers(2, 5))).tolist():
        room = _with(room, _on_wall(room, kind, rng))
    for kind in rng.choice(list(SMALL), int(rng.integers(8, 22))).tolist():
        room = _with(room, _on_something(room, kind, rng))
    return room


def with_moved(room: Room, share: float, seed: int) -> tuple[Room, list[int]]:
    """The room with at least a share of its things at other places; and which ones, by row."""
    rng = np.random.default_rng(seed)
    things = list(room.things)
    moved: set[int] = set()
    for row in rng.permutation(len(things)).tolist():
        if len(moved) >= share * len(things):
            break
        thing = things[row]
        others = replace(room, things=tuple(things[:row] + things[row + 1 :]))
        if thing.label in ON_WALLS:
            new = _on_wall(others, thing.label, rng)
        elif thing.label in SMALL:
            # Rows of `others` are shifted by the one that is taken out.
            new = _on_something(others, thing.label, rng)
            new = None if new is None else replace(new, on=new.on + (new.on >= row))
        else:
            new = _on_floor(others, thing.label, rng)
        if new is None or np.linalg.norm(np.subtract(new.centre, thing.centre)) < 0.4:
            continue
        shift = np.subtract(new.centre, thing.centre)
        things[row] = replace(new, size=thing.size)
        moved.add(row)
        for other, item in enumerate(things):  # what stands on it goes with it
            if item.on == row and other != row:
                centre = tuple((np.array(item.centre) + shift).tolist())
                things[other] = replace(item, centre=centre)
                moved.add(other)
    return replace(room, things=tuple(things)), sorted(moved)


def _with(room: Room, thing: Box | None) -> Room:
    return room if thing is None else replace(room, things=(*room.things, thing))


def _size(kind: str, rng: np.random.Generator) -> tuple[float, float, float]:
    sizes = {**FURNITURE, **ON_WALLS, **SMALL}[kind]
    a, b, c = (np.array(sizes) * rng.uniform(0.92, 1.08, 3)).tolist()
    return a, b, c


def _is_free(room: Room, centre: Sequence[float], size: Sequence[float], heading: float) -> bool:
    """Whether a place on the floor is inside the room and away from other things, by circles."""
    half = math.hypot(size[0], size[1]) / 2
    cos, sin = abs(math.cos(heading)), abs(math.sin(heading))
    across = (cos * size[0] + sin * size[1]) / 2, (sin * size[0] + cos * size[1]) / 2
    if abs(centre[0]) + across[0] > room.width / 2 or abs(centre[1]) + across[1] > room.depth / 2:
        return False
    for other in room.things:
        if other.label in FURNITURE:
            apart = math.dist(centre[:2], other.centre[:2])
            if apart < 0.8 * (half + math.hypot(*other.size[:2]) / 2):
                return False
    return True


def _on_floor(room: Room, kind: str, rng: np.random.Generator) -> Box | None:
    size = _size(kind, rng)
    for _ in range(40):
        heading = float(rng.integers(4) * math.pi / 2 + (rng.random() < 0.3) * rng.normal(0, 0.3))
        x, y = rng.uniform(-0.5, 0.5, 2) * [room.width, room.depth]
        if rng.random() < 0.6:  # at a wall
            y = (room.depth / 2 - size[1] / 2 - 0.02) * (1 if rng.random() < 0.5 else -1)
            heading = 0.0
        centre = float(x), float(y), size[2] / 2
        if _is_free(room, centre, size, heading):
            return Box(kind, centre, size, heading)
    return None


def _beside(table: Box, side: int, rng: np.random.Generator) -> Box:
    size = _size("chair", rng)
    along = (0.0, 0.0, 1.0, -1.0)[side] * (table.size[0] / 2 + 0.2)
    across = (1.0, -1.0, 0.0, 0.0)[side] * (table.size[1] / 2 + 0.2)
    along, across = along + rng.normal(0, 0.08), across + rng.normal(0, 0.08)
    cos, sin = math.cos(table.heading), math.sin(table.heading)
    x = table.centre[0] + cos * along - sin * across
    y = table.centre[1] + sin * along + cos * across
    return Box("chair", (x, y, size[2] / 2), size, table.heading + float(rng.normal(0, 0.3)))


def _on_wall(room: Room, kind: str, rng: np.random.Generator) -> Box | None:
    size = _size(kind, rng)
    wall = int(rng.integers(4))
    along = float(rng.uniform(-0.4, 0.4)) * (room.depth if wall < 2 else room.width)
    side = 1 if wall % 2 else -1
    z = float(rng.uniform(1.3, 1.8))
    if wall < 2:
        return Box(kind, (side * (room.width - size[1]) / 2, along, z), size, math.pi / 2)
    return Box(kind, (along, side * (room.depth - size[1]) / 2, z), size, 0.0)


def _on_something(room: Room, kind: str, rng: np.random.Generator) -> Box | None:
    size = _size(kind, rng)
    bearing = [row for row, item in enumerate(room.things) if item.label in BEARING]
    for _ in range(20 if bearing else 0):
        row = int(rng.choice(bearing))
        base = room.things[row]
        free = np.array(base.size[:2]) - np.array(size[:2])
        if (free < 0).any():
            continue
        x, y = rng.uniform(-0.5, 0.5, 2) * free
        cos, sin = math.cos(base.heading), math.sin(base.heading)
        place = base.centre[0] + cos * x - sin * y, base.centre[1] + sin * x + cos * y
        top = base.centre[2] + base.size[2] / 2 + size[2] / 2
        others = [item for item in room.things if item.on == row]
        if any(math.dist(place, item.centre[:2]) < 0.2 for item in others):
            continue
        heading = base.heading + float(rng.normal(0, 0.2))
        return Box(kind, (float(place[0]), float(place[1]), top), size, heading, row)
    return None


# --- What a camera sees in it.


@numba.njit(cache=True)
def cast(origin, rays, boxes, shell):
    """Depth along each ray (n, 3), and the box that it meets: -1 = a wall, the floor, nothing."""
    depths, hits = np.empty(len(rays)), np.full(len(rays), -1, np.int64)
    for i in range(len(rays)):
        best = np.inf
        for axis in range(3):
            for side in range(2):
                if rays[i, axis] != 0.0:
                    t = (shell[side, axis] - origin[axis]) / rays[i, axis]
                    if 0.0 < t < best:
                        best = t
        for k in range(len(boxes)):
            x, y, z, a, b, c, cos, sin = boxes[k]
            near, far = 0.05, best
            px, py = origin[0] - x, origin[1] - y
            start = (cos * px + sin * py, -sin * px + cos * py, origin[2] - z)
            rx, ry = rays[i, 0], rays[i, 1]
            step = (cos * rx + sin * ry, -sin * rx + cos * ry, rays[i, 2])
            half = (a / 2, b / 2, c / 2)
            for axis in range(3):
                if abs(step[axis]) < 1e-12:
                    if abs(start[axis]) > half[axis]:
                        far = -1.0
                    continue
                t0 = (-half[axis] - start[axis]) / step[axis]
                t1 = (half[axis] - start[axis]) / step[axis]
                near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
                if near >= far:
                    break
            if near < far and near < best:
                best, hits[i] = near, k
        depths[i] = best
    return depths, hits


def tour(room: Room, seconds: float, seed: int) -> list[np.ndarray]:
    """Poses of a camera that walks through the room and looks around, T_room_camera."""
    rng = np.random.default_rng(seed)
    count = int(seconds * RATE_HZ)
    phase, turn = rng.uniform(0, 2 * math.pi), rng.choice([-1.0, 1.0])
    middle = rng.uniform(-0.12, 0.12, 2) * [room.width, room.depth]
    poses = []
    for k in range(count):
        angle = phase + turn * 2 * math.pi * k / count
        x = middle[0] + 0.22 * room.width * math.cos(angle)
        y = middle[1] + 0.22 * room.depth * math.sin(angle)
        yaw = angle + turn * 2 * math.pi * 1.5 * k / count
        poses.append(pose(x, y, 1.45 + 0.05 * math.sin(k / 5), yaw, 0.3 + 0.1 * math.sin(k / 7)))
    return poses


def look_around(room: Room, seconds: float, seed: int) -> list[np.ndarray]:
    """Poses of somebody who stands somewhere and turns by 60 degrees a second."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.28, 0.28, 2) * [room.width, room.depth]
    yaw, turn = rng.uniform(0, 2 * math.pi), rng.choice([-1.0, 1.0])
    drift = rng.normal(0, 0.15, 2)
    poses = []
    for k in range(int(seconds * RATE_HZ)):
        s = k / RATE_HZ
        angle = yaw + turn * math.radians(60.0) * s
        tilt = 0.3 + 0.12 * math.sin(s * 1.3)
        poses.append(pose(x + drift[0] * s / 3, y + drift[1] * s / 3, 1.5, angle, tilt))
    return poses


def pose(x: float, y: float, z: float, yaw: float, down: float) -> np.ndarray:
    """T_world_camera (4, 4) of a camera that looks along a heading, and down by an angle."""
    ahead = np.array(
        [math.cos(yaw) * math.cos(down), math.sin(yaw) * math.cos(down), -math.sin(down)]
    )
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = x, y, z
    return T


def start_frame(poses: Sequence[np.ndarray], seed: int) -> np.ndarray:
    """T_odom_room (4, 4) of an odometry that begins at the first pose, with any heading."""
    yaw = float(np.random.default_rng(seed).uniform(-math.pi, math.pi))
    start = poses[0][:3, 3] * [1, 1, 0]
    return rigid_motion(np.zeros(3), np.array([0, 0, yaw])) @ rigid_motion(-start, np.zeros(3))


def local_graphs(
    room: Room,
    poses: Sequence[np.ndarray],
    T_odom_room: np.ndarray,
    seed: int,
    frame_id: str = "odom",
    start_ns: int = 10**9,
) -> Iterator[LocalGraph]:
    """What lifting would make of each frame: detections, points, and the depth grid."""
    rng = np.random.default_rng(seed)
    boxes = np.array(
        [[*t.centre, *t.size, math.cos(t.heading), math.sin(t.heading)] for t in room.things]
    )
    half = np.array([room.width / 2, room.depth / 2, 0.0])
    shell = np.stack([-half, half + [0, 0, HEIGHT_M]])
    first = STRIDE_PX // 2
    v, u = np.mgrid[first : CAMERA.height : STRIDE_PX // 2, first : CAMERA.width : STRIDE_PX // 2]
    rays_camera = CAMERA.back_project(u.ravel(), v.ravel(), np.ones(u.size))
    spells: dict[tuple[int, int], int] = {}
    for index, T_room_camera in enumerate(poses):
        rays = rays_camera @ T_room_camera[:3, :3].T
        depth, hits = cast(T_room_camera[:3, 3], rays, boxes.reshape(-1, 8), shell)
        sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
        depth = np.where(depth > 4.5, 0.0, depth + rng.normal(0, 1, len(depth)) * sigma)
        found = _detect(room, hits, depth, T_room_camera, rng, spells)
        T = T_odom_room @ T_room_camera
        points = (depth[:, None] * rays_camera) @ T[:3, :3].T + T[:3, 3]
        stamp_ns = start_ns + int(index * 1e9 / RATE_HZ)
        yield local_graph(found, hits, depth, points, u, v, T, frame_id, stamp_ns)


def _detect(room, hits, depth, T_room_camera, rng, spells):
    """Rows of things that the detector names, each with its pixels, distribution and score."""
    found = []
    for row in np.unique(hits[hits >= 0]).tolist():
        at = np.flatnonzero((hits == row) & (depth > 0))
        if len(at) < 10 or rng.random() < 0.12:
            continue
        away = np.subtract(T_room_camera[:3, 3], room.things[row].centre)
        side = int(math.atan2(away[1], away[0]) // math.radians(30))
        # A wrong name lasts as long as the thing is seen from there.
        label = room.things[row].label
        if (row, side) not in spells:
            spells[row, side] = rng.random() < 0.12
        name = ALIKE[label] if spells[row, side] else label
        top = rng.uniform(0.55, 0.95)
        distribution = np.full(len(CLASSES), (1 - top) * 0.4 / len(CLASSES))
        distribution[CLASSES.index(name)] += top
        distribution[CLASSES.index(ALIKE[name])] += (1 - top) * 0.6
        found.append((row, at, distribution / distribution.sum(), top))
    return found


def local_graph(found, hits, depth, points, u, v, T, frame_id, stamp_ns, vocabulary=VOCABULARY):
    """What lifting would make of detections: row, pixels, distribution and score of each."""
    means = np.array([points[at].mean(axis=0) for _, at, _, _ in found]).reshape(-1, 3)
    covariances = [np.cov(points[at].T) + 1e-6 * np.eye(3) for _, at, _, _ in found]
    columns, rows = u.ravel(), v.ravel()
    boxes = [
        [columns[at].min(), rows[at].min(), columns[at].max() + 1, rows[at].max() + 1]
        for _, at, _, _ in found
    ]
    instances = np.zeros(len(hits), np.uint16)
    for number, (_, at, _, _) in enumerate(found, start=1):
        instances[at] = number
    grid = (slice(None, None, 2), slice(None, None, 2))
    depth_mm = np.round(1000 * depth).astype(np.uint16).reshape(u.shape)
    return LocalGraph(
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        width=CAMERA.width,
        height=CAMERA.height,
        T_world_camera=T,
        vocabulary=vocabulary,
        instance_ids=np.arange(1, len(found) + 1),
        boxes_xyxy=np.array(boxes, np.float64).reshape(-1, 4),
        class_probabilities=np.array([item[2] for item in found]).reshape(
            -1, len(vocabulary.classes)
        ),
        scores=np.array([item[3] for item in found], np.float64),
        means_world=means,
        covariances_world=np.array(covariances).reshape(-1, 3, 3),
        depths_m=np.array([depth[at].mean() for _, at, _, _ in found]),
        pixel_counts=np.array([16 * len(at) for _, at, _, _ in found], np.int64),
        surface_points_world=tuple(points[at].astype(np.float32) for _, at, _, _ in found),
        relations=Relations.none(len(vocabulary.predicates)),
        depth_grid=DepthGrid(
            np.ascontiguousarray(depth_mm[grid]), STRIDE_PX, CAMERA,
            np.ascontiguousarray(instances.reshape(u.shape)[grid]),
        ),
    )  # fmt: skip


def _turn(heading: float) -> tuple[float, float]:
    return math.cos(heading), math.sin(heading)


def true_transform(T_map_room: np.ndarray, T_odom_room: np.ndarray) -> np.ndarray:
    """T_map_odom (4, 4), which is to be found."""
    return T_map_room @ invert_pose(T_odom_room)
