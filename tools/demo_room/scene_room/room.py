"""The furnished room: the objects, their positions and their supports."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from . import furniture as fu
from . import tableware as tw
from .meshes import Mesh, axis_rotation, box, sheet

HALF_X, HALF_Y, HEIGHT = 3.0, 2.5, 2.6
WINDOW_Y, WINDOW_Z, WINDOW_W, WINDOW_H = 0.25, 0.95, 2.0, 1.25


@dataclass
class PlacedObject:
    """One object of the room. Its pose is `position` and a rotation about z.

    Attributes:
        class_name: COCO class, or None if COCO has none.
        kind: furniture, screen, wall, small or shell.
        parts: meshes in the world frame, with the names of their materials.
        parent: name of the direct support, or None.
        predicate: relation to the support: on, in or attached to.
        local_low, local_high: (3,) corners of the box in the object's frame, metres.
    """

    object_id: int
    name: str
    class_name: str | None
    label: str
    kind: str
    position: tuple[float, float, float]
    yaw_deg: float
    parts: list[tuple[Mesh, str]]
    parent: str | None = None
    predicate: str | None = None
    local_low: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    local_high: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))


class RoomBuilder:
    """Collects objects. Ids count from 1 in the order of the calls."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.objects: list[PlacedObject] = []
        self._by_name: dict[str, PlacedObject] = {}

    def put(
        self,
        name: str,
        class_name: str | None,
        parts: list[tuple[Mesh, str]],
        xyz: tuple[float, float, float],
        yaw_deg: float = 0.0,
        *,
        label: str | None = None,
        kind: str = "small",
        parent: str | None = None,
        predicate: str | None = None,
    ) -> None:
        """Add an object at a pose in the world. `parts` are in the object's frame."""
        vertices = np.concatenate([mesh.vertices for mesh, _ in parts])
        placed = [(mesh.turned("z", yaw_deg).moved(*xyz), material) for mesh, material in parts]
        item = PlacedObject(
            object_id=len(self.objects) + 1,
            name=name,
            class_name=class_name,
            label=label or class_name or name,
            kind=kind,
            position=xyz,
            yaw_deg=yaw_deg,
            parts=placed,
            parent=parent,
            predicate=predicate,
            local_low=vertices.min(0),
            local_high=vertices.max(0),
        )
        self.objects.append(item)
        self._by_name[name] = item

    def put_on(
        self,
        base: str,
        name: str,
        class_name: str | None,
        parts: list[tuple[Mesh, str]],
        local_xy: tuple[float, float],
        yaw_deg: float = 0.0,
        *,
        height: float | None = None,
        predicate: str = "on",
        label: str | None = None,
        kind: str = "small",
    ) -> None:
        """Put an object on `base`: x and y in the frame of the base, at its top or at `height`."""
        support = self._by_name[base]
        z = support.local_high[2] if height is None else height
        offset = axis_rotation("z", support.yaw_deg) @ np.array([*local_xy, z + 0.0005])
        x, y, z = (float(a) for a in np.array(support.position) + offset)
        self.put(
            name, class_name, parts, (x, y, z), support.yaw_deg + yaw_deg,
            label=label, kind=kind, parent=base, predicate=predicate,
        )  # fmt: skip


def build_room(seed: int) -> list[PlacedObject]:
    """All objects of the room. The shell (floor, walls, ceiling) is first."""
    room = RoomBuilder(seed)
    _shell(room)
    _dining(room)
    _kitchen(room)
    _living(room)
    _bookcase(room)
    return room.objects


def _shell(room: RoomBuilder) -> None:
    x, y, z = np.eye(3)
    lx, ly = 2 * HALF_X, 2 * HALF_Y
    low = np.array([-HALF_X, -HALF_Y, 0.0])
    floor = sheet(low, lx * x, ly * y, 0.03)
    room.put("floor", None, [(floor, "floor")], (0, 0, 0), kind="shell")
    ceiling = sheet(low + [0, ly, HEIGHT], lx * x, -ly * y, 0.10)
    room.put("ceiling", None, [(ceiling, "ceiling")], (0, 0, 0), kind="shell")

    north = [(sheet(np.array([-HALF_X, HALF_Y, 0.0]), lx * x, HEIGHT * z, 0.05), "wall")]
    splash = sheet(np.array([-2.26, HALF_Y - 0.004, 0.90]), 2.1 * x, 0.62 * z, 0.04)
    room.put(
        "north wall", None, [*north, (splash, "wall_tiles")], (0, 0, 0), label="wall", kind="shell"
    )
    south = sheet(np.array([HALF_X, -HALF_Y, 0.0]), -lx * x, HEIGHT * z, 0.05)
    room.put("south wall", None, [(south, "wall_accent")], (0, 0, 0), label="wall", kind="shell")
    east = sheet(np.array([HALF_X, HALF_Y, 0.0]), -ly * y, HEIGHT * z, 0.05)
    room.put("east wall", None, [(east, "wall")], (0, 0, 0), label="wall", kind="shell")

    a, b = WINDOW_Y - WINDOW_W / 2, WINDOW_Y + WINDOW_W / 2
    c, d = WINDOW_Z, WINDOW_Z + WINDOW_H
    west = []
    for y0, y1, z0, z1 in (
        (-HALF_Y, a, 0, HEIGHT),
        (b, HALF_Y, 0, HEIGHT),
        (a, b, 0, c),
        (a, b, d, HEIGHT),
    ):
        corner = np.array([-HALF_X, y0, z0])
        west.append((sheet(corner, (y1 - y0) * y, (z1 - z0) * z, 0.05), "wall"))
    depth = 0.16
    for corner, u, v in (
        ((-HALF_X, a, d), (-depth, 0, 0), (0, b - a, 0)),
        ((-HALF_X, a, c), (-depth, 0, 0), (0, 0, d - c)),
        ((-HALF_X - depth, b, c), (depth, 0, 0), (0, 0, d - c)),
        ((-HALF_X - depth, a, c), (depth, 0, 0), (0, b - a, 0)),
    ):
        west.append((sheet(np.array(corner), np.array(u), np.array(v), 0.04), "skirting"))
    room.put("west wall", None, west, (0, 0, 0), label="wall", kind="shell")

    boards = []
    for length, xyz, yaw in (
        (lx, (0, HALF_Y - 0.006, 0), 0), (lx, (0, -HALF_Y + 0.006, 0), 0),
        (ly, (HALF_X - 0.006, 0, 0), 90), (ly, (-HALF_X + 0.006, 0, 0), 90),
    ):  # fmt: skip
        boards.append(
            (box(length, 0.012, 0.08, 0.004, 0.06).turned("z", yaw).moved(*xyz), "skirting")
        )
    room.put("skirting", None, boards, (0, 0, 0), kind="shell")
    room.put(
        "window", None, fu.window(WINDOW_W, WINDOW_H), (-HALF_X, WINDOW_Y, WINDOW_Z), 90,
        kind="wall", parent="west wall", predicate="attached to",
    )  # fmt: skip


def _dining(room: RoomBuilder) -> None:
    room.put(
        "dining table", "diningtable", fu.dining_table(), (-1.15, 0.10, 0), 0, kind="furniture"
    )
    chairs = (("south-west", -1.52, -0.46, 176), ("south-east", -0.70, -0.55, 150),
              ("north-west", -1.52, 0.68, -4), ("north-east", -0.76, 0.70, 6))  # fmt: skip
    for name, x, y, yaw in chairs:
        room.put(f"{name} chair", "chair", fu.chair(), (x, y, 0), yaw, kind="furniture")
    put = room.put_on
    table = "dining table"
    put(table, "red cup", "cup", tw.cup("ceramic_red"), (0.34, -0.24), -30)
    put(table, "blue cup", "cup", tw.cup("ceramic_blue"), (-0.42, 0.22), 200)
    put(table, "fruit bowl", "bowl", tw.bowl("ceramic_white"), (0.10, 0.16))
    put(table, "wine bottle", "bottle", tw.wine_bottle(), (0.58, 0.20), 100)
    put(table, "tulip vase", "vase", tw.vase("ceramic_teal"), (-0.14, 0.02), 0)
    put(table, "laptop", "laptop", tw.laptop(), (-0.42, -0.19), 4)
    put(table, "atlas", "book", tw.lying_book(1, 0.032, 0.27, 0.20), (0.54, -0.12), 24)
    put("atlas", "novel", "book", tw.lying_book(3, 0.026, 0.21, 0.145), (0.0, 0.0), -16)
    put(
        "tulip vase",
        "tulips",
        "pottedplant",
        tw.flowers(room.rng, 0.255),
        (0, 0),
        height=0.02,
        predicate="in",
        label="flowers",
    )
    for name, material, r, x, y, z in (
        ("first orange", "orange", 0.039, 0.048, 0.030, 0.024),
        ("second orange", "orange", 0.037, -0.034, 0.048, 0.024),
        ("apple", "apple", 0.037, -0.010, -0.050, 0.024),
    ):
        put("fruit bowl", name, material, tw.fruit(material, r), (x, y), height=z, predicate="in")
    room.put(
        "pendant lamp", None, fu.pendant_lamp(), (-1.15, 0.10, 1.80), kind="wall",
        label="lamp", parent="ceiling", predicate="attached to",
    )  # fmt: skip


def _kitchen(room: RoomBuilder) -> None:
    room.put(
        "refrigerator", "refrigerator", fu.refrigerator(), (-2.62, 2.13, 0), 0, kind="furniture"
    )
    length, sink_at, oven_at = 2.06, -0.42, 0.70
    room.put(
        "counter", None, fu.counter(length, sink_at, oven_at), (-1.23, 2.19, 0), 0,
        kind="furniture", label="counter",
    )  # fmt: skip
    put = room.put_on
    put(
        "counter",
        "sink",
        "sink",
        fu.sink(),
        (sink_at, 0.0),
        predicate="attached to",
        kind="furniture",
    )
    room.put(
        "oven",
        "oven",
        fu.oven(),
        (-1.23 + oven_at, 2.19, 0.0),
        0,
        kind="furniture",
        parent="counter",
        predicate="in",
    )
    put("counter", "cooktop", None, fu.cooktop(), (oven_at, 0.02), label="cooktop")
    put("counter", "microwave", "microwave", fu.microwave(), (0.13, 0.08))
    put("counter", "soap bottle", "bottle", tw.soap_bottle(), (-0.80, 0.19), 20)
    put("counter", "bananas", "banana", tw.bananas(), (-0.90, -0.12), 24)
    put("counter", "white cup", "cup", tw.cup("ceramic_white"), (-0.06, -0.20), -50)
    room.put(
        "wall cabinet", None, fu.wall_cabinet(1.36), (-1.56, 2.33, 1.52), 0, kind="wall",
        label="cabinet", parent="north wall", predicate="attached to",
    )  # fmt: skip
    room.put(
        "wall clock", "clock", fu.wall_clock(), (0.42, HALF_Y, 1.62), 0, kind="wall",
        parent="north wall", predicate="attached to",
    )  # fmt: skip


def _living(room: RoomBuilder) -> None:
    room.put("tv stand", None, fu.tv_stand(), (1.72, 2.26, 0), 0, kind="furniture", label="cabinet")
    room.put_on("tv stand", "tv", "tvmonitor", fu.tv(), (0.0, 0.02), kind="screen")
    rug = [
        (
            box(2.3, 1.5, 0.010, 0.004, 0.04).mapped(
                lambda v, n: np.c_[v[:, 0] / 2.3 + 0.5, v[:, 1] / 1.5 + 0.5]
            ),
            "rug",
        )
    ]
    room.put("rug", None, rug, (1.55, -0.35, 0), 0, kind="flat", parent="floor", predicate="on")
    room.put("couch", "sofa", fu.couch(), (1.62, -1.98, 0), 180, kind="furniture")
    room.put(
        "coffee table",
        "diningtable",
        fu.coffee_table(),
        (1.58, -0.62, 0.0105),
        3,
        kind="furniture",
        label="coffee table",
        parent="rug",
        predicate="on",
    )
    put = room.put_on
    put(
        "couch",
        "yellow pillow",
        None,
        fu.pillow("pillow_yellow"),
        (0.60, 0.02),
        10,
        height=0.465,
        label="pillow",
    )
    put(
        "couch",
        "cream pillow",
        None,
        fu.pillow("pillow_cream"),
        (-0.62, 0.03),
        -8,
        height=0.465,
        label="pillow",
    )
    put("couch", "teddy bear", "teddy bear", tw.teddy_bear(), (0.12, -0.08), 8, height=0.47)
    put("coffee table", "teal cup", "cup", tw.cup("ceramic_teal"), (0.30, 0.06), 30)
    put("coffee table", "remote", "remote", tw.remote(), (0.10, 0.10), -55)
    put("coffee table", "magazine", "book", tw.lying_book(9, 0.018, 0.28, 0.21), (-0.22, -0.02), 12)
    plant = tw.potted_plant(room.rng, 1.15, "terracotta", 19)
    room.put("large plant", "pottedplant", plant, (0.16, -2.02, 0), 0, kind="furniture")
    plant = tw.potted_plant(room.rng, 0.95, "ceramic_white", 16, 0.42)
    room.put("corner plant", "pottedplant", plant, (2.76, 1.55, 0), 40, kind="furniture")
    room.put(
        "floor lamp", None, fu.floor_lamp(), (2.80, -2.25, 0), 0, kind="furniture", label="lamp"
    )
    room.put(
        "painting", None, fu.painting(), (1.62, -HALF_Y, 1.30), 180, kind="wall", label="picture",
        parent="south wall", predicate="attached to",
    )  # fmt: skip


def _bookcase(room: RoomBuilder) -> None:
    boards = (0.06, 0.42, 0.78, 1.14, 1.50)
    room.put(
        "bookshelf",
        None,
        fu.bookshelf(boards=boards),
        (-1.25, -2.35, 0),
        180,
        kind="furniture",
        label="shelf",
    )
    rng = room.rng
    number = 0
    for board, count in ((0.42, 9), (0.78, 10), (1.14, 6)):
        x = -0.41
        for _ in range(count):
            number += 1
            thickness = float(rng.uniform(0.026, 0.048))
            height = float(rng.uniform(0.21, 0.28))
            depth = float(rng.uniform(0.15, 0.19))
            book = tw.book(int(rng.integers(10)), thickness, height, depth)
            x += thickness / 2
            room.put_on("bookshelf", f"shelf book {number}", "book", book, (x, -0.02), height=board)
            x += thickness / 2 + float(rng.uniform(0.0012, 0.004))
    put = room.put_on
    put("bookshelf", "blue vase", "vase", tw.vase("ceramic_blue", 0.27), (0.25, 0.0), height=1.14)
    put(
        "bookshelf",
        "shelf plant",
        "pottedplant",
        tw.potted_plant(rng, 0.46, "ceramic_white", 13),
        (0.22, 0.0),
    )
    put(
        "bookshelf",
        "salad bowl",
        "bowl",
        tw.bowl("ceramic_teal", 0.135, 0.09),
        (0.22, 0.0),
        height=0.78,
    )
    put(
        "bookshelf",
        "clock radio",
        None,
        [(box(0.2, 0.11, 0.10, 0.01, 0.03), "black_plastic")],
        (-0.2, 0),
        label="radio",
    )
