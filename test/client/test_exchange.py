"""Graphs in other formats, compared, and merged."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
import typer.testing
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.cli.app import app
from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.combine import Known, align, combine
from deworldsg_ros.client.export import FORMATS, SPARK_SYMBOL, _colour, export
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.scene.camera import invert_pose, rigid_motion, rotation_angle_deg
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import messages as wire

EMPTY = SceneGraph(make_graph())
FOLDER = SceneGraph.load(Path(__file__).parent / "saved" / "scene_graph_v1.json")


def turned(graph: SceneGraph, T: np.ndarray) -> SceneGraph:
    """A graph in another world frame; its points to the millimetre."""
    return SceneGraph(combine(EMPTY, graph, T).message)


@pytest.mark.parametrize("kind", sorted(FORMATS))
def test_every_format_takes_an_empty_graph(tmp_path: Path, kind: str) -> None:
    for path in export(EMPTY, kind, tmp_path / "new" / "graph.x"):
        assert path.stat().st_size > 0


def test_other_formats_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ClientError, match="format 'xml': expected graphml, csv, ply, spark_dsg"):
        export(EMPTY, "xml", tmp_path / "x")
    (tmp_path / "file").touch()
    with pytest.raises(ClientError, match="cannot be written"):
        export(EMPTY, "csv", tmp_path / "file" / "x.csv")


def test_csv_has_all_objects_and_relations(room: SceneGraph, tmp_path: Path) -> None:
    first, second = export(room, "csv", tmp_path / "graph.csv")
    assert second.name == "graph_relations.csv"
    objects = list(csv.DictReader(first.open()))
    assert [int(row["id"]) for row in objects] == [item.id for item in room]
    assert float(objects[0]["height"]) == room[1].size_m[2]
    assert len(list(csv.DictReader(second.open()))) == len(room.relations())


def test_networkx_reads_the_graphml(room: SceneGraph, tmp_path: Path) -> None:
    networkx = pytest.importorskip("networkx")
    (path,) = export(room, "graphml", tmp_path / "graph.graphml")
    graph = networkx.read_graphml(path, node_type=int)
    assert set(graph.nodes) == {item.id for item in room}
    assert graph.nodes[13]["label"] == "cup"
    assert graph.nodes[13]["z"] == room[13].position_m[2]
    assert graph.edges[13, 5]["predicate"] == "on"
    assert graph.edges[13, 5]["probability"] == pytest.approx(0.992)


def test_networkx_in_one_call(room: SceneGraph) -> None:
    networkx = pytest.importorskip("networkx")
    graph = room.to_networkx()
    assert isinstance(graph, networkx.MultiDiGraph)
    assert graph.edges[13, 5, "on"]["provenance"] == "fused"
    assert len(graph) == len(room)


def test_the_splats_are_the_gaussians(room: SceneGraph, tmp_path: Path) -> None:
    (path,) = export(room, "ply", tmp_path / "graph.ply")
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if "property" in line]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    assert len(rows) == len(room)
    for row, item in zip(rows.astype(float), room):
        values = dict(zip(names, row))
        assert [values[name] for name in "xyz"] == pytest.approx(item.mean_m, abs=1e-5)
        w, x, y, z = (values[f"rot_{i}"] for i in range(4))
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        scales = np.exp([values[f"scale_{i}"] for i in range(3)])
        covariance = rotation @ np.diag(scales**2) @ rotation.T
        assert covariance == pytest.approx(np.array(item.covariance_m2), abs=1e-5)


def test_spark_dsg_reads_its_json(room: SceneGraph, tmp_path: Path) -> None:
    spark_dsg = pytest.importorskip(
        "spark_dsg", reason="needs spark_dsg, 276 MB: pip install 'deworldsg_ros[spark]'"
    )
    (path,) = export(room, "spark_dsg", tmp_path / "graph.json")
    graph = spark_dsg.DynamicSceneGraph.load(str(path))
    assert graph.num_nodes() == len(room)
    cup = graph.get_node(SPARK_SYMBOL + 13).attributes
    assert cup.name == "cup"
    assert cup.position == pytest.approx(room[13].position_m)
    assert cup.bounding_box.dimensions == pytest.approx(room[13].size_m)
    assert graph.get_labelspace(2, 0).labels_to_names[cup.semantic_label] == "cup"
    edge = graph.get_edge(SPARK_SYMBOL + 13, SPARK_SYMBOL + 5)
    assert edge.info.weight == pytest.approx(0.992)
    assert edge.info.metadata.get()["relations"][0]["predicate"] == "on"


@pytest.mark.parametrize(
    ("angle", "place"), [(0.0, (0, 0, 0)), (2.5, (5, -3, 1)), (-1.2, (-200, 70, -0.5))]
)
def test_the_transform_between_two_world_frames_is_found(angle: float, place: tuple) -> None:
    T = rigid_motion(np.array(place, float), angle * np.array([0.0, 0.0, 1.0]))
    found = align(list(FOLDER), list(turned(FOLDER, T)))
    rest = found.T_a_b @ T
    assert np.linalg.norm(rest[:3, 3]) < 0.05
    assert rotation_angle_deg(rest[:3, :3]) < 0.5
    assert found.matched >= 0.9 * len(FOLDER)
    assert found.confidence == pytest.approx(align(list(FOLDER), list(FOLDER)).confidence, abs=0.01)
    assert 0.1 < found.confidence <= 1.0


def test_parts_of_a_room_that_overlap_are_merged(room: SceneGraph) -> None:
    def part(keep) -> SceneGraph:
        nodes = [item.state for item in room if keep(item.position_m[1])]
        ids = {node.id for node in nodes}
        edges = [e for e in room.message.edges if {e.subject, e.object} <= ids]
        return SceneGraph(msgspec.structs.replace(room.message, nodes=nodes, edges=edges))

    T = rigid_motion(np.array([3.0, -2.0, 0.5]), np.array([0.0, 0.0, 2.0]))
    first, second = part(lambda y: y < 0.5), turned(part(lambda y: y > -0.6), T)
    combined = combine(first, second)
    assert combined.confidence > 0.1
    whole = SceneGraph(combined.message)
    assert not whole.changes_since(room)
    assert len(whole) == len(room)
    assert len(combined.pairs) == len(first) + len(second) - len(room)
    assert rotation_angle_deg((combined.T_a_b @ T)[:3, :3]) < 0.5
    assert {item.text for item in whole.relations() if item.subject.label == "cup"} >= {
        "cup #13 on dining table #5"
    }
    seen = {item.id: item.observations for item in first}
    both = {pair.before.id for pair in combined.pairs}
    assert all(whole[i].observations == seen[i] * (2 if i in both else 1) for i in seen)


@pytest.mark.parametrize("seed", range(5))
def test_what_the_last_merge_knows_changes_nothing(room: SceneGraph, seed: int) -> None:
    rng, known = np.random.default_rng(seed), Known()

    def changed(graph: SceneGraph) -> SceneGraph:
        nodes = list(graph.message.nodes)
        for at in rng.permutation(len(nodes))[:3].tolist():
            mean = [value + 0.01 for value in nodes[at].mean_m]
            more = nodes[at].observations + 1
            nodes[at] = msgspec.structs.replace(nodes[at], mean_m=mean, observations=more)
        del nodes[rng.integers(len(nodes))]
        ids = {node.id for node in nodes}
        edges = [e for e in graph.message.edges if {e.subject, e.object} <= ids]
        return SceneGraph(msgspec.structs.replace(graph.message, nodes=nodes, edges=edges))

    first, second, T = room, room, np.eye(4)
    for step in range(8):
        first, second = changed(first), changed(second)
        if step == 5:
            T = rigid_motion(np.array([0.02, 0.0, 0.0]), np.array([0.0, 0.0, 0.01]))
        fresh, again = combine(first, second, T), combine(first, second, T, known)
        assert wire.encode(again.message) == wire.encode(fresh.message)
        assert again.ids == fresh.ids


def test_graphs_of_different_rooms_are_not_merged(room: SceneGraph) -> None:
    rng = np.random.default_rng(0)
    other = [make_node(item.id, item.label, rng.uniform(-3, 3, 3) * [1, 1, 0.3]) for item in room]
    with pytest.raises(ClientError, match="give the transform"):
        combine(room, SceneGraph(make_graph(other)))
    with pytest.raises(ClientError, match="no two objects of equal classes"):
        combine(room, SceneGraph(make_graph([make_node(1, "lamp")])))
    with pytest.raises(ClientError, match="the same up"):
        combine(room, room, rigid_motion(np.zeros(3), np.array([1.0, 0.0, 0.0])))
    with pytest.raises(RefusedInput):
        combine(room, room, np.ones((4, 4)))


def test_a_merge_with_itself_changes_only_the_counts(room: SceneGraph) -> None:
    combined = combine(room, room, np.eye(4))
    whole = SceneGraph(wire.decode(wire.encode(combined.message), wire.SceneGraphMessage))
    assert not whole.changes_since(room)
    assert [item.observations for item in whole] == [2 * item.observations for item in room]
    for now, before in zip(whole, room):
        assert now.mean_m == pytest.approx(before.mean_m, abs=1e-3)
        assert np.array(now.covariance_m2) == pytest.approx(
            np.array(before.covariance_m2), abs=1e-4
        )
        assert now.probability == pytest.approx(before.probability, abs=1e-3)
        assert 50 <= len(surface_points(now.state)) <= 120


def test_the_commands(demo_out: Path, tmp_path: Path, room: SceneGraph) -> None:
    def run(*arguments: object) -> typer.testing.Result:
        return typer.testing.CliRunner().invoke(app, list(map(str, arguments)))

    T = rigid_motion(np.array([1.0, 2.0, 0.0]), np.array([0.0, 0.0, 0.5]))
    other = tmp_path / "other.json"
    other.write_text(wire.encode(turned(room, T).message))
    merged = run("merge", demo_out, other, tmp_path / "both.json")
    assert merged.exit_code == 0, merged.stderr
    assert "transform found" in merged.stdout
    assert "34 of the 34 and 34 objects are in both" in merged.stdout
    x, y, z = invert_pose(T)[:3, 3]
    given_ = run(
        "merge", demo_out, other, tmp_path / "b.json", "--transform", f"{x},{y},{z},-28.648"
    )
    assert "34 of the 34 and 34" in given_.stdout, given_.stderr
    assert run("merge", demo_out, other, "x", "--transform", "1,2").exit_code == 2

    assert run("diff", demo_out, tmp_path / "both.json").stdout == "unchanged: 34 objects\n"
    changes = json.loads(run("diff", demo_out, other, "--json").stdout)
    assert changes["moved"] or changes["gone"]
    assert "graph.csv" in run("export", "csv", demo_out, tmp_path / "graph.csv").stdout


HOSTILE = "cup\nelement vertex 9\x1b[2J\x00\ufffe"


@pytest.fixture
def hostile() -> SceneGraph:
    """A graph whose names contain control characters."""
    nodes = [make_node(1, HOSTILE), make_node(2, "table", (0.4, 0, 0))]
    return SceneGraph(make_graph(nodes, [make_edge(1, 2, HOSTILE)], HOSTILE))


def test_names_are_text_in_every_format(hostile: SceneGraph, tmp_path: Path) -> None:
    written = {kind: export(hostile, kind, tmp_path / f"graph.{kind}") for kind in FORMATS}
    (ply,), (graphml,), (spark,) = (written[kind] for kind in ("ply", "graphml", "spark_dsg"))
    header = ply.read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert [line for line in header if "vertex" in line and "comment" not in line] == [
        "element vertex 2"
    ]
    for path in (graphml, *written["csv"]):
        assert not re.search(r"[\x00-\x09\x0b-\x1f]", path.read_text(encoding="utf-8"))
    values = [data.text for data in ElementTree.parse(graphml).iter() if data.text]
    assert any(value.startswith("cup\\u000aelement") for value in values)
    objects, relations = (list(csv.reader(path.open())) for path in written["csv"])
    assert (len(objects), len(relations)) == (3, 2)
    assert json.loads(spark.read_text())["nodes"][0]["attributes"]["name"] == HOSTILE


def test_the_terminal_shows_names_as_text(
    hostile: SceneGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SceneGraph, "load", lambda path: hostile if path.name == "a" else EMPTY)
    commands = (
        ["explain", "a", "1"], ["explain", "a", "1", "2"], ["explain", "a", "1", "--json"],
        ["query", "a", "table"], ["query", "a", "sofa"], ["goal", "a", "1"],
        ["goal", "a", "2"], ["diff", "a", "b"], ["diff", "b", "a"], ["diff", "b", "a", "--json"],
        ["explain", "a", "\x1b[2J"],
    )  # fmt: skip
    for command in commands:
        shown = typer.testing.CliRunner().invoke(app, command)
        text = shown.stdout + shown.stderr
        assert "1b[2J" in text.replace("\n", ""), command
        assert not re.search(r"[\x00-\x09\x0b-\x1f]", text), command
        assert "\nelement" not in text, command


def old_colour(label: str) -> list[float]:
    number = sum(ord(letter) * 31**place for place, letter in enumerate(label))
    rest = np.array([number % 97, number // 97 % 89, number // 8633 % 83])
    return (0.2 + 0.8 * rest / 97.0).tolist()


@pytest.mark.timeout(60)  # with powers of 31, the last one takes hours
def test_the_colours_of_classes_stay_and_long_names_take_no_time() -> None:
    for label in ("", "cup", "dining table", "椅子", "x" * 500):
        assert _colour(label).tolist() == old_colour(label)
    assert _colour("x" * 400_000).min() >= 0.2


def test_sums_of_a_merge_are_those_that_a_message_may_have() -> None:
    most = 2**63 - 1
    many = make_graph([make_node(1, "cup", observations=most)])
    whole = combine(SceneGraph(many), SceneGraph(many), np.eye(4)).message
    assert wire.decode(wire.encode(whole), wire.SceneGraphMessage).nodes[0].observations == most
    last = SceneGraph(make_graph([make_node(most, "cup")]))
    other = SceneGraph(make_graph([make_node(1, "dog", (9, 0, 0)), make_node(2, "cat", (0, 9, 0))]))
    with pytest.raises(ClientError, match="because 2 objects need new ids"):
        combine(last, other, np.eye(4))
    assert combine(other, last, np.eye(4)).ids == {most: 3}
    assert combine(last, last, np.eye(4)).ids == {most: most}
