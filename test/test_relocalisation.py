"""A run is found in the map of the day before, or waits apart; synthetic rooms."""

import contextlib
import json
import os
from dataclasses import replace

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.nodes_bench import Bench
from typer.testing import CliRunner

from bench.furnished import furnish, local_graphs, look_around, start_frame, tour, with_moved
from deworldsg_ros.cli.app import app
from deworldsg_ros.client import SceneGraph
from deworldsg_ros.config import Config
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import apart_of, read_map, write_map
from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.poses.drift import moved as moved_graph
from deworldsg_ros.relocalisation import MAP_FRAME, Place, Returning, Surfaces
from deworldsg_ros.ros.options import NodeOptions, Parameters
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.camera import invert_pose, rigid_motion, rotation_angle_deg
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.limits import APART_SESSION
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import local_graph_to_message

DAY_NS = 86_400 * 10**9


def built(locals_):
    builder = None
    for local in locals_:
        builder = builder or GraphBuilder(Config(), local.vocabulary, local.frame_id)
        builder.integrate(local)
    return builder


class Day:
    """A room, its map (without a folder there is none), and a run of the next day in it."""

    def __init__(self, folder, seed):
        room = furnish(seed)
        poses = tour(room, 8.0, seed)
        T_map_room = start_frame(poses, seed)
        if folder is not None:
            self.path = folder / "room.map"
            write_map(built(local_graphs(room, poses, T_map_room, seed)), self.path)
        room, _ = with_moved(room, 1 / 3, seed)
        poses = look_around(room, 4.0, seed + 1)
        T_odom_room = start_frame(poses, seed + 1)
        self.T_map_odom = T_map_room @ invert_pose(T_odom_room)
        self.frames = list(local_graphs(room, poses, T_odom_room, seed, start_ns=DAY_NS))

    def map(self):
        return read_map(Config(), self.path)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return Day(tmp_path_factory.mktemp("home"), 2)


@pytest.fixture(scope="module")
def elsewhere():
    return Day(None, 3)


@pytest.fixture(scope="module")
def known(home):
    """The objects of the map, its views, and a place of both."""
    builder = home.map()
    objects = list(SceneGraph(builder.full()))
    return objects, builder.space, Place(objects, builder.space)


def come_back(frames, returning):
    """The graph after the frames, and when it was found."""
    builder = found_ns = None
    for local in frames:
        builder = builder or returning.begin(local.vocabulary, local.frame_id)
        builder.integrate(local)
        if returning.waits and (continued := returning.note(builder, local)) is not None:
            builder, found_ns = continued, local.stamp_ns
    return builder, found_ns


def test_the_map_continues_with_its_ids_and_tells_what_has_changed(home):
    returning = Returning(Config(), home.map())
    builder, found_ns = come_back(home.frames, returning)
    assert found_ns is not None, returning.status
    error = invert_pose(home.T_map_odom) @ returning.found.T_map_world
    assert np.linalg.norm(error[:3, 3]) < 0.03
    assert rotation_angle_deg(error[:3, :3]) < 0.5
    before, after = SceneGraph(home.map().full()), SceneGraph(builder.full())
    assert builder.graph.frame_id == MAP_FRAME
    assert builder.poses_frame == "odom"
    # Most things stayed: they have their ids, and were seen on both days.
    seen_again = [i for i in {item.id for item in before} if i in after]
    again = [i for i in seen_again if after[i].last_seen_ns >= DAY_NS]
    assert len(again) >= 4
    same = [
        i for i in again if np.linalg.norm(np.subtract(after[i].mean_m, before[i].mean_m)) < 0.1
    ]
    assert len(same) >= 0.5 * len(again)
    assert all(after[i].observations > before[i].observations for i in same)
    # Nothing of the first minutes is lost: the frames before it was found are in the graph.
    assert min(item.first_seen_ns for item in after if item.first_seen_ns >= DAY_NS) < found_ns
    changes = returning.changes(after)
    assert changes.moved or changes.gone
    assert not {item.id for item in changes.added} & {item.id for item in before}
    assert all(line.split()[0] in ("new", "gone", "moved") for line in changes.dated_lines)
    assert any("until 19" in line for line in changes.dated_lines)


def test_another_room_waits_apart(home, elsewhere):
    returning = Returning(Config(), home.map())
    builder, found_ns = come_back(elsewhere.frames, returning)
    assert found_ns is None
    assert returning.waits
    assert returning.status.startswith("not yet: ")
    assert builder.graph.frame_id == "odom"
    # No id means two objects.
    assert min(builder.graph.nodes.slot_of) >= home.map().graph.next_id
    other = replace(elsewhere.frames[0].vocabulary, predicates=("beside", "near"))
    waiting = returning.begin(other, "odom")
    returning._next_views = 0
    assert returning.note(waiting, replace(elsewhere.frames[0], vocabulary=other)) is None
    assert returning.status.endswith("the map has other predicates")


def test_the_first_day_begins_the_map_in_its_own_frame(home):
    returning = Returning(Config(), None)
    frames = [replace(local, frame_id="robot1/odom") for local in home.frames[:5]]
    builder, _ = come_back(frames, returning)
    assert builder.graph.frame_id == f"robot1/{MAP_FRAME}"
    assert not returning.waits
    plain = built(home.frames[:5])
    ours, theirs = builder.full(), plain.full()
    assert [n.mean_m for n in ours.nodes] == [n.mean_m for n in theirs.nodes]


def test_poses_of_another_frame_are_placed_in_that_of_the_graph(home):
    T = rigid_motion(np.array([3.0, -1.0, 0.2]), np.array([0.0, 0.0, 1.1]))
    frames = home.frames[:6]
    placed = GraphBuilder(Config(), frames[0].vocabulary, "there")
    placed.place(T, "odom")
    expected = built(replace(moved_graph(local, T), frame_id="there") for local in frames)
    for local in frames:
        placed.integrate(local)
    assert wire.encode(placed.full()) == wire.encode(expected.full())
    with pytest.raises(RefusedInput, match="expected 'odom'"):
        placed.integrate(replace(frames[0], frame_id="there", stamp_ns=2 * DAY_NS))
    with pytest.raises(RefusedInput):
        placed.place(2 * np.eye(4), "odom")
    # A correction comes in the frame of the poses.
    correction = rigid_motion(np.array([0.1, 0.0, 0.0]), np.zeros(3))
    before = {item.id: np.array(item.mean_m) for item in SceneGraph(placed.full())}
    assert placed.apply_correction(correction, 0)
    for item in SceneGraph(placed.full()):
        assert item.mean_m - before[item.id] == pytest.approx(T[:3, :3] @ [0.1, 0, 0], abs=2e-3)
    # And so does a trajectory, of the camera: unchanged, and back to where it was.
    stamps_ns = np.array([local.stamp_ns for local in frames])
    poses = np.array([local.T_world_camera for local in frames])
    assert not placed.apply_trajectory(stamps_ns, correction @ poses)
    assert placed.apply_trajectory(stamps_ns, poses)
    for item in SceneGraph(placed.full()):
        assert item.mean_m == pytest.approx(before[item.id], abs=2e-3)


@pytest.mark.parametrize("seed", range(4))
def test_surfaces_are_put_onto_each_other(known, seed):
    """The fit takes away a motion of decimetres and some degrees, and refuses what is far."""
    rng = np.random.default_rng(seed)
    _, space, place = known
    surfaces = Surfaces.of(space).some()
    T = rigid_motion(rng.uniform(-0.2, 0.2, 3), rng.uniform(-1, 1, 3) * [0.02, 0.02, 0.08])
    rest = place._fitted(T, surfaces)
    assert rest is not None
    middle = surfaces.points.mean(axis=0)
    assert np.linalg.norm(rest[:3, :3] @ middle + rest[:3, 3] - middle) < 0.01
    assert rotation_angle_deg(rest[:3, :3]) < 0.2
    assert place._fitted(rigid_motion(np.array([50.0, 0, 0]), np.zeros(3)), surfaces) is None


def test_without_views_nothing_is_found(known):
    objects, space, place = known
    assert Place(objects, SeenSpace()).find(objects, space) is None
    assert Place([], space).find(objects, space) is None
    found = place.find(objects, space)
    assert found is not None
    assert found.T_map_world == pytest.approx(np.eye(4), abs=2e-3)


class Robot(Bench):
    """A graph_node that looks for the map of a day."""

    def __init__(self, day, folder):
        self.path = folder / "room.map"
        if day is not None and not self.path.exists():
            os.link(day.path, self.path)
        values = {"map_path": str(self.path), "relocalise": True}
        values |= {"save_path": str(folder / "a.json")}
        super().__init__(GraphNode, {"deworldsg/local_graph": String}, parameters=values)
        self.transforms = []
        self.peer.node.create_subscription(
            TransformStamped, "deworldsg/map_transform", self.transforms.append,
            reliable(1, latched=True),
        )  # fmt: skip

    def see(self, frames):
        for local in frames:
            surfaces = tuple(points[:4000] for points in local.surface_points_world)
            local = replace(local, surface_points_world=surfaces)
            self.send(deworldsg__local_graph=local_graph_to_message(local))
            self.expect(lambda ns=local.stamp_ns: self.node.graph.newest_ns == ns, "the frame")

    def call(self, name):
        client = self.peer.node.create_client(Trigger, f"/graph_node/{name}")
        self.expect(client.service_is_ready, "the service")
        future = client.call_async(Trigger.Request())
        self.expect(future.done, "the answer")
        return future.result()


def test_a_node_continues_the_map_when_it_is_found(home, tmp_path):
    with Robot(home, tmp_path) as robot:
        robot.see(home.frames[:2])
        assert robot.node.graph.session.startswith(APART_SESSION)
        assert any("to be found in the map" in text for text in robot.node.graph.problems())
        assert "not yet found" in robot.call("undo").message
        assert not robot.call("changes").success
        assert "unchanged" in robot.call("save").message
        robot.see(home.frames[2:])
        assert not robot.node.graph.session.startswith(APART_SESSION)
        assert robot.node.graph.values()["found in the map"].startswith("after ")
        robot.expect(lambda: len(robot.transforms) > 0, "the transform")
        told = json.loads(robot.call("changes").message)
        assert told["moved"] or told["gone"]
        # A graph that is cleared takes the poses as before.
        assert robot.call("clear").success
        robot.see([replace(home.frames[-1], stamp_ns=home.frames[-1].stamp_ns + 10**9)])
        assert robot.node.graph.builder.graph.frame_id == MAP_FRAME
        assert not robot.node.health.drops.get("wrong_frame")
    header = robot.transforms[0].header, robot.transforms[0].child_frame_id
    assert (header[0].frame_id, header[1]) == (MAP_FRAME, "odom")
    x, y = robot.transforms[0].transform.translation.x, robot.transforms[0].transform.translation.y
    assert (x, y) == pytest.approx(home.T_map_odom[:2, 3], abs=0.05)
    saved = read_map(Config(), tmp_path / "room.map")
    assert saved.graph.frame_id == MAP_FRAME
    assert saved.graph.next_id > home.map().graph.next_id


def test_a_node_leaves_the_map_of_another_room_as_it_is(home, elsewhere, tmp_path):
    content = home.path.read_bytes()
    with Robot(home, tmp_path) as robot:
        robot.see(elsewhere.frames[:15])
    assert (tmp_path / "room.map").read_bytes() == content
    apart = read_map(Config(), apart_of(tmp_path / "room.map"))
    assert apart.newest_ns == elsewhere.frames[14].stamp_ns
    assert apart.graph.frame_id == "odom"


def test_a_node_without_a_map_begins_one(home, tmp_path):
    with Robot(None, tmp_path) as robot:
        robot.see(home.frames[:3])
        robot.expect(lambda: len(robot.transforms) > 0, "the transform")
        assert robot.transforms[0].transform.rotation.w == 1.0
    assert read_map(Config(), tmp_path / "room.map").graph.frame_id == MAP_FRAME


def test_it_needs_a_map(tmp_path):
    done = CliRunner().invoke(app, ["run", str(tmp_path), "--out", "x", "--relocalise"])
    assert done.exit_code == 2
    assert "expected --map FILE" in " ".join(done.output.split())
    with contextlib.ExitStack() as stack:
        stack.enter_context(pytest.raises(ConfigurationError, match="expected a map_path"))
        stack.enter_context(Bench(GraphNode, {}, parameters={"relocalise": True}))
    assert not Parameters(node=NodeOptions()).node.relocalise
