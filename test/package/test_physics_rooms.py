"""tools/physics_rooms: the truth rules on a small scene made by hand."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="tools/physics_rooms alone needs mujoco")

SIZE = (6.0, 6.0, 2.5)


@pytest.fixture(scope="module", autouse=True)
def tool(root_dir):
    """The modules of the tool on the path."""
    folder = str(root_dir / "tools" / "physics_rooms")
    sys.path.insert(0, folder)
    yield
    sys.path.remove(folder)


def at(item: Any, place: tuple[float, float, float], anchor: str = "free") -> Any:
    """The item, with the middle of its bottom at a place."""
    item.position, item.anchor = np.array(place, float), anchor
    return item


def block(label: str, kind: str, place: tuple[float, float, float], half: tuple[float, ...]) -> Any:
    """A box. Furniture and wall things do not move."""
    from physics_room.shapes import Item, Material, box

    x, y, z = half
    item = Item(label, kind, [box((-x, -y, 0), (x, y, 2 * z))], [Material((0.5,) * 3)])
    return at(item, place, "free" if kind in ("small", "screen") else "world")


def table() -> Any:
    from physics_room.shapes import Item, Material, box

    corners = [(x, y) for x in (-0.6, 0.6) for y in (-0.4, 0.4)]
    legs = [box((x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 0.7)) for x, y in corners]
    top = box((-0.65, -0.45, 0.7), (0.65, 0.45, 0.74))
    return at(Item("table", "furn", [top, *legs], [Material((0.5,) * 3)]), (0, 0, 0), "world")


def judge(items: list[Any]) -> Any:
    """The truth of some items, after they have settled."""
    from physics_room.simulate import simulate
    from physics_room.truth import Judge

    for number, item in enumerate(items, start=1):
        item.number = number
    outcome = simulate(items, SIZE)
    assert outcome.resting
    return Judge(items, outcome, {item.number for item in items}).judge()


def stack() -> list[Any]:
    book = block("book", "small", (0, 0, 0.745), (0.1, 0.13, 0.015))
    return [table(), book, block("box", "small", (0, 0, 0.78), (0.05, 0.05, 0.05))]


def beside(space: float) -> list[Any]:
    low = block("cabinet", "furn", (-0.4, 0, 0), (0.4, 0.25, 0.4))
    return [low, block("refrigerator", "furn", (0.3 + space, 0, 0), (0.3, 0.3, 0.8))]


def screen(x: float) -> list[Any]:
    stand = block("tv-stand", "furn", (0, 2.75, 0), (0.5, 0.2, 0.25))
    return [stand, block("tv-screen", "wallm", (x, 2.97, 0.9), (0.4, 0.02, 0.25))]


@pytest.mark.parametrize(
    ("scene", "relations"),
    [
        (stack, {(2, 1): "on", (3, 2): "on"}),
        (lambda: beside(0.02), {(1, 2): "against", (2, 1): None}),
        (lambda: beside(0.12), {(1, 2): "near", (2, 1): "near"}),
        (lambda: beside(0.7), {(1, 2): None, (2, 1): None}),
        (lambda: screen(0.0), {(2, 1): "above", (1, 2): "under"}),
        (lambda: screen(1.8), {(2, 1): None, (1, 2): None}),
    ],
)
def test_relations_of_what_has_settled(scene, relations):
    found = judge(scene()).relations
    assert {pair: found.get(pair) for pair in relations} == relations


def test_a_thing_falls_with_all_that_carries_it():
    physics = judge(stack()).physics
    assert [physics[i]["falls_without"] for i in (2, 3)] == [[1], [1, 2]]
    (support,) = physics[3]["supports"]
    assert (support["id"], support["normal"][2]) == (2, pytest.approx(1.0, abs=0.01))


def test_the_same_seed_gives_the_same_room():
    from physics_room.layout import build_room

    first, second = (build_room(np.random.default_rng(3)).items for _ in range(2))
    assert [i.label for i in first] == [i.label for i in second]
    assert all(np.array_equal(a.position, b.position) for a, b in zip(first, second))
