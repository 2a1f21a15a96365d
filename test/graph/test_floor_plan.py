"""The floor plan: where a robot can go in a room of boxes."""

import numpy as np
import pytest
from support.spaces import add_view, looking, seen_room

from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.floor_plan import FREE, OCCUPIED, UNKNOWN, floor_plan
from deworldsg_ros.graph.provenance import SeenSpace

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
