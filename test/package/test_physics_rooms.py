"""tools/physics_rooms: the truth rules on a small scene made by hand."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "mujoco", reason="tools/physics_rooms needs mujoco, which is no dependency of the package"
)

SIZE = (6.0, 6.0, 2.5)


@pytest.fixture(scope="module")
def tool(root_dir: Path) -> Iterator[None]:
    """The modules of the tool on the path."""
    folder = str(root_dir / "tools" / "physics_rooms")
    sys.path.insert(0, folder)
    yield
    sys.path.remove(folder)


def block(label: str, kind: str, place: tuple[float, float, float], half: tuple[float, ...]) -> Any:
    """A box; `place` is the middle of its bottom. Furniture and wall things do not move."""
    from physics_room.shapes import Item, Material, box

    x, y, z = half
    item = Item(label, kind, [box((-x, -y, 0), (x, y, 2 * z))], [Material((0.5,) * 3)])
    item.position = np.array(place, float)
    item.anchor = "free" if kind in ("small", "screen") else "world"
    return item


def judge(items: list[Any]) -> Any:
    """The truth of some items, after they have settled."""
    from physics_room.simulate import simulate
    from physics_room.truth import Judge

    for number, item in enumerate(items, start=1):
        item.number = number
    outcome = simulate(items, SIZE)
    assert outcome.resting
    return Judge(items, outcome, {item.number for item in items}).judge()


def table(place: tuple[float, float, float] = (0, 0, 0)) -> Any:
    from physics_room.shapes import Item, Material, box

    legs = [
        box((x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 0.7))
        for x in (-0.6, 0.6)
        for y in (-0.4, 0.4)
    ]
    top = box((-0.65, -0.45, 0.7), (0.65, 0.45, 0.74))
    item = Item("table", "furn", [top, *legs], [Material((0.5,) * 3)], anchor="world")
    item.position = np.array(place, float)
    return item


def bowl(place: tuple[float, float, float]) -> Any:
    from physics_room.things import fruit_bowl

    item = fruit_bowl(np.random.default_rng(0))[0]
    item.position = np.array(place, float)
    return item


def orange(place: tuple[float, float, float]) -> Any:
    from physics_room.shapes import Item, Material, Part

    ball = Part("ellipsoid", (0.035,) * 3, (0, 0, 0.035))
    item = Item("orange", "small", [ball], [Material((0.8, 0.4, 0))], 0.2)
    item.position = np.array(place, float)
    return item


@pytest.mark.usefixtures("tool")
class TestTruth:
    def test_a_stack_rests_on_its_direct_supports_and_falls_with_each(self) -> None:
        truth = judge([
            table(),
            block("book", "small", (0, 0, 0.745), (0.1, 0.13, 0.015)),
            block("box", "small", (0, 0, 0.78), (0.05, 0.05, 0.05)),
        ])  # fmt: skip
        assert truth.relations == {(2, 1): "on", (3, 2): "on"}
        assert truth.physics[3]["falls_without"] == [1, 2]
        assert truth.physics[2]["falls_without"] == [1]
        (support,) = truth.physics[3]["supports"]
        assert support["id"] == 2
        assert support["normal"][2] == pytest.approx(1.0, abs=0.01)

    def test_fruit_in_a_bowl_is_in_it_and_fruit_beside_it_is_near(self) -> None:
        truth = judge([table(), bowl((0, 0, 0.745)), orange((0, 0, 0.78)), orange((0.2, 0, 0.745))])
        assert truth.relations[3, 2] == "in"
        assert truth.relations[2, 1] == truth.relations[4, 1] == "on"
        assert truth.relations[2, 4] == truth.relations[4, 2] == "near"
        assert (3, 1) not in truth.relations

    def test_boxes_that_overlap_without_contact_do_not_rest_on_each_other(self) -> None:
        # The seat is partly under the table: their boxes overlap, and nothing carries anything.
        chair = block("chair", "furn", (0, -0.7, 0), (0.2, 0.2, 0.22))
        back = block("box", "small", (0, -0.7, 0.445), (0.05, 0.05, 0.05))
        truth = judge([table(), chair, back])
        assert truth.relations == {(1, 2): "with", (2, 1): "near", (3, 2): "on"}

    def test_a_thing_that_falls_off_is_where_it_fell(self) -> None:
        truth = judge([table(), block("box", "small", (0.69, 0, 0.76), (0.05, 0.05, 0.05))])
        assert truth.physics[2]["on_floor"]
        assert truth.relations == {(1, 2): "near", (2, 1): "near"}

    @pytest.mark.parametrize(("space", "found"), [(0.02, "against"), (0.12, "near"), (0.7, None)])
    def test_against_takes_the_gap_between_surfaces(self, space: float, found: str | None) -> None:
        low = block("cabinet", "furn", (-0.4, 0, 0), (0.4, 0.25, 0.4))
        high = block("refrigerator", "furn", (0.3 + space, 0, 0), (0.3, 0.3, 0.8))
        truth = judge([low, high])
        assert truth.relations.get((1, 2)) == found
        assert truth.relations.get((2, 1)) == (found if found == "near" else None)

    @pytest.mark.parametrize(("x", "found"), [(0.0, "above"), (1.8, None)])
    def test_a_screen_on_the_wall_is_above_only_what_is_below(
        self, x: float, found: str | None
    ) -> None:
        stand = block("tv-stand", "furn", (0, 2.75, 0), (0.5, 0.2, 0.25))
        screen = block("tv-screen", "wallm", (x, 2.97, 0.9), (0.4, 0.02, 0.25))
        truth = judge([stand, screen])
        assert truth.relations.get((2, 1)) == found
        assert truth.relations.get((1, 2)) == ("under" if found else None)

    def test_a_third_thing_between_two_keeps_them_from_being_near(self) -> None:
        row = [block("bottle", "small", (x, 0, 0.745), (0.02, 0.02, 0.1)) for x in (-0.06, 0, 0.06)]
        truth = judge([table(), *row])
        assert truth.relations[2, 3] == truth.relations[3, 4] == "near"
        assert (2, 4) not in truth.relations

    def test_a_cup_in_a_sink_is_in_it_and_falls_with_all_that_carries_the_sink(self) -> None:
        from physics_room.furniture import base_cabinet, counter
        from physics_room.layout import attach
        from physics_room.things import cup

        rng = np.random.default_rng(1)
        base, (board, sink), (mug,) = base_cabinet(rng, 1.4), counter(rng, 1.4, True), cup(rng)
        base.anchor = "world"
        board.position = np.array([0, -0.02, base.height + 0.001])
        attach(sink)
        mug.position = sink.position + [0, 0, 0.02]
        truth = judge([base, board, sink, mug])
        assert truth.relations == {(2, 1): "on", (3, 2): "attached to", (4, 3): "in"}
        assert truth.physics[4]["falls_without"] == [1, 2, 3]

    def test_the_same_seed_gives_the_same_room(self) -> None:
        from physics_room.layout import build_room

        first, second = (build_room(np.random.default_rng(3)).items for _ in range(2))
        assert [i.label for i in first] == [i.label for i in second]
        assert all(np.array_equal(a.position, b.position) for a, b in zip(first, second))
