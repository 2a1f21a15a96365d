"""Furniture: pieces that stand on the floor, hang on a wall or hang from the ceiling.

The front of a piece faces −y in its own frame, its back is at +y.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from . import colours
from .shapes import Cavity, Item, Part, Top, box, ring, turn, upright

Maker = Callable[[np.random.Generator], Item]


def _legs(w: float, d: float, top: float, t: float, rng: np.random.Generator) -> list[Part]:
    inset = t + rng.uniform(0.0, 0.04)
    places = [
        (x, y) for x in (-w / 2 + inset, w / 2 - inset) for y in (-d / 2 + inset, d / 2 - inset)
    ]
    if rng.random() < 0.4:
        return [upright(t, 0, top, at, 1) for at in places]
    return [box((x - t, y - t, 0), (x + t, y + t, top), 1) for x, y in places]


def table(rng: np.random.Generator) -> Item:
    """Dining table: rectangular with four legs, or round with a column."""
    h, t = rng.uniform(0.7, 0.78), rng.uniform(0.02, 0.045)
    materials = [colours.wood(rng), colours.wood(rng)]
    if rng.random() < 0.35:
        r = rng.uniform(0.4, 0.62)
        parts = [upright(r, h - t, h), upright(0.05, 0.03, h - t, material=1)]
        parts += [upright(r * 0.55, 0, 0.03, material=1)]
        return Item(
            "table", "furn", parts, materials, 30, tops=[Top((0, 0), (r, r), h, round=True)]
        )
    w, d = rng.uniform(0.9, 1.8), rng.uniform(0.65, 0.95)
    parts = [box((-w / 2, -d / 2, h - t), (w / 2, d / 2, h)), *_legs(w, d, h - t, 0.03, rng)]
    return Item("table", "furn", parts, materials, 30, tops=[Top((0, 0), (w / 2, d / 2), h)])


def low_table(rng: np.random.Generator) -> Item:
    """Coffee or side table, sometimes with a second board."""
    w, d, h = rng.uniform(0.45, 1.1), rng.uniform(0.4, 0.6), rng.uniform(0.35, 0.55)
    t = rng.uniform(0.02, 0.04)
    parts = [box((-w / 2, -d / 2, h - t), (w / 2, d / 2, h)), *_legs(w, d, h - t, 0.02, rng)]
    tops = [Top((0, 0), (w / 2, d / 2), h)]
    if rng.random() < 0.3:
        parts.append(box((-w / 2 + 0.04, -d / 2 + 0.04, 0.12), (w / 2 - 0.04, d / 2 - 0.04, 0.14)))
        tops.append(Top((0, 0), (w / 2 - 0.08, d / 2 - 0.08), 0.14, h - t - 0.15))
    return Item("table", "furn", parts, [colours.wood(rng), colours.wood(rng)], 15, tops=tops)


def desk(rng: np.random.Generator) -> Item:
    """Desk with a drawer block on one side."""
    w, d, h = rng.uniform(1.0, 1.7), rng.uniform(0.55, 0.8), rng.uniform(0.7, 0.78)
    side = rng.choice([-1, 1])
    block = sorted([side * (w / 2 - 0.02), side * (w / 2 - 0.4)])
    parts = [
        box((-w / 2, -d / 2, h - 0.03), (w / 2, d / 2, h)),
        box((block[0], -d / 2 + 0.03, 0.02), (block[1], d / 2 - 0.02, h - 0.03), 1),
    ]
    parts += [
        box((block[0] + 0.03, -d / 2 + 0.018, z), (block[1] - 0.03, -d / 2 + 0.03, z + 0.17), 2)
        for z in np.arange(0.08, h - 0.22, 0.2)
    ]
    x = -side * (w / 2 - 0.04)
    parts += [
        box((x - 0.02, y - 0.02, 0), (x + 0.02, y + 0.02, h - 0.03), 1)
        for y in (0.03 - d / 2, d / 2 - 0.03)
    ]
    materials = [colours.wood(rng), colours.wood(rng), colours.wood(rng)]
    return Item("desk", "furn", parts, materials, 35, tops=[Top((0, 0), (w / 2, d / 2), h)])


def bench(rng: np.random.Generator) -> Item:
    """Bench without a back."""
    w, d, h = rng.uniform(0.8, 1.4), rng.uniform(0.3, 0.42), rng.uniform(0.4, 0.48)
    parts = [box((-w / 2, -d / 2, h - 0.04), (w / 2, d / 2, h)), *_legs(w, d, h - 0.04, 0.025, rng)]
    return Item(
        "bench",
        "furn",
        parts,
        [colours.wood(rng), colours.wood(rng)],
        12,
        tops=[Top((0, 0), (w / 2, d / 2), h)],
    )


def chair(rng: np.random.Generator) -> Item:
    """Chair with a closed or slatted back."""
    w, d = rng.uniform(0.38, 0.48), rng.uniform(0.38, 0.48)
    h, top = rng.uniform(0.42, 0.48), rng.uniform(0.8, 1.02)
    t = 0.018
    parts = [box((-w / 2, -d / 2, h - 0.04), (w / 2, d / 2, h)), *_legs(w, d, h - 0.04, t, rng)]
    for x in (-w / 2 + t, w / 2 - t):
        parts.append(box((x - t, d / 2 - 2 * t, h), (x + t, d / 2, top), 1))
    if rng.random() < 0.5:
        parts.append(
            box((-w / 2 + 2 * t, d / 2 - 0.03, h + 0.1), (w / 2 - 2 * t, d / 2 - 0.005, top))
        )
    else:
        for z in np.linspace(h + 0.12, top - 0.07, rng.integers(2, 5)):
            parts.append(
                box((-w / 2 + 2 * t, d / 2 - 0.028, z), (w / 2 - 2 * t, d / 2 - 0.008, z + 0.05))
            )
    seat = Top((0, -0.03), (w / 2 - 0.01, d / 2 - 0.04), h)
    material = colours.wood(rng) if rng.random() < 0.6 else colours.fabric(rng)
    return Item("chair", "furn", parts, [material, colours.wood(rng)], 6, tops=[seat])


def armchair(rng: np.random.Generator) -> Item:
    """Upholstered chair for one person."""
    return _upholstered("armchair", rng.uniform(0.7, 0.9), rng)


def couch(rng: np.random.Generator) -> Item:
    """Couch for two or three people."""
    return _upholstered("sofa", rng.uniform(1.4, 2.1), rng)


def _upholstered(label: str, w: float, rng: np.random.Generator) -> Item:
    d, h = rng.uniform(0.78, 0.92), rng.uniform(0.38, 0.46)
    arm, back = rng.uniform(0.1, 0.2), rng.uniform(0.16, 0.24)
    top = rng.uniform(0.72, 0.9)
    parts = [
        box((-w / 2, -d / 2, 0.06), (w / 2, d / 2, h - 0.12)),
        box((-w / 2, -d / 2, 0.0), (w / 2, d / 2, 0.06), 1),
        box((-w / 2, d / 2 - back, h - 0.12), (w / 2, d / 2, top)),
    ]
    for x in (-w / 2, w / 2 - arm):
        parts.append(box((x, -d / 2, h - 0.12), (x + arm, d / 2 - back, rng.uniform(0.55, 0.62))))
    seats = max(1, int(round((w - 2 * arm) / 0.65)))
    edges = np.linspace(-w / 2 + arm, w / 2 - arm, seats + 1)
    for a, b in zip(edges, edges[1:]):
        parts.append(box((a + 0.004, -d / 2 - 0.01, h - 0.12), (b - 0.004, d / 2 - back, h)))
    cloth = colours.fabric(rng)
    seat = Top((0, -back / 2), (w / 2 - arm - 0.02, (d - back) / 2 - 0.02), h)
    return Item(label, "furn", parts, [cloth, colours.wood(rng)], 50, tops=[seat])


def bed(rng: np.random.Generator) -> Item:
    """Bed with a head board."""
    w, d, h = rng.choice([0.95, 1.2, 1.45]), rng.uniform(1.9, 2.05), rng.uniform(0.42, 0.58)
    parts = [
        box((-w / 2, -d / 2, 0.08), (w / 2, d / 2, 0.28), 1),
        box((-w / 2 + 0.02, -d / 2 + 0.02, 0.28), (w / 2 - 0.02, d / 2 - 0.03, h)),
        box((-w / 2, d / 2 - 0.02, 0.0), (w / 2, d / 2 + 0.03, rng.uniform(0.8, 1.1)), 1),
        box((-w / 2, -d / 2, 0), (-w / 2 + 0.06, -d / 2 + 0.06, 0.1), 1),
        box((w / 2 - 0.06, -d / 2, 0), (w / 2, -d / 2 + 0.06, 0.1), 1),
        box(
            (-w / 2 + 0.015, -d / 2 + 0.015, h),
            (w / 2 - 0.015, d / 6, h + 0.012),
            2,
            collides=False,
        ),
    ]
    materials = [colours.fabric(rng), colours.wood(rng), colours.fabric(rng)]
    return Item(
        "bed",
        "furn",
        parts,
        materials,
        60,
        tops=[Top((0, 0.1), (w / 2 - 0.05, d / 2 - 0.2), h + 0.012)],
    )


def _front(
    w: float, front: float, low: float, high: float, columns: int, rows: int, material: int
) -> list[Part]:
    """Doors or drawers with handles on the front of a closed body."""
    parts = []
    xs, zs = np.linspace(-w / 2, w / 2, columns + 1), np.linspace(low, high, rows + 1)
    for a, b in zip(xs, xs[1:]):
        for c, e in zip(zs, zs[1:]):
            parts.append(
                box((a + 0.008, front - 0.014, c + 0.008), (b - 0.008, front, e - 0.008), material)
            )
            z = (c + e) / 2
            parts.append(
                box(
                    (b - 0.06, front - 0.03, z - 0.04),
                    (b - 0.045, front - 0.014, z + 0.04),
                    2,
                    collides=False,
                )
            )
    return parts


def _cupboard(
    label: str,
    kind: str,
    size: tuple[float, float, float],
    grid: tuple[int, int],
    rng: np.random.Generator,
) -> Item:
    w, d, h = size
    foot = 0.05 if kind == "furn" else 0.0
    parts = [box((-w / 2, -d / 2 + 0.014, foot), (w / 2, d / 2, h))]
    if foot:
        parts.append(box((-w / 2 + 0.02, -d / 2 + 0.05, 0), (w / 2 - 0.02, d / 2, foot), 2))
    parts += _front(w, -d / 2 + 0.014, foot + 0.01, h - 0.01, *grid, 1)
    body = colours.wood(rng)
    materials = [body, body if rng.random() < 0.6 else colours.wood(rng), colours.metal(rng)]
    return Item(label, kind, parts, materials, 40, tops=[Top((0, 0), (w / 2, d / 2 - 0.01), h)])


def cabinet(rng: np.random.Generator) -> Item:
    """Low or middle-high cabinet with doors or drawers."""
    w, d, h = rng.uniform(0.4, 1.3), rng.uniform(0.35, 0.5), rng.uniform(0.5, 1.15)
    grid = (max(1, round(w / 0.45)), int(rng.integers(1, 4)))
    return _cupboard("cabinet", "furn", (w, d, h), grid, rng)


def wardrobe(rng: np.random.Generator) -> Item:
    """Tall cabinet."""
    w, d, h = rng.uniform(0.6, 1.3), rng.uniform(0.45, 0.6), rng.uniform(1.6, 2.1)
    item = _cupboard("wardrobe", "furn", (w, d, h), (max(1, round(w / 0.5)), 1), rng)
    item.tops = []
    return item


def nightstand(rng: np.random.Generator) -> Item:
    """Small closed stand."""
    size = rng.uniform(0.36, 0.5), rng.uniform(0.33, 0.42), rng.uniform(0.42, 0.62)
    return _cupboard("nightstand", "furn", size, (1, int(rng.integers(1, 3))), rng)


def tv_stand(rng: np.random.Generator) -> Item:
    """Long and low cabinet."""
    w = rng.uniform(0.9, 1.6)
    size = w, rng.uniform(0.35, 0.45), rng.uniform(0.4, 0.6)
    return _cupboard("tv-stand", "furn", size, (max(2, round(w / 0.5)), 1), rng)


def base_cabinet(rng: np.random.Generator, w: float) -> Item:
    """Kitchen cabinet that carries a counter; open at the top, because a sink hangs into it."""
    item = _cupboard("base-cabinet", "furn", (w, 0.58, 0.86), (max(1, round(w / 0.5)), 1), rng)
    floor, t = 0.6, 0.018
    front = -0.29 + 0.014
    item.parts[0] = box((-w / 2, front, 0.05), (w / 2, 0.29, floor))
    item.parts += [
        box((-w / 2, front, floor), (-w / 2 + t, 0.29, 0.86)),
        box((w / 2 - t, front, floor), (w / 2, 0.29, 0.86)),
        box((-w / 2 + t, front, floor), (w / 2 - t, front + t, 0.86)),
        box((-w / 2 + t, 0.29 - t, floor), (w / 2 - t, 0.29, 0.86)),
    ]
    return item


def wall_cabinet(rng: np.random.Generator) -> Item:
    """Cabinet on the wall; the bottom is z = 0 in its frame."""
    w = rng.uniform(0.6, 1.6)
    item = _cupboard(
        "wall-cabinet",
        "wallm",
        (w, rng.uniform(0.3, 0.36), rng.uniform(0.45, 0.7)),
        (max(1, round(w / 0.45)), 1),
        rng,
    )
    item.tops = []
    return item


def counter(rng: np.random.Generator, w: float, with_sink: bool) -> list[Item]:
    """Counter top, and a sink welded into it."""
    t, d, x = 0.04, 0.62, 0.0
    materials = [colours.wood(rng) if rng.random() < 0.5 else colours.metal(rng)]
    if not with_sink:
        top = Top((0, 0), (w / 2, d / 2), t)
        parts = [box((-w / 2, -d / 2, 0), (w / 2, d / 2, t))]
        return [Item("countertop", "furn", parts, materials, 40, tops=[top])]
    x = rng.uniform(-0.5, 0.5) * (w - 0.8)
    half = rng.uniform(0.2, 0.26), rng.uniform(0.16, 0.2)
    a, b = x - half[0], x + half[0]
    front, back = -half[1], half[1]
    parts = [
        box((-w / 2, -d / 2, 0), (a, d / 2, t)),
        box((b, -d / 2, 0), (w / 2, d / 2, t)),
        box((a, -d / 2, 0), (b, front, t)),
        box((a, back, 0), (b, d / 2, t)),
    ]
    left, right = (a - 0.02 + w / 2) / 2, (w / 2 - b - 0.02) / 2
    tops = [
        Top(((-w / 2 + a) / 2 - 0.01, 0), (left, d / 2), t),
        Top(((w / 2 + b) / 2 + 0.01, 0), (right, d / 2), t),
    ]
    board = Item(
        "countertop", "furn", parts, materials, 40, tops=[top for top in tops if top.half[0] > 0.1]
    )
    return [board, _sink(rng, (x, t), half, board)]


def _sink(
    rng: np.random.Generator, place: tuple[float, float], half: tuple[float, float], board: Item
) -> Item:
    x, top = place
    w, d, deep, t = half[0], half[1], 0.16, 0.012
    parts = [
        box((-w, -d, 0), (w, d, t)),
        box((-w, -d, t), (-w + t, d, deep)),
        box((w - t, -d, t), (w, d, deep)),
        box((-w, -d, t), (w, -d + t, deep)),
        box((-w, d - t, t), (w, d, deep)),
        box((-w - 0.02, d, deep - 0.004), (w + 0.02, d + 0.03, deep + 0.004)),
        box((-w - 0.02, -d - 0.02, deep - 0.004), (w + 0.02, -d, deep + 0.004)),
        box((-w - 0.02, -d, deep - 0.004), (-w, d, deep + 0.004)),
        box((w, -d, deep - 0.004), (w + 0.02, d, deep + 0.004)),
        upright(0.013, deep, deep + 0.24, (0, d + 0.015), 1),
        box((-0.012, -0.03, deep + 0.22), (0.012, d + 0.015, deep + 0.24), 1),
    ]
    steel = colours.metal(rng)
    item = Item(
        "sink",
        "furn",
        parts,
        [steel, colours.metal(rng)],
        5,
        [Cavity((0, 0), (w - t, d - t), t, deep)],
    )
    item.tops = [Top((0, 0), (w - t - 0.01, d - t - 0.01), t, 0.4)]
    item.anchor, item.holder = "item", board
    item.position = np.array([x, 0.0, top - deep + 0.003])
    return item


def shelf(rng: np.random.Generator) -> Item:
    """Open shelf or bookshelf with several boards."""
    w, d, h = rng.uniform(0.6, 1.2), rng.uniform(0.26, 0.38), rng.uniform(0.8, 1.9)
    t = 0.022
    boards = max(2, int(h / rng.uniform(0.3, 0.4)))
    zs = np.linspace(0.06, h - t, boards + 1)
    parts = [
        box((-w / 2, -d / 2, 0), (-w / 2 + t, d / 2, h)),
        box((w / 2 - t, -d / 2, 0), (w / 2, d / 2, h)),
    ]
    tops = []
    for k, z in enumerate(zs):
        parts.append(box((-w / 2 + t, -d / 2, z), (w / 2 - t, d / 2, z + t)))
        room = zs[k + 1] - z - t if k + 1 < len(zs) else 1.0
        if z < 1.6:
            tops.append(Top((0, -0.01), (w / 2 - t - 0.01, d / 2 - 0.02), z + t, room))
    if rng.random() < 0.6:
        parts.append(box((-w / 2 + t, d / 2 - 0.01, 0.06), (w / 2 - t, d / 2, h), 1))
    return Item("shelf", "furn", parts, [colours.wood(rng), colours.wood(rng)], 30, tops=tops)


def wall_shelf(rng: np.random.Generator) -> Item:
    """Board on the wall with two brackets."""
    w, d = rng.uniform(0.5, 1.1), rng.uniform(0.2, 0.28)
    parts = [box((-w / 2, -d / 2, 0.08), (w / 2, d / 2, 0.105))]
    parts += [
        box((x - 0.012, d / 2 - 0.02 - d * 0.6, 0), (x + 0.012, d / 2, 0.08), 1)
        for x in (-w / 3, w / 3)
    ]
    return Item(
        "shelf",
        "wallm",
        parts,
        [colours.wood(rng), colours.metal(rng)],
        5,
        tops=[Top((0, 0), (w / 2, d / 2 - 0.01), 0.105, 0.6)],
    )


def refrigerator(rng: np.random.Generator) -> Item:
    """Refrigerator with one or two doors."""
    size = rng.uniform(0.55, 0.75), rng.uniform(0.58, 0.68), rng.uniform(1.3, 1.9)
    item = _cupboard("refrigerator", "furn", size, (1, 2), rng)
    item.materials = [colours.metal(rng)] * 2 + [colours.metal(rng)]
    item.tops = []
    return item


def oven(rng: np.random.Generator) -> Item:
    """Oven with a cooktop."""
    w, d, h = 0.6, 0.6, rng.uniform(0.85, 0.92)
    parts = [
        box((-w / 2, -d / 2 + 0.02, 0), (w / 2, d / 2, h)),
        box((-w / 2 + 0.03, -d / 2, 0.15), (w / 2 - 0.03, -d / 2 + 0.02, h - 0.15), 1),
        box(
            (-w / 2 + 0.08, -d / 2 - 0.02, h - 0.2),
            (w / 2 - 0.08, -d / 2, h - 0.18),
            2,
            collides=False,
        ),
    ]
    parts += [
        upright(0.08, h, h + 0.002, (x, y), 1, collides=False)
        for x in (-0.15, 0.15)
        for y in (-0.12, 0.14)
    ]
    materials = [colours.metal(rng), colours.dark(), colours.metal(rng)]
    return Item(
        "oven", "furn", parts, materials, 40, tops=[Top((0, 0), (w / 2, d / 2 - 0.02), h + 0.001)]
    )


def stool(rng: np.random.Generator) -> Item:
    """Stool with a round or square seat."""
    r, h = rng.uniform(0.15, 0.2), rng.uniform(0.42, 0.65)
    square = rng.random() < 0.4
    seat = box((-r, -r, h - 0.035), (r, r, h)) if square else upright(r, h - 0.035, h)
    s = r * (0.9 if square else 0.62)
    legs = [
        upright(0.016, 0, h - 0.035, (x, y), 1)
        for x in (-s + 0.02, s - 0.02)
        for y in (-s + 0.02, s - 0.02)
    ]
    material = colours.wood(rng) if rng.random() < 0.6 else colours.fabric(rng)
    return Item(
        "stool",
        "furn",
        [seat, *legs],
        [material, colours.wood(rng)],
        4,
        tops=[Top((0, 0), (r, r), h, round=not square)],
    )


def plant_stand(rng: np.random.Generator) -> Item:
    """High and small stand."""
    r, h = rng.uniform(0.15, 0.2), rng.uniform(0.5, 0.9)
    parts = [
        upright(r, h - 0.025, h),
        upright(0.03, 0.02, h - 0.025, material=1),
        upright(r * 0.9, 0, 0.02, material=1),
    ]
    return Item(
        "plant-stand",
        "furn",
        parts,
        [colours.wood(rng), colours.metal(rng)],
        5,
        tops=[Top((0, 0), (r, r), h, round=True)],
    )


def floor_lamp(rng: np.random.Generator) -> Item:
    """Lamp on a long pole."""
    h, r = rng.uniform(1.3, 1.7), rng.uniform(0.13, 0.2)
    parts = [
        upright(0.14, 0, 0.025),
        upright(0.015, 0.025, h - 0.2),
        upright(r, h - 0.28, h, material=1),
    ]
    return Item(
        "lamp", "furn", parts, [colours.metal(rng), colours.paint(rng, value=(0.5, 0.9))], 4
    )


def pendant_lamp(rng: np.random.Generator) -> Item:
    """Lamp that hangs from the ceiling; z = 0 is its lowest point."""
    r = rng.uniform(0.13, 0.25)
    parts = [upright(r, 0, rng.uniform(0.15, 0.25)), upright(0.008, 0.15, 2.0, material=1)]
    return Item("lamp", "wallm", parts, [colours.paint(rng, value=(0.5, 0.9)), colours.dark()], 2)


def wall_screen(rng: np.random.Generator) -> Item:
    """Flat television on the wall."""
    w = rng.uniform(0.7, 1.25)
    h = w * 0.58
    parts = [
        box((-w / 2, -0.02, 0), (w / 2, 0.02, h), 1),
        box((-w / 2 + 0.012, -0.024, 0.012), (w / 2 - 0.012, -0.02, h - 0.012), 0, collides=False),
    ]
    return Item("tv-screen", "wallm", parts, [colours.dark(), colours.metal(rng)], 8)


def picture(rng: np.random.Generator) -> Item:
    """Framed picture."""
    w, h = rng.uniform(0.25, 0.8), rng.uniform(0.25, 0.65)
    parts = [
        box((-w / 2, -0.012, 0), (w / 2, 0.012, h), 1),
        box((-w / 2 + 0.03, -0.015, 0.03), (w / 2 - 0.03, -0.012, h - 0.03), 0, collides=False),
    ]
    art = colours.paint(
        rng, patterns=(colours.PRINT, colours.CHECKS, colours.GRADIENT), scale_m=(0.05, 0.2)
    )
    return Item("picture", "wallm", parts, [art, colours.wood(rng)], 2)


def wall_clock(rng: np.random.Generator) -> Item:
    """Round clock on the wall."""
    r = rng.uniform(0.11, 0.18)
    disc = Part("cylinder", (r, 0.02), (0, 0, r), turn(0, 0, np.pi / 2))
    face = Part(
        "cylinder", (r * 0.88, 0.003), (0, -0.021, r), turn(0, 0, np.pi / 2), 1, collides=False
    )
    hand = box((-0.006, -0.03, r), (0.006, -0.024, r * 1.7), 0, collides=False)
    other = box((-0.004, -0.03, r - 0.006), (r * 0.5, -0.024, r + 0.006), 0, collides=False)
    return Item(
        "clock", "wallm", [disc, face, hand, other], [colours.paint(rng), colours.metal(rng)], 1
    )


def door(rng: np.random.Generator) -> Item:
    """Closed door in its frame."""
    w, h = rng.uniform(0.8, 0.95), rng.uniform(1.98, 2.08)
    parts = [
        box((-w / 2, -0.02, 0), (w / 2, 0.03, h)),
        box((-w / 2 - 0.06, -0.03, 0), (-w / 2, 0.03, h + 0.06), 1),
        box((w / 2, -0.03, 0), (w / 2 + 0.06, 0.03, h + 0.06), 1),
        box((-w / 2, -0.03, h), (w / 2, 0.03, h + 0.06), 1),
        box((w / 2 - 0.12, -0.07, 1.0), (w / 2 - 0.05, -0.02, 1.03), 2),
    ]
    return Item(
        "door", "wallm", parts, [colours.wood(rng), colours.wood(rng), colours.metal(rng)], 30
    )


def rug(rng: np.random.Generator) -> Item:
    """Thin rug; the physics does not see it."""
    w, d = rng.uniform(1.0, 2.2), rng.uniform(0.8, 1.5)
    parts = [box((-w / 2, -d / 2, 0), (w / 2, d / 2, 0.004), collides=False)]
    return Item("rug", "flat", parts, [colours.fabric(rng)], anchor="world")


def window(rng: np.random.Generator) -> list[Item]:
    """Window, often with one or two curtains welded to it."""
    w, h = rng.uniform(0.8, 1.5), rng.uniform(0.9, 1.3)
    t = 0.05
    parts = [
        box((-w / 2, -0.02, 0), (w / 2, 0.02, t), 1),
        box((-w / 2, -0.02, h - t), (w / 2, 0.02, h), 1),
        box((-w / 2, -0.02, t), (-w / 2 + t, 0.02, h - t), 1),
        box((w / 2 - t, -0.02, t), (w / 2, 0.02, h - t), 1),
        box((-0.02, -0.02, t), (0.02, 0.02, h - t), 1),
        box((-w / 2 + t, 0.0, t), (w / 2 - t, 0.02, h - t), 0),
    ]
    glass = colours.paint(
        rng,
        saturation=(0.05, 0.3),
        value=(0.6, 0.95),
        patterns=(colours.GRADIENT,),
        scale_m=(0.3, 0.6),
    )
    pane = Item("window", "wallm", parts, [glass, colours.wood(rng)], 20)
    cloth = colours.fabric(rng)
    curtains = []
    for side in rng.permutation([-1, 1])[: rng.integers(0, 3)]:
        curtains.append(_curtain(rng, int(side), w, h, pane, cloth))
    return [pane, *curtains]


def _curtain(rng, side: int, w: float, h: float, pane: Item, cloth) -> Item:
    wide, low, high = rng.uniform(0.25, 0.45), -rng.uniform(0.05, 0.6), h + 0.08
    folds = 7
    xs = np.linspace(-wide / 2, wide / 2, folds + 1)
    parts = []
    for k, (a, b) in enumerate(zip(xs, xs[1:])):
        y = -0.055 - 0.02 * (k % 2)
        parts.append(box((a, y - 0.012, 0), (b, y + 0.012, high - low)))
    item = Item("curtain", "wallm", parts, [cloth], 2)
    item.anchor, item.holder = "item", pane
    item.position = np.array([side * (w / 2 - wide * 0.25), 0.0, low])
    return item


def bowl_of(radius: float, deep: float, t: float) -> list[Part]:
    """Open round shell for the physics."""
    outer = [(radius * 0.5, 0.0), (radius * 0.85, deep * 0.5), (radius, deep)]
    return [upright(radius * 0.5, 0, t, visible=False), *ring(outer, t)]
