"""Graphs in other formats."""

import csv
import json
import os
import re
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
from support.spaces import BLOCK, BLOCK_RGB, seen_room
from support.view import box_at, make_edge, make_graph, make_node

from deworldsg_ros.base.files import write_csv
from deworldsg_ros.client import ClientError, Robot, SceneGraph
from deworldsg_ros.client.export import FORMATS, SPARK_SYMBOL, export
from deworldsg_ros.graph.floor_plan import OCCUPIED, UNKNOWN
from deworldsg_ros.scene.camera import pose_from_quaternion

HOSTILE = "cup\nelement vertex 9\x1b[2J\x00\ufffe"


@pytest.mark.timeout(60)  # the number of a long name once took hours
@pytest.mark.parametrize("kind", sorted(FORMATS))
def test_every_format_takes_an_empty_graph_and_a_long_name(tmp_path, kind):
    if kind == "glb":
        pytest.importorskip("trimesh")
    for message in (make_graph(), make_graph([make_node(1, "x" * 400_000)])):
        graph = SceneGraph(message)
        if kind == "nav2" or (kind == "glb" and not len(graph)):
            with pytest.raises(ClientError, match="no views of the camera"):
                export(graph, kind, tmp_path / "graph.x")
            graph.space = seen_room()
        for path in export(graph, kind, tmp_path / "new" / "graph.x"):
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


@pytest.fixture
def block():
    """A room with a block in it."""
    low, high = np.array(BLOCK)
    box = box_at((low + high) / 2, high - low)
    graph = SceneGraph(make_graph([make_node(7, "box", box=box)]))
    graph.space = seen_room()
    return graph


def test_the_room_is_a_ply_of_points_with_ids_and_of_boxes(block, tmp_path):
    (path,) = export(block, "ply", tmp_path / "room.ply")
    header, body = path.read_bytes().split(b"end_header\n", 1)
    (count, edges) = (int(n) for n in re.findall(rb"element \w+ (\d+)", header))
    kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    named = re.findall(r"property (\w+) (\w+)", header.decode())[:-2]
    vertices = np.frombuffer(body, [(name, kinds[kind]) for kind, name in named], count)
    pairs = np.frombuffer(body[vertices.nbytes :], "<i4").reshape(-1, 2)
    assert len(pairs) == edges == 12
    own = vertices["object"] == 7
    red = (vertices["red"] == BLOCK_RGB[0]) & (vertices["green"] == BLOCK_RGB[1])
    assert red.sum() > 100 and own[red].all()
    corners = vertices[-8:]
    for axis, (low, high) in zip("xyz", np.transpose(BLOCK)):
        assert sorted(corners[axis].tolist()) == pytest.approx([low] * 4 + [high] * 4)
        sides = abs(vertices[axis][pairs[:, 0]] - vertices[axis][pairs[:, 1]])
        assert (sides > 0.01).sum() == 4  # each edge goes along one axis


def test_the_room_is_a_glb_with_named_parts(block, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    (path,) = export(block, "glb", tmp_path / "room.glb")
    scene = trimesh.load(path)
    assert set(scene.geometry) == {"room", "box #7", "box #7 box"}
    points = scene.geometry["box #7"].vertices
    (x0, y0, _), (x1, y1, z1) = BLOCK
    assert points.min(axis=0)[[0, 2]] == pytest.approx([x0, -y1], abs=0.05)
    assert points.max(axis=0) == pytest.approx([x1, z1, -y0], abs=0.05)  # y points up
    assert scene.geometry["box #7 box"].bounds[1] == pytest.approx([x1, z1, -y0], abs=1e-5)


def test_nav2_reads_the_map(block, tmp_path):
    yaml_path, image_path = export(block, "nav2", tmp_path / "room.yaml")
    about = yaml.safe_load(yaml_path.read_text())
    image = cv2.imread(str(tmp_path / about["image"]), cv2.IMREAD_UNCHANGED)
    assert image_path.name == about["image"] == "room.pgm"

    def shade(x, y):
        column, row = (np.array([x, y]) - about["origin"][:2]) / about["resolution"]
        return image[image.shape[0] - 1 - int(row), int(column)]

    assert shade(-1.0, 0.5) == 254
    assert shade(0.8, 0.0) == shade(1.0, 0.2) == 0
    assert set(np.unique(image)) <= {0, 205, 254}
    # As map_server decides: occupancy is 1 - shade / 255.
    assert 1 - 254 / 255 < about["free_thresh"] < 1 - 205 / 255 < about["occupied_thresh"] < 1
    block.up = (0.0, -0.9, -0.44)
    with pytest.raises(ClientError, match="z axis points up"):
        export(block, "nav2", tmp_path / "room.yaml")


def test_a_floor_plan_has_bounds(block):
    plan = block.floor_plan(Robot(height_m=0.3))
    assert plan.at((0.5, 0.0, 0.0)) == OCCUPIED  # the side of the block that is in view
    assert plan.at((0.8, 0.0, 0.0)) == UNKNOWN  # its inside
    with pytest.raises(ClientError, match=r"0\.01 to 1"):
        block.floor_plan(cell_m=1e-4)
    block.space.depths_mm = block.space.depths_mm * 0
    with pytest.raises(ClientError, match="show nothing"):
        block.floor_plan()


def test_the_splats_are_the_gaussians(room, tmp_path):
    (path,) = export(room, "splats", tmp_path / "graph.ply")
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
    kinds = sorted(FORMATS.keys() - {"glb", "nav2"})  # these need views of the camera
    written = {kind: export(hostile, kind, tmp_path / f"graph.{kind}") for kind in kinds}
    (graphml,), (spark,) = (written[kind] for kind in ("graphml", "spark_dsg"))
    for kind, count in (("splats", 2), ("ply", 16)):
        header = written[kind][0].read_bytes().split(b"end_header\n")[0].decode().splitlines()
        found = [line for line in header if line.startswith("element vertex")]
        assert found == [f"element vertex {count}"]
    for path in (graphml, *written["csv"]):
        assert not re.search(r"[\x00-\x09\x0b-\x1f]", path.read_text(encoding="utf-8"))
    values = [data.text for data in ElementTree.parse(graphml).iter() if data.text]
    assert any(value.startswith("cup\\u000aelement") for value in values)
    objects, relations = (list(csv.reader(path.open())) for path in written["csv"])
    assert (len(objects), len(relations)) == (3, 2)
    assert json.loads(spark.read_text())["nodes"][0]["attributes"]["name"] == HOSTILE
