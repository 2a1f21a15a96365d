"""Markers, tables, picture and page of small graphs, and the geometry that they share."""

import base64
import json
import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from support.view import make_edge, make_graph, make_node, make_room

from deworldsg_ros.cli import outputs
from deworldsg_ros.scene.arrays import shared_areas
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.view import page, picture
from deworldsg_ros.view.colours import (
    PALETTE,
    class_colours,
    drawable_edges,
    predicate_colours,
)
from deworldsg_ros.view.markers import markers, pair_id
from deworldsg_ros.view.picture import place
from deworldsg_ros.wire import messages as wire

BACKGROUND_BGR = (247, 250, 251)
# three.js is 0.6 MB of it.
MOST_BYTES = 1_700_000

seeds = st.integers(0, 2**32 - 1)


def test_a_new_label_changes_no_class_colour_and_near_is_grey():
    labels = [f"class {index}" for index in range(len(PALETTE))]
    all_colours = class_colours(labels)
    assert len(set(all_colours.values())) == len(PALETTE)
    for count in range(len(labels)):
        assert class_colours(labels[:count]).items() <= all_colours.items()
    assert class_colours([*labels, "one more"])["one more"] in PALETTE
    colours = predicate_colours({"near": 50, "on": 10, "under": 3})
    assert len(set(colours.values())) == 3
    assert colours["near"] == "#8d93a5"


def test_drawable_edges_have_both_ends_and_symmetric_ones_appear_once():
    nodes = [make_node(1, "cup"), make_node(2, "table")]
    edges = [
        make_edge(1, 2, "near", 0.6),
        make_edge(2, 1, "near", 0.9),
        make_edge(1, 2, "on", 0.5),
        make_edge(2, 1, "on", 0.4),
        make_edge(1, 3, "on", 0.9),
    ]
    drawn = drawable_edges(make_graph(nodes, edges))
    assert [(edge.subject, edge.predicate) for edge in drawn] == [(2, "near"), (1, "on"), (2, "on")]


@pytest.mark.parametrize("count", [0, 1, 12, 40])
def test_labels_do_not_overlap_and_stay_inside(count):
    rng = np.random.default_rng(count)
    anchors = rng.uniform(300, 900, (count, 2))
    sizes = np.column_stack([rng.uniform(40, 90, count), np.full(count, 14.0)])
    placed = place(anchors, sizes, np.array([0.0, 0.0, 1200.0, 1200.0]))
    shared = shared_areas(placed.boxes, placed.boxes)
    np.fill_diagonal(shared, 0)
    assert (shared <= 4).all()
    assert (placed.boxes >= 0).all() and (placed.boxes <= 1200).all()
    assert (np.linalg.norm(placed.centres - anchors, axis=1) < 200).all()


# --- markers -----------------------------------------------------------------------------------


def by_namespace(graph):
    found = {}
    for marker in markers(graph):
        found.setdefault(marker.namespace, []).append(marker)
    return found


@given(seeds)
def test_a_sphere_marker_has_the_shape_of_its_gaussian(seed):
    shape = np.random.default_rng(seed).normal(size=(3, 3))
    covariance = shape @ shape.T
    found = by_namespace(make_graph([make_node(4, "cup", (1, 2, 3), covariance)]))
    (sphere,), (label,) = found["objects"], found["labels"]
    assert (sphere.kind, sphere.id, sphere.position) == ("sphere", 4, (1.0, 2.0, 3.0))
    rotation = pose_from_quaternion(np.zeros(3), np.array(sphere.quat_xyzw))[:3, :3]
    deviations = np.array(sphere.scale) / 4
    np.testing.assert_allclose(
        rotation @ np.diag(deviations**2) @ rotation.T, covariance, atol=1e-9
    )
    assert (label.kind, label.text) == ("text", "cup #4")
    assert label.position[2] > 3.0


def test_relations_are_arrows_from_subject_to_object():
    nodes = [make_node(1, "cup", (0, 0, 1)), make_node(2, "table", (1, 0, 0))]
    found = by_namespace(make_graph(nodes, [make_edge(1, 2, "on"), make_edge(1, 9, "near")]))
    (arrow,), (text,) = found["relations"], found["predicates"]
    assert arrow.kind == "arrow"
    assert arrow.points == ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    assert text.text == "on"


def test_marker_ids_are_unique_stable_and_fit_their_message():
    assert markers(make_graph()) == []
    room = make_room(30)
    every = markers(room)
    keys = [(marker.namespace, marker.id) for marker in every]
    assert len(set(keys)) == len(keys)
    assert all(0 <= number < 2**31 for _, number in keys)
    assert markers(room) == every
    fewer = make_graph(room.nodes[5:], room.edges)
    assert {(m.namespace, m.id) for m in markers(fewer)} <= set(keys)
    ids = {pair_id(i, j) for i in range(1, 60) for j in range(1, 60)}
    assert len(ids) == 59 * 59
    assert pair_id(46340, 46340) < 2**31
    assert 0 <= pair_id(10**6, 10**6 + 1) < 2**31


# --- tables ------------------------------------------------------------------------------------


def printed(graph, **options):
    console = Console(width=120, record=True, force_terminal=False)
    with console.capture() as capture:
        outputs.print_graph(console, graph, **options)
    return capture.get()


def test_the_tables_end_with_the_rooms():
    graph = make_graph([make_node(1, "cup")])
    assert "rooms" not in printed(graph)
    corners = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 3.0, 0.0]]
    graph.rooms = [
        wire.RoomState(1, "kitchen", [wire.Belief("kitchen", 0.9)], 0, corners, 12.3, [], []),
        wire.RoomState(2, "office", [wire.Belief("office", 0.55)], 0, corners, 8.0, [], []),
    ]
    assert "rooms: kitchen (room 1) of 12 m², office (room 2) of 8 m² (?)" in printed(graph)


def test_tables_list_objects_and_relations():
    nodes = [
        make_node(1, "cup [red]", (0.5, -1.25, 2), np.diag([0.01, 0.0025, 1e-4]), observations=7),
        make_node(2, "table", observations=30),
    ]
    text = printed(make_graph(nodes, [make_edge(1, 2, "on", 0.83, "fused")]))
    assert "2 objects" in text and "1 relation" in text
    cup = next(line for line in text.splitlines() if "cup [red] #1" in line)
    assert re.search(r"90 %.*0\.50\s+-1\.25\s+2\.00.*35 × 17 × 4.* 7 ", cup)
    assert text.index("table #2") < text.index("cup [red] #1")  # most observed first
    relation = next(line for line in text.splitlines() if "fused" in line)
    assert re.search(r"cup \[red\] #1.*on.*table #2.*67 %.*fused.*4", relation)


def test_tables_of_an_empty_and_of_a_large_graph():
    assert "0 objects" in printed(make_graph())
    text = printed(make_room(25), most=3)
    assert "25 objects (the first 3)" in text
    assert sum(" #" in line for line in text.splitlines()) == 6


# --- picture and page --------------------------------------------------------------------------


def drawn(graph, path, **options):
    """The picture of a graph."""
    picture.draw(graph, path, **options)
    return cv2.imread(str(path)).astype(int)


@pytest.mark.parametrize(
    "graph",
    [
        make_graph(),
        make_graph([make_node(1, "cup")]),
        make_graph([make_node(1, "cup"), make_node(2, "cup")], [make_edge(1, 2), make_edge(2, 3)]),
        make_room(40),
    ],
    ids=["empty", "one", "two at one position", "room"],
)
def test_picture_and_page_of_any_graph(tmp_path, graph):
    sides = drawn(graph, tmp_path / "graph.png").shape[:2]
    assert min(sides) > 700 and max(sides) < 2200
    page.write(graph, tmp_path / "graph.html")
    assert (tmp_path / "graph.html").stat().st_size < MOST_BYTES


def test_up_direction_decides_where_the_picture_shows_an_object(tmp_path):
    # One object far to the right and forward, in the world frame of a camera (y down).
    graph = make_graph([make_node(1, "cup", (0, 0, 0)), make_node(2, "lamp", (3, 0, 2))])

    def height_of_the_lamp(up):
        image = drawn(graph, tmp_path / "graph.png", up_world=up)
        body = np.abs(image - np.array(BACKGROUND_BGR)).sum(axis=2)[80:-80] > 60
        columns = np.nonzero(body.any(axis=0))[0]
        return np.nonzero(body[:, columns.mean().astype(int) :])[0].mean() / len(body)

    assert height_of_the_lamp((0, -1, 0)) < 0.5 < height_of_the_lamp((0, 1, 0))


def embedded(path):
    """The text of a page, and its content."""
    text = path.read_text(encoding="utf-8")
    found = re.search(r'<script id="graph" type="application/json">(.*?)</script>', text, re.S)
    return text, json.loads(found[1])


def test_page_is_self_contained_and_complete(tmp_path):
    room = make_room(21)
    page.write(room, tmp_path / "graph.html", camera_path_world=np.zeros((3, 3)))
    text, details = embedded(tmp_path / "graph.html")
    markup = re.sub(r"<script>.*?</script>", "", text, flags=re.S)
    assert "__" not in markup.replace("__proto__", "")
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=(?!\"data:,\")", text)
    assert [node["id"] for node in details["nodes"]] == [node.id for node in room.nodes]
    assert 0 < len(details["edges"]) <= len(room.edges)
    assert set(details["head"]["tints"]) == {"on", "near", "under"}
    assert details["head"]["verbs"]["on"] == "is on"
    assert all(edge["why"] for edge in details["edges"])
    for node, cloud in zip(room.nodes, details["clouds"], strict=True):
        steps = np.frombuffer(base64.b64decode(cloud["mm"]), "<i2").reshape(-1, 3)
        shown = np.array(cloud["from"]) + steps / 1000
        assert cloud["id"] == node.id and len(steps) == 40
        assert np.abs(shown - node.surface_points_m).max() < 1e-3
    assert len(details["path"]) == 3


def test_a_page_of_1000_objects_is_small(tmp_path):
    page.write(make_room(1000, points=512), tmp_path / "graph.html")
    assert (tmp_path / "graph.html").stat().st_size < MOST_BYTES


def test_page_shows_up_as_z_in_any_world_frame(tmp_path):
    nodes = [make_node(1, "cup", (0, -2.0, 0)), make_node(2, "table", (0, 0, 0))]
    page.write(make_graph(nodes), tmp_path / "graph.html", up_world=(0, -1, 0))
    cup, floor = embedded(tmp_path / "graph.html")[1]["nodes"]
    assert cup["centre"][2] == pytest.approx(2.0)
    assert cup["position"] == [0.0, -2.0, 0.0]
    assert floor["centre"][2] == pytest.approx(0)
