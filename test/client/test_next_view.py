"""Where to look next: what a view is expected to tell, from which poses, and why."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.spaces import ROOM, add_view, looking, seen_room
from support.view import box_at, make_edge, make_graph, make_node

from deworldsg_ros.client import ClientError, Robot, SceneGraph, ViewCamera
from deworldsg_ros.client.next_view import items_of, places_of, sides_seen, views_from
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph.seen_cells import (
    AZIMUTHS,
    CELL_M,
    ELEVATIONS,
    FREE,
    FREE_PATH_M,
    OCCUPIED,
    RANGE_M,
    UNSEEN,
    WORTH_M,
    Looks,
    SeenCells,
    enclosed,
    reach,
)
from deworldsg_ros.wire import messages as wire

UP = (0.0, 0.0, 1.0)
SMALL = Robot(radius_m=0.2, height_m=1.0)


def thing(node_id, label, center, size, sure=0.95, other="bowl", **fields):
    """An object with its box, sure of its name or not."""
    classes = [wire.Belief(label, sure), wire.Belief(other, 1.0 - sure)]
    fields = {"existence": 1.0, "remainder": 0.0, **fields}
    return make_node(node_id, label, center, box=box_at(center, size), classes=classes, **fields)


def seen_graph(*nodes, space=None, edges=(), **fields) -> SceneGraph:
    graph = SceneGraph(make_graph(nodes, edges, up=list(UP), **fields))
    graph.space = space
    return graph


def half_seen(block: object = ((0.5, -0.3, 0.0), (1.1, 0.3, 0.8))) -> SeenSpace:
    """The room with a block, from a turn on one side of it."""
    space = SeenSpace()
    for number, degrees in enumerate(range(-180, 180, 15)):
        add_view(space, looking((-1.5, 0.0, 1.2), degrees), 10**9 * (number + 1), block)
    return space


def told_slowly(looks, cells, state, place):
    """Volumes and areas by azimuth, a sample after another."""
    camera, c = looks.camera, CELL_M
    volumes, areas = np.zeros(AZIMUTHS), np.zeros(AZIMUTHS)
    for a in range(AZIMUTHS):
        azimuth = (a + 0.5) * 2 * math.pi / AZIMUTHS
        for e in range(ELEVATIONS):
            rise = ((e + 0.5) / ELEVATIONS - 0.5) * camera.tall_rad - camera.down_rad
            angle = 2 * math.pi / AZIMUTHS * camera.tall_rad / ELEVATIONS * math.cos(rise)
            chance = 1.0
            for k in range(math.floor(RANGE_M / c)):
                r = (k + 0.5) * c
                clear = min(1.0, (2.5 / r) ** 2)
                x = place[0] + r * math.cos(rise) * math.cos(azimuth)
                y = place[1] + r * math.cos(rise) * math.sin(azimuth)
                z = looks.height_m + r * math.sin(rise)
                cell = [math.floor(v / c) - first for v, first in zip((x, y, z), cells.first)]
                cell[2] = min(max(cell[2], 0), state.shape[2] - 1)
                inside = all(0 <= i < n for i, n in zip(cell, state.shape))
                what = state[tuple(cell)] if inside else UNSEEN
                counts = looks.floor_m < z < looks.floor_m + WORTH_M
                counts = counts and math.floor(z / c) - cells.first[2] < state.shape[2]
                if what == OCCUPIED:
                    better = max(clear - cells.clear[tuple(cell)] / 255, 0.0)
                    areas[a] += counts * angle * r**2 * better * chance
                    break
                if what == UNSEEN:
                    volumes[a] += counts * angle * r**2 * c * clear * chance
                    chance *= math.exp(-c / FREE_PATH_M)
    return volumes, areas


def test_unseen_space_is_that_of_a_slow_reference_on_a_small_grid():
    rng = np.random.default_rng(3)
    cells = enclosed(UP, [np.array([[0, 0], [2, 0], [2, 1.5], [0, 1.5]])], 0.0, [])
    state = rng.choice([UNSEEN, FREE, OCCUPIED], cells.free.shape, p=[0.3, 0.65, 0.05])
    cells.clear = rng.integers(0, 256, cells.clear.shape).astype(np.uint8)
    looks = Looks(cells, state.astype(np.uint8), ViewCamera(1.0, 0.2, 1.0, 0.9), 0.0)
    for row in ((8, 8), (12, 5)):
        place = (np.array(row) + cells.first[:2] + 0.5) * CELL_M
        volumes, areas = looks.unseen(place[None])
        slow = told_slowly(looks, cells, state, place)
        assert volumes[0] == pytest.approx(slow[0], rel=1e-3, abs=1e-5)
        assert areas[0] == pytest.approx(slow[1], rel=1e-3, abs=1e-5)
        assert volumes.max() > 0 and areas.max() > 0


def test_what_is_behind_a_block_is_worth_a_look_and_the_reason_says_so():
    block = thing(1, "wardrobe", (0.8, 0.0, 0.9), (0.6, 1.2, 1.8))
    space = half_seen(((0.5, -0.6, 0.0), (1.1, 0.6, 1.8)))
    found = seen_graph(block, space=space).next_view(robot=SMALL)
    assert found.nats["space"] > max(found.nats["names"], found.nats["existence"])
    assert found.reason == "to see behind wardrobe #1"
    x, y, z = found.position_m
    assert z == pytest.approx(0.0, abs=0.05)
    assert found.path_m >= math.hypot(x + 1.5, y) - CELL_M


def test_a_view_that_was_had_already_tells_less():
    """From there, of unseen space and of an unsure object."""
    cup = thing(1, "cup", (0.8, 0.0, 0.85), (0.1, 0.1, 0.1), sure=0.5)
    space = half_seen()
    graph, gains = seen_graph(cup, space=space), []
    place = None
    for more in (False, True):
        cells = SeenCells(UP).add(space)
        state = cells.state
        reached = reach(cells, state, 0.2, 1.0, np.array([-1.5, 0.0]))
        if place is None:
            found = graph.next_view(robot=SMALL)
            place = np.floor(np.array(found.position_m[:2]) / CELL_M).astype(int)
        looks = Looks(cells, state, ViewCamera.of(cells), cells.floor_m)
        items = items_of(graph, cells.axes)
        items.sides = sides_seen(items, cells, looks)
        views = views_from((place - reached.first)[None], reached, looks, items)
        gains.append({kind: values.max() for kind, values in views.nats.items()})
        if not more:
            x, y = views.places[0]
            for number, degrees in enumerate(range(0, 360, 15)):
                add_view(space, looking((x, y, 1.2), degrees), 10**11 + number)
    assert gains[1]["space"] < 0.1 * gains[0]["space"]
    assert gains[1]["names"] <= gains[0]["names"]


def test_from_the_same_side_a_view_tells_whether_it_is_there_not_what_it_is():
    hidden = wire.HiddenNode("vase", [0.8, 0.0, 0.85], 0.4, 1, "seen once")
    cup = thing(1, "cup", (0.8, 0.1, 0.85), (0.1, 0.1, 0.1), sure=0.5)
    graph = seen_graph(cup, space=half_seen(None), hidden=[hidden])
    cells = SeenCells(UP).add(graph.space)
    state = cells.state
    reached = reach(cells, state, 0.2, 1.0, np.array([-1.5, 0.0]))
    looks = Looks(cells, state, ViewCamera.of(cells), cells.floor_m)
    items = items_of(graph, cells.axes)
    items.sides = sides_seen(items, cells, looks)
    nats = []
    for place in ((-0.7, 0.0), (0.8, -1.2)):  # the side of the views so far, and another one
        cell = np.floor(np.array(place) / CELL_M).astype(int) - reached.first
        views = views_from(cell[None], reached, looks, items)
        nats.append({kind: values.max() for kind, values in views.nats.items()})
    assert nats[0]["names"] < 0.01 < 0.05 < nats[1]["names"]
    assert nats[0]["existence"] > 0.1 and nats[1]["existence"] > 0.1


def test_one_view_does_not_tell_all_of_a_surface():
    space, told = SeenSpace(), []
    cells = SeenCells(UP)
    for number in range(4):
        add_view(space, looking((-0.3 * number, 0.0, 1.2), 0.0), 10**9 * (number + 1), None)
        before = cells.clear.sum(dtype=np.int64)
        cells.add(space)
        told.append(int(cells.clear.sum(dtype=np.int64) - before))
        assert cells.clear.max() <= math.ceil(255 * (1.0 - 0.4 ** (number + 1)))
    # Each view tells something, and less than the first one.
    assert min(told) > 0 and max(told[1:]) < told[0]


@pytest.mark.parametrize("side_m", [0.2, 0.3, 0.5])
def test_only_places_are_tried_to_which_the_robot_can_get(side_m):
    """Also those behind a wall with a gap: it gets there only if it fits through."""
    cells = SeenCells(UP).add(half_seen(None))
    state = cells.state
    # A wall across the room, with a gap of 0.75 m; the far side was seen, too.
    floor = cells.floor_m
    state[state == UNSEEN] = FREE
    wall = math.floor(0.0 / CELL_M) - cells.first[0]
    gap = np.arange(-3, 3) - cells.first[1]
    state[wall] = OCCUPIED
    state[wall, gap] = FREE
    state[:, :, : math.ceil(floor / CELL_M) - cells.first[2]] = OCCUPIED
    reached = reach(cells, state, side_m, 1.0, np.array([-1.5, 0.0]))
    centers = reached.centers(places_of(reached))
    assert (centers[:, 0] > 0.0).any() == (side_m < 0.4)
    (low_x, low_y, _), (high_x, high_y, _) = ROOM
    own = np.hypot(*(centers - [-1.5, 0.0]).T) < side_m
    edge = np.minimum(centers - [low_x, low_y], [high_x, high_y] - centers).min(axis=1)
    assert (edge[~own] > side_m - CELL_M).all()
    path = reached.path_to(places_of(reached)[-1])
    assert reached.way_m[tuple(places_of(reached)[-1])] == pytest.approx(
        np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    )


def turned(space: SeenSpace, quarter: np.ndarray) -> SeenSpace:
    found = SeenSpace()
    found.__dict__.update(space.__dict__)
    found.poses = quarter @ space.poses
    return found


def test_a_map_that_is_turned_by_a_quarter_turns_the_answer():
    quarter = np.eye(4)
    quarter[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    center, size = np.array([0.8, 0.0, 0.85]), (0.1, 0.1, 0.1)
    robot_at = (-1.5625, 0.0625, 1.2)  # the middle of a cell stays the middle of a cell
    graph = seen_graph(thing(1, "cup", center, size, sure=0.6), space=half_seen())
    there = quarter[:3, :3] @ center
    other = seen_graph(thing(1, "cup", there, size, sure=0.6), space=turned(half_seen(), quarter))
    a = graph.next_view(robot=SMALL, start=robot_at)
    b = other.next_view(robot=SMALL, start=tuple(quarter[:3, :3] @ robot_at))
    assert b.gain_nats == pytest.approx(a.gain_nats, rel=0.02)
    assert b.position_m == pytest.approx(quarter[:3, :3] @ a.position_m, abs=1e-6)
    yaws = [2 * math.atan2(*found.orientation_xyzw[2:]) for found in (a, b)]
    assert math.remainder(yaws[1] - yaws[0] - math.pi / 2, 2 * math.pi) == pytest.approx(
        0, abs=1e-6
    )


def test_nothing_is_worth_a_look_where_all_is_seen_and_sure():
    space = SeenSpace()
    for number, (x, y) in enumerate([(-1.2, -0.8), (1.2, 0.8), (-1.2, 0.8), (1.2, -0.8)]):
        for step in range(24):
            stamp_ns = 10**9 * (24 * number + step + 1)
            add_view(space, looking((x, y, 1.2), 15 * step, 30.0), stamp_ns, None)
    assert seen_graph(space=space).next_view(robot=SMALL) is None
    sure = thing(1, "cup", (0.0, 0.0, 0.05), (0.1, 0.1, 0.1), sure=1.0)
    assert seen_graph(sure, space=space).next_view(robot=SMALL) is None
    unsure = thing(1, "cup", (0.0, 0.0, 0.05), (0.1, 0.1, 0.1), sure=0.5, existence=0.5)
    outline = [[x, y, 0.0] for x, y in ((-2, -1.5), (2, -1.5), (2, 1.5), (-2, 1.5))]
    room = wire.RoomState(1, "room", [], 0, outline, 12.0, [], [])
    assert seen_graph(sure, rooms=[room]).next_view(robot=SMALL) is None
    assert seen_graph(unsure, rooms=[room]).next_view(robot=SMALL) is not None


def test_a_message_alone_tells_of_names_existence_and_relations_not_of_space():
    outline = [[x, y, 0.0] for x, y in ((-2, -1.5), (2, -1.5), (2, 1.5), (-2, 1.5))]
    room = wire.RoomState(1, "room", [], 0, outline, 12.0, [], [])
    table = thing(2, "table", (0.5, 0.0, 0.35), (0.8, 0.8, 0.7), sure=1.0)
    cup = thing(1, "cup", (0.5, 0.0, 0.75), (0.1, 0.1, 0.1), sure=0.5)
    graph = seen_graph(cup, table, rooms=[room])
    found = graph.next_view(robot=SMALL)
    assert (found.reason, found.path_m, found.objects) == ("cup #1 may be a bowl", None, (1,))
    assert found.nats["space"] == found.nats["relations"] == 0.0
    x, y, _ = found.position_m
    assert abs(x) < 1.8 and abs(y) < 1.3 and max(abs(x - 0.5), abs(y)) > 0.5
    ahead = np.subtract(cup.mean_m[:2], (x, y))
    yaw = 2 * math.atan2(*found.orientation_xyzw[2:])
    assert abs(math.remainder(math.atan2(ahead[1], ahead[0]) - yaw, 2 * math.pi)) < 0.53
    near = graph.next_view(robot=SMALL, start=(-1.5, 0.0, 0.0))
    assert near.path_m is not None
    sure = replace_name(cup, 1.0)
    doubt = make_edge(1, 2, probability=0.5)
    found = seen_graph(sure, table, edges=[doubt], rooms=[room]).next_view(robot=SMALL)
    assert found.reason == "to see whether cup #1 is on table #2"
    unsure = thing(3, "vase", (-0.5, 0.5, 0.1), (0.1, 0.1, 0.2), sure=1.0, existence=0.5)
    found = seen_graph(sure, unsure, rooms=[room]).next_view(robot=SMALL)
    assert found.reason == "to see whether vase #3 is there"
    hidden = wire.HiddenNode("lamp", [-0.5, 0.0, 0.5], 0.5, 2, "seen once")
    found = seen_graph(sure, rooms=[room], hidden=[hidden]).next_view(robot=SMALL)
    assert found.reason == "to see whether there is a lamp"


def replace_name(node, sure):
    import msgspec

    return msgspec.structs.replace(node, classes=[wire.Belief(node.label, sure)])


def test_the_cells_remember_forgotten_views_and_follow_moved_ones():
    space = seen_room()
    cells = SeenCells(UP).add(space)
    before = cells.state
    later = SeenSpace()
    add_view(later, looking((-0.5, 0.0, 1.2), 0.0), 10**12)
    assert ((cells.add(later).state != UNSEEN) >= (before != UNSEEN)).all()
    assert len(cells.poses) == 13
    later.poses = later.poses.copy()
    later.poses[0, 0, 3] += 0.5
    assert len(cells.add(later).poses) == 1
    assert cells.floor_m == pytest.approx(0.0, abs=0.03)
    # Upstairs, what is below is no floor of the robot's.
    upstairs = np.eye(4)
    upstairs[2, 3] = 2.9
    for number in range(2):
        add_view(later, looking((-0.5, 0.0, 1.2), 90.0 * number), 2 * 10**12 + number)
        later.poses[-1] = upstairs @ later.poses[-1]
        assert len(cells.add(later).poses) == 1 + number
    assert cells.floor_m == pytest.approx(2.9, abs=0.03)


def test_what_cannot_be_answered_says_why():
    dark = half_seen()
    dark.depths_mm = np.zeros_like(dark.depths_mm)
    for space in (None, dark):
        with pytest.raises(ClientError, match="nothing is known of the space"):
            seen_graph(space=space).next_view()
    graph = seen_graph(space=seen_room())
    with pytest.raises(ClientError, match="three finite numbers"):
        graph.next_view(start=(0.0, math.nan, 0.0))
    with pytest.raises(ClientError, match="beside what is known"):
        graph.next_view(start=(50.0, 0.0, 0.0))
    with pytest.raises(ClientError, match="camera 9 m above the floor"):
        ViewCamera(height_m=9.0)


def test_the_pose_is_a_goal_for_navigation():
    found = seen_graph(space=half_seen()).next_view(robot=SMALL)
    values = found.to_dict()
    assert values["header"]["frame_id"] == "map"
    assert set(values["nats"]) == {"space", "names", "existence", "relations"}
    assert values["gain_nats"] == pytest.approx(found.gain_nats, abs=1e-3)
    pytest.importorskip("geometry_msgs")
    pose = replace(found, stamp_ns=1_500_000_000).pose_stamped()
    assert pose.header.stamp.nanosec == 500_000_000
    assert pose.pose.position.x == found.position_m[0]
