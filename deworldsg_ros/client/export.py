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
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.errors import ClientError

# A node of spark_dsg has the symbol of its layer in the upper byte: O for objects, layer 2.
SPARK_SYMBOL = ord("O") << 56
SPARK_LAYERS = {"AGENTS": 2, "OBJECTS": 2, "PLACES": 3, "ROOMS": 4, "BUILDINGS": 5}
SPARK_VERSION = {"major": 1, "minor": 1, "patch": 3}
# Zeroth spherical harmonic: colours of splats are relative to it.
SH_C0 = 0.28209479177387814
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
        path: of the file. CSV writes a second one: ``graph.csv`` and ``graph_relations.csv``.

    Returns:
        The files written.

    Raises:
        ClientError: for another format, or if a file cannot be written.
    """
    if kind not in FORMATS:
        raise ClientError(f"format '{kind}': expected {', '.join(FORMATS)}")
    written = []
    for suffix, content in FORMATS[kind](graph).items():
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
    "ply": gaussians,
    "spark_dsg": spark_dsg,
}


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
