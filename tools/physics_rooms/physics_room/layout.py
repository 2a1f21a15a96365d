"""Places furniture along the walls and in the room, and things on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from . import furniture, things
from .plane import Rect, part_rects, rect_of, rects_clash, yaw_of
from .shapes import Item, Top, turn
from .things import Group

# Wall: yaw of a piece whose back is at it, and the direction towards the wall.
WALLS = (
    (0.0, (0.0, 1.0)),
    (np.pi, (0.0, -1.0)),
    (-np.pi / 2, (1.0, 0.0)),
    (np.pi / 2, (-1.0, 0.0)),
)
THEMES = ("kitchen", "living", "bedroom", "office", "mixed")
DROP_M = 0.006
FLOOR_THINGS = ["floor_plant", "floor_basket", "floor_box", "floor_box", "floor_bag", "shoes"]
FLOOR_THINGS += ["umbrella_basket", "books", "toy", "board", "basket"]
WALL_THINGS = ["picture", "picture", "wall_clock", "window", "window", "wall_shelf"]
WALL_THINGS += ["wall_screen", "wall_cabinet"]


@dataclass
class Room:
    """A room under construction. Origin at its middle, floor at z = 0.

    Attributes:
        size: width along x, depth along y and height, m.
        items: everything in it; walls, floor and ceiling are not among them.
        tops: surfaces that can carry things, with their item.
    """

    size: tuple[float, float, float]
    theme: str
    clutter: float
    items: list[Item] = field(default_factory=list)

    def solid(self) -> list[Item]:
        """What does not move: furniture and what is on the walls."""
        return [item for item in self.items if item.anchor != "free"]


def build_room(rng: np.random.Generator) -> Room:
    """A furnished room. Things stand a few millimetres above their support."""
    size = (rng.uniform(3.3, 6.0), rng.uniform(3.2, 5.2), rng.uniform(2.4, 2.9))
    room = Room(size, str(rng.choice(THEMES)), float(rng.uniform(0.3, 1.1)))
    _put_on_wall(room, furniture.door(rng), rng, low=0.0)
    for maker in _large_pieces(room, rng):
        maker(room, rng)
    for _ in range(int(rng.integers(4, 9))):
        _wall_things(room, rng)
    for _ in range(int(rng.integers(3, 9))):
        _floor_group(room, rng)
    _fill_tops(room, rng)
    if rng.random() < 0.4:
        mat = furniture.rug(rng)
        mat.position = np.array([*rng.uniform(-0.2, 0.2, 2) * size[:2], 0.0])
        mat.rotation = turn(rng.normal(0, 0.3))
        room.items.append(mat)
    for number, item in enumerate(room.items, start=1):
        item.number = number
    return room


def _large_pieces(room: Room, rng: np.random.Generator) -> list[Callable]:
    along = {
        "kitchen": ["kitchen_run", "refrigerator", "oven", "table_set", "cabinet", "shelf"],
        "living": ["couch", "tv_stand", "low_table", "shelf", "cabinet", "armchair", "table_set"],
        "bedroom": ["bed", "nightstand", "wardrobe", "desk_set", "shelf", "nightstand"],
        "office": ["desk_set", "desk_set", "shelf", "cabinet", "couch", "table_set"],
        "mixed": ["kitchen_run", "refrigerator", "couch", "table_set", "tv_stand", "desk_set"],
    }[room.theme]
    extra = ["cabinet", "cabinet", "cabinet", "shelf", "nightstand", "nightstand", "bench"]
    extra += ["plant_stand", "floor_lamp", "stool", "armchair", "low_table", "wardrobe"]
    extra += ["refrigerator", "chair", "stool", "chair", "bed", "shelf"]
    count = int(rng.integers(2, 8))
    names = along + [str(n) for n in rng.choice(extra, count)]
    kept = [n for n in names if rng.random() < 0.88]
    return [PIECES[name] for name in kept]


def _free(room: Room, item: Item, margin: float = 0.02) -> bool:
    """Whether a floor piece is inside the room and hits nothing."""
    rect = rect_of(item)
    limit = np.array(room.size[:2]) / 2 - 0.005
    if (np.abs(rect.corners()) > limit).any():
        return False
    for other in room.items:
        if other.anchor == "free" or not rects_clash(rect, rect_of(other), 0.002):
            continue
        table = {"table", "desk"} & {item.label, other.label}
        if not table or _parts_clash(item, other, margin):
            return False
    return True


def _parts_clash(a: Item, b: Item, margin: float) -> bool:
    return any(rects_clash(p, q, margin) for p in part_rects(a) for q in part_rects(b))


def _fix(room: Room, item: Item) -> None:
    if item.anchor == "free":
        item.anchor = "world"
    room.items.append(item)


def _against_wall(room: Room, item: Item, rng: np.random.Generator, tries: int = 60) -> bool:
    """Put a piece with its back at a wall, often beside another piece."""
    low, high = item.bounds()
    back, half_w = high[1], (high - low)[0] / 2
    for _ in range(tries):
        wall = int(rng.integers(4))
        yaw, normal = WALLS[wall]
        reach = room.size[0 if normal[0] else 1] / 2
        span = room.size[1 if normal[0] else 0] / 2 - half_w - 0.02
        if span <= 0:
            continue
        t = rng.uniform(-span, span)
        neighbours = [
            o for o in room.items if o.anchor == "world" and o.kind == "furn" and _faces(o, yaw)
        ]
        if neighbours and rng.random() < 0.75:
            t = _beside(neighbours[int(rng.integers(len(neighbours)))], half_w, normal, rng)
        distance = reach - back - rng.uniform(0.006, 0.05)
        along = np.array([-normal[1], normal[0]])
        place = np.array(normal) * distance + along * t
        skew = rng.normal(0, 0.03) if rng.random() < 0.25 else 0.0
        item.position = np.array([*place, item.position[2]])
        item.rotation = turn(yaw + skew)
        if _free(room, item):
            _fix(room, item)
            return True
    return False


def _faces(item: Item, yaw: float) -> bool:
    return abs(np.angle(np.exp(1j * (yaw_of(item.rotation) - yaw)))) < 0.02


def _beside(other: Item, half_w: float, normal, rng: np.random.Generator) -> float:
    along = np.array([-normal[1], normal[0]])
    rect = rect_of(other)
    # Touching, or clearly apart: a gap of 4 to 8 cm would be unclear.
    space = rng.uniform(0.006, 0.03) if rng.random() < 0.75 else rng.uniform(0.09, 0.5)
    side = rng.choice([-1, 1])
    return float(rect.centre @ along + side * (rect.half[0] + half_w + space))


def _anywhere(room: Room, item: Item, rng: np.random.Generator, *, tries: int = 60) -> bool:
    """Put a piece somewhere on the floor with any yaw."""
    for _ in range(tries):
        limit = np.array(room.size[:2]) / 2 - 0.2
        item.position = np.array([*rng.uniform(-limit, limit), item.position[2]])
        straight = rng.random() < 0.4
        item.rotation = turn(
            rng.integers(4) * np.pi / 2 if straight else rng.uniform(-np.pi, np.pi)
        )
        crowded = any(
            rects_clash(rect_of(item), rect_of(o), 0.12) for o in room.solid() if o.kind == "furn"
        )
        if not crowded and _free(room, item):
            _fix(room, item)
            return True
    return False


def _wall_piece(maker: furniture.Maker) -> Callable:
    return lambda room, rng: _against_wall(room, maker(rng), rng)


def _loose_piece(maker: furniture.Maker) -> Callable:
    def put(room: Room, rng: np.random.Generator) -> None:
        item = maker(rng)
        if rng.random() < 0.5 or not _against_wall(room, item, rng):
            _anywhere(room, item, rng)

    return put


def _kitchen_run(room: Room, rng: np.random.Generator) -> None:
    w = rng.uniform(1.0, 2.4)
    base = furniture.base_cabinet(rng, w)
    top, *sinks = furniture.counter(rng, w, rng.random() < 0.75)
    if not _against_wall(room, base, rng):
        return
    base.tops = []
    top.rotation = base.rotation
    # Flush with the back of the cabinet, 4 cm over its front.
    top.position = base.position + base.rotation @ [0, -0.02, base.height + 0.001]
    room.items.append(top)
    for sink in sinks:
        attach(sink)
        room.items.append(sink)
    if rng.random() < 0.8:
        hung = furniture.wall_cabinet(rng)
        wanted = base.position + base.rotation @ [rng.uniform(-0.2, 0.2), 0, 0]
        _put_on_wall(
            room, hung, rng, low=rng.uniform(1.35, 1.5), near=wanted, yaw=yaw_of(base.rotation)
        )


def attach(item: Item) -> None:
    """Change the pose of a welded item from its holder's frame to the frame of the room."""
    assert item.holder is not None
    item.position = item.holder.rotation @ item.position + item.holder.position
    item.rotation = item.holder.rotation @ item.rotation


def _table_set(room: Room, rng: np.random.Generator) -> None:
    item = furniture.table(rng)
    if not (_anywhere(room, item, rng) or _against_wall(room, item, rng)):
        return
    for _ in range(int(rng.integers(2, 6))):
        _seat_at(
            room, item, furniture.chair(rng) if rng.random() < 0.8 else furniture.stool(rng), rng
        )
    if rng.random() < 0.3:
        lamp = furniture.pendant_lamp(rng)
        z = room.size[2] - rng.uniform(0.7, 1.0)
        lamp.position = np.array([*item.position[:2], max(z, 1.45)])
        _fix(room, lamp)


def _desk_set(room: Room, rng: np.random.Generator) -> None:
    item = furniture.desk(rng)
    if _against_wall(room, item, rng):
        _seat_at(room, item, furniture.chair(rng), rng, sides=(0,))


def _seat_at(
    room: Room, table: Item, seat: Item, rng: np.random.Generator, sides=(0, 1, 2, 3)
) -> bool:
    """Put a seat at a side of a table: away from it, or partly or wholly under it."""
    low, high = table.bounds()
    half = (high - low)[:2] / 2
    seat_low, seat_high = seat.bounds()
    for _ in range(25):
        side = int(rng.choice(sides))
        inward = np.array([[0, 1], [0, -1], [1, 0], [-1, 0]][side], float)
        along = np.array([-inward[1], inward[0]])
        reach, free = (half[1], half[0]) if side < 2 else (half[0], half[1])
        tucked = rng.choice([rng.uniform(-0.3, -0.03), rng.uniform(0.05, 0.3)])
        if seat.label == "stool" and rng.random() < 0.5:
            tucked = rng.uniform(0.36, 0.45)
        out = reach - seat_low[1] - tucked
        local = -inward * out + along * rng.uniform(-0.7, 0.7) * max(free - 0.25, 0)
        # The front of the seat (−y) looks at the table.
        yaw = float(np.arctan2(-inward[0], inward[1])) + np.pi + rng.normal(0, 0.12)
        seat.position = table.position + table.rotation @ [*local, 0]
        seat.position[2] = 0.0
        seat.rotation = table.rotation @ turn(yaw)
        if _free(room, seat):
            _fix(room, seat)
            return True
    return False


def _couch(room: Room, rng: np.random.Generator) -> None:
    item = furniture.couch(rng)
    if not _against_wall(room, item, rng) or rng.random() < 0.35:
        return
    table = furniture.low_table(rng)
    table.position = item.position + item.rotation @ [
        rng.uniform(-0.3, 0.3),
        -rng.uniform(0.85, 1.1),
        0,
    ]
    table.rotation = item.rotation @ turn(rng.normal(0, 0.2))
    if _free(room, table):
        _fix(room, table)


def _tv_stand(room: Room, rng: np.random.Generator) -> None:
    item = furniture.tv_stand(rng)
    if not _against_wall(room, item, rng):
        return
    if rng.random() < 0.35:
        screen = furniture.wall_screen(rng)
        _put_on_wall(
            room,
            screen,
            rng,
            low=rng.uniform(0.9, 1.2),
            near=item.position,
            yaw=yaw_of(item.rotation),
        )
        return
    screen = things.television(rng)[0]
    low, high = item.bounds()
    if screen.bounds()[1][0] < high[0] + 0.1:
        top = item.tops[0]
        _drop(room, [screen], item, top, np.array([rng.uniform(-0.05, 0.05), 0.03]), 0.0)


def _put_on_wall(
    room: Room,
    item: Item,
    rng: np.random.Generator,
    *,
    low: float,
    near=None,
    yaw: float | None = None,
) -> bool:
    """Fix a thing to a wall with its lowest point at a height, at a place or anywhere."""
    a, b = item.bounds()
    for _ in range(40):
        wall = int(rng.integers(4))
        if yaw is not None:
            wall = int(np.argmin([abs(np.angle(np.exp(1j * (w[0] - yaw)))) for w in WALLS]))
        turned, normal = WALLS[wall]
        reach = room.size[0 if normal[0] else 1] / 2
        span = room.size[1 if normal[0] else 0] / 2 - (b - a)[0] / 2 - 0.08
        along = np.array([-normal[1], normal[0]])
        t = rng.uniform(-span, span) if span > 0 else 0.0
        if near is not None:
            t = float(near[:2] @ along) + rng.normal(0, 0.04)
        if abs(t) > span:
            continue
        place = np.array(normal) * (reach - b[1] - 0.002) + along * t
        item.position = np.array([*place, low - a[2]])
        item.rotation = turn(turned)
        rect = rect_of(item)
        others = [rect_of(o) for o in room.solid() if o.kind in ("furn", "wallm")]
        if rect.high < room.size[2] - 0.02 and not any(rects_clash(rect, o, 0.03) for o in others):
            _fix(room, item)
            return True
    return False


def _wall_things(room: Room, rng: np.random.Generator) -> None:
    kind = str(rng.choice(WALL_THINGS))
    if kind == "window":
        pane, *curtains = furniture.window(rng)
        if _put_on_wall(room, pane, rng, low=rng.uniform(0.85, 1.05)):
            for curtain in curtains:
                attach(curtain)
                room.items.append(curtain)
        return
    item = getattr(furniture, kind)(rng)
    low, near, yaw = rng.uniform(1.2, 1.55), None, None
    below = [o for o in room.items if o.kind == "furn" and o.anchor == "world" and o.height < 1.2]
    if below and rng.random() < 0.65:
        piece = below[int(rng.integers(len(below)))]
        near, yaw = piece.position, yaw_of(piece.rotation)
        low = max(low, piece.height + 0.25)
    _put_on_wall(room, item, rng, low=low, near=near, yaw=yaw)


def _floor_group(room: Room, rng: np.random.Generator) -> None:
    """A thing on the floor, at a wall, under a table, beside furniture, or leaning."""
    name = str(rng.choice(FLOOR_THINGS))
    group = getattr(things, name)(rng)
    if name == "board":
        _lean(room, group[0], rng)
        return
    for _ in range(30):
        limit = np.array(room.size[:2]) / 2 - 0.15
        place = rng.uniform(-limit, limit)
        under = [o for o in room.items if o.label in ("table", "desk", "bench")]
        if under and rng.random() < 0.25:
            piece = under[int(rng.integers(len(under)))]
            place = piece.position[:2] + rng.normal(0, 0.2, 2)
        pieces = [o for o in room.solid() if o.kind == "furn"]
        if pieces and rng.random() < 0.4:
            piece = pieces[int(rng.integers(len(pieces)))]
            half = rect_of(piece).half
            side = rng.choice([-1, 1]) * (
                half[0] + things.extent(group)[1][0] + rng.uniform(0.01, 0.12)
            )
            place = (
                piece.position + piece.rotation @ [side, rng.uniform(-half[1], half[1]) * 0.7, 0]
            )[:2]
        if _settle(room, group, np.array([*place, 0.0]), rng.uniform(-np.pi, np.pi)):
            return


def _lean(room: Room, item: Item, rng: np.random.Generator) -> None:
    """Lean a board at a wall, or at the side of a piece of furniture."""
    tilt = rng.uniform(0.15, 0.3)
    low, high = item.bounds()
    for _ in range(30):
        yaw, normal = WALLS[int(rng.integers(4))]
        reach = room.size[0 if normal[0] else 1] / 2
        span = room.size[1 if normal[0] else 0] / 2 - high[0] - 0.05
        out = reach - np.sin(tilt) * high[2] - 0.02
        along = np.array([-normal[1], normal[0]])
        place = np.array(normal) * out + along * rng.uniform(-span, span)
        item.position = np.array([*place, 0.012])
        item.rotation = turn(yaw) @ turn(0, 0, -tilt)
        centre = np.array(normal) * (reach - 0.5 * np.sin(tilt) * high[2]) + along * (place @ along)
        half = np.array([high[0], 0.5 * np.sin(tilt) * high[2] + 0.02])
        rect = Rect(centre, half, yaw, 0.0, high[2])
        if not any(rects_clash(rect, _loose_rect(o), 0.02) for o in room.items):
            room.items.append(item)
            return


def _loose_rect(item: Item) -> Rect:
    """Axis-aligned box of an item with any rotation."""
    points = item.vertices()
    low, high = points.min(0), points.max(0)
    return Rect(((low + high) / 2)[:2], ((high - low) / 2)[:2], 0.0, low[2], high[2])


def _settle(room: Room, group: Group, place: np.ndarray, yaw: float, margin: float = 0.004) -> bool:
    """Put a group with its base at a place if it hits nothing; everything counts."""
    low, high = things.extent(group)
    low = np.minimum(low, things.solid_extent(group[0])[0])
    rotation = turn(yaw)
    centre = place + rotation @ ((low + high) / 2)
    limit = np.array(room.size[:2]) / 2 - 0.01
    half = (high - low)[:2] / 2
    rect = Rect(centre[:2], half, yaw, place[2] + 0.001, place[2] + high[2])
    if (np.abs(rect.corners()) > limit).any():
        return False
    for other in room.items:
        if other.anchor == "free":
            if rects_clash(rect, _loose_rect(other), margin):
                return False
        elif rects_clash(rect, rect_of(other), margin) and any(
            rects_clash(rect, part, margin) for part in part_rects(other)
        ):
            return False
    for item in group:
        if item.holder is not None:
            continue
        item.position = rotation @ item.position + place + [0, 0, DROP_M]
        item.rotation = rotation @ item.rotation
    for item in group:
        if item.holder is not None:
            attach(item)
    room.items.extend(group)
    return True


def _drop(room: Room, group: Group, item: Item, top: Top, at: np.ndarray, yaw: float) -> bool:
    local = np.array([at[0] + top.centre[0], at[1] + top.centre[1], top.height])
    place = item.rotation @ local + item.position
    return _settle(room, group, place, yaw_of(item.rotation) + yaw)


# What a piece of furniture can carry: names of makers in things.py, likely ones more than once.
CABINET = """table_lamp flowers microwave books potted_plant desk_clock basket carton cartons vase
    fruit_bowl open_box bowl bottle book_row remote monitor"""
STOOL = "book towel potted_plant cup"
CHAIR = "pillow bag book towel carton toy"
ON = {
    label: names.split()
    for label, names in {
        "table": """place_setting place_setting fruit_bowl cup bottle flowers vase book books bowl
            plate plates basket bag remote towel carton laptop fruit potted_plant open_box""",
        "desk": """laptop monitor keyboard cup books book table_lamp remote desk_clock bottle
            potted_plant carton open_box book_row""",
        "countertop": """bowl plates bottle cup microwave empty_pot fruit_bowl bottle towel carton
            basket potted_plant fruit plate vase""",
        "sink": "bowl cup plate plates fruit",
        "oven": "empty_pot empty_pot bowl plate towel",
        "chair": CHAIR,
        "armchair": CHAIR,
        "stool": STOOL,
        "bench": STOOL + " bag basket pillow",
        "sofa": "pillow pillow pillow book remote bag toy laptop towel",
        "bed": "pillow pillow pillow towel toy book laptop bag open_box",
        "shelf": """book_row book_row books vase potted_plant desk_clock carton basket bowl bottle
            toy cartons open_box cup empty_pot plates""",
        "cabinet": CABINET,
        "nightstand": CABINET,
        "tv-stand": CABINET,
        "plant-stand": "potted_plant flowers vase table_lamp",
        "box": "book cup bowl toy flowers",
    }.items()
}
# Expected number of groups per square metre of a surface at full clutter.
GROUPS_PER_M2 = {
    "chair": 3.0,
    "stool": 5.0,
    "sofa": 3.0,
    "armchair": 3.0,
    "bed": 2.2,
    "shelf": 16.0,
    "bench": 5.0,
    "table": 11.0,
    "countertop": 9.0,
    "sink": 7.0,
}
MOST_SMALL = 56


def _fill_tops(room: Room, rng: np.random.Generator) -> None:
    carriers = [(item, top) for item in room.items for top in item.tops if item.label in ON]
    for index in rng.permutation(len(carriers)):
        item, top = carriers[index]
        area = 4 * top.half[0] * top.half[1]
        count = rng.poisson(1.5 * area * GROUPS_PER_M2.get(item.label, 8.0) * room.clutter + 0.25)
        for _ in range(min(count, 9)):
            if sum(o.kind in ("small", "screen") for o in room.items) < MOST_SMALL:
                _put_on(room, item, top, rng)


def _put_on(room: Room, item: Item, top: Top, rng: np.random.Generator) -> None:
    group = getattr(things, str(rng.choice(ON[item.label])))(rng)
    turned = rng.normal(0, 0.25) if item.label in ("shelf", "desk") else rng.uniform(-np.pi, np.pi)
    if group[0].label in (
        "monitor",
        "microwave",
        "laptop",
        "computer-keyboard",
        "clock",
        "tv-screen",
    ):
        turned = rng.normal(0, 0.2)
    if group[0].label == "book" and abs(group[0].rotation[2, 2]) < 0.5:
        turned = 0.0
    low, high = things.extent(group)
    if high[2] > top.clearance - 0.02:
        return
    if group[0].label == "cushion" and item.label == "sofa" and rng.random() < 0.6:
        _lean_pillow(room, group[0], item, top, rng)
        return
    c, s = abs(np.cos(turned)), abs(np.sin(turned))
    reach = np.maximum(np.abs(low), np.abs(high))[:2]
    slack = np.array(top.half) - [c * reach[0] + s * reach[1], s * reach[0] + c * reach[1]]
    if (slack < -0.01).any():
        return
    slack = np.maximum(slack, 0)
    for _ in range(12):
        at = rng.uniform(-slack, slack)
        if top.round and np.linalg.norm(at) + np.linalg.norm(reach) > top.half[0] + 0.01:
            continue
        if _drop(room, group, item, top, at, turned):
            return


def _lean_pillow(room: Room, pillow: Item, couch: Item, top: Top, rng: np.random.Generator) -> None:
    """A pillow that leans at the back of a couch."""
    low, high = pillow.bounds()
    tilt = rng.uniform(0.95, 1.2)
    x = rng.uniform(-1, 1) * max(top.half[0] - high[0], 0)
    # Roll: the pillow's +y edge goes up, its underside turns to the back.
    rotation = turn(0, 0, tilt)
    corners = pillow.vertices(placed=False) @ rotation.T
    y = top.half[1] - corners[:, 1].max() + 0.01
    local = np.array(
        [x + top.centre[0], y + top.centre[1], top.height - corners[:, 2].min() + DROP_M]
    )
    pillow.position = couch.rotation @ local + couch.position
    pillow.rotation = couch.rotation @ rotation
    rect = _loose_rect(pillow)
    if any(o.anchor == "free" and rects_clash(rect, _loose_rect(o), 0.0) for o in room.items):
        return
    room.items.append(pillow)


PIECES: dict[str, Callable] = {
    "kitchen_run": _kitchen_run,
    "table_set": _table_set,
    "desk_set": _desk_set,
    "couch": _couch,
    "tv_stand": _tv_stand,
    "refrigerator": _wall_piece(furniture.refrigerator),
    "oven": _wall_piece(furniture.oven),
    "cabinet": _wall_piece(furniture.cabinet),
    "wardrobe": _wall_piece(furniture.wardrobe),
    "shelf": _wall_piece(furniture.shelf),
    "bed": _wall_piece(furniture.bed),
    "nightstand": _wall_piece(furniture.nightstand),
    "armchair": _loose_piece(furniture.armchair),
    "low_table": _loose_piece(furniture.low_table),
    "bench": _loose_piece(furniture.bench),
    "stool": _loose_piece(furniture.stool),
    "chair": _loose_piece(furniture.chair),
    "plant_stand": _loose_piece(furniture.plant_stand),
    "floor_lamp": _loose_piece(furniture.floor_lamp),
}
