"""Homes: a corridor, furnished rooms on both sides of it, things on tables, and what is true there.

The furniture is that of ../physics_rooms. Metres; the floor is z = 0, the corridor goes along x.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "physics_rooms"))

from physics_room import furniture, things
from physics_room.labels import coco
from physics_room.layout import WALLS
from physics_room.plane import Rect, part_rects, rect_of, rects_clash, yaw_of
from physics_room.shapes import Item, turn

WALL_M, CEILING_M, LINTEL_M = 0.1, 2.5, 2.05
DOOR_M, DOOR_FREE_M = (0.85, 1.0), 0.9
# Of the floor grids that are true, and the robot that has to fit.
CELL_M, RADIUS_M, ROBOT_M = 0.05, 0.24, 1.3

Box = tuple[float, float, float, float]  # x and y of two corners

PIECES = {
    "kitchen": ("refrigerator", "oven", "counter", "table set", "cabinet"),
    "living room": ("couch", "tv stand", "low table", "shelf"),
    "bedroom": ("bed", "nightstand", "wardrobe"),
    "office": ("desk set", "shelf", "cabinet"),
    "dining room": ("table set", "cabinet", "low table"),
}
# Things that stand more than once in a home, so that a name alone is not enough; and once.
MANY = {"cup": things.cup, "bowl": things.bowl, "bottle": things.bottle, "book": things.book}
ONCE = {
    "laptop": things.laptop, "vase": things.vase, "clock": things.desk_clock,
    "microwave": things.microwave, "teddy bear": things.toy,
}  # fmt: skip
BEARING = ("table", "desk", "countertop", "cabinet", "nightstand", "bed", "sofa", "tv-stand")


@dataclass
class Home:
    """A home.

    Attributes:
        kinds, rects: of each room; the first one is the corridor.
        walls: (n, 2, 3) corners of boxes.
        items: furniture and things; `number` is the row plus one.
        on: number of what bears a thing, by its number.
        room_of: row of the room, by number.
        doors: openings in the walls of the corridor.
        gone: numbers of what was taken away.
    """

    kinds: list[str] = field(default_factory=list)
    rects: list[Box] = field(default_factory=list)
    walls: list[np.ndarray] = field(default_factory=list)
    items: list[Item] = field(default_factory=list)
    on: dict[int, int] = field(default_factory=dict)
    room_of: dict[int, int] = field(default_factory=dict)
    doors: list[Box] = field(default_factory=list)
    gone: set[int] = field(default_factory=set)

    def name(self, number: int) -> str:
        """Common name of an object."""
        return coco(self.items[number - 1].label) or self.items[number - 1].label

    def bounds(self, number: int) -> np.ndarray:
        """Corners (2, 3) of the box around an object, along the axes of the home."""
        points = self.items[number - 1].vertices()
        return np.stack([points.min(0), points.max(0)])

    @property
    def present(self) -> list[int]:
        """The numbers of all objects that are there now."""
        return [item.number for item in self.items if item.number not in self.gone]

    def called(self, name: str) -> list[int]:
        """The objects of a name."""
        return [number for number in self.present if self.name(number) == name]

    def alike(self, numbers: tuple[int, ...]) -> list[int]:
        """All objects with the names of some."""
        names = {self.name(number) for number in numbers}
        return [number for number in self.present if self.name(number) in names]

    def extent(self) -> Box:
        """Corners of the home, walls included."""
        boxes = np.array(self.walls)
        low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def blocked(self) -> tuple[np.ndarray, np.ndarray]:
        """The cells (rows, columns) that walls and furniture cover, and their corner (2,)."""
        x0, y0, x1, y1 = self.extent()
        corner = np.array([x0, y0])
        cells = np.zeros((int((y1 - y0) / CELL_M) + 1, int((x1 - x0) / CELL_M) + 1), np.uint8)
        outlines = [Rect((b[0] + b[1])[:2] / 2, (b[1] - b[0])[:2] / 2, 0.0).corners()
                    for b in self.walls if b[0, 2] < ROBOT_M]  # fmt: skip
        for number in self.present:
            item = self.items[number - 1]
            if item.kind != "flat":
                solid = [r for r in part_rects(item) if r.high > 0.02 and r.low < ROBOT_M]
                outlines += [rect.corners() for rect in solid]
        for outline in outlines:
            cv2.fillConvexPoly(cells, np.round((outline - corner) / CELL_M).astype(np.int32), 1)
        return cells > 0, corner

    def room_free(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance (rows, columns) of each place of the floor from what is in the way, metres."""
        cells, corner = self.blocked()
        return CELL_M * cv2.distanceTransform((~cells).astype(np.uint8), cv2.DIST_L2, 5), corner


def build(seed: int) -> Home:
    """A home of four to six rooms, the corridor included; every room can be reached."""
    for attempt in range(100):
        rng = np.random.default_rng([seed, attempt])
        home = _rooms(rng)
        for row in range(1, len(home.kinds)):
            for piece in PIECES[home.kinds[row]]:
                _put(home, row, piece, rng)
        # One window, so that "the window" is one.
        _put(home, int(rng.integers(1, len(home.kinds))), "window", rng)
        _put_things(home, rng)
        if _is_usable(home):
            return home
    raise RuntimeError(f"no home of seed {seed} can be used")


def _rooms(rng: np.random.Generator) -> Home:
    count = int(rng.integers(3, 6))
    upper = (count + 1) // 2
    width = float(rng.uniform(1.3, 1.7))
    wide = [rng.uniform(3.4, 4.6, n) for n in (upper, count - upper)]
    length = float(max(row.sum() + WALL_M * (len(row) - 1) for row in wide))
    home = Home(["corridor"], [(0.0, 0.0, length, width)])
    others = [str(kind) for kind in rng.permutation(["bedroom", "office", "dining room"])]
    kinds = [str(k) for k in rng.permutation(["kitchen", "living room", *others[: count - 2]])]
    w = WALL_M
    gaps: list[list[tuple[float, float]]] = [[], []]
    deep = [float(rng.uniform(3.4, 4.4)) for _ in wide]
    for side, row in enumerate(wide):
        spare = (length - row.sum() - w * (len(row) - 1)) / len(row)
        x = 0.0
        for wish in row:
            x1 = x + float(wish + spare)
            y = (width + w, width + w + deep[0]) if side == 0 else (-w - deep[1], -w)
            home.kinds.append(kinds.pop())
            home.rects.append((x, y[0], x1, y[1]))
            door = float(rng.uniform(*DOOR_M))
            at = float(rng.uniform(x + 0.3, x1 - 0.3 - door))
            gaps[side].append((at, at + door))
            y_wall = width if side == 0 else -w
            home.doors.append((at, y_wall, at + door, y_wall + w))
            if x1 < length - 1e-6:
                _wall(home, (x1, y[0] - w, x1 + w, y[1] + w))
            x = x1 + w
        y_wall = width if side == 0 else -w
        ends = [-w, *(end for gap in gaps[side] for end in gap), length + w]
        for start, stop in zip(ends[::2], ends[1::2]):
            _wall(home, (start, y_wall, stop, y_wall + w))
        for start, stop in gaps[side]:
            _wall(home, (start, y_wall, stop, y_wall + w), LINTEL_M)
    low, high = -w - deep[1], width + w + deep[0]
    _wall(home, (-w, low - w, length + w, low))
    _wall(home, (-w, high, length + w, high + w))
    _wall(home, (-w, low, 0.0, high))
    _wall(home, (length, low, length + w, high))
    return home


def _wall(home: Home, box: Box, low: float = 0.0) -> None:
    home.walls.append(np.array([[box[0], box[1], low], [box[2], box[3], CEILING_M]]))


def _add(home: Home, room: int, item: Item, on: int | None = None) -> int:
    item.number = len(home.items) + 1
    home.items.append(item)
    home.room_of[item.number] = room
    if on is not None:
        home.on[item.number] = on
    return item.number


def _fits(home: Home, room: int, item: Item, margin: float) -> bool:
    rect = rect_of(item)
    x0, y0, x1, y1 = home.rects[room]
    corners = rect.corners()
    if (corners < [x0, y0]).any() or (corners > [x1, y1]).any():
        return False
    for door in home.doors:
        half = np.array([(door[2] - door[0]) / 2, DOOR_FREE_M])
        middle = np.array([(door[0] + door[2]) / 2, (door[1] + door[3]) / 2])
        if rects_clash(rect, Rect(middle, half, 0.0)):
            return False
    return not any(rects_clash(rect, rect_of(other), margin) for other in home.items)


def _at_wall(
    home: Home, room: int, item: Item, rng: np.random.Generator, margin: float = 0.05
) -> bool:
    """Put a piece with its back at a wall of a room."""
    x0, y0, x1, y1 = home.rects[room]
    low, high = item.bounds()
    for _ in range(60):
        yaw, normal = WALLS[int(rng.integers(4))]
        along = np.array([-normal[1], normal[0]])
        half = np.array([(x1 - x0) / 2, (y1 - y0) / 2])
        reach, span = abs(half @ normal), abs(half @ along) - (high - low)[0] / 2 - 0.02
        if span <= 0:
            continue
        place = np.array(normal) * (reach - high[1] - 0.02) + along * rng.uniform(-span, span)
        item.position = np.array([*(place + [(x0 + x1) / 2, (y0 + y1) / 2]), item.position[2]])
        item.rotation = turn(yaw)
        if _fits(home, room, item, margin):
            return True
    return False


def _in_the_middle(home: Home, room: int, item: Item, rng: np.random.Generator) -> bool:
    x0, y0, x1, y1 = home.rects[room]
    for _ in range(60):
        item.position = np.array([*rng.uniform([x0 + 1.1, y0 + 1.1], [x1 - 1.1, y1 - 1.1]), 0.0])
        item.rotation = turn(rng.integers(2) * np.pi / 2)
        if _fits(home, room, item, 0.65):
            return True
    return False


def _put(home: Home, room: int, piece: str, rng: np.random.Generator) -> None:
    """Put a piece of furniture into a room, if there is a place for it."""
    if piece == "table set":
        table = furniture.table(rng)
        if _in_the_middle(home, room, table, rng):
            _add(home, room, table)
            _chairs(home, room, table, rng, int(rng.integers(2, 4)))
        return
    if piece == "desk set":
        desk = furniture.desk(rng)
        if _at_wall(home, room, desk, rng):
            _add(home, room, desk)
            _chairs(home, room, desk, rng, 1, sides=((0, -1),))
        return
    if piece == "counter":
        wide = float(rng.uniform(1.0, 1.6))
        base = furniture.base_cabinet(rng, wide)
        if _at_wall(home, room, base, rng):
            base.tops = []
            top = furniture.counter(rng, wide, False)[0]
            top.rotation = base.rotation
            top.position = base.position + base.rotation @ [0, -0.02, base.height + 0.001]
            bearer = _add(home, room, base)
            _add(home, room, top, bearer)
        return
    if piece == "window":
        pane = furniture.window(rng)[0]
        pane.position[2] = 0.95
        if _at_wall(home, room, pane, rng, 0.0):
            _add(home, room, pane)
        return
    item = getattr(furniture, piece.replace(" ", "_"))(rng)
    if piece == "low table":
        placed = _in_the_middle(home, room, item, rng) or _at_wall(home, room, item, rng)
    else:
        placed = _at_wall(home, room, item, rng)
    if placed:
        number = _add(home, room, item)
        if piece == "tv stand":
            screen = things.television(rng)[0]
            if screen.bounds()[1][0] < item.bounds()[1][0] + 0.1:
                _stand(screen, item, np.zeros(2), 0.0)
                _add(home, room, screen, number)


def _chairs(
    home: Home, room: int, table: Item, rng: np.random.Generator, count: int,
    sides: tuple[tuple[int, int], ...] = ((0, 1), (0, -1), (1, 0), (-1, 0)),
) -> None:  # fmt: skip
    low, high = table.bounds()
    for index in rng.permutation(len(sides))[:count]:
        out = np.array(sides[index], float)
        seat = furniture.chair(rng)
        gap = np.abs(out) @ ((high - low)[:2] / 2) + rng.uniform(0.15, 0.3)
        seat.position = table.position + table.rotation @ [*(out * gap), 0.0]
        seat.position[2] = 0.0
        # The front of a seat (−y) looks at the table.
        seat.rotation = table.rotation @ turn(float(np.arctan2(-out[0], out[1])))
        others = [o for o in home.items if o is not table]
        x0, y0, x1, y1 = home.rects[room]
        corners = rect_of(seat).corners()
        inside = (corners > [x0, y0]).all() and (corners < [x1, y1]).all()
        if inside and not any(rects_clash(rect_of(seat), rect_of(o), 0.05) for o in others):
            _add(home, room, seat)


def _stand(item: Item, bearer: Item, at: np.ndarray, yaw: float) -> None:
    top = bearer.tops[0]
    local = np.array([at[0] + top.centre[0], at[1] + top.centre[1], top.height + 0.001])
    item.position = bearer.position + bearer.rotation @ local
    item.rotation = turn(yaw_of(bearer.rotation) + yaw)


def place_on(home: Home, item: Item, bearer: int, rng: np.random.Generator) -> bool:
    """Stand a thing on a piece of furniture, away from what is there; false if there is no room."""
    base = home.items[bearer - 1]
    low, high = item.bounds()
    reach = float(np.abs(np.stack([low, high])[:, :2]).max())
    top = base.tops[0]
    free = np.array(top.half) * (0.7 if top.round else 1.0) - reach - 0.03
    if (free < 0).any():
        return False
    for _ in range(30):
        _stand(item, base, rng.uniform(-free, free), float(rng.normal(0, 0.25)))
        rect = rect_of(item)
        others = [home.items[n - 1] for n in home.on if home.on[n] == bearer and n not in home.gone]
        if not any(rects_clash(rect, rect_of(o), 0.08) for o in others if o is not item):
            return True
    return False


def bearers(home: Home) -> list[int]:
    """The pieces that things stand on."""
    return [i.number for i in home.items if i.label in BEARING and i.tops and i.height < 1.15]


def _put_things(home: Home, rng: np.random.Generator) -> None:
    names = [n for n in MANY for _ in range(int(rng.integers(2, 4)))]
    names += [n for n in ONCE if rng.random() < 0.9]
    for name in rng.permutation(names):
        item = {**MANY, **ONCE}[str(name)](rng)[0]
        if coco(item.label) != name:
            continue
        for bearer in rng.permutation(bearers(home)):
            if place_on(home, item, int(bearer), rng):
                _add(home, home.room_of[int(bearer)], item, int(bearer))
                break


def _is_usable(home: Home) -> bool:
    """Whether a robot reaches all rooms, and there is something to ask for."""
    distance, corner = home.room_free()
    _, parts = cv2.connectedComponents((distance > RADIUS_M + 0.08).astype(np.uint8))
    found = set()
    for x0, y0, x1, y1 in home.rects:
        part = parts[
            int((y0 - corner[1]) / CELL_M) : int((y1 - corner[1]) / CELL_M),
            int((x0 - corner[0]) / CELL_M) : int((x1 - corner[0]) / CELL_M),
        ]
        if not (part > 0).any():
            return False
        found.add(int(np.bincount(part[part > 0]).argmax()))
    return len(found) == 1 and len(home.called("chair")) >= 2 and len(home.on) >= 8
