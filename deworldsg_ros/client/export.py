"""The graph in the formats of other programs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from deworldsg_ros.base.files import csv_text, write_atomically
from deworldsg_ros.base.words import visible
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.floor_plan import FREE, OCCUPIED, UNKNOWN
from deworldsg_ros.graph.surface import objects_at, surface_of
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt8
from deworldsg_ros.scene.camera import pose_from_quaternion, quaternion_from_rotation
from deworldsg_ros.scene.errors import ClientError

# A node of spark_dsg has the symbol of its layer in the upper byte: O for objects, layer 2.
SPARK_SYMBOL = ord("O") << 56
SPARK_LAYERS = {"AGENTS": 2, "OBJECTS": 2, "PLACES": 3, "ROOMS": 4, "BUILDINGS": 5}
SPARK_VERSION = {"major": 1, "minor": 1, "patch": 3}
# Zeroth spherical harmonic: colours of splats are relative to it.
SH_C0 = 0.28209479177387814
# Pairs of corners of a box that differ in one bit.
BOX_EDGES = [(a, a | 1 << axis) for axis in range(3) for a in range(8) if not a & 1 << axis]
# Cosine of the largest tilt, 6 degrees, at which z still points up.
LEAST_UPRIGHT = 0.995
# Splats of flat objects are this thick at least.
MIN_SIGMA_M = 1e-3
# Primes: the colours of labels depend on a number modulo their product.
_RED, _GREEN, _BLUE = 97, 89, 83

_OBJECT_COLUMNS = (
    "id", "label", "probability", "existence", "x", "y", "z", "length", "width", "height",
    "qx", "qy", "qz", "qw", "observations", "first_seen_s", "last_seen_s", "frame_id",
)  # fmt: skip
_RELATION_COLUMNS = (
    "subject", "predicate", "object", "probability", "provenance", "observations",
)  # fmt: skip


def export(graph: SceneGraph, kind: str, path: Path) -> list[Path]:
    """Write a graph in another format.

    Args:
        graph: to write.
        kind: a key of `FORMATS`.
        path: of the file. CSV writes a second one, ``graph.csv`` and ``graph_relations.csv``, and
            nav2 too: ``room.yaml`` and ``room.pgm``.

    Returns:
        The files written.

    Raises:
        ClientError: for another format, or if a file cannot be written.
    """
    if kind not in FORMATS:
        raise ClientError(f"format '{kind}': expected {', '.join(FORMATS)}")
    written = []
    make = FORMATS[kind]
    contents = nav2_map(graph, path.stem) if make is nav2_map else make(graph)
    for suffix, content in contents.items():
        if suffix.startswith("."):
            target = path.with_suffix(suffix)
        else:
            target = path.with_name(f"{path.stem}{suffix}{path.suffix}") if suffix else path
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(target, content)
        except OSError as error:
            raise ClientError(f"{target} cannot be written: {error.strerror}") from error
        written.append(target)
    return written


def graphml(graph: SceneGraph) -> dict[str, bytes]:
    """GraphML: directed, with typed attributes; opens in Gephi, yEd, networkx."""
    root = ElementTree.Element("graphml", xmlns="http://graphml.graphdrawing.org/xmlns")
    keys = {
        **{("node", name): "string" for name in ("label", "frame_id")},
        **{("node", name): "double" for name in _OBJECT_COLUMNS[2:-1]},
        **{("edge", name): "string" for name in ("predicate", "provenance")},
        ("edge", "probability"): "double",
        ("edge", "observations"): "long",
    }
    for (where, name), kind in keys.items():
        names = {"id": f"{where}.{name}", "for": where, "attr.name": name, "attr.type": kind}
        ElementTree.SubElement(root, "key", names)
    top = ElementTree.SubElement(root, "graph", edgedefault="directed")

    def fill(element: ElementTree.Element, where: str, values: dict[str, object]) -> None:
        for name, value in values.items():
            if (where, name) in keys and value is not None:
                ElementTree.SubElement(element, "data", key=f"{where}.{name}").text = str(value)

    for row in _object_rows(graph):
        fill(ElementTree.SubElement(top, "node", id=str(row["id"])), "node", row)
    for row in _relation_rows(graph):
        ends = {"source": str(row["subject"]), "target": str(row["object"])}
        fill(ElementTree.SubElement(top, "edge", ends), "edge", row)
    ElementTree.indent(root)
    return {"": ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)}


def tables(graph: SceneGraph) -> dict[str, bytes]:
    """Two CSV tables: objects, and relations."""
    return {
        "": _csv(_OBJECT_COLUMNS, _object_rows(graph)),
        "_relations": _csv(_RELATION_COLUMNS, _relation_rows(graph)),
    }


def surface(graph: SceneGraph) -> dict[str, bytes]:
    """PLY of the room: coloured points with the id of their object (0 = none), and boxes as edges.

    Points and boxes are in the world frame. MeshLab, CloudCompare, Blender and Open3D open it.
    """
    points, colours, ids = _surface(graph)
    boxes = [item for item in graph if all(side > 0 for side in item.size_m)]
    corners = np.concatenate([np.zeros((0, 3)), *(_corners(item) for item in boxes)])
    names = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1")]
    vertices = np.zeros(len(points) + len(corners), [*names, ("blue", "u1"), ("object", "<i4")])
    for axis, name in enumerate("xyz"):
        vertices[name] = np.concatenate([points[:, axis], corners[:, axis]])
    shown = [255 * _colour(item.label) for item in boxes]
    colours = np.concatenate([colours, np.repeat(np.reshape(shown, (-1, 3)), 8, axis=0)])
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    vertices["object"] = np.concatenate([ids, np.repeat([item.id for item in boxes], 8)])
    first = len(points) + 8 * np.arange(len(boxes))
    edges = (first[:, None, None] + np.array(BOX_EDGES)).reshape(-1, 2).astype("<i4")
    types = {"f4": "float", "u1": "uchar", "i4": "int"}
    header = [
        *("ply", "format binary_little_endian 1.0", f"comment frame {visible(graph.frame_id)}"),
        *(f"comment object {item.id} {visible(item.label)}" for item in graph),
        f"element vertex {len(vertices)}",
        *(
            f"property {types[vertices.dtype[name].str[1:]]} {name}"
            for name in vertices.dtype.names or ()
        ),
        *(f"element edge {len(edges)}", "property int vertex1", "property int vertex2"),
        "end_header\n",
    ]
    return {"": "\n".join(header).encode() + vertices.tobytes() + edges.tobytes()}


def scene(graph: SceneGraph) -> dict[str, bytes]:
    """GLB of the room: the points of each object, the others, and a box of lines for each object.

    The parts have the names of the objects, so that one can be hidden or cut out; y points up, as
    glTF wants it. Blender, and the viewers of glTF in browsers and headsets, open it.

    Raises:
        ClientError: without the package trimesh.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ClientError(
            "GLB needs the package trimesh: pip install 'deworldsg_ros[glb]'"
        ) from error
    x, y, up = horizontal_axes(graph.up)
    turn = np.stack([x, up, -y])
    points, colours, ids = _surface(graph)
    shown = trimesh.Scene()
    names = {0: "room", **{item.id: item.name for item in graph}}
    for node_id, name in names.items():
        own = ids == node_id
        if own.any():
            cloud = trimesh.PointCloud(points[own] @ turn.T, colors=colours[own])
            shown.add_geometry(cloud, node_name=visible(name), geom_name=visible(name))
    for item in graph:
        if all(side > 0 for side in item.size_m):
            lines = (_corners(item) @ turn.T)[np.array(BOX_EDGES)]
            box = trimesh.load_path(lines)
            box.colors = np.tile(np.append(255 * _colour(item.label), 255), (len(box.entities), 1))
            name = visible(f"{item.name} box")
            shown.add_geometry(box, node_name=name, geom_name=name)
    if shown.is_empty:
        graph.seen_space()  # says why
        raise ClientError("nothing to show: no view has depth, and no object has a box")
    return {"": shown.export(file_type="glb")}


def nav2_map(graph: SceneGraph, name: str = "room") -> dict[str, bytes]:
    """The floor plan as the map server of Nav2 reads it: YAML, and ``NAME.pgm`` beside it.

    Raises:
        ClientError: if z does not point up; the format has maps of the x-y plane only.
    """
    plan = graph.floor_plan()
    axes = plan.T_world_plan[:3, :3]
    if axes[2, 2] < LEAST_UPRIGHT:
        raise ClientError(
            f"up is {tuple(round(value, 2) for value in graph.up)}: a map of Nav2 needs a world "
            "frame whose z axis points up, as with odometry, or poses of a robot"
        )
    shades = {UNKNOWN: 205, FREE: 254, OCCUPIED: 0}
    image = np.zeros(plan.cells.shape, np.uint8)
    for value, shade in shades.items():
        image[plan.cells == value] = shade
    x, y, _ = plan.T_world_plan[:3, 3].tolist()
    yaw = math.atan2(axes[1, 0], axes[0, 0])
    rows, columns = plan.cells.shape
    lines = [
        *(f"image: {json.dumps(f'{name}.pgm')}", "mode: trinary", f"resolution: {plan.cell_m:.4f}"),
        f"origin: [{x:.4f}, {y:.4f}, {yaw:.5f}]",
        *("negate: 0", "occupied_thresh: 0.65", "free_thresh: 0.196\n"),
    ]
    # The first row of the image is the last one of the plan.
    pixels = f"P5\n{columns} {rows}\n255\n".encode() + image[::-1].tobytes()
    return {"": "\n".join(lines).encode(), ".pgm": pixels}


def gaussians(graph: SceneGraph) -> dict[str, bytes]:
    """PLY of the Gaussians as 3D Gaussian splats, one for each object; opens in splat viewers."""
    names = [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
        "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]  # fmt: skip
    labels = [f"comment object {item.id} {visible(item.label)}" for item in graph]
    header = ["ply", "format binary_little_endian 1.0", *labels, f"element vertex {len(graph)}"]
    header += [*(f"property float {name}" for name in names), "end_header\n"]
    rows = np.array([_splat(item) for item in graph], "<f4").reshape(-1, len(names))
    return {"": "\n".join(header).encode() + rows.tobytes()}


def spark_dsg(graph: SceneGraph) -> dict[str, bytes]:
    """JSON of spark_dsg: objects in its layer OBJECTS; Hydra's viewer opens it.

    spark_dsg has at most one edge for a pair, without a direction. It has the highest probability
    as its weight and all relations in its metadata.
    """
    labels = graph.labels
    edges: dict[tuple[int, int], list[dict[str, object]]] = {}
    for row in _relation_rows(graph):
        pair = sorted((int(str(row["subject"])), int(str(row["object"]))))
        edges.setdefault((pair[0], pair[1]), []).append(row)
    layers = [{"layer": layer, "partition": 0} for layer in sorted(set(SPARK_LAYERS.values()))]
    content = {
        "SPARK_DSG_header": {"project_name": "main", "version": SPARK_VERSION},
        "directed": False,
        "multigraph": False,
        "layer_keys": layers,
        "layer_names": {n: {"layer": i, "partition": 0} for n, i in SPARK_LAYERS.items()},
        "metadata": {
            "labelspaces": {"_l2p0": [[index, label] for index, label in enumerate(labels)]},
            "frame_id": graph.frame_id,
        },
        "nodes": [_spark_node(item, labels.index(item.label)) for item in graph],
        "edges": [
            {
                "source": SPARK_SYMBOL + a,
                "target": SPARK_SYMBOL + b,
                "info": {
                    "type": "EdgeAttributes",
                    "weighted": True,
                    "weight": max(float(str(row["probability"])) for row in rows),
                    "metadata": {"relations": rows},
                },
            }
            for (a, b), rows in edges.items()
        ],
    }
    return {"": json.dumps(content).encode()}


FORMATS: dict[str, Callable[[SceneGraph], dict[str, bytes]]] = {
    "graphml": graphml,
    "csv": tables,
    "ply": surface,
    "glb": scene,
    "nav2": nav2_map,
    "splats": gaussians,
    "spark_dsg": spark_dsg,
}


def _surface(graph: SceneGraph) -> tuple[Float32, UInt8, Int64]:
    """The n points of the room (n, 3), their colours, and the ids of their objects.

    There are none without views of the camera, as in a graph from the topics.
    """
    points, colours, _ = surface_of(graph.space).kept()
    return points, colours, objects_at(points, graph.message.nodes)


def _corners(item: SceneObject) -> Float64:
    """The corners (8, 3) of a box; bit k of the row says on which side along axis k."""
    bits = np.array([[(row >> axis) & 1 for axis in range(3)] for row in range(8)])
    T_world_box = pose_from_quaternion(np.array(item.position_m), np.array(item.orientation_xyzw))
    local = (bits - 0.5) * np.array(item.size_m)
    return np.asarray(local @ T_world_box[:3, :3].T + T_world_box[:3, 3])


def _object_rows(graph: SceneGraph) -> list[dict[str, object]]:
    rows = []
    for item in graph:
        label, frame_id = visible(item.label), visible(item.frame_id)
        values: list[object] = [item.id, label, round(item.probability, 4), item.existence]
        values += [*item.position_m, *item.size_m, *item.orientation_xyzw, item.observations]
        values += [item.first_seen_ns / 1e9, item.last_seen_ns / 1e9, frame_id]
        rows.append(dict(zip(_OBJECT_COLUMNS, values)))
    return rows


def _relation_rows(graph: SceneGraph) -> list[dict[str, object]]:
    return [
        {
            "subject": item.subject.id,
            "predicate": visible(item.predicate),
            "object": item.object.id,
            "probability": round(item.probability, 4),
            "provenance": item.provenance,
            "observations": item.observations,
        }
        for item in graph.relations()
    ]


def _csv(columns: tuple[str, ...], rows: list[dict[str, object]]) -> bytes:
    return csv_text([columns, *([row[name] for name in columns] for row in rows)], "\n").encode()


def _splat(item: SceneObject) -> list[float]:
    values, axes = np.linalg.eigh(np.array(item.covariance_m2))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    sigmas = np.maximum(np.sqrt(np.maximum(values, 0.0)), MIN_SIGMA_M)
    x, y, z, w = quaternion_from_rotation(axes).tolist()
    chance = min(max(item.probability, 0.01), 0.99)
    colour = (_colour(item.label) - 0.5) / SH_C0
    return [
        *item.mean_m, 0.0, 0.0, 0.0, *colour.tolist(), math.log(chance / (1 - chance)),
        *np.log(sigmas).tolist(), w, x, y, z,
    ]  # fmt: skip


def _colour(label: str) -> Float64:
    """A colour (3,) from 0.2 to 1 that depends on the class alone."""
    number = 0
    for letter in reversed(label):
        number = (number * 31 + ord(letter)) % (_RED * _GREEN * _BLUE)
    parts = number % _RED, number // _RED % _GREEN, number // (_RED * _GREEN) % _BLUE
    return 0.2 + 0.8 * np.array(parts) / _RED


def _spark_node(item: SceneObject, label: int) -> dict[str, object]:
    turn = dict(zip("xyzw", item.orientation_xyzw))
    red, green, blue = (255 * _colour(item.label)).astype(int).tolist()
    return {
        "id": SPARK_SYMBOL + item.id,
        "layer": SPARK_LAYERS["OBJECTS"],
        "partition": 0,
        "attributes": {
            "type": "ObjectNodeAttributes",
            "name": item.label,
            "position": list(item.position_m),
            "semantic_label": label,
            "semantic_feature": {"rows": 0, "cols": 0, "data": None},
            "color": {"r": red, "g": green, "b": blue, "a": 255},
            "last_update_time_ns": max(item.last_seen_ns, 0),
            "is_active": False,
            "is_predicted": False,
            "registered": False,
            "mesh_connections": [],
            "metadata": {
                "probability": round(item.probability, 4),
                "observations": item.observations,
            },
            "world_R_object": turn,
            "bounding_box": {
                "type": "RAABB",
                "dimensions": list(item.size_m),
                "world_P_center": list(item.position_m),
                "world_R_center": turn,
            },
        },
    }
