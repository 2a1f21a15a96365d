"""Graphs in other formats."""

import csv
import json
import os
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.base.files import write_csv
from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.export import FORMATS, SPARK_SYMBOL, export
from deworldsg_ros.scene.camera import pose_from_quaternion

HOSTILE = "cup\nelement vertex 9\x1b[2J\x00\ufffe"


@pytest.mark.timeout(60)  # the number of a long name once took hours
@pytest.mark.parametrize("kind", sorted(FORMATS))
def test_every_format_takes_an_empty_graph_and_a_long_name(tmp_path, kind):
    for graph in (make_graph(), make_graph([make_node(1, "x" * 400_000)])):
        for path in export(SceneGraph(graph), kind, tmp_path / "new" / "graph.x"):
            assert path.stat().st_size > 0


def test_other_formats_and_folders_are_refused(tmp_path):
    with pytest.raises(ClientError, match="'xml'"):
        export(SceneGraph(make_graph()), "xml", tmp_path / "x")
    (tmp_path / "file").touch()
    with pytest.raises(ClientError, match="cannot be written"):
        export(SceneGraph(make_graph()), "csv", tmp_path / "file" / "x.csv")


def test_csv_has_all_objects_and_relations(room, tmp_path):
    first, second = export(room, "csv", tmp_path / "graph.csv")
    assert second.name == "graph_relations.csv"
    objects = list(csv.DictReader(first.open()))
    assert [int(row["id"]) for row in objects] == [item.id for item in room]
    assert float(objects[0]["height"]) == room[1].size_m[2]
    assert len(list(csv.DictReader(second.open()))) == len(room.relations())


def test_networkx_reads_the_graphml_and_takes_the_graph(room, tmp_path):
    networkx = pytest.importorskip("networkx")
    (path,) = export(room, "graphml", tmp_path / "graph.graphml")
    read, made = networkx.read_graphml(path, node_type=int), room.to_networkx()
    assert set(read.nodes) == set(made.nodes) == {item.id for item in room}
    assert read.nodes[13]["label"] == "cup"
    assert read.nodes[13]["z"] == room[13].position_m[2]
    assert read.edges[13, 5]["probability"] == pytest.approx(0.992)
    assert made.edges[13, 5, "on"]["provenance"] == "fused"


def test_the_splats_are_the_gaussians(room, tmp_path):
    (path,) = export(room, "ply", tmp_path / "graph.ply")
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if "property" in line]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names)).astype(float)
    assert len(rows) == len(room)
    for row, item in zip(rows, room):
        values = dict(zip(names, row))
        assert [values[name] for name in "xyz"] == pytest.approx(item.mean_m, abs=1e-5)
        quat_xyzw = np.array([values[f"rot_{i}"] for i in (1, 2, 3, 0)])
        rotation = pose_from_quaternion(np.zeros(3), quat_xyzw)[:3, :3]
        scales = np.exp([values[f"scale_{i}"] for i in range(3)])
        covariance = rotation @ np.diag(scales**2) @ rotation.T
        assert covariance == pytest.approx(np.array(item.covariance_m2), abs=1e-5)


def test_spark_dsg_reads_its_json(room, tmp_path):
    spark_dsg = pytest.importorskip("spark_dsg", reason="pip install 'deworldsg_ros[spark]'")
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


@pytest.mark.parametrize("mark", [*"=+-@＝", " ="])
def test_no_cell_is_a_formula_and_numbers_stay(tmp_path, mark):
    name = f"{mark}cmd|'/c calc'!A0"
    node = make_node(1, name, (-1.5, 0, 0))
    (first, _) = export(SceneGraph(make_graph([node])), "csv", tmp_path / "graph.csv")
    (row,) = csv.DictReader(first.open(encoding="utf-8"))
    assert (row["label"], float(row["x"])) == (f"'{name}", -1.5)
    write_csv(tmp_path / "more.csv", [[f"\t{name}", -2, "-0.5", "cup"]])
    (cells,) = csv.reader((tmp_path / "more.csv").open(newline="", encoding="utf-8"))
    assert cells == [f"'\t{name}", "-2", "-0.5", "cup"]


def test_export_to_a_pipe_is_refused_and_does_not_block(room, tmp_path):
    os.mkfifo(tmp_path / "graph.csv")
    with pytest.raises(ClientError, match=r"graph\.csv cannot be written: it is a pipe"):
        export(room, "csv", tmp_path / "graph.csv")


def test_names_are_text_in_every_format(tmp_path):
    nodes = [make_node(1, HOSTILE), make_node(2, "table", (0.4, 0, 0))]
    hostile = SceneGraph(make_graph(nodes, [make_edge(1, 2, HOSTILE)], HOSTILE))
    written = {kind: export(hostile, kind, tmp_path / f"graph.{kind}") for kind in FORMATS}
    (ply,), (graphml,), (spark,) = (written[kind] for kind in ("ply", "graphml", "spark_dsg"))
    header = ply.read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert [line for line in header if line.startswith("element vertex")] == ["element vertex 2"]
    for path in (graphml, *written["csv"]):
        assert not re.search(r"[\x00-\x09\x0b-\x1f]", path.read_text(encoding="utf-8"))
    values = [data.text for data in ElementTree.parse(graphml).iter() if data.text]
    assert any(value.startswith("cup\\u000aelement") for value in values)
    objects, relations = (list(csv.reader(path.open())) for path in written["csv"])
    assert (len(objects), len(relations)) == (3, 2)
    assert json.loads(spark.read_text())["nodes"][0]["attributes"]["name"] == HOSTILE
