"""Small things, alone and in arrangements.

A maker returns a group: a list of items with poses in the frame of the group. A welded item has its
pose in the frame of its holder. The layout puts a group on a surface.
"""

from __future__ import annotations

import numpy as np

from . import colours
from .shapes import Cavity, Item, Material, Part, Top, box, ring, turn, upright

Group = list[Item]
# Free air below things that are stacked, m. They drop by this at the start of the simulation.
GAP_M = 0.002


def _at(item: Item, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Item:
    item.position = np.array([x, y, z])
    item.rotation = turn(yaw)
    return item


def _lathe(profile: list[tuple[float, float]], material: int = 0) -> Part:
    return Part("lathe", (), material=material, collides=False, profile=np.array(profile, float))


def _round_shell(
    rng: np.random.Generator,
    label: str,
    outer: list[tuple[float, float]],
    t: float,
    mass_kg: float,
    material: Material,
    sides: int = 10,
) -> Item:
    """Open vessel from its outer profile: a lathe to see, and boxes in a ring to touch."""
    inner = [(max(r - t, 0.004), max(z, t)) for r, z in outer]
    profile = [(0, 0), *outer, *inner[::-1], (0, t)]
    base = outer[0][0]
    parts = [_lathe(profile), upright(base, 0, t, visible=False), *ring(outer, t, sides)]
    cavity = Cavity((0, 0), (max(r for r, _ in outer) - t,) * 2, 0.0, outer[-1][1], round=True)
    return Item(label, "small", parts, [material, colours.ceramic(rng)], mass_kg, [cavity])


def cup(rng: np.random.Generator) -> Group:
    """Mug or glass."""
    r, h = rng.uniform(0.033, 0.047), rng.uniform(0.075, 0.12)
    item = _round_shell(
        rng, "cup", [(r * rng.uniform(0.75, 1), 0), (r, h)], 0.005, 0.3, colours.ceramic(rng), 8
    )
    if rng.random() < 0.7:
        for z, x in ((0.3, 0.012), (0.7, 0.012)):
            item.parts.append(
                box((r - 0.006, -0.006, h * z - 0.005), (r + 2 * x, 0.006, h * z + 0.005))
            )
        item.parts.append(box((r + 0.018, -0.006, h * 0.3), (r + 0.028, 0.006, h * 0.7)))
    return [item]


def bowl(rng: np.random.Generator) -> Group:
    """Open bowl."""
    r, h = rng.uniform(0.06, 0.12), rng.uniform(0.045, 0.075)
    outer = [(r * 0.55, 0), (r * 0.86, h * 0.5), (r, h)]
    return [_round_shell(rng, "bowl", outer, 0.006, 0.4, colours.ceramic(rng))]


def plate(rng: np.random.Generator) -> Group:
    """Flat plate."""
    r = rng.uniform(0.08, 0.135)
    profile = [(0, 0), (r * 0.65, 0), (r, 0.018), (r - 0.004, 0.021), (r * 0.63, 0.008), (0, 0.008)]
    parts = [_lathe(profile), upright(r * 0.65, 0, 0.008, visible=False)]
    parts += ring([(r * 0.65, 0.0), (r, 0.018)], 0.006, 12)
    return [Item("plate", "small", parts, [colours.ceramic(rng)], 0.4)]


def plates(rng: np.random.Generator) -> Group:
    """Pile of plates of one size."""
    seed = int(rng.integers(1 << 30))
    return [
        _at(plate(np.random.default_rng(seed))[0], z=k * (0.0095 + GAP_M))
        for k in range(int(rng.integers(2, 5)))
    ]


def bottle(rng: np.random.Generator) -> Group:
    """Bottle with a neck, a cap and a label."""
    r, h = rng.uniform(0.028, 0.05), rng.uniform(0.16, 0.33)
    neck, s = rng.uniform(0.3, 0.45) * r, rng.uniform(0.55, 0.72) * h
    profile = [(0, 0), (r, 0), (r, s), (neck, s + 0.2 * h), (neck, h - 0.015), (0, h - 0.015)]
    parts = [
        _lathe(profile),
        upright(r, 0, s, visible=False),
        upright(neck * 1.2, s, h - 0.015, visible=False),
        upright(neck * 1.15, h - 0.02, h, material=1),
        upright(r * 1.01, s * 0.25, s * 0.8, material=2, collides=False),
    ]
    materials = [
        colours.paint(rng),
        colours.paint(rng),
        colours.paint(rng, patterns=(colours.PRINT, colours.PLAIN)),
    ]
    item = Item("bottle", "small", parts, materials, 0.7)
    if rng.random() < 0.1:
        item.rotation = turn(0, np.pi / 2)
        item.position = np.array([-h / 2, 0, r])
    return [item]


def vase(rng: np.random.Generator) -> Group:
    """Vase, alone."""
    return [_vase(rng)]


def _vase(rng: np.random.Generator) -> Item:
    r, h = rng.uniform(0.045, 0.085), rng.uniform(0.14, 0.32)
    mouth = r * rng.uniform(0.55, 1.1)
    outer = [(r * 0.6, 0), (r, h * 0.4), (mouth * 0.85, h * 0.8), (mouth, h)]
    return _round_shell(rng, "vase", outer, 0.007, 0.9, colours.ceramic(rng), 8)


def _leaves(
    rng: np.random.Generator, reach: float, low: float, high: float, count: int
) -> list[Part]:
    """Thin leaves around a stem; too light for the physics."""
    parts = []
    for _ in range(count):
        yaw, z = rng.uniform(0, 2 * np.pi), rng.uniform(low, high)
        length, pitch = reach * rng.uniform(0.5, 1.0) / 2, rng.uniform(-0.9, 0.1)
        rotation = turn(yaw, pitch)
        centre = rotation @ [length, 0, 0] + [0, 0, z]
        size = (length, length * rng.uniform(0.25, 0.5), 0.003)
        parts.append(
            Part("ellipsoid", size, tuple(centre), rotation, int(rng.integers(0, 2)), False)
        )
    return parts


def _green(rng: np.random.Generator) -> list[Material]:
    first = (rng.uniform(0.02, 0.2), rng.uniform(0.15, 0.5), rng.uniform(0.02, 0.15))
    second = colours.paint(rng) if rng.random() < 0.4 else Material((0.1, 0.3, 0.05))
    return [Material(first, (0.1, 0.4, 0.05), colours.GRADIENT, 0.1), second]


def flowers(rng: np.random.Generator) -> Group:
    """Vase with stems that stand in it."""
    holder = _vase(rng)
    h = holder.height
    reach = rng.uniform(0.06, 0.14)
    stem = upright(0.012, 0, h + 0.08, collides=False)
    parts = [stem, *_leaves(rng, reach, h + 0.01, h + 0.16, int(rng.integers(8, 16)))]
    for _ in range(int(rng.integers(0, 6))):
        place = (*rng.uniform(-0.06, 0.06, 2), h + rng.uniform(0.1, 0.2))
        parts.append(Part("ellipsoid", (0.02, 0.02, 0.016), place, material=1, collides=False))
    item = Item("indoor-plant", "small", parts, _green(rng), 0.1)
    return [holder, _welded(item, holder, 0.012)]


def _welded(item: Item, holder: Item, z: float) -> Item:
    item.anchor, item.holder = "item", holder
    return _at(item, z=z, yaw=0.0)


def potted_plant(rng: np.random.Generator) -> Group:
    """Plant in a pot on a table or shelf."""
    return _potted(rng, rng.uniform(0.05, 0.09), rng.uniform(0.08, 0.14), rng.uniform(0.1, 0.25))


def floor_plant(rng: np.random.Generator) -> Group:
    """Large plant in a pot on the floor."""
    return _potted(rng, rng.uniform(0.13, 0.2), rng.uniform(0.2, 0.32), rng.uniform(0.35, 0.8))


def _potted(rng: np.random.Generator, r: float, h: float, tall: float) -> Group:
    outer = [(r * 0.7, 0), (r, h)]
    pot = _round_shell(rng, "pot", outer, 0.008, 12 * r, colours.ceramic(rng), 8)
    soil = h * 0.8
    pot.parts.append(upright(r * 0.9, soil - 0.02, soil, material=1))
    pot.materials[1] = Material((0.06, 0.04, 0.025), (0.1, 0.07, 0.05), colours.SPECKLES, 0.01)
    stem = upright(0.008 + 0.01 * tall, 0, h * 0.25 + tall * 0.7, collides=False, material=0)
    parts = [
        stem,
        *_leaves(
            rng, rng.uniform(0.3, 0.55) * tall, h * 0.3, h * 0.25 + tall, int(rng.integers(14, 30))
        ),
    ]
    plant = Item("indoor-plant", "small", parts, _green(rng), 0.1)
    return [pot, _welded(plant, pot, soil - 0.005)]


def empty_pot(rng: np.random.Generator) -> Group:
    """Cooking pot with a lid and two handles."""
    r, h = rng.uniform(0.07, 0.13), rng.uniform(0.08, 0.16)
    parts = [
        upright(r, 0, h),
        upright(r * 1.02, h, h + 0.008, material=1),
        upright(0.015, h, h + 0.03, material=2),
    ]
    parts += [
        box((s * r - 0.03, -0.02, h - 0.03), (s * r + 0.03, 0.02, h - 0.015), 2) for s in (-1, 1)
    ]
    return [
        Item("pot", "small", parts, [colours.metal(rng), colours.metal(rng), colours.dark()], 1.5)
    ]


def _book(rng: np.random.Generator) -> tuple[Item, tuple[float, float, float]]:
    """Book that lies flat: width (spine to edge), height and thickness."""
    w, d, t = rng.uniform(0.11, 0.19), rng.uniform(0.17, 0.26), rng.uniform(0.015, 0.05)
    parts = [
        box(
            (-w / 2 + 0.003, -d / 2 + 0.003, 0.003),
            (w / 2 - 0.004, d / 2 - 0.003, t - 0.003),
            1,
            collides=False,
        ),
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, 0.003), collides=False),
        box((-w / 2, -d / 2, t - 0.003), (w / 2, d / 2, t), collides=False),
        box((-w / 2, -d / 2, 0), (-w / 2 + 0.003, d / 2, t), collides=False),
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, t), visible=False),
    ]
    cover = colours.paint(
        rng, patterns=(colours.PLAIN, colours.PRINT, colours.STRIPES), scale_m=(0.02, 0.1)
    )
    pages = Material((0.75, 0.72, 0.62), (0.6, 0.57, 0.5), colours.STRIPES, 0.004)
    return Item("book", "small", parts, [cover, pages], 4e3 * w * d * t * 0.2), (w, d, t)


def book(rng: np.random.Generator) -> Group:
    """One book that lies."""
    return [_book(rng)[0]]


def books(rng: np.random.Generator) -> Group:
    """Pile of books."""
    sizes = sorted(
        (_book(rng) for _ in range(int(rng.integers(2, 5)))), key=lambda b: -b[1][0] * b[1][1]
    )
    z, group = 0.0, []
    for item, (_, _, t) in sizes:
        yaw = rng.normal(0, 0.25)
        group.append(_at(item, *rng.normal(0, 0.006, 2), z, yaw))
        z += t + GAP_M
    return group


def book_row(rng: np.random.Generator, longest: float = 0.4) -> Group:
    """Books that stand beside each other; sometimes the last one leans."""
    x, group = 0.0, []
    # The spine faces −y, the cover +x.
    upward = np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0]])
    for _ in range(int(rng.integers(3, 8))):
        item, (w, d, t) = _book(rng)
        if x + t > longest:
            break
        item.rotation = upward
        item.position = np.array([x, rng.uniform(0, 0.01), d / 2])
        x += t + 0.001
        group.append(item)
    if group and rng.random() < 0.4:
        item, (w, d, t) = _book(rng)
        lean = rng.uniform(0.1, 0.35)
        item.rotation = turn(0, -lean) @ upward
        item.position = np.array(
            [
                x + np.cos(lean) * t + np.sin(lean) * d / 2 + 0.002,
                0.005,
                (np.cos(lean) * d + np.sin(lean) * t) / 2 + 0.002,
            ]
        )
        x = item.position[0] + np.sin(lean) * d / 2
        group.append(item)
    for item in group:
        item.position = item.position - [x / 2, 0, 0]
    return group


def carton(rng: np.random.Generator, scale: float = 1.0) -> Group:
    """Closed box."""
    return [_carton(rng, scale)]


def _carton(rng: np.random.Generator, scale: float = 1.0) -> Item:
    w, d, h = (
        rng.uniform(0.1, 0.26) * scale,
        rng.uniform(0.08, 0.2) * scale,
        rng.uniform(0.05, 0.22) * scale,
    )
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, h)),
        box(
            (-w / 2 - 5e-4, -d * 0.08, h * 0.4),
            (w / 2 + 5e-4, d * 0.08, h + 5e-4),
            1,
            collides=False,
        ),
    ]
    return Item(
        "box",
        "small",
        parts,
        [colours.paint(rng), colours.paint(rng)],
        150 * w * d * h + 0.1,
        tops=[Top((0, 0), (w / 2, d / 2), h)],
    )


def cartons(rng: np.random.Generator) -> Group:
    """Box on a box."""
    below, above = _carton(rng, 1.2), _carton(rng, 0.8)
    return [below, _at(above, *rng.normal(0, 0.01, 2), below.height + GAP_M, rng.normal(0, 0.2))]


def _open(
    label: str, w: float, d: float, h: float, t: float, material: Material, mass_kg: float
) -> Item:
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, t)),
        box((-w / 2, -d / 2, t), (-w / 2 + t, d / 2, h)),
        box((w / 2 - t, -d / 2, t), (w / 2, d / 2, h)),
        box((-w / 2 + t, -d / 2, t), (w / 2 - t, -d / 2 + t, h)),
        box((-w / 2 + t, d / 2 - t, t), (w / 2 - t, d / 2, h)),
    ]
    cavity = Cavity((0, 0), (w / 2 - t, d / 2 - t), 0.0, h)
    return Item(label, "small", parts, [material], mass_kg, [cavity])


def open_box(rng: np.random.Generator, scale: float = 1.0) -> Group:
    """Open box with things in it."""
    w, d, h = (
        rng.uniform(0.22, 0.36) * scale,
        rng.uniform(0.18, 0.28) * scale,
        rng.uniform(0.1, 0.2) * scale,
    )
    item = _open("box", w, d, h, 0.008, colours.paint(rng), 0.6)
    return [
        item,
        *_contents(
            rng,
            w / 2 - 0.015,
            d / 2 - 0.015,
            0.012,
            (book, cup, toy, fruit, bottle, towel, remote, shoe),
        ),
    ]


def basket(rng: np.random.Generator, scale: float = 1.0) -> Group:
    """Basket, round or square, with things in it."""
    weave = colours.paint(
        rng, saturation=(0.3, 0.6), patterns=(colours.CHECKS, colours.STRIPES), scale_m=(0.01, 0.03)
    )
    if rng.random() < 0.5:
        r, h = rng.uniform(0.12, 0.18) * scale, rng.uniform(0.1, 0.18) * scale
        item = _round_shell(rng, "basket", [(r * 0.85, 0), (r, h)], 0.01, 0.6, weave, 12)
        half = r * 0.58, r * 0.58
    else:
        w, d, h = (
            rng.uniform(0.25, 0.38) * scale,
            rng.uniform(0.2, 0.28) * scale,
            rng.uniform(0.1, 0.18) * scale,
        )
        item = _open("basket", w, d, h, 0.012, weave, 0.6)
        half = w / 2 - 0.018, d / 2 - 0.018
    return [
        item,
        *_contents(rng, *half, 0.014, (fruit, toy, bottle, towel, fruit, book, shoe, pillow)),
    ]


def floor_basket(rng: np.random.Generator) -> Group:
    """Large basket on the floor."""
    return basket(rng, 1.4)


def floor_box(rng: np.random.Generator) -> Group:
    """Large box on the floor, closed or open."""
    return open_box(rng, 1.3) if rng.random() < 0.4 else carton(rng, 2.0)


def _contents(rng: np.random.Generator, hx: float, hy: float, low: float, makers) -> Group:
    """Things that fit into a hollow of half sizes hx, hy."""
    found: Group = []
    taken: list[tuple[float, float, float, float]] = []
    for _ in range(int(rng.integers(0, 5)) * 3):
        group = makers[int(rng.integers(len(makers)))](rng)
        item = group[0]
        if len(group) > 1 or item.cavities and item.label != "cup":
            continue
        a, b = item.bounds()
        half = (b - a)[:2] / 2 + 0.003
        if half[0] > hx or half[1] > hy:
            continue
        x, y = rng.uniform(-hx + half[0], hx - half[0]), rng.uniform(-hy + half[1], hy - half[1])
        if any(abs(x - u) < half[0] + p and abs(y - v) < half[1] + q for u, v, p, q in taken):
            continue
        taken.append((x, y, *half))
        found.append(_at(item, x - (a + b)[0] / 2, y - (a + b)[1] / 2, low + 0.003))
    return found


def fruit(rng: np.random.Generator) -> Group:
    """Orange, apple or banana."""
    if rng.random() < 0.25:
        r, bend = 0.017, 0.5
        parts = [
            Part(
                "capsule",
                (r, 0.035),
                (s * 0.03, 0.006 * 0, r),
                turn(0, np.pi / 2) @ turn(0, 0, s * bend / 2),
            )
            for s in (-1, 1)
        ]
        return [
            Item(
                "banana",
                "small",
                parts,
                [Material((0.8, 0.62, 0.05), (0.6, 0.5, 0.1), colours.SPECKLES, 0.02)],
                0.15,
            )
        ]
    r = rng.uniform(0.03, 0.043)
    orange = rng.random() < 0.5
    first = (
        (0.85, 0.35, 0.03) if orange else tuple(rng.uniform([0.3, 0.05, 0.02], [0.7, 0.45, 0.08]))
    )
    part = Part("ellipsoid", (r, r, r * 0.95), (0, 0, r * 0.95))
    return [
        Item(
            "orange" if orange else "fruit",
            "small",
            [part],
            [Material(first, (0.6, 0.4, 0.1), colours.SPECKLES, 0.01)],
            0.18,
        )
    ]


def fruit_bowl(rng: np.random.Generator) -> Group:
    """Bowl with fruit."""
    r, h = rng.uniform(0.1, 0.14), rng.uniform(0.06, 0.09)
    outer = [(r * 0.6, 0), (r * 0.88, h * 0.5), (r, h)]
    holder = _round_shell(rng, "bowl", outer, 0.007, 0.8, colours.ceramic(rng))
    group = [holder]
    count = int(rng.integers(1, 5))
    for k in range(count):
        angle = 2 * np.pi * k / count
        reach = 0.0 if count == 1 else 0.052
        item = fruit(rng)[0]
        group.append(
            _at(
                item,
                reach * np.cos(angle),
                reach * np.sin(angle),
                0.02 + 0.02 * (k % 2),
                angle + np.pi / 2,
            )
        )
    return group


def place_setting(rng: np.random.Generator) -> Group:
    """Plate with a bowl or cup on it, and often a cup beside it."""
    dish = plate(rng)[0]
    group = [dish]
    if rng.random() < 0.6:
        above = (bowl if rng.random() < 0.6 else cup)(rng)[0]
        if above.label == "bowl" and above.bounds()[1][0] > dish.bounds()[1][0]:
            above = cup(rng)[0]
        group.append(_at(above, z=0.0095 + GAP_M, yaw=rng.uniform(0, 6)))
    if rng.random() < 0.6:
        group.append(
            _at(
                cup(rng)[0],
                dish.bounds()[1][0] + rng.uniform(0.06, 0.11),
                rng.uniform(0, 0.06),
                0,
                rng.uniform(0, 6),
            )
        )
    return group


def laptop(rng: np.random.Generator) -> Group:
    """Open laptop."""
    w, d = rng.uniform(0.3, 0.37), rng.uniform(0.21, 0.25)
    lean = rng.uniform(0.15, 0.45)
    lid = turn(0, 0, -lean)
    centre = np.array([0, d / 2, 0.018]) + lid @ [0, 0, d / 2]
    screen = np.array([0, d / 2, 0.018]) + lid @ [0, -0.0045, d / 2]
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, 0.018)),
        box(
            (-w / 2 + 0.02, -d / 2 + 0.08, 0.018),
            (w / 2 - 0.02, d / 2 - 0.02, 0.019),
            1,
            collides=False,
        ),
        Part("box", (w / 2, 0.004, d / 2), tuple(centre), lid),
        Part("box", (w / 2 - 0.01, 0.001, d / 2 - 0.01), tuple(screen), lid, 1, collides=False),
    ]
    return [Item("laptop", "small", parts, [colours.metal(rng), colours.dark()], 1.6)]


def keyboard(rng: np.random.Generator) -> Group:
    """Keyboard."""
    w, d = rng.uniform(0.32, 0.44), rng.uniform(0.12, 0.15)
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, 0.018)),
        box(
            (-w / 2 + 0.01, -d / 2 + 0.01, 0.018),
            (w / 2 - 0.01, d / 2 - 0.01, 0.024),
            1,
            collides=False,
        ),
    ]
    keys = Material((0.3, 0.3, 0.3), (0.05, 0.05, 0.05), colours.CHECKS, 0.018)
    return [Item("computer-keyboard", "small", parts, [colours.metal(rng), keys], 0.7)]


def monitor(rng: np.random.Generator) -> Group:
    """Screen on a foot."""
    w = rng.uniform(0.42, 0.65)
    return [_screen(rng, "monitor", w, 0.08)]


def television(rng: np.random.Generator) -> Group:
    """Large screen on a foot."""
    return [_screen(rng, "tv-screen", rng.uniform(0.7, 1.1), 0.06)]


def _screen(rng: np.random.Generator, label: str, w: float, lift: float) -> Item:
    h = w * 0.58
    parts = [
        box((-w * 0.22, -0.09, 0), (w * 0.22, 0.09, 0.012), 1),
        box((-0.03, 0.01, 0.012), (0.03, 0.03, lift + h * 0.4), 1),
        box((-w / 2, -0.015, lift), (w / 2, 0.015, lift + h), 1),
        box(
            (-w / 2 + 0.012, -0.018, lift + 0.012),
            (w / 2 - 0.012, -0.015, lift + h - 0.012),
            0,
            collides=False,
        ),
    ]
    return Item(label, "screen", parts, [colours.dark(), colours.metal(rng)], 6)


def remote(rng: np.random.Generator) -> Group:
    """Remote control or phone."""
    if rng.random() < 0.5:
        parts = [
            box((-0.022, -0.085, 0), (0.022, 0.085, 0.02)),
            box((-0.015, -0.07, 0.02), (0.015, 0.06, 0.023), 1, collides=False),
        ]
        return [
            Item(
                "remote-control",
                "small",
                parts,
                [
                    colours.dark(),
                    colours.paint(rng, patterns=(colours.CHECKS,), scale_m=(0.01, 0.012)),
                ],
                0.15,
            )
        ]
    parts = [
        box((-0.037, -0.075, 0), (0.037, 0.075, 0.009)),
        box((-0.034, -0.072, 0.009), (0.034, 0.072, 0.0095), 1, collides=False),
    ]
    return [Item("phone", "small", parts, [colours.paint(rng), colours.dark()], 0.2)]


def towel(rng: np.random.Generator) -> Group:
    """Folded towel."""
    w, d, h = rng.uniform(0.14, 0.26), rng.uniform(0.12, 0.2), rng.uniform(0.025, 0.07)
    cloth = colours.fabric(rng)
    parts = [
        Part("ellipsoid", (w / 2, d / 2, h * 0.62), (0, 0, h / 2), collides=False, visible=False)
    ]
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, h / 2 - 0.002)),
        box((-w / 2 + 0.005, -d / 2 + 0.004, h / 2), (w / 2 - 0.003, d / 2 - 0.006, h)),
    ]
    parts.append(
        box((-w / 2 + 0.01, -d / 2 + 0.01, h / 2 - 0.002), (w / 2 - 0.01, d / 2 - 0.01, h / 2))
    )
    return [Item("towel", "small", parts, [cloth], 0.3)]


def pillow(rng: np.random.Generator) -> Group:
    """Pillow that lies."""
    w, d, h = rng.uniform(0.32, 0.5), rng.uniform(0.3, 0.42), rng.uniform(0.1, 0.15)
    parts = [
        Part(
            "lathe", (), collides=False, visible=False, profile=np.array([[0.0, 0.0], [0.1, 0.0]])
        ),
        Part("ellipsoid", (w * 0.54, d * 0.54, h / 2), (0, 0, h / 2), collides=False),
        box((-w / 2, -d / 2, h * 0.32), (w / 2, d / 2, h * 0.68)),
        box((-w * 0.36, -d * 0.36, 0.002), (w * 0.36, d * 0.36, h - 0.002), visible=False),
    ]
    return [Item("cushion", "small", parts[1:], [colours.fabric(rng)], 0.5)]


def toy(rng: np.random.Generator) -> Group:
    """Sitting toy bear, or a toy brick."""
    s = rng.uniform(0.6, 1.4)
    body = [
        Part("ellipsoid", (0.05 * s, 0.045 * s, 0.06 * s), (0, 0, 0.06 * s)),
        Part("ellipsoid", (0.038 * s, 0.036 * s, 0.036 * s), (0, 0, 0.145 * s)),
        box((-0.045 * s, -0.045 * s, 0), (0.045 * s, 0.045 * s, 0.03 * s), visible=False),
    ]
    for x in (-1, 1):
        body += [
            Part(
                "ellipsoid",
                (0.014 * s, 0.008 * s, 0.014 * s),
                (x * 0.03 * s, 0, 0.18 * s),
                collides=False,
            ),
            Part(
                "ellipsoid", (0.018 * s, 0.045 * s, 0.018 * s), (x * 0.03 * s, -0.05 * s, 0.018 * s)
            ),
            Part(
                "ellipsoid",
                (0.015 * s, 0.03 * s, 0.015 * s),
                (x * 0.052 * s, -0.02 * s, 0.08 * s),
                collides=False,
            ),
        ]
    fur = colours.paint(rng, saturation=(0.2, 0.8), patterns=(colours.SPECKLES,))
    return [Item("teddy-bear", "small", body, [fur], 0.25)]


def shoe(rng: np.random.Generator) -> Group:
    """Shoe."""
    d = rng.uniform(0.2, 0.28)
    parts = [
        box((-0.04, -d / 2, 0), (0.04, d / 2, 0.025), 1),
        box((-0.037, 0, 0.025), (0.037, d / 2 - 0.01, 0.09)),
        Part("ellipsoid", (0.037, d / 3.2, 0.04), (0, -d / 2 + d / 3.1, 0.028), collides=False),
    ]
    return [Item("shoe", "small", parts, [colours.paint(rng), colours.metal(rng)], 0.4)]


def shoes(rng: np.random.Generator) -> Group:
    """Pair of shoes."""
    seed = int(rng.integers(1 << 30))
    pair = [shoe(np.random.default_rng(seed))[0] for _ in range(2)]
    return [
        _at(pair[0], -0.06, 0),
        _at(pair[1], 0.06, rng.uniform(-0.04, 0.04), 0, rng.normal(0, 0.15)),
    ]


def bag(rng: np.random.Generator, scale: float = 1.0) -> Group:
    """Bag that stands, with a handle."""
    w, d, h = (
        rng.uniform(0.2, 0.32) * scale,
        rng.uniform(0.1, 0.16) * scale,
        rng.uniform(0.18, 0.3) * scale,
    )
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, h * 0.8)),
        box((-w * 0.42, -d * 0.38, h * 0.8), (w * 0.42, d * 0.38, h)),
        box((-w * 0.35, -d / 2 - 0.015, h * 0.1), (w * 0.35, -d / 2, h * 0.5), 1),
        box((-0.05, -0.008, h + 0.035), (0.05, 0.008, h + 0.047), 1, collides=False),
        box((-0.05, -0.008, h), (-0.04, 0.008, h + 0.04), 1, collides=False),
        box((0.04, -0.008, h), (0.05, 0.008, h + 0.04), 1, collides=False),
    ]
    label = "backpack" if rng.random() < 0.5 else "handbag"
    return [Item(label, "small", parts, [colours.fabric(rng), colours.fabric(rng)], 2.0)]


def floor_bag(rng: np.random.Generator) -> Group:
    """Large bag."""
    return bag(rng, 1.35)


def table_lamp(rng: np.random.Generator) -> Group:
    """Lamp with a shade."""
    h, r = rng.uniform(0.3, 0.5), rng.uniform(0.08, 0.14)
    shade = [(r, h * 0.6), (r * rng.uniform(0.6, 1), h)]
    parts = [
        upright(0.07, 0, 0.02),
        upright(0.016 if rng.random() < 0.5 else 0.04, 0.02, h * 0.62),
        _lathe([(shade[0][0] - 0.004, shade[0][1]), *shade, (shade[1][0] - 0.004, h)], 1),
        upright(r, h * 0.6, h, visible=False),
    ]
    return [
        Item(
            "lamp",
            "small",
            parts,
            [colours.ceramic(rng), colours.paint(rng, value=(0.5, 0.9))],
            1.5,
        )
    ]


def desk_clock(rng: np.random.Generator) -> Group:
    """Clock that stands."""
    w, d, h = rng.uniform(0.09, 0.16), 0.05, rng.uniform(0.09, 0.14)
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, h)),
        box((-w * 0.4, -d / 2 - 0.002, h * 0.15), (w * 0.4, -d / 2, h * 0.85), 1, collides=False),
        box(
            (-0.003, -d / 2 - 0.004, h * 0.5), (0.003, -d / 2 - 0.002, h * 0.78), 2, collides=False
        ),
    ]
    return [
        Item(
            "clock", "small", parts, [colours.wood(rng), colours.ceramic(rng), colours.dark()], 0.5
        )
    ]


def microwave(rng: np.random.Generator) -> Group:
    """Microwave oven."""
    w, d, h = rng.uniform(0.44, 0.52), rng.uniform(0.3, 0.36), rng.uniform(0.26, 0.3)
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, h)),
        box((-w / 2 + 0.02, -d / 2 - 0.01, 0.02), (w / 2 - 0.12, -d / 2, h - 0.02), 1),
        box(
            (w / 2 - 0.1, -d / 2 - 0.004, 0.03), (w / 2 - 0.02, -d / 2, h - 0.03), 2, collides=False
        ),
    ]
    return [
        Item(
            "microwave",
            "small",
            parts,
            [colours.metal(rng), colours.dark(), colours.metal(rng)],
            11,
        )
    ]


def umbrella_basket(rng: np.random.Generator) -> Group:
    """High basket with an umbrella that leans in it."""
    weave = colours.paint(
        rng, saturation=(0.3, 0.6), patterns=(colours.CHECKS,), scale_m=(0.02, 0.03)
    )
    holder = _round_shell(rng, "basket", [(0.12, 0), (0.13, 0.42)], 0.01, 3.0, weave, 12)
    h = rng.uniform(0.75, 0.9)
    rod = [
        Part("capsule", (0.03, h / 2 - 0.15), (0, 0, h / 2 - 0.05)),
        upright(0.008, h - 0.25, h, material=1),
        upright(0.016, h - 0.09, h, material=1),
        upright(0.008, 0, 0.1, material=1),
    ]
    item = Item("umbrella", "small", rod, [colours.fabric(rng), colours.dark()], 0.6)
    return [holder, _at(item, 0.02, 0, 0.02)]


def board(rng: np.random.Generator) -> Group:
    """Flat board that can lean; it stands on its long edge."""
    w, h = rng.uniform(0.35, 0.9), rng.uniform(0.4, 0.8)
    parts = [
        box((-w / 2, -0.01, 0), (w / 2, 0.01, h)),
        box((-w / 2 + 0.03, -0.012, 0.03), (w / 2 - 0.03, -0.01, h - 0.03), 1, collides=False),
    ]
    materials = [
        colours.wood(rng),
        colours.paint(rng, patterns=(colours.PRINT, colours.GRADIENT), scale_m=(0.05, 0.2)),
    ]
    return [Item("board", "small", parts, materials, 1.5)]


def extent(group: Group) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of a group in its own frame."""
    points = []
    for item in group:
        local = item.vertices(placed=False) @ item.rotation.T + item.position
        if item.holder is not None:
            local = local @ item.holder.rotation.T + item.holder.position
        points.append(local)
    stacked = np.concatenate(points)
    return stacked.min(0), stacked.max(0)


def solid_extent(item: Item) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of what collides, in the frame of the item."""
    points = np.concatenate([p.mesh.vertices for p in item.parts if p.collides])
    return points.min(0), points.max(0)
