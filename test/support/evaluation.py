"""Tiny data sets in the official layouts."""

import json
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.evaluation.predictions import ScanPrediction

CLASSES = ("book", "chair", "table")
PREDICATES = ("near", "on", "under")
NAMES = {
    "replica": (
        "ReplicaSSG",
        "ReplicaSSG/objects.json",
        "ReplicaSSG/relationships.json",
        "ReplicaSSG/replica_to_visual_genome.json",
        ("Replica2VisualGenome", "VisualGenome_list", "VisualGenome_rel"),
    ),
    "3rscan": (
        "3DSSG_subset",
        "3DSSG/objects.json",
        "3DSSG_subset/relationships20.json",
        "3DSSG_subset/3dssg_to_scannet.json",
        ("3DSSG2NYUv2", "ScanNet_list", "ScanNet_rel"),
    ),
}


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_ply(path: Path, points: np.ndarray, ids: np.ndarray, form: str = "ascii") -> None:
    """Write a PLY file, ascii or binary_little_endian, with elements around the vertices."""
    header = (
        f"ply\nformat {form} 1.0\ncomment made by a test\n"
        "element sensor 1\nproperty list uchar int numbers\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty ushort objectId\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    if form == "ascii":
        rows = [f"{x!r} {y!r} {z!r} 7 {i}" for (x, y, z), i in zip(points.tolist(), ids.tolist())]
        path.write_text(header + "2 5 6\n" + "\n".join(rows) + "\n3 0 0 0\n")
        return
    table = np.zeros(len(points), [("points", "<f4", 3), ("red", "u1"), ("id", "<u2")])
    table["points"], table["id"] = points, ids
    before = b"\x02" + np.array([5, 6], "<i4").tobytes()
    after = b"\x03" + np.array([0, 0, 0], "<i4").tobytes()
    path.write_bytes(header.encode() + before + table.tobytes() + after)


def write_dataset(
    root: Path,
    scans: Mapping[str, tuple[Sequence[tuple[str, int]], Sequence[tuple[int, int, str]]]],
    *,
    layout: str = "replica",
    split_scans: Sequence[str] | None = None,
) -> Path:
    """Write scans, each of objects (label, id) and relations (subject, object, predicate)."""
    lists, objects, relations, mapping, keys = NAMES[layout]
    labels = {name: name for name in CLASSES} | {"wall": "wall"}
    write_json(root / mapping, dict(zip(keys, (labels, CLASSES, PREDICATES))))
    listed = [
        {"scan": scan, "objects": [{"label": label, "id": str(i)} for label, i in content[0]]}
        for scan, content in scans.items()
    ]
    write_json(root / objects, {"scans": listed})
    # The third field of a relation is wrong on purpose. No reader may use it.
    related = [
        {"scan": scan, "relationships": [[s, o, 99, name] for s, o, name in content[1]]}
        for scan, content in scans.items()
    ]
    write_json(root / relations, {"scans": related})
    (root / lists).mkdir(parents=True, exist_ok=True)
    for name in ("train", "validation", "test"):
        chosen = split_scans if split_scans is not None else list(scans)
        text = "\n".join(chosen if name == "test" else []) + "\n"
        (root / lists / f"{name}_scans.txt").write_text(text)
    for scan, content in scans.items():
        ids = np.repeat([i for _, i in content[0]], 20)
        points = surface(ids)
        write_ply(root / "data" / scan / "labels.instances.annotated.v2.ply", points, ids)
    return root


def surface(ids: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the objects `ids` (n,): x = id metres, and steps of 5 cm along y."""
    points = np.zeros((len(ids), 3))
    points[:, 0] = np.asarray(ids)
    points[:, 1] = 0.05 * (np.arange(len(ids)) % 20)
    return points


def segment(object_id: int, count: int = 10, offset: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """The first points on the surface of one object, translated by `offset`."""
    return surface(np.repeat(object_id, 20))[:count] + np.asarray(offset, float)


def one_hot(index: int) -> list[float]:
    """A certain distribution over three classes or predicates."""
    return np.eye(3)[index].tolist()


def write_predictions(
    path: Path, predictions: Mapping[str, ScanPrediction], protocol: int | None = None
) -> None:
    """Write predictions as FROSS does, in a pickle."""
    scans = {
        scan: {
            "pcd": list(prediction.points_world),
            "cls": prediction.class_scores,
            "edge_index": prediction.edges.T,
            "edge_cls": prediction.edge_scores,
        }
        for scan, prediction in predictions.items()
    }
    path.write_bytes(pickle.dumps(scans, protocol))
