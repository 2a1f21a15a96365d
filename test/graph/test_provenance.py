"""The frames behind nodes and edges, and the space seen as free; in maps and beside graphs."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from support.merging import VOCABULARY, local_graph
from support.surfaces import CAMERA, CUP, HERE, TABLE, slab, view

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.config import Config, InputsConfig, OutputConfig
from deworldsg_ros.graph import graph_files, provenance
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.graph_files import write_graph
from deworldsg_ros.graph.pairs import frame_votes
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import copy_state, read_map, write_map
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph
from deworldsg_ros.wire import messages as wire

CONFIG = Config(output=OutputConfig(min_existence=0.0), inputs=InputsConfig(world_up="z"))

# --- the frames behind nodes and edges -----------------------------------------------------------


class Memory(provenance.FrameMemory):
    """The frames of a graph of some nodes."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.graph = GlobalGraph(VOCABULARY, "world")
        for _ in range(count):
            self.graph.add_node(np.zeros(3), np.eye(3), np.full(4, 0.25), 1)

    def see(self, stamp_ns: int, strength: float, ids: list[int], logit: float = 2.0) -> None:
        """A frame that shows two cups, the first on the second."""
        classes = np.array([[strength, *[(1 - strength) / 3] * 3]] * 2)
        logits = np.array([[logit, -9.0, -9.0]])
        seen = np.zeros((2, 3)), np.stack([np.eye(3)] * 2), classes
        local = local_graph(stamp_ns, *seen, pairs=[(0, 1)], logits=logits)
        self.note(self.graph, local, ids, frame_votes(logits))

    def spans(self) -> list[tuple[int, int, int, int]]:
        found = self.all(self.graph)
        return [(item.node, item.other, item.first_ns, item.last_ns) for item in found]


def test_first_last_and_the_clearest_few_are_kept() -> None:
    memory = Memory(2)
    for stamp_ns, strength in enumerate([0.5, 0.9, 0.6, 0.8, 0.7, 0.9], start=1):
        memory.see(stamp_ns, strength, [1, 2], strength)
    assert memory.spans() == [(1, 0, 1, 6), (1, 2, 1, 6), (2, 0, 1, 6)]
    node, pair, _ = memory.all(memory.graph)
    # Of equally clear frames, the earlier one comes first. The score of a detection is 0.9.
    assert [(f.stamp_ns, f.name, f.strength) for f in node.clearest] == [
        (2, "cup", 0.81), (6, "cup", 0.81), (4, "cup", 0.72),
    ]  # fmt: skip
    assert [(f.stamp_ns, f.name) for f in pair.clearest] == [(2, "on"), (6, "on"), (4, "on")]


def test_frames_follow_merges_and_removals_and_do_not_grow() -> None:
    memory = Memory(3)
    graph = memory.graph
    memory.see(1, 0.5, [1, 2])
    memory.see(2, 0.9, [3, 2])
    graph.merge_nodes(1, 3)
    assert memory.spans() == [(1, 0, 1, 2), (1, 2, 1, 2), (2, 0, 1, 2)]
    graph.remove_node(2)
    assert memory.spans() == [(1, 0, 1, 2)]
    for stamp_ns in range(3, 3 * provenance.PRUNE_FRAMES):
        new_id = graph.add_node(np.zeros(3), np.eye(3), np.full(4, 0.25), stamp_ns)
        memory.see(stamp_ns, 0.9, [1, new_id])
        graph.remove_node(new_id)
        assert len(memory._seen) <= 2 * provenance.PRUNE_FRAMES + 1
    (node,) = memory.all(graph)
    assert len(node.clearest) == provenance.CLEAREST


@pytest.fixture
def table_and_cup() -> GraphBuilder:
    builder = GraphBuilder(CONFIG, VOCABULARY, "world")
    floor = slab((0, 0, 0.95), (1.2, 0.8, 0.01))
    for stamp in range(1, 6):
        builder.integrate(view(stamp, (HERE, CUP), (floor, TABLE)))
    return builder


def test_explain_names_the_frames_of_a_saved_graph(tmp_path, table_and_cup) -> None:
    message = table_and_cup.full()
    path = write_graph(tmp_path, message)
    assert SceneGraph.load(tmp_path).explain(1).values["frames"] is None
    stamp_ns = wire.ns_from_stamp(message.stamp)
    seen = table_and_cup.frames.all(table_and_cup.graph)
    provenance.write_seen(path, stamp_ns, seen)
    found = SceneGraph.load(tmp_path).explain(1)
    assert found.lines[1] == (
        "frames: first 0.100, last 0.500, clearest 0.100 (cup 76%), 0.200 (cup 76%), "
        "0.300 (cup 76%)"
    )
    assert found.values["frames"]["clearest"][0]["stamp_ns"] == 10**8
    # The file of another graph, or a damaged one, is not used.
    provenance.write_seen(path, stamp_ns + 1, seen)
    assert SceneGraph.load(tmp_path).frames(1) is None
    provenance.path_beside(path).write_text("{")
    assert SceneGraph.load(tmp_path).frames(1) is None


# --- the space that was seen ---------------------------------------------------------------------

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


def test_points_before_the_wall_are_free_and_views_that_disagree_are_counted() -> None:
    space = provenance.SeenSpace()
    assert [answer.any() for answer in space.look(np.zeros((1, 3)))] == [False, False]
    space.note(frame(1))
    points = np.array([[1.5, 0, 1], [3.0, 0, 1], [4, 0, 1], [-1, 0, 1], [1.5, 2, 1], [0.05, 0, 1]])
    free, occupied = space.look(points)
    assert free.tolist() == [True, False, False, False, False, False]
    assert occupied.tolist() == [False, True, False, False, False, False]
    assert all(len(answer) == 0 for answer in space.look(np.zeros((0, 3))))
    space.note(frame(2, 0.5, wall_m=2.5))
    space.note(frame(3, 1.0, wall_m=4.0))  # it sees through the wall
    free, occupied = space.look(np.array([[3.0, 0.0, 1.0], [2.0, 0.0, 1.0]]))
    assert (free.tolist(), occupied.tolist()) == ([False, True], [True, False])


def test_only_different_views_are_kept_and_no_more_than_some() -> None:
    space = provenance.SeenSpace()
    for stamp_ns in range(50):
        space.note(frame(stamp_ns, x_m=0.004 * stamp_ns))
    assert len(space) == 1
    space.note(frame(60, turn_rad=0.3))
    space.note(frame(61, turn_rad=0.2))  # near to the turned one
    space.note(dataclasses.replace(frame(62, x_m=9.0), depth_grid=None))
    assert len(space) == 2
    T = np.eye(4)
    T[1, 3] = 10.0
    change = provenance.TrailChange(np.array([60]), *[np.stack([np.eye(4), T])] * 2)
    space.move(change)  # the views move with their keyframes
    assert space.poses[:, 1, 3].tolist() == [0.0, 10.0]
    for stamp_ns in range(100, 100 + provenance.MAX_VIEWS):
        space.note(frame(stamp_ns, x_m=float(stamp_ns)))
    assert len(space) == provenance.MAX_VIEWS and space.stamps_ns[0] == 100
    assert space.depths_mm.nbytes < 1.3e6
    # Another camera begins again.
    camera = Intrinsics(150.0, 150.0, 159.5, 119.5, 320, 240)
    grid = DepthGrid(np.full((30, 40), 3000, np.uint16), 8, camera)
    space.note(dataclasses.replace(frame(999, x_m=5.0), depth_grid=grid))
    assert space.depths_mm.shape == (1, 30, 40) and space.stamps_ns.tolist() == [999]


@pytest.fixture(scope="module")
def walk() -> GraphBuilder:
    """A camera that turns all around in a round room with a cup; nothing is nearer than 2 m."""
    builder = GraphBuilder(CONFIG, VOCABULARY, "world")
    for stamp_ns in range(1, 20):
        builder.integrate(frame(stamp_ns * 10**8, turn_rad=0.33 * stamp_ns, wall_m=2.0))
    return builder


def test_a_goal_is_before_the_walls_that_are_no_objects(walk: GraphBuilder) -> None:
    graph, space = SceneGraph(walk.full()), walk.space
    cup = graph.one("cup")
    assert graph.goal_near(cup, 1.0).seen_free is None
    far = graph.goal_near(cup, 2.2, towards=(9.0, 0.0, 0.0)).position_m
    assert np.hypot(*far[:2]) > 2.0  # behind the wall: the graph does not know it
    goal = graph.goal_near(cup, 1.0, towards=(9.0, 0.0, 0.0), space=space)
    assert np.hypot(*goal.position_m[:2]) < 2.0
    assert goal.seen_free > 0.3 and goal.to_dict()["seen_free"] == round(goal.seen_free, 2)
    for distance in (1.6, 1.8, 2.0):
        x, y, z = graph.goal_near(cup, distance, space=space).position_m
        assert not space.look(np.array([[x, y, z + 1.0]]))[1].any()


def test_maps_and_saved_graphs_have_both(tmp_path: Path, walk: GraphBuilder) -> None:
    map_path = tmp_path / "room.map"
    write_map(walk, map_path)
    again = read_map(CONFIG, map_path)
    assert len(again.space) == len(walk.space) > 8
    assert len(again.frames.all(again.graph)) == len(walk.frames.all(walk.graph)) > 0
    one, other = copy_state(again), copy_state(walk)
    kept = [name for name in one if name.startswith(("view_", "seen_frames"))]
    assert len(kept) == 6 and all(one[name].tobytes() == other[name].tobytes() for name in kept)
    path = write_graph(tmp_path, walk.full())
    assert SceneGraph.load(tmp_path).goal_near("cup").seen_free is None
    provenance.write_space(path, walk.space)
    assert SceneGraph.load(tmp_path).goal_near("cup").seen_free > 0.0
    provenance.space_path(path).write_bytes(b"no archive")
    assert SceneGraph.load(tmp_path).space is None
    arrays = graph_files.read(map_path)
    for name, wrong, says in (
        ("view_poses", np.zeros((2, 4, 4)), "view_poses"),
        ("view_depths_mm", np.zeros((provenance.MAX_VIEWS + 1, 2, 2), np.uint16), "view_depths_mm"),
        ("view_cameras", np.full((len(walk.space), 4), np.nan), "view_cameras"),
        ("seen_frames", np.zeros(3, np.uint8), "JSON"),
    ):
        graph_files.write(tmp_path / "bad.map", {**arrays, name: wrong})
        with pytest.raises(ConfigurationError, match=says):
            read_map(CONFIG, tmp_path / "bad.map")
