"""Questions to a graph, and the typed answers."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.objects import is_class, odds_of, predicate_names
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import messages as wire


@pytest.fixture
def small() -> SceneGraph:
    """A cup on a table, a chair near the table, and a shelf far away."""
    nodes = [
        make_node(1, "cup", (0.0, 0.0, 0.80), np.diag([0.001, 0.001, 0.001])),
        make_node(2, "dining table", (0.0, 0.0, 0.60), np.diag([0.1, 0.05, 0.01])),
        make_node(3, "chair", (1.2, 0.0, 0.45), np.diag([0.02, 0.02, 0.05])),
        make_node(4, "shelf", (5.0, 0.0, 1.0), np.diag([0.02, 0.1, 0.2])),
    ]
    edges = [
        make_edge(1, 2, "standing on", 0.9),
        make_edge(2, 3, "near", 0.8),
        make_edge(3, 2, "under", 0.3),
    ]
    return SceneGraph(make_graph(nodes, edges))


def test_an_empty_graph_answers_nothing() -> None:
    graph = SceneGraph(make_graph())
    assert len(graph) == 0
    assert graph.objects("cup") == graph.relations() == graph.on("table") == []
    assert graph.up == (0.0, 0.0, 1.0)
    with pytest.raises(ClientError, match="no object of class 'cup'; classes of the graph: none"):
        graph.one("cup")


def test_objects_by_class_place_and_probability(small: SceneGraph) -> None:
    assert [item.id for item in small.objects()] == [1, 2, 3, 4]
    assert [item.id for item in small.objects("table")] == [2]
    assert [item.id for item in small.objects(near=(1.0, 0.0, 0.4), within=1.2)] == [3, 2, 1]
    assert [item.id for item in small.objects(near=small[1], within=0.1)] == [2]
    assert small.objects("cup", min_probability=0.95) == []
    assert {item.id for item in small.objects("other", min_probability=0.1)} == {1, 2, 3, 4}
    with pytest.raises(ClientError, match="near"):
        small.objects(within=1.0)


def test_relations_from_both_ends(small: SceneGraph) -> None:
    assert [i.text for i in small.relations("cup", "on")] == ["cup #1 standing on dining table #2"]
    assert small.relations("cup", "lying on") == []
    assert [item.id for item in small.on("table")] == [1]
    assert [item.id for item in small.on(2, "chair")] == []
    # The edge from the chair says "under": the symmetric one is published from the table.
    assert [i.text for i in small.relations("chair", "near")] == []
    graph = SceneGraph(make_graph(list(small.message.nodes), small.message.edges[:2]))
    (near,) = graph.relations("chair", "near", "table")
    assert (near.subject.id, near.object.id, near.probability) == (3, 2, 0.8)
    assert len(graph.relations(predicate="near")) == 1
    assert len(graph.relations_of("chair")) == 1
    assert near.unrelated == pytest.approx(0.2)


def test_neighbours_and_paths(small: SceneGraph) -> None:
    neighbours = small.neighbours("table", within=1.0)
    assert [item.id for item, _ in neighbours] == [1, 3]
    assert neighbours[0][1] == 0.0
    assert 0.3 < neighbours[1][1] < 0.6
    assert [(i.subject.id, i.object.id) for i in small.path("cup", "chair")] == [(1, 2), (2, 3)]
    assert small.path("cup", "shelf") == []


def test_objects_are_frozen_and_tell_everything(small: SceneGraph) -> None:
    cup = small[1]
    assert cup.name == "cup #1"
    assert cup.probability == 0.9
    assert cup.box_source == "gaussian"
    assert cup.other_classes == pytest.approx(0.0)
    assert cup.size_m == pytest.approx([12**0.5 * 0.0316] * 3, abs=2e-3)
    assert cup.to_dict()["sure"]
    with pytest.raises(FrozenInstanceError):
        cup.label = "bowl"  # type: ignore[misc]
    with pytest.raises(ClientError, match="object 9 is not in the graph of 4 objects"):
        small[9]


def test_existence_counts(small: SceneGraph) -> None:
    node = wire.msgspec.structs.replace(small.message.nodes[0], existence=0.5)
    item = SceneGraph(make_graph([node]))[1]
    assert item.probability == pytest.approx(0.45)
    assert not item.is_sure


def test_heights_follow_the_up_direction() -> None:
    node = make_node(1, "cup", (0.0, -2.0, 0.0), np.diag([0.01, 0.0003, 0.01]))
    message = make_graph([node])
    message.up = [0.0, -1.0, 0.0]
    cup = SceneGraph(message)[1]
    assert cup.height_m == pytest.approx(2.0)
    assert cup.size_m[2] == pytest.approx((12 * 0.0003) ** 0.5, abs=2e-3)
    assert cup.footprint.low == pytest.approx(2.0 - cup.size_m[2] / 2, abs=1e-3)


def test_a_file_of_version_1_is_read(room: SceneGraph) -> None:
    assert room.message.schema.version == 1
    assert len(room) == 34
    (cup,) = room.on("dining table", "cup")
    assert cup.position_m == pytest.approx((-0.80, -0.15, 0.80), abs=0.03)
    assert cup.box_source == "surface"
    assert cup.size_m[2] == pytest.approx(0.104, abs=0.02)
    assert len(cup.surface_m) == 60
    assert room.hidden is None


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RefusedInput, match="cannot be read"):
        SceneGraph.load(tmp_path / "nowhere.json")


def test_the_client_of_files_needs_no_ros() -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None\n"
        "import deworldsg_ros.client as c; c.SceneGraph\n"
        "assert not {'numba', 'scipy'} & set(sys.modules)\n"  # which take a second to import
        "try: c.SceneGraphClient\nexcept ImportError: print('needs ROS')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "needs ROS\n"


@pytest.mark.parametrize(
    ("asked", "label", "same"),
    [
        ("", "cup", False),
        ("cup", "cup", True),
        ("Cups", "cup", True),
        ("table", "dining table", True),
        ("dining table", "table", False),
        ("dining_tables", "dining table", True),
        ("shelves", "shelf", True),
        ("teddy", "teddy bear", False),
        ("glass", "wine glass", True),
    ],
)
def test_names_of_classes(asked: str, label: str, same: bool) -> None:
    assert is_class(asked, label) == same


def test_names_of_predicates() -> None:
    assert "standing on" in predicate_names("on")
    assert predicate_names("standing on") == {"standing on"}
    assert predicate_names("eating") == {"eating"}


@pytest.mark.parametrize(
    ("probability", "odds"),
    [(0.0, "none"), (1.0, "certain"), (0.5, "1 : 1"), (0.75, "3 : 1"), (0.01, "1 : 99")],
)
def test_odds(probability: float, odds: str) -> None:
    assert odds_of(probability) == odds
