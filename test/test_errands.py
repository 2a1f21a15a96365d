"""tools/errands: a robot that acts on the graph in a simulated home."""

import importlib
import sys

import numpy as np
import pytest
from support.view import box_at, make_graph, make_node

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.wire import messages as wire


@pytest.fixture(scope="module")
def tool(root_dir):
    """Imports a module of the tool."""
    folder = str(root_dir / "tools" / "errands")
    sys.path.insert(0, folder)
    yield importlib.import_module
    sys.path.remove(folder)


def test_homes_have_rooms_and_things_and_the_errands_are_true(tool):
    home = tool("home").build(3)
    tasks = tool("tasks")
    rng = np.random.default_rng(0)
    assert 4 <= len(home.kinds) <= 6
    assert [item.number for item in home.items] == list(range(1, len(home.items) + 1))
    for thing, bearer in home.on.items():
        (low, _), (_, top) = home.bounds(thing)[:, 2], home.bounds(bearer)[:, 2]
        assert low <= top + 0.01
    asked = [*tasks.standing_tasks(home, rng), *tasks.absent_tasks(home, rng)]
    for task in asked:
        if task.kind == "relation":
            thing, bearer = task.words.split(" on ")
            expected = [
                a for a, b in home.on.items() if (home.name(a), home.name(b)) == (thing, bearer)
            ]
            assert sorted(task.right) == sorted(expected)
        elif task.kind == "absent":
            assert not task.right
            assert " on " in task.words or not home.called(task.words)
    before = {number: home.bounds(number) for number in home.present}
    moved = tasks.move_things(home, rng)
    assert {task.kind for task in moved} <= {"moved", "removed"} and moved
    for task in moved:
        if task.kind == "moved":
            (number,) = task.right
            assert np.abs(home.bounds(number) - before[number]).max() > 0.3
        else:
            assert not task.right and not home.called(task.words)


def test_depth_and_objects_are_those_of_rays(tool):
    home = tool("home").build(3)
    camera = Intrinsics(13.0, 13.0, 7.5, 5.5, 16, 12)
    boxed = next(i for i in home.items if home.name(i.number) == "refrigerator")
    low, high = home.bounds(boxed.number)
    # From before it.
    eye = boxed.position + boxed.rotation @ [0.0, -1.5, 1.2]
    ahead = (low + high) / 2 - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = eye
    triangles = tool("raster").Triangles(home)
    _, depth_m, owners = triangles.render(T, camera)
    v, u = np.mgrid[:12, :16]
    rays = camera.back_project(u, v, np.ones((12, 16))) @ T[:3, :3].T
    best, owner = np.full((12, 16), np.inf), np.full((12, 16), -1)
    for corners, number in zip(triangles.corners, triangles.owners):
        a, b, c = corners - eye
        with np.errstate(divide="ignore", invalid="ignore"):
            normal = np.cross(b - a, c - a)
            t = (a @ normal) / (rays @ normal)
            p = rays * t[..., None]
            sides = [np.cross(q - o, p - o) @ normal for o, q in ((a, b), (b, c), (c, a))]
        hit = (np.stack(sides) >= 0).all(axis=0) & (t > 0.05) & (t < best)
        best[hit], owner[hit] = t[hit], number
    same = np.abs(depth_m - np.where(np.isfinite(best), best, 0.0)) < 1e-3
    # At edges, a pixel may belong to either side.
    assert same.mean() > 0.98
    assert (owners == np.maximum(owner, 0))[same].mean() > 0.99
    assert (owners == boxed.number).any()


def test_the_planner_finds_the_shortest_way_round_a_wall(tool):
    robot = tool("robot")
    free = np.ones((60, 80), bool)
    free[:40, 40:44] = False
    import cv2

    clearance = 0.05 * cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, 5)
    planner = robot.Planner(clearance, np.zeros(2), 0.2)
    path = planner.path(np.array([1.0, 0.5]), np.array([3.2, 0.5]))
    # Round the corner of the wall at (2.0 to 2.2, 2.0), 0.2 m away from it.
    least = np.hypot(0.9, 1.6) + np.hypot(0.9, 1.6)
    assert least < robot.length_m(path) < 1.25 * (least + 0.4)
    rows, columns = np.floor(path[:, ::-1] / 0.05).astype(int).T
    assert (clearance[rows, columns] > 0.2).all()
    assert planner.path(np.array([1.0, 0.5]), np.array([2.1, 0.5])) is None


def test_a_wall_hides_what_is_behind_it_and_a_table_does_not(tool):
    robot, home = tool("robot"), tool("home").build(3)
    grid = robot.Grid.around(home)
    T = robot.looking(1.0, 1.0, 0.0)
    for ahead_m, is_hidden in ((2.0, False), (1.0, True)):  # a wall behind the target, before it
        depth_m = np.full((480, 640), ahead_m, np.float32)
        for _ in range(3):
            grid.see(depth_m, T)
        assert grid.hides(np.array([[1.2, 1.0]]), np.array([[2.8, 1.0]])) == [is_hidden]
    assert grid.hides(np.array([[-50.0, 1.0]]), np.array([[2.8, 1.0]])).all()
    low = robot.Grid.around(home)
    v = (np.arange(480) - 239.5)[:, None] / 525
    down = np.sin(robot.TILT_RAD) + v * np.cos(robot.TILT_RAD)
    # A table of 0.7 m: what looks more than that down sees its top, the rest sees nothing.
    with np.errstate(divide="ignore"):
        depth_m = np.where(down > 0.1, 0.5 / down, 0.0).repeat(640, axis=1).astype(np.float32)
    for _ in range(3):
        low.see(depth_m, T)
    assert low.hits.any() and not low.hides(np.array([[1.2, 1.0]]), np.array([[2.8, 1.0]])).any()


def test_answers_are_the_nearest_of_those_that_are_about_as_probable(tool):
    mind = tool("mind")
    places = {1: (4.0, 0.9), 2: (1.0, 0.85), 3: (0.5, 0.3), 4: (0.2, 0.1)}
    nodes = [
        make_node(
            node_id, "cup", (x, 0.0, 0.8), existence=1.0,
            classes=[wire.Belief("cup", share), wire.Belief("bowl", 1.0 - share)],
            box=box_at((x, 0.0, 0.8), (0.08, 0.08, 0.1 if node_id < 4 else 0.4)),
        )
        for node_id, (x, share) in places.items()
    ]  # fmt: skip
    graph = SceneGraph(make_graph(nodes))
    found = mind.answers_to(graph, "cup", np.zeros(3), 0.15)
    assert [one.item.id for one in found] == [2, 1, 3]
    assert mind.answers_to(graph, "teapot", np.zeros(3), 0.15) == []
    assert mind.like(graph[1], graph[2]) and not mind.like(graph[1], graph[4])


def test_a_robot_that_looks_at_all_furniture_sees_what_stands_on_it(tool):
    robot_, look, home = tool("robot"), tool("look"), tool("home").build(3)
    planner = robot_.Planner(*home.room_free(), 0.32)
    start = planner.point(int(np.flatnonzero(planner.free.ravel())[0]))
    robot = robot_.Robot(home, 3, np.array([*start, 0.0]))
    furniture = [number for number in home.present if home.name(number) in look.SURFACES]
    nodes = [
        make_node(number, home.name(number), low, box=box_at((low + high) / 2, high - low))
        for number, (low, high) in ((n, home.bounds(n)) for n in furniture)
    ]
    items = list(SceneGraph(make_graph(nodes)))
    looked, seen = look.Looked(robot), np.zeros(len(home.items) + 1, int)
    left, views = [len(looked.left(items))], 0
    place = start
    while place is not None:
        for yaw in np.arange(12) * np.pi / 6:
            robot.pose = np.array([*place, yaw])
            robot.T_map_camera = robot_.looking(*robot.pose)
            robot.look()
            looked.note(items, np.eye(4))
            seen = np.maximum(seen, np.bincount(robot.instances.ravel(), minlength=len(seen)))
        looked.give_up(items, place, np.eye(4))
        left.append(len(looked.left(items)))
        views += 1
        path = looked.next_view(items, np.eye(4))
        place = None if path is None else path[-1]
    things = [thing for thing, bearer in home.on.items() if bearer in furniture]
    assert np.mean(seen[things] > 100) > 0.9
    # It comes to an end, with fewer views than furniture.
    assert (np.diff(left) <= 0).all() and left[-1] < 0.1 * left[0]
    assert 3 <= views < len(furniture)
    # It does not count what the camera did not show.
    unseen = look.Looked(robot)
    robot.depth_m = np.full_like(robot.depth_m, 0.3)
    unseen.note(items, np.eye(4))
    assert len(unseen.left(items)) == left[0]


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_robot_fulfils_errands_on_its_graph(tool):
    outcomes = tool("errands").run_home(8, "boxes", most=5)
    assert len(outcomes) == 5
    assert sum(not one.failure for one in outcomes) >= 3, outcomes
    assert all(one.path_m < 2 * one.shortest_m + 1.5 for one in outcomes if not one.failure)
    assert any(one.path_m > 3.0 for one in outcomes if not one.failure)
