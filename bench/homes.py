"""Simulated homes: rooms, walls, doors and furniture as boxes, and what a depth camera sees there.

They are synthetic: straight walls, boxes for furniture, a pinhole camera with noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from msgspec.structs import replace
from support.spaces import looking

from deworldsg_ros.graph.provenance import GREY, MAX_VIEWS, SeenSpace
from deworldsg_ros.graph.rooms import RoomMap
from deworldsg_ros.scene.arrays import Bool, Float64, UInt16
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import empty_scene_graph

WALL_M, CEILING_M, DOOR_M = 0.12, 2.5, 2.03
CELL_M = 0.04
# The depth grid of a graph: every 8th pixel of 640 x 480.
HEIGHT, WIDTH, FOCAL_PX, FAR_M = 60, 80, 65.0, 6.0
CAMERA = np.array([FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2])
DEPTH_NOISE, LOST, POSE_NOISE_M = 0.008, 0.02, 0.01

# Label, length along the wall, depth, height, and height of its bottom. What is first stands in
# every room of the kind, the others in most.
_WALL_SIDE = {
    "kitchen": [
        ("refrigerator", 0.6, 0.65, 1.8, 0.0),
        ("oven", 0.6, 0.6, 0.9, 0.0),
        ("sink", 0.6, 0.5, 0.15, 0.8),
        ("microwave", 0.5, 0.4, 0.3, 0.95),
        ("counter", 1.4, 0.6, 0.9, 0.0),
    ],
    "bathroom": [
        ("toilet", 0.4, 0.6, 0.75, 0.0),
        ("sink", 0.5, 0.4, 0.15, 0.75),
        ("bathtub", 1.5, 0.7, 0.55, 0.0),
        ("towel", 0.4, 0.05, 0.6, 1.0),
    ],
    "bedroom": [
        ("bed", 1.6, 1.95, 0.55, 0.0),
        ("wardrobe", 1.5, 0.6, 2.0, 0.0),
        ("nightstand", 0.4, 0.4, 0.5, 0.0),
        ("lamp", 0.2, 0.2, 0.4, 0.55),
    ],
    "living room": [
        ("couch", 2.0, 0.9, 0.8, 0.0),
        ("tv", 1.1, 0.1, 0.65, 0.6),
        ("bookshelf", 0.9, 0.35, 1.9, 0.0),
        ("potted plant", 0.4, 0.4, 0.9, 0.0),
        ("chair", 0.6, 0.6, 0.9, 0.0),
    ],
    "office": [
        ("desk", 1.4, 0.7, 0.75, 0.0),
        ("laptop", 0.35, 0.25, 0.2, 0.76),
        ("bookshelf", 0.9, 0.35, 1.9, 0.0),
        ("chair", 0.6, 0.6, 1.0, 0.0),
        ("keyboard", 0.4, 0.15, 0.03, 0.76),
    ],
    "hallway": [("shoe", 0.3, 0.25, 0.12, 0.0)],
}
_MIDDLE = {"kitchen": ("dining table", 1.1, 0.75), "living room": ("coffee table", 0.9, 0.45)}

Rect = tuple[float, float, float, float]  # x and y of two corners


@dataclass
class Thing:
    """An object: its label, its box (two corners) and the row of its room."""

    label: str
    box: Float64
    room: int


@dataclass
class Home:
    """A home of one storey.

    Attributes:
        kinds: of the n rooms.
        rects: of each room, one or two rectangles.
        doors: rectangles in the walls, and the two rooms of each.
        things: furniture.
        boxes: (m, 2, 3) corners of walls, floor, ceiling and furniture.
        floor_m: height of the floor.
    """

    kinds: list[str] = field(default_factory=list)
    rects: list[list[Rect]] = field(default_factory=list)
    doors: list[tuple[Rect, int, int]] = field(default_factory=list)
    things: list[Thing] = field(default_factory=list)
    boxes: Float64 = field(default_factory=lambda: np.zeros((0, 2, 3)))
    floor_m: float = 0.0

    def mask(self, room: int, x: Float64, y: Float64) -> Bool:
        """Whether points are in a room, furniture included."""
        inside = np.zeros(np.broadcast(x, y).shape, np.bool_)
        for x0, y0, x1, y1 in self.rects[room]:
            inside |= (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
        return inside


def home(seed: int, floor_m: float = 0.0) -> Home:
    """A home of 6 to 13 rooms: a corridor, rooms on both of its sides, some with a bathroom."""
    rng = np.random.default_rng(seed)
    made = Home(floor_m=floor_m)
    length, width = rng.uniform(9.0, 13.0), rng.uniform(1.1, 1.7)
    made.kinds.append("hallway")
    made.rects.append([(0.0, 0.0, length, width)])
    wanted = ["kitchen", "living room", "bathroom", "bedroom", "bedroom", "office", "bedroom"]
    rng.shuffle(wanted)
    for low, side in ((width + WALL_M, 1.0), (-WALL_M, -1.0)):
        deep = rng.uniform(3.0, 4.6)
        x = 0.0
        last = None
        while length - x > 1.8:
            kind = wanted.pop() if wanted else str(rng.choice(["bedroom", "office", "bathroom"]))
            wide = rng.uniform(1.8, 2.6) if kind == "bathroom" else rng.uniform(2.6, 4.6)
            if length - x - wide < 2.6:
                wide = length - x
            rect = _rect(x, low, x + wide, low + side * deep)
            row = _add(made, kind, rect)
            _door(made, rng, 0, row, (x, x + wide), width + WALL_M / 2 if side > 0 else -WALL_M / 2)
            if kind == "bedroom" and wide > 3.2 and deep > 3.4 and rng.random() < 0.5:
                _bathroom(made, rng, row, side)
            elif last is not None and rng.random() < 0.35:
                _between(made, rng, last, row, x - WALL_M / 2)
            last = row
            x += wide + WALL_M
    _furnish(made, rng)
    made.boxes = _walls(made)
    return made


def _rect(x0: float, y0: float, x1: float, y1: float) -> Rect:
    return min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)


def _add(made: Home, kind: str, *rects: Rect) -> int:
    made.kinds.append(kind)
    made.rects.append(list(rects))
    return len(made.kinds) - 1


def _door(
    made: Home, rng: np.random.Generator, a: int, b: int, span: tuple[float, float], y: float
) -> None:
    """A door in a wall along x."""
    wide = float(rng.uniform(0.75, 1.0))
    at = float(rng.uniform(span[0] + 0.15, span[1] - 0.15 - wide))
    made.doors.append(((at, y - WALL_M, at + wide, y + WALL_M), a, b))


def _between(made: Home, rng: np.random.Generator, a: int, b: int, x: float) -> None:
    """A door or an opening in a wall along y between two rooms of one side."""
    low = max(made.rects[room][0][1] for room in (a, b)) + 0.3
    high = min(made.rects[room][0][3] for room in (a, b)) - 0.3
    if any(len(made.rects[room]) > 1 for room in (a, b)) or high - low < 1.6:
        return
    wide = float(rng.choice([0.85, 0.95, 1.3]))
    at = float(rng.uniform(low, high - wide))
    made.doors.append(((x - WALL_M, at, x + WALL_M, at + wide), a, b))


def _bathroom(made: Home, rng: np.random.Generator, row: int, side: float) -> None:
    """Cut a bathroom out of a far corner of a room, which is L-shaped then."""
    x0, y0, x1, y1 = made.rects[row][0]
    wide, deep = rng.uniform(1.7, 2.0), rng.uniform(1.7, 2.0)
    far, near = (y1 - deep, y1 - deep - WALL_M) if side > 0 else (y0 + deep, y0 + deep + WALL_M)
    bath = _rect(x0, far, x0 + wide, y1 if side > 0 else y0)
    made.rects[row] = [
        _rect(x0, near, x1, y0 if side > 0 else y1),
        _rect(x0 + wide + WALL_M, near, x1, y1 if side > 0 else y0),
    ]
    new = _add(made, "bathroom", bath)
    _door(made, rng, row, new, (x0 + 0.1, x0 + wide - 0.1), (far + near) / 2)


def _furnish(made: Home, rng: np.random.Generator) -> None:
    """Put things along the walls and into the middle, away from doors."""
    for row, kind in enumerate(made.kinds):
        kept = [_grown(door, 0.75) for door, a, b in made.doors if row in (a, b)]
        rect = made.rects[row][0]
        for number, (label, long, deep, high, bottom) in enumerate(_WALL_SIDE[kind]):
            if number and rng.random() > 0.75:
                continue
            for _ in range(30):
                place = _along_wall(rng, rect, long, deep)
                if place is None or any(_meet(place, other) for other in kept):
                    continue
                kept.append(place)
                _thing(made, label, row, place, bottom, bottom + high)
                break
        x0, y0, x1, y1 = rect
        if kind in _MIDDLE and min(x1 - x0, y1 - y0) > 3.0:
            label, wide, high = _MIDDLE[kind]
            x, y = (x0 + x1 - wide) / 2, (y0 + y1 - wide) / 2
            place = (x, y, x + wide, y + wide)
            if not any(_meet(place, other) for other in kept):
                _thing(made, label, row, place, high - 0.05, high)


def _thing(made: Home, label: str, row: int, place: Rect, low: float, high: float) -> None:
    x0, y0, x1, y1 = place
    box = np.array([[x0, y0, low], [x1, y1, high]]) + [0.0, 0.0, made.floor_m]
    made.things.append(Thing(label, box, row))


def _along_wall(rng: np.random.Generator, rect: Rect, long: float, deep: float) -> Rect | None:
    x0, y0, x1, y1 = rect
    if rng.random() < 0.5:
        if x1 - x0 < long or y1 - y0 < deep + 0.9:
            return None
        x, y = rng.uniform(x0, x1 - long), (y0 if rng.random() < 0.5 else y1 - deep)
        return x, y, x + long, y + deep
    if y1 - y0 < long or x1 - x0 < deep + 0.9:
        return None
    x, y = (x0 if rng.random() < 0.5 else x1 - deep), rng.uniform(y0, y1 - long)
    return x, y, x + deep, y + long


def _grown(rect: Rect, by: float) -> Rect:
    return rect[0] - by, rect[1] - by, rect[2] + by, rect[3] + by


def _meet(a: Rect, b: Rect) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _walls(made: Home) -> Float64:
    """The boxes that rays hit: walls, lintels above doors, floor, ceiling, and things."""
    rects = np.array([rect for room in made.rects for rect in room])
    low, high = rects[:, :2].min(axis=0) - 0.24, rects[:, 2:].max(axis=0) + 0.24
    columns, rows = np.ceil((high - low) / CELL_M).astype(int)
    x = low[0] + CELL_M * (np.arange(columns) + 0.5)
    y = low[1] + CELL_M * (np.arange(rows)[:, None] + 0.5)
    solid = np.ones((rows, columns), np.bool_)
    for room in range(len(made.kinds)):
        solid &= ~made.mask(room, x, y)
    for (x0, y0, x1, y1), _, _ in made.doors:
        solid &= ~((x >= x0) & (x < x1) & (y >= y0) & (y < y1))
    floor, top = made.floor_m, made.floor_m + CEILING_M
    found = [
        [[*(low + CELL_M * np.array([c0, r0])), floor], [*(low + CELL_M * np.array([c1, r1])), top]]
        for c0, r0, c1, r1 in _rectangles(solid)
    ]
    found += [[[x0, y0, floor + DOOR_M], [x1, y1, top]] for (x0, y0, x1, y1), _, _ in made.doors]
    found += [[[*low, level], [*high, level + 0.1]] for level in (floor - 0.1, top)]
    return np.concatenate([np.array(found), np.array([thing.box for thing in made.things])])


def _rectangles(solid: Bool) -> Iterator[tuple[int, int, int, int]]:
    """Rectangles (first column, first row, and the ends) that cover all true cells."""
    left = solid.copy()
    while left.any():
        row, first = np.unravel_index(int(left.argmax()), left.shape)
        run = left[row, first:]
        last = first + (len(run) if run.all() else int((~run).argmax()))
        end = row + 1
        while end < len(left) and left[end, first:last].all():
            end += 1
        left[row:end, first:last] = False
        yield int(first), int(row), int(last), int(end)


def poses(made: Home, seed: int, spots: int = 2, turns: int = 10) -> list[Float64]:
    """Where a hand-held camera is (T_world_camera): in each room it turns round at some spots."""
    rng = np.random.default_rng(seed)
    found = []
    for row in range(len(made.kinds)):
        for x, y in _spots(made, row, rng, 3 if row == 0 else spots):
            for turn in range(turns):
                degrees = 360.0 * (turn + rng.uniform(-0.3, 0.3)) / turns
                height = made.floor_m + 1.4 + rng.uniform(-0.1, 0.1)
                found.append(looking((x, y, height), degrees, 15.0 + rng.uniform(-8, 8)))
    return found


def _spots(
    made: Home, row: int, rng: np.random.Generator, count: int
) -> Iterator[tuple[float, float]]:
    """Places in a room, the first ones near the middles of its parts, not in things."""
    rects = made.rects[row]
    boxes = [t.box for t in made.things if t.room == row]
    for number in range(count):
        x0, y0, x1, y1 = rects[number % len(rects)]
        if row == 0:
            x, y = x0 + (x1 - x0) * (number + 0.5) / count, (y0 + y1) / 2
        for _ in range(50):
            if row:
                x, y = rng.uniform(x0 + 0.4, x1 - 0.4), rng.uniform(y0 + 0.4, y1 - 0.4)
            if all(
                not (b[0, 0] - 0.2 < x < b[1, 0] + 0.2 and b[0, 1] - 0.2 < y < b[1, 1] + 0.2)
                for b in boxes
            ):
                break
        yield float(x), float(y)


def depth_image(boxes: Float64, T_world_camera: Float64, rng: np.random.Generator) -> UInt16:
    """What the camera measures: (h, w) uint16 millimetres, 0 = nothing."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    fx, fy, cx, cy = CAMERA
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=2)
    rays = (rays.reshape(-1, 3) @ T_world_camera[:3, :3].T).astype(np.float32)
    start = T_world_camera[:3, 3]
    gaps = np.maximum(boxes[:, 0] - start, start - boxes[:, 1])
    near = boxes[np.linalg.norm(np.maximum(gaps, 0.0), axis=1) < 1.3 * FAR_M]
    depth = np.full(len(rays), 2 * FAR_M, np.float32)
    inverse = 1.0 / np.where(np.abs(rays) < 1e-6, 1e-6, rays)
    for box in near:
        sides = np.sort(((box - start).astype(np.float32)[:, None] * inverse), axis=0)
        enters, leaves = sides[0].max(axis=1), sides[1].min(axis=1)
        hit = (enters < leaves) & (enters > 0.05)
        depth[hit] = np.minimum(depth[hit], enters[hit])
    depth *= 1.0 + DEPTH_NOISE * rng.standard_normal(len(depth)).astype(np.float32)
    depth[(depth > FAR_M) | (rng.random(len(depth)) < LOST)] = 0.0
    return np.round(1000 * depth).astype(np.uint16).reshape(HEIGHT, WIDTH)


def see(space: SeenSpace, boxes: Float64, poses: list[Float64], seed: int) -> None:
    """Add views to a space, which keeps the newest, as a graph does. Poses get their noise."""
    rng = np.random.default_rng(seed)
    kept = slice(-MAX_VIEWS, None)
    depths = np.stack([depth_image(boxes, T, rng) for T in poses])
    noisy = np.array(poses)
    noisy[:, :3, 3] += POSE_NOISE_M * rng.standard_normal((len(poses), 3))
    first = int(space.stamps_ns[-1]) if len(space) else 0
    stamps = first + 10**8 * np.arange(1, len(poses) + 1)
    before = space.depths_mm.reshape(-1, HEIGHT, WIDTH)
    space.depths_mm = np.concatenate([before, depths])[kept]
    space.poses = np.concatenate([space.poses, noisy])[kept]
    space.cameras = np.concatenate([space.cameras, np.tile(CAMERA, (len(poses), 1))])[kept]
    space.stamps_ns = np.concatenate([space.stamps_ns, stamps])[kept]
    space.colours = np.full((len(space), HEIGHT, WIDTH, 3), GREY, np.uint8)


def nodes_of(made: Home, seed: int, first_id: int = 1) -> list[wire.NodeState]:
    """The furniture as objects of a graph: boxes and classes with errors."""
    rng = np.random.default_rng(seed)
    labels = sorted({row[0] for rows in _WALL_SIDE.values() for row in rows} | {"table", "cup"})
    stamp = wire.stamp_from_ns(10**9)
    found = []
    for number, thing in enumerate(made.things):
        sure = float(rng.uniform(0.55, 0.98))
        other = str(rng.choice([label for label in labels if label != thing.label]))
        classes = [wire.Belief(thing.label, sure), wire.Belief(other, (1.0 - sure) / 2)]
        # The detector is wrong sometimes, and not sure of it.
        if rng.random() < 0.1:
            classes = [wire.Belief(other, 0.5), wire.Belief(thing.label, 0.3)]
        low, high = thing.box + rng.normal(0.0, 0.03, (2, 3))
        size = np.maximum(high - low, 0.02)
        found.append(
            wire.NodeState(
                id=first_id + number,
                label=classes[0].label,
                classes=classes,
                mean_m=((low + high) / 2).tolist(),
                covariance_m2=np.diag(size**2 / 12).ravel().tolist(),
                observations=9,
                first_seen=stamp,
                last_seen=stamp,
                existence=0.95,
                box=wire.GravityBox(
                    ((low + high) / 2).tolist(), size.tolist(), [0.0, 0.0, 0.0, 1.0]
                ),
            )
        )
    return found


def graph_of(nodes: list[wire.NodeState], rooms: RoomMap) -> wire.SceneGraphMessage:
    """The message of a graph with these objects and rooms."""
    return replace(
        empty_scene_graph("map"),
        nodes=nodes,
        up=[0.0, 0.0, 1.0],
        rooms=rooms.states(nodes),
        storeys_m=rooms.floors_m,
    )
