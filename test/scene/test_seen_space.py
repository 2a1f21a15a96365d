"""The space that the camera saw as free: kept views, points in them, goals before walls."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from support.merging import VOCABULARY
from support.surfaces import CAMERA, CUP, HERE, view

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.config import Config, InputsConfig, OutputConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph_files import write_graph
from deworldsg_ros.graph.provenance import MAX_VIEWS, SeenSpace, space_path, write_space
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import copy_state, read_map, write_map
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

# The camera looks along world x, at a height of 1 m; its image has x to the right and y down.
LEVEL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]])


def frame(
    stamp_ns: int, x_m: float = 0.0, turn_rad: float = 0.0, wall_m: float = 3.0
) -> LocalGraph:
    """A level camera at x, turned about the vertical, before a wall at a distance."""
    pose = LEVEL.copy()
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    pose[:3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ LEVEL[:3, :3]
    pose[0, 3] = x_m
    grid = DepthGrid(np.full((60, 80), 1000 * wall_m, np.uint16), 8, CAMERA)
    seen = view(1, (HERE, CUP))
    return dataclasses.replace(seen, T_world_camera=pose, stamp_ns=stamp_ns, depth_grid=grid)


def test_a_point_is_free_before_the_wall_occupied_at_it_and_not_seen_elsewhere() -> None:
    space = SeenSpace()
    assert [answer.any() for answer in space.look(np.zeros((1, 3)))] == [False, False]
    space.note(frame(1))
    points = np.array([[1.5, 0, 1], [3.0, 0, 1], [4, 0, 1], [-1, 0, 1], [1.5, 2, 1], [0.05, 0, 1]])
    free, occupied = space.look(points)
    assert free.tolist() == [True, False, False, False, False, False]
    assert occupied.tolist() == [False, True, False, False, False, False]
    assert all(len(answer) == 0 for answer in space.look(np.zeros((0, 3))))


def test_views_that_disagree_are_counted() -> None:
    space = SeenSpace()
    for stamp_ns, x_m, wall_m in ((1, 0.0, 3.0), (2, 0.5, 2.5), (3, 1.0, 4.0)):
        space.note(frame(stamp_ns, x_m, wall_m=wall_m))  # the third one sees through the wall
    free, occupied = space.look(np.array([[3.0, 0.0, 1.0], [2.0, 0.0, 1.0]]))
    assert (free.tolist(), occupied.tolist()) == ([False, True], [True, False])


def test_only_different_views_are_kept_and_no_more_than_some() -> None:
    space = SeenSpace()
    for stamp_ns in range(50):
        space.note(frame(stamp_ns, x_m=0.004 * stamp_ns))
    assert len(space) == 1
    space.note(frame(60, turn_rad=0.3))
    space.note(frame(61, turn_rad=0.2))  # near to the turned one
    assert len(space) == 2
    space.note(dataclasses.replace(frame(62, x_m=9.0), depth_grid=None))
    assert len(space) == 2
    for stamp_ns in range(100, 100 + MAX_VIEWS):
        space.note(frame(stamp_ns, x_m=float(stamp_ns)))
    assert len(space) == MAX_VIEWS and space.stamps_ns[0] == 100
    assert space.depths_mm.nbytes < 1.3e6


def test_another_camera_begins_again() -> None:
    space = SeenSpace()
    space.note(frame(1))
    camera = Intrinsics(150.0, 150.0, 159.5, 119.5, 320, 240)
    grid = DepthGrid(np.full((30, 40), 3000, np.uint16), 8, camera)
    space.note(dataclasses.replace(frame(2, x_m=5.0), depth_grid=grid))
    assert space.depths_mm.shape == (1, 30, 40) and space.stamps_ns.tolist() == [2]


def test_a_correction_moves_the_views_since_then() -> None:
    space, T = SeenSpace(), np.eye(4)
    space.note(frame(1))
    space.note(frame(5, x_m=1.0))
    T[1, 3] = 10.0
    space.move(T, 5)
    assert space.poses[:, 1, 3].tolist() == [0.0, 10.0]


def walk() -> GraphBuilder:
    """A camera that turns all around in a round room with a cup; nothing is nearer than 2 m."""
    config = Config(output=OutputConfig(min_existence=0.0), inputs=InputsConfig(world_up="z"))
    builder = GraphBuilder(config, VOCABULARY, "world")
    for stamp_ns in range(1, 20):
        builder.integrate(frame(stamp_ns * 10**8, turn_rad=0.33 * stamp_ns, wall_m=2.0))
    return builder


def test_a_goal_is_before_the_walls_that_are_no_objects() -> None:
    builder = walk()
    graph = SceneGraph(builder.full())
    cup = graph.one("cup")
    assert graph.goal_near(cup, 1.0).seen_free is None
    far = [graph.goal_near(cup, d, towards=(9.0, 0.0, 0.0)).position_m for d in (1.0, 2.2)]
    assert np.hypot(*far[1][:2]) > 2.0  # behind the wall: the graph does not know it
    goal = graph.goal_near(cup, 1.0, towards=(9.0, 0.0, 0.0), space=builder.space)
    assert np.hypot(*goal.position_m[:2]) < 2.0
    assert goal.seen_free > 0.3 and goal.to_dict()["seen_free"] == round(goal.seen_free, 2)
    for distance in (1.6, 1.8, 2.0):
        goal = graph.goal_near(cup, distance, space=builder.space)
        x, y, z = goal.position_m
        assert not builder.space.look(np.array([[x, y, z + 1.0]]))[1].any()


def test_it_is_in_the_map_and_beside_a_saved_graph(tmp_path: Path) -> None:
    builder = walk()
    write_map(builder, tmp_path / "room.map")
    again = read_map(Config(), tmp_path / "room.map")
    assert len(again.space) == len(builder.space) > 8
    one, other = copy_state(again), copy_state(builder)
    assert all(one[name].tobytes() == other[name].tobytes() for name in one if "view_" in name)
    path = write_graph(tmp_path, builder.full())
    assert SceneGraph.load(tmp_path).goal_near("cup").seen_free is None
    write_space(path, builder.space)
    assert SceneGraph.load(tmp_path).goal_near("cup").seen_free > 0.0
    space_path(path).write_bytes(b"no archive")
    assert SceneGraph.load(tmp_path).space is None
    arrays = graph_files.read(tmp_path / "room.map")
    for name, wrong in (
        ("view_poses", np.zeros((2, 4, 4))),
        ("view_depths_mm", np.zeros((MAX_VIEWS + 1, 2, 2), np.uint16)),
        ("view_cameras", np.full((len(builder.space), 4), np.nan)),
    ):
        graph_files.write(tmp_path / "bad.map", {**arrays, name: wrong})
        with pytest.raises(ConfigurationError, match=name):
            read_map(Config(), tmp_path / "bad.map")
