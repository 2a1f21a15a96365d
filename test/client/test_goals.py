"""Poses from which an object is in view, free directions, explanations and changes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.spaces import add_view, looking
from support.view import box_at, make_edge, make_graph, make_node

from deworldsg_ros.client import ClientError, Robot, SceneGraph
from deworldsg_ros.client.boxes import footprint, gap_m, point_gaps_m, polygon_gap_m
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.wire import messages as wire

FLAT = (0.0, 0.0, 0.0, 1.0)
UP = (0.0, 0.0, 1.0)


def boxed(node_id: int, label: str, center, size, points=()) -> wire.NodeState:
    """An object whose Gaussian has the deviations of its box."""
    covariance = np.diag(np.square(size) / 12)
    return make_node(node_id, label, center, covariance, points=points, box=box_at(center, size))


def graph_of(*nodes, edges=(), **fields) -> SceneGraph:
    return SceneGraph(make_graph(nodes, edges, **fields))


@pytest.fixture
def corner():
    """A cup on a table in the corner of two shelves; free towards +x and -y."""
    rim = [(0.05 * math.cos(a), 0.05 * math.sin(a) - 0.01, 0.8) for a in np.linspace(-3, 0, 20)]
    return graph_of(
        boxed(1, "cup", (0, 0, 0.8), (0.1, 0.1, 0.1), points=rim),
        boxed(2, "table", (0, 0, 0.37), (0.8, 0.8, 0.74)),
        boxed(3, "shelf", (-0.8, 0, 1), (0.4, 2.0, 2.0)),
        boxed(4, "shelf", (0, 0.8, 1), (2.0, 0.4, 2.0)),
        boxed(5, "chair", (1.5, -1.5, 0.4), (0.4, 0.4, 0.8)),
    )


def test_a_goal_is_at_the_distance_faces_the_object_and_is_free(corner):
    goal = corner.goal_near("cup", 0.9)
    spot = footprint(goal.position_m, (0, 0, 0), FLAT, UP)
    assert gap_m(spot, corner[1].footprint) > 0.9
    assert goal.distance_m == pytest.approx(0.9, abs=1e-3)
    T = pose_from_quaternion(np.array(goal.position_m), np.array(goal.orientation_xyzw))
    to_cup = np.subtract(corner[1].position_m, goal.position_m) * [1, 1, 0]
    assert T[:3, 0] @ to_cup == pytest.approx(np.linalg.norm(to_cup))
    assert T[:3, 2] == pytest.approx([0, 0, 1])
    for other in list(corner)[1:]:
        gap = polygon_gap_m(spot.corners, other.footprint.corners)
        assert gap >= 0.3 + goal.clearance_m - 1e-6
    assert goal.clearance_m > 0
    assert goal.in_known_area
    assert goal.blocked_by is None
    assert goal.position_m[1] < 0  # the side whose surface was seen
    assert goal.position_m[2] == pytest.approx(0.0)
    assert goal.across_std_m == pytest.approx(0.1 / 12**0.5, abs=0.01)
    assert goal.bearing_std_rad == pytest.approx(math.atan2(goal.across_std_m, 0.95), abs=0.02)
    near = corner.goal_near("cup", 0.9, towards=(0.2, -8.0, 0.0))
    assert near.position_m[1] < -0.8  # the side of the robot


def test_a_goal_is_not_behind_a_wall_that_was_seen():
    # A thing 0.2 m beside a wall, the robot on the other side of it, and all of both sides seen.
    wall = ((0.5, -1.5, 0.0), (0.6, 1.5, 2.5))
    graph = graph_of(
        boxed(1, "cup", (0.25, 0, 0.8), (0.1, 0.1, 0.1)),
        *(boxed(2 + i, "chair", (x, 1.2 * y, 0.4), (0.4, 0.4, 0.8))
          for i, (x, y) in enumerate(((-1.6, 1), (-1.6, -1), (1.7, 1), (1.7, -1)))),
    )  # fmt: skip
    space = SeenSpace()
    for number in range(24):
        x = -1.0 if number < 12 else 1.4
        add_view(space, looking((x, 0.0, 1.2), 30.0 * number), 10**9 * (number + 1), wall)
    robot = Robot(0.2, 1.3)
    there = (1.8, 0.0, 0.0)
    assert graph.goal_near(1, 0.7, robot=robot, towards=there).position_m[0] > 0.6
    goal = graph.goal_near(1, 0.7, robot=robot, towards=there, space=space)
    assert goal.position_m[0] < 0.3 and goal.seen_free == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(
    ("distance", "words"), [(0.2, "cup #1 at 0.2 m"), (math.nan, "positive"), (1e308, "at most 10")]
)
def test_no_free_side(corner, distance, words):
    with pytest.raises(ClientError, match=words):
        corner.goal_near("cup", distance)
    space = SeenSpace()
    add_view(space, looking((0.0, -2.0, 1.2), 90.0), 10**9)
    with pytest.raises(ClientError, match=words):
        corner.goal_near("cup", distance, space=space)


def test_a_small_robot_goes_where_a_large_one_does_not(corner):
    with pytest.raises(ClientError, match="smaller radius"):
        corner.goal_near("cup", 0.9, robot=Robot(radius_m=2.0))
    shop = graph_of(
        boxed(1, "cup", (0, 0, 0.8), (0.1, 0.1, 0.1)),
        boxed(2, "canopy", (0, 0, 1.0), (6.0, 6.0, 0.1)),
        boxed(3, "rug", (9, 0, 0.005), (1.0, 1.0, 0.01)),
    )
    assert shop.goal_near("cup", 0.9, robot=Robot(height_m=0.2)).clearance_m > 0.0
    with pytest.raises(ClientError, match="no free side"):
        shop.goal_near("cup", 0.9)


@pytest.mark.parametrize("size", [{"radius_m": 0.0}, {"radius_m": math.nan}, {"height_m": 11.0}])
def test_no_robot_has_such_a_size(size):
    with pytest.raises(ClientError, match="expected positive metres"):
        Robot(**size)


def test_the_object_in_the_way_has_a_name(corner):
    goal = replace(corner.goal_near("cup", 0.9), blocked_by=corner[5])
    assert goal.to_dict()["blocked_by"] == {"id": 5, "label": "chair"}


def test_a_goal_as_a_message_for_nav2(corner):
    pytest.importorskip("geometry_msgs")
    goal = corner.goal_near("cup", 0.9)
    message = goal.pose_stamped()
    assert message.header.frame_id == "map"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 5)
    assert message.pose.position.x == goal.position_m[0]
    assert goal.to_dict()["pose"]["orientation"]["w"] == round(message.pose.orientation.w, 5)


@pytest.mark.parametrize("size", [(0, 0, 0), (0.4, 0, 0.3), (0, 0, 0.3), (0.4, 0.1, 0)])
@pytest.mark.parametrize("others", [0, 1, 3])
def test_a_goal_near_objects_without_width(size, others):
    behind = [boxed(2 + i, "cup", (1.5 + i, 0, 0.5), size) for i in range(others)]
    goal = graph_of(boxed(1, "post", (0, 0, 0.5), size), *behind).goal_near(1, 0.8)
    assert goal.distance_m == pytest.approx(0.8, abs=1e-3)
    assert goal.clearance_m == math.inf if not others else goal.clearance_m > 0.0
    assert goal.blocked_by is None
    assert not goal.in_known_area


def standing(center, size, heading_rad: float):
    """The footprint of an upright box."""
    turn = (0, 0, math.sin(heading_rad / 2), math.cos(heading_rad / 2))
    return footprint(center, size, turn, UP)


angles = st.floats(-3.2, 3.2)
places = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2))
lengths = st.floats(0.05, 2) | st.just(0.0)
sizes = st.tuples(lengths, lengths, lengths)


@given(places, sizes, angles, places, sizes, angles)
def test_gaps_are_symmetric_and_zero_only_in_contact(p, s, a, q, t, b):
    first, second = standing(p, s, a), standing(q, t, b)
    gap = gap_m(first, second)
    assert gap == pytest.approx(gap_m(second, first))
    reach = np.linalg.norm(s) / 2 + np.linalg.norm(t) / 2
    assert np.linalg.norm(np.subtract(p, q)) - reach - 1e-9 <= gap
    assert gap <= np.linalg.norm(np.subtract(p, q)) + 1e-9
    for corner in first.corners:
        point = np.repeat(corner[None], 4, axis=0)
        exact = polygon_gap_m(point, second.corners)
        assert point_gaps_m(corner, second.corners[None])[0] == pytest.approx(exact, abs=1e-7)


def test_free_directions(corner):
    x, y, z = corner.free_direction("table", room=0.5)
    assert z == 0.0
    assert np.hypot(x, y) == pytest.approx(1.0)
    assert x > -0.1 and y < 0.1
    x, y, _ = corner.free_direction("table", towards=(5.0, 0.0, 0.0), room=0.2)
    assert x > 0.9
    sides = enumerate([(3, 0, 1), (-3, 0, 1), (0, 3, 1), (0, -3, 1)])
    walls = [boxed(i + 2, "wall", center, (4, 4, 2)) for i, center in sides]
    with pytest.raises(ClientError, match="no free side"):
        graph_of(boxed(1, "cup", (0, 0, 1), (1, 1, 1)), *walls).free_direction("cup")


def test_why(corner):
    graph = graph_of(*corner.message.nodes, edges=[make_edge(1, 2, "on", 0.9)])
    why = graph.explain((1, 2))
    assert "evidence: seen in 4 frames" in why.lines
    assert why.values["contact"] is True
    assert why.values["gap_m"] == pytest.approx(0.01, abs=1e-3)
    assert "cup #1 is on table #2: 90%" in graph.explain("cup").lines
    assert "not in contact" in str(graph.explain((1, 5)))
    assert "cup #1 may be one: 10%" in graph.explain("other").lines


def test_hidden_objects_tell_why_they_are_hidden(corner):
    message = make_graph(corner.message.nodes)
    message.hidden = [wire.HiddenNode("shop", [1.0, 2.0, 3.0], 0.3, 2, "seen too little")]
    graph = SceneGraph(wire.decode(wire.encode(message), wire.SceneGraphMessage))
    why = graph.explain("shop")
    assert why.lines[0].startswith("hidden at 1.00 2.00 3.00: seen too little")
    assert why.values["hidden"][0]["reason"] == "seen too little"
    assert "never detected" in graph.explain("sofa").lines[-1]


def test_changes_between_sessions_are_found_by_place():
    before = graph_of(
        boxed(1, "table", (0, 0, 0.4), (1, 1, 0.8)),
        boxed(2, "cup", (0, 0, 0.85), (0.1, 0.1, 0.1)),
        boxed(3, "chair", (2, 0, 0.4), (0.4, 0.4, 0.8)),
        boxed(4, "shop", (-4, 0, 1), (0.3, 0.3, 1)),
        boxed(5, "vase", (4, 4, 1), (0.2, 0.2, 0.3)),
    )
    after = graph_of(
        boxed(7, "table", (0.02, 0, 0.4), (1, 1, 0.8)),
        boxed(8, "cup", (0.4, 0.45, 0.85), (0.1, 0.1, 0.1)),
        boxed(9, "stool", (2, 0.01, 0.4), (0.4, 0.4, 0.8)),
        boxed(10, "book", (0, -0.4, 0.85), (0.2, 0.2, 0.02)),
        boxed(11, "vase", (4, 4, 1), (0.2, 0.2, 0.3)),
    )
    changes = after.changes_since(before)
    assert [item.id for item in changes.added] == [10]
    assert [item.id for item in changes.gone] == [4]
    assert [(p.before.id, p.after.id) for p in changes.moved] == [(2, 8)]
    assert [(p.before.id, p.after.id) for p in changes.relabelled] == [(3, 9)]
    assert changes.same == 2
    assert changes.lines[0] == "added book #10 at 0.00 -0.40 0.85"
    assert not after.changes_since(after)
