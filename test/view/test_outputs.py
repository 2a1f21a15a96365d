"""Markers, tables, picture and page of small graphs."""

from __future__ import annotations

import base64
import json
import re

import cv2
import numpy as np
import pytest
from rich.console import Console
from support.view import make_edge, make_graph, make_node, make_room

from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.view import page, picture, table
from deworldsg_ros.view.markers import markers, pair_id

BACKGROUND_BGR = (247, 250, 251)
# three.js is 0.6 MB of it.
MOST_BYTES = 1.5e6


def by_namespace(graph):
    found = {}
    for marker in markers(graph):
        found.setdefault(marker.namespace, []).append(marker)
    return found


def test_an_empty_graph_has_no_markers():
    assert markers(make_graph()) == []


def test_a_sphere_marker_has_the_shape_of_its_gaussian():
    rng = np.random.default_rng(2)
    shape = rng.normal(size=(3, 3))
    covariance = shape @ shape.T
    graph = make_graph([make_node(4, "cup", (1, 2, 3), covariance)])
    (sphere,) = by_namespace(graph)["objects"]
    assert (sphere.kind, sphere.id, sphere.position) == ("sphere", 4, (1.0, 2.0, 3.0))
    rotation = pose_from_quaternion(np.zeros(3), np.array(sphere.quat_xyzw))[:3, :3]
    semi_axes = np.array(sphere.scale) / 2
    np.testing.assert_allclose(rotation @ np.diag((semi_axes / 2) ** 2) @ rotation.T, covariance)
    (label,) = by_namespace(graph)["labels"]
    assert (label.kind, label.text) == ("text", "cup #4")
    assert label.position[2] > 3.0


def test_relations_are_arrows_from_subject_to_object():
    nodes = [make_node(1, "cup", (0, 0, 1)), make_node(2, "table", (1, 0, 0))]
    graph = make_graph(nodes, [make_edge(1, 2, "on"), make_edge(1, 9, "near")])
    found = by_namespace(graph)
    (arrow,) = found["relations"]
    assert arrow.kind == "arrow"
    assert arrow.points == ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    assert [text.text for text in found["predicates"]] == ["on"]


def test_marker_ids_are_unique_stable_and_fit_their_message():
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


def printed(graph, **options):
    console = Console(width=120, record=True, force_terminal=False)
    with console.capture() as capture:
        table.print_graph(console, graph, **options)
    return capture.get()


def test_tables_list_objects_and_relations():
    nodes = [
        make_node(1, "cup [red]", (0.5, -1.25, 2), np.diag([0.01, 0.0025, 1e-4]), observations=7),
        make_node(2, "table", observations=30),
    ]
    text = printed(make_graph(nodes, [make_edge(1, 2, "on", 0.83, "fused")]))
    assert "2 objects" in text
    assert "1 relation" in text
    cup = next(line for line in text.splitlines() if "cup [red] #1" in line)
    assert "90 %" in cup
    assert re.search(r"0\.50\s+-1\.25\s+2\.00", cup)
    assert "35 × 17 × 4" in cup
    assert cup.rstrip(" │").endswith("7")
    assert text.index("table #2") < text.index("cup [red] #1")  # most observed first
    relation = next(line for line in text.splitlines() if "83 %" in line)
    assert re.search(r"cup \[red\] #1.*on.*table #2.*83 %.*fused.*4", relation)


def test_tables_of_an_empty_and_of_a_large_graph():
    assert "0 objects" in printed(make_graph())
    text = printed(make_room(25), most=3)
    assert "25 objects (the first 3)" in text
    assert sum(" #" in line for line in text.splitlines()) == 6


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
    picture.draw(graph, tmp_path / "graph.png")
    image = cv2.imread(str(tmp_path / "graph.png"))
    assert min(image.shape[:2]) > 700
    assert max(image.shape[:2]) < 2200
    page.write(graph, tmp_path / "graph.html")
    assert (tmp_path / "graph.html").stat().st_size < MOST_BYTES


def test_up_direction_decides_where_the_picture_shows_an_object(tmp_path):
    # One object far to the right and forward, in the world frame of a camera (y down).
    nodes = [make_node(1, "cup", (0, 0, 0)), make_node(2, "lamp", (3, 0, 2))]
    coloured = {}
    for name, up in {"down": (0, -1, 0), "up": (0, 1, 0)}.items():
        picture.draw(make_graph(nodes), tmp_path / f"{name}.png", up_world=up)
        image = cv2.imread(str(tmp_path / f"{name}.png")).astype(int)
        body = np.abs(image - np.array(BACKGROUND_BGR)).sum(axis=2)[80:-80] > 60
        columns = np.nonzero(body.any(axis=0))[0]
        right = body[:, columns.mean().astype(int) :]
        coloured[name] = np.nonzero(right)[0].mean() / len(body)
    assert coloured["down"] < 0.5 < coloured["up"]


def test_picture_shows_the_camera_path_and_is_repeatable(tmp_path):
    room = make_room(12)
    path = np.column_stack([np.linspace(-3, 3, 50), np.full(50, -3.5), np.full(50, 1.5)])
    for name in ("a", "b"):
        picture.draw(room, tmp_path / f"{name}.png", camera_path_world=path)
    picture.draw(room, tmp_path / "without.png")
    images = [cv2.imread(str(tmp_path / f"{name}.png")) for name in ("a", "b", "without")]
    np.testing.assert_array_equal(images[0], images[1])
    assert images[0].shape != images[2].shape or (images[0] != images[2]).any()


def embedded(text, name):
    found = re.search(rf'<script id="{name}" type="application/json">(.*?)</script>', text, re.S)
    return json.loads(found.group(1))


def test_page_is_self_contained_and_complete(tmp_path):
    room = make_room(21)
    page.write(room, tmp_path / "graph.html", camera_path_world=np.zeros((3, 3)))
    text = (tmp_path / "graph.html").read_text(encoding="utf-8")
    assert "__" not in re.sub(r"<script>.*?</script>", "", text, flags=re.S).replace(
        "__proto__", ""
    )
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=", text)
    details = embedded(text, "graph")
    assert [node["id"] for node in details["nodes"]] == [node.id for node in room.nodes]
    assert 0 < len(details["edges"]) <= len(room.edges)
    assert set(details["tints"]) == {"on", "near", "under"}
    points = details["points"]
    assert points["counts"] == [40] * 21
    steps = np.frombuffer(base64.b64decode(points["xyz"]), "<u2").reshape(-1, 3)
    shown = np.array(points["low"]) + points["step"] * steps
    true = np.concatenate([node.surface_points_m for node in room.nodes])
    assert np.abs(shown - true).max() < 1e-3
    assert len(details["path"]) == 3


def test_page_escapes_labels(tmp_path):
    evil = "</script><script>alert(1)</script>"
    nodes = [make_node(1, evil), make_node(2, "cup", (1, 0, 0))]
    page.write(make_graph(nodes, [make_edge(1, 2, evil)], evil), tmp_path / "graph.html")
    text = (tmp_path / "graph.html").read_text(encoding="utf-8")
    assert evil not in text
    assert embedded(text, "graph")["nodes"][0]["label"] == evil


def test_a_page_of_1000_objects_is_small(tmp_path):
    page.write(make_room(1000, points=512), tmp_path / "graph.html")
    assert (tmp_path / "graph.html").stat().st_size < MOST_BYTES


def test_page_shows_up_as_z_in_any_world_frame(tmp_path):
    nodes = [make_node(1, "cup", (0, -2.0, 0)), make_node(2, "table", (0, 0, 0))]
    page.write(make_graph(nodes), tmp_path / "graph.html", up_world=(0, -1, 0))
    text = (tmp_path / "graph.html").read_text(encoding="utf-8")
    cup, floor = embedded(text, "graph")["nodes"]
    assert cup["centre"][2] == pytest.approx(2.0)
    assert cup["position"] == [0.0, -2.0, 0.0]
    assert floor["centre"][2] == pytest.approx(0)
