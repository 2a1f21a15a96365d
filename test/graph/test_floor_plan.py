"""A room of boxes from above: where a robot can go, and what stands on a table."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from support.spaces import BOARD, ON_BOARD, add_view, looking, seen_room, walk_round
from support.view import box_at, make_node

from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.floor_plan import FREE, OCCUPIED, UNKNOWN, Thing, Things, floor_plan
from deworldsg_ros.graph.provenance import SeenSpace, TrailChange
from deworldsg_ros.scene.frame_graph import LocalGraph, derived
from deworldsg_ros.wire.messages import NodeState

UP = (0.0, 0.0, 1.0)


def test_walls_and_things_are_occupied_the_air_is_free_and_the_rest_unknown():
    plan = floor_plan(seen_room(), UP, 1.5)
    assert plan.cell_m == 0.05
    assert plan.T_world_plan[2, 3] == pytest.approx(0.0, abs=0.02)
    for x, y in ((-1.0, 0.5), (0.2, -1.0), (-1.8, 1.3), (0.0, 0.0)):
        assert plan.at((x, y, 0.0)) == FREE, (x, y)
    walls = [plan.at((x, y, 1.0)) for x in np.arange(-1.8, 1.8, 0.05) for y in (-1.5, 1.5)]
    assert np.mean(np.array(walls) == OCCUPIED) > 0.9
    block = [
        plan.at((x, y, 0)) for x in np.arange(0.55, 1.1, 0.05) for y in np.arange(-0.25, 0.3, 0.05)
    ]
    assert np.mean(np.array(block) == OCCUPIED) > 0.9
    assert plan.at((1.5, 0.0, 0.0)) != OCCUPIED  # behind the block
    assert {plan.at((3.0, 0.0, 0.0)), plan.at((0.0, 9.0, 0.0))} == {UNKNOWN}
    # The free area is that of the room without the block, as far as it is in view.
    area_m2 = (plan.cells == FREE).sum() * plan.cell_m**2
    assert 0.85 * (4 * 3 - 0.36) < area_m2 < 4 * 3 - 0.36


def test_what_is_higher_than_the_robot_is_not_in_its_way():
    table = ((0.5, -0.3, 0.7), (1.1, 0.3, 0.75))  # a board without legs
    space = seen_room(table)
    middle = (0.8, 0.0, 0.0)
    assert floor_plan(space, UP, 1.5).at(middle) == OCCUPIED
    assert floor_plan(space, UP, 0.5).at(middle) != OCCUPIED


def test_what_was_carried_away_is_free_again():
    space = seen_room()
    for number, degrees in enumerate(range(-30, 31, 15)):
        for i, x in enumerate((-0.4, -0.2)):
            add_view(space, looking((x, 0.0, 1.2), degrees), 10**10 * (number + 2 * i + 2), None)
    block = [(x, y, 0.0) for x in (0.6, 0.8, 1.0) for y in (-0.2, 0.0, 0.2)]
    assert [floor_plan(space, UP, 1.5).at(place) for place in block] == [FREE] * 9


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, -0.9, -0.44), (1.0, 0.0, 0.0)])
def test_up_may_be_any_axis(up):
    axes = horizontal_axes(up)
    space = seen_room()
    T = np.eye(4)
    T[:3, :3] = axes.T
    space.poses = T @ space.poses
    plan, upright = floor_plan(space, up, 1.5), floor_plan(seen_room(), UP, 1.5)
    assert np.mean(plan.cells[:60, :80] == upright.cells[:60, :80]) > 0.97
    assert plan.at(axes.T @ (-1.0, 0.5, 0.0)) == FREE
    assert plan.at(axes.T @ (0.8, 0.0, 0.0)) == OCCUPIED


def test_a_large_place_has_wider_cells_and_an_empty_one_no_plan(monkeypatch):
    monkeypatch.setattr("deworldsg_ros.graph.floor_plan.MOST_CELLS", 20)
    plan = floor_plan(seen_room(), UP, 1.5)
    assert max(plan.cells.shape) <= 21 and plan.cell_m > 0.19
    space = seen_room()
    space.poses[0, 2, 3] = -1e8  # of a damaged file
    assert floor_plan(space, UP, 1.5) is not None
    space = SeenSpace()
    assert floor_plan(space, UP, 1.5) is None
    add_view(space, looking((0, 0, 1.2), 0.0), 1)
    space.depths_mm = space.depths_mm * 0
    assert floor_plan(space, UP, 1.5) is None


# --- Things that no detector fires at.

LOW_BOX = ((-0.4, 0.1, 0.75), (-0.1, 0.25, 0.85))
SHEET = ((-0.4, -0.3, 0.75), (-0.2, -0.1, 0.755))
WIDE = ((-0.4, -0.35, 0.75), (0.4, -0.2, 0.95))
POST = ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.9))  # from the floor
FLOATING = ((0.1, -0.1, 0.95), (0.22, 0.04, 1.1))


def things_of(frames: Sequence[LocalGraph]) -> Things:
    things = Things()
    for number, frame in enumerate(frames):
        things.note(frame, number)
    return things


def found_by(things: Things, *nodes: NodeState) -> list[Thing]:
    return things.find(UP, nodes).things


def node_at(box: object) -> NodeState:
    low, high = np.array(box)
    return make_node(1, "cup", box=box_at(((low + high) / 2).tolist(), (high - low).tolist()))


def assert_is(thing: Thing, box: object) -> None:
    """The points of a thing are on its box, from just above its support to its top."""
    low, high = np.array(box)
    found = thing.points_world.min(axis=0), thing.points_world.max(axis=0)
    np.testing.assert_allclose(found, (low + (0, 0, 0.014), high), atol=0.025)


def test_compact_things_on_a_table_are_found_and_nothing_else():
    frames = walk_round(BOARD, ON_BOARD, LOW_BOX, SHEET, steps=48)
    things = things_of(frames)
    found = sorted(found_by(things), key=lambda thing: thing.points_world[:, 0].mean())
    assert len(found) == 2  # a sheet of 5 mm may be noise
    for thing, box in zip(found, (LOW_BOX, ON_BOARD)):
        assert_is(thing, box)
        assert 40 < len(set(thing.keyframes.tolist())) <= 48
    # What is a node already is not found again; a node around the table hides nothing.
    (left,) = found_by(things, node_at(ON_BOARD), node_at(BOARD))
    assert_is(left, LOW_BOX)


@pytest.mark.parametrize(
    "blocks",
    [(BOARD,), (BOARD, WIDE), (POST,), (BOARD, FLOATING)],
    ids=["bare", "wide", "post", "floating"],
)
def test_what_is_no_compact_thing_on_a_support_is_not_found(blocks):
    assert found_by(things_of(walk_round(*blocks, steps=36))) == []


def test_one_viewpoint_finds_nothing_nor_is_found_what_was_carried_away():
    assert found_by(things_of(walk_round(BOARD, ON_BOARD, steps=8, part=0.02))) == []
    quarter = walk_round(BOARD, ON_BOARD, steps=9, part=0.25)
    assert len(found_by(things_of(quarter))) == 1
    assert found_by(things_of([*quarter, *walk_round(BOARD, steps=36)])) == []


def test_things_turn_and_move_with_the_world():
    things = things_of(walk_round(BOARD, ON_BOARD, steps=36))
    (upright,) = found_by(things)
    stamps_ns = np.array([10**8 * (number + 1) for number in range(36)])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = horizontal_axes((0.0, -0.9, -0.44)).T, (3.0, 2.0, 1.0)
    before = copy(things)
    things.move(TrailChange(stamps_ns, np.stack([T] * 37), np.stack([T] * 37)))
    assert things.moves == 1 and before.moves == 0
    (turned,) = things.find(T[:3, :3] @ UP, []).things
    expected = upright.points_world @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(turned.points_world.mean(axis=0), expected.mean(axis=0), atol=0.01)
    (again,) = found_by(before)
    np.testing.assert_array_equal(again.points_world, upright.points_world)


def test_only_the_place_around_the_newest_view_is_searched():
    away = np.eye(4)
    away[0, 3] = 40.0
    here = walk_round(BOARD, ON_BOARD, steps=36)
    there = [
        derived(frame, T_world_camera=away @ frame.T_world_camera, stamp_ns=frame.stamp_ns + 10**10)
        for frame in here
    ]
    found = things_of([*here, *there]).find(UP, [])
    (thing,) = found.things
    assert thing.points_world[:, 0].min() > 39.0
    assert here[-1].stamp_ns < found.since_ns <= thing.first_ns


def test_views_that_are_alike_are_kept_once_and_the_newest_of_many(monkeypatch):
    frame, *others = walk_round(BOARD, ON_BOARD, steps=36)
    things = things_of([frame, frame, derived(frame, depth_grid=None)])
    assert len(things) == 1 and things.is_new
    monkeypatch.setattr("deworldsg_ros.graph.floor_plan.MOST_GLANCES", 20)
    for other in others:
        things.note(other, 1)
    assert len(things) == 20 and len(found_by(things)) == 1
    things.forget()
    assert len(things) == 0 and found_by(things) == []
    grid = replace(frame.depth_grid, depth_mm=0 * frame.depth_grid.depth_mm)
    blind = derived(frame, depth_grid=grid)
    assert found_by(things_of([blind])) == []
