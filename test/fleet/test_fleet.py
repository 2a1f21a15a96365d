"""Graphs of several robots in worlds of their own become one."""

import numpy as np
from msgspec.structs import replace
from support.view import SAVED, box_at, make_graph, make_node

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.client.combine import moved_object
from deworldsg_ros.fleet.fleet import FRAME_ID, Fleet
from deworldsg_ros.scene.camera import invert_pose, rigid_motion
from deworldsg_ros.wire import messages as wire

ROOM = SceneGraph.load(SAVED)
WORLDS = {
    "ada": np.eye(4),
    "bob": rigid_motion(np.array([30.0, -20.0, 0.5]), np.array([0.0, 0.0, 2.0])),
    "eve": rigid_motion(np.array([-7.0, 90.0, 0.0]), np.array([0.0, 0.0, -1.0])),
}
# Parts of the room, by y: together they are all of it.
SOUTH, NORTH, ALL = (-np.inf, 0.5), (-0.6, np.inf), (-np.inf, np.inf)


def seen_by(name, part=ALL, *, sequence=1, session="", world=None):
    """A part of the room in a robot's world; ids are the robot's own."""
    world = WORLDS[name] if world is None else world
    first = 100 * (1 + list(WORLDS).index(name))
    kept = [item for item in ROOM if part[0] < item.position_m[1] < part[1]]
    ids = {item.id: first + item.id for item in kept}
    moved = [moved_object(item, world, "map", (0.0, 0.0, 1.0)).state for item in kept]
    return replace(
        ROOM.message,
        frame_id="map",
        session=session or name,
        sequence=sequence,
        nodes=[replace(node, id=ids[node.id]) for node in moved],
        edges=[
            replace(edge, subject=ids[edge.subject], object=ids[edge.object])
            for edge in ROOM.message.edges
            if edge.subject in ids and edge.object in ids
        ],
    )


def fleet_of(**parts):
    fleet = Fleet()
    for name, part in parts.items():
        fleet.update(name, seen_by(name, part))
    return fleet


def moved(T, places):
    return places @ T[:3, :3].T + T[:3, 3]


def labels(message):
    return {node.id: node.label for node in message.nodes}


def test_one_robot_with_an_impossible_graph_stops_no_other():
    fleet, bad = fleet_of(ada=ALL), seen_by("bob")
    box = wire.GravityBox([0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0])
    bad.nodes[0] = replace(bad.nodes[0], box=box)
    fleet.update("bob", bad)
    fleet.update("eve", seen_by("eve"))
    assert len(fleet.combine().nodes) == len(ROOM)
    assert fleet.members["eve"].T_fleet_world is not None
    assert "orientation" in fleet.members["bob"].reason


def test_robots_far_away_or_without_classes_stop_no_other():
    far = seen_by("bob")
    far.nodes.append(make_node(999, "cup", (1e8, 1e8, 1e8), box=box_at((0, 0, 0))))
    nothing = [replace(node, classes=[], remainder=1.0) for node in seen_by("eve").nodes]
    fleet = fleet_of(ada=ALL)
    fleet.update("bob", far)
    fleet.update("eve", replace(seen_by("eve"), nodes=nothing))
    for sequence in (2, 3):
        whole = fleet.combine()
        assert len(whole.nodes) >= len(ROOM)
        wire.decode(wire.encode(whole), wire.SceneGraphMessage)
        fleet.update("ada", seen_by("ada", sequence=sequence))
    assert "at most 1e+08 m" in fleet.members["bob"].reason


def test_three_robots_in_unknown_worlds_have_one_node_an_object():
    fleet = fleet_of(ada=SOUTH, bob=NORTH, eve=ALL)
    whole = fleet.combine()
    assert whole.frame_id == FRAME_ID
    assert len(whole.nodes) == len(ROOM)
    assert not SceneGraph(whole).changes_since(ROOM)
    places = np.array([item.position_m for item in ROOM])
    for name, member in fleet.members.items():
        assert member.T_fleet_world is not None and member.reason == ""
        error = member.T_fleet_world @ WORLDS[name]
        assert np.abs(moved(error, places) - places).max() < 0.05
    wire.decode(wire.encode(whole), wire.SceneGraphMessage)


def test_a_robot_gets_what_only_others_saw_in_its_own_world():
    fleet = fleet_of(ada=SOUTH, bob=NORTH)
    assert fleet.part_for("bob") is None  # before the graphs were combined
    fleet.combine()
    part = fleet.part_for("bob")
    only_ada = [item for item in ROOM if item.position_m[1] <= NORTH[0]]
    assert len(part.nodes) == len(only_ada)
    assert part.frame_id == "map"
    for item in SceneGraph(part):
        place = moved(invert_pose(WORLDS["bob"]), item.position_m)
        same = [other.position_m for other in only_ada if other.label == item.label]
        assert min(np.linalg.norm(place - other) for other in same) < 0.05
    ids = {node.id for node in part.nodes}
    assert part.edges and {i for e in part.edges for i in (e.subject, e.object)} <= ids
    assert fleet.part_for("nobody") is None


def test_ids_stay_when_graphs_grow_and_robots_join():
    fleet = fleet_of(ada=SOUTH)
    before = labels(fleet.combine())
    fleet.update("bob", seen_by("bob"))
    between = labels(fleet.combine())
    assert before.items() <= between.items() and len(between) == len(ROOM)
    fleet.update("ada", seen_by("ada", sequence=2))
    after = fleet.combine()
    assert labels(after) == between
    assert after.sequence == 3


def test_what_a_robot_removed_is_removed_if_no_other_has_it():
    fleet = fleet_of(ada=ALL, bob=NORTH)
    whole = fleet.combine()
    fleet.update("ada", seen_by("ada", (0.3, np.inf), sequence=2))
    after = fleet.combine()
    assert len(after.nodes) == sum(item.position_m[1] > NORTH[0] for item in ROOM)
    assert labels(after).keys() < labels(whole).keys()


def test_a_robot_that_started_again_in_another_world_is_located_anew():
    fleet = fleet_of(ada=ALL, bob=ALL, eve=ALL)
    fleet.combine()
    world = rigid_motion(np.array([3.0, 4.0, 0.0]), np.array([0.0, 0.0, 0.7]))
    fleet.update("ada", seen_by("ada", session="again", world=world))
    assert len(fleet.combine().nodes) == len(ROOM)
    assert all(member.T_fleet_world is not None for member in fleet.members.values())


def test_another_room_and_one_that_is_ambiguous_are_not_joined():
    fleet, rng = fleet_of(ada=ALL), np.random.default_rng(0)
    other = [make_node(i, item.label, rng.uniform(-3, 3, 3)) for i, item in enumerate(ROOM, 1)]
    fleet.update("bob", replace(make_graph(other), session="b"))
    assert len(fleet.combine().nodes) == len(ROOM)
    assert "expected" in fleet.status()[1]["reason"]
    # Eight equal chairs around a point look the same after each eighth of a turn.
    angles = np.arange(8) * np.pi / 4
    places = [(2 * np.cos(angle), 2 * np.sin(angle), 0) for angle in angles]
    ring = make_graph([make_node(i, "chair", place) for i, place in enumerate(places, 1)])
    fleet = Fleet()
    for name in ("ada", "bob"):
        fleet.update(name, replace(ring, session=name))
    assert len(fleet.combine().nodes) == 8
    assert "ambiguous" in fleet.status()[1]["reason"]


def test_a_fleet_without_objects_is_empty():
    fleet = Fleet()
    assert fleet.combine().nodes == []
    fleet.update("ada", make_graph())
    assert fleet.combine().nodes == []
    assert fleet.status()[0]["located"] is False
