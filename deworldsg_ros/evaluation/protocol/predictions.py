"""Predicted scene graphs of the protocol, and the two formats that they are read from.

The open format (JSON) and the official pickle are described in docs/dev/evaluation/protocol.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.protocol.pickles import load_pickle
from deworldsg_ros.files import read_regular
from deworldsg_ros.parsing import parse_any_json, parse_json
from deworldsg_ros.scene.arrays import Float64, Int64

MAX_FILE_BYTES = 2 << 30
# Large detectors know 1200 classes.
MAX_NAMES = 10_000
# Of one scan: 400 MB. A scan with a thousand nodes and a million edges has 26 million.
MAX_SCORES = 50_000_000


@dataclass(frozen=True)
class ScanPrediction:
    """The predicted graph of one scan: N nodes, E edges, C classes, P predicates.

    The order of nodes and edges decides ties.

    Attributes:
        points_world: N arrays (n_i, 3), metres.
        class_scores: (N, C), any number type.
        edges: (E, 2) int64, rows of subject and object among the nodes.
        edge_scores: (E, P), any number type.
        notes: input on which the official program would stop, and how it was handled.
    """

    points_world: tuple[NDArray[np.floating[Any]], ...]
    class_scores: NDArray[Any]
    edges: Int64
    edge_scores: NDArray[Any]
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.points_world)

    @staticmethod
    def empty(class_count: int, predicate_count: int) -> ScanPrediction:
        """A prediction without nodes."""
        return ScanPrediction(
            (),
            np.zeros((0, class_count)),
            np.zeros((0, 2), np.int64),
            np.zeros((0, predicate_count)),
        )


def read_predictions(path: Path) -> dict[str, ScanPrediction]:
    """Predictions of a ``.json`` or ``.pkl`` file, by scan.

    Raises:
        EvaluationError: the file cannot be read or has another format.
    """
    try:
        content = read_regular(path, MAX_FILE_BYTES)
    except OSError as error:
        raise EvaluationError(f"predictions {path} cannot be read ({error.strerror})") from error
    if path.suffix.lower() in (".pkl", ".pickle"):
        return _from_official(load_pickle(content, str(path)), path)
    return _from_open(_parse_json(content, path), path)


def _parse_json(content: bytes, path: Path) -> Any:
    try:
        return parse_json(content, object)
    except ValueError:
        pass
    try:
        # Slower, but it reads NaN and Infinity, which Python's json module writes.
        return parse_any_json(content)
    except ValueError as error:
        raise EvaluationError(f"predictions {path} are not JSON: {error}") from error


def _from_open(content: Any, path: Path) -> dict[str, ScanPrediction]:
    try:
        class_count, predicate_count = int(content["num_classes"]), int(content["num_predicates"])
        scans = dict(content["scans"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise EvaluationError(
            f"predictions {path}: expected num_classes, num_predicates and scans at the top"
        ) from error
    if not (0 <= class_count <= MAX_NAMES and 0 <= predicate_count <= MAX_NAMES):
        raise EvaluationError(
            f"predictions {path}: {class_count} classes and {predicate_count} predicates: expected "
            f"0 to {MAX_NAMES}"
        )
    predictions = {}
    for scan, graph in scans.items():
        try:
            predictions[scan] = _open_scan(graph, class_count, predicate_count)
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            raise EvaluationError(
                f"predictions {path}, scan {scan}: {type(error).__name__}: {error}; expected nodes "
                "with class_index or class_probabilities and points, and edges with subject, "
                "object and predicate_probabilities"
            ) from error
        except EvaluationError as error:
            raise EvaluationError(f"predictions {path}, scan {scan}: {error}") from error
    return predictions


def _open_scan(graph: Any, class_count: int, predicate_count: int) -> ScanPrediction:
    nodes, edges = list(graph["nodes"]), list(graph.get("edges", []))
    notes: list[str] = []
    size = len(nodes) * class_count + len(edges) * predicate_count
    if size > MAX_SCORES:
        raise EvaluationError(f"it has {size} scores: expected at most {MAX_SCORES}")
    class_scores = np.zeros((len(nodes), class_count))
    indices: dict[int, int] = {}
    for row, node in enumerate(nodes):
        node_id = int(node.get("id", row))
        if node_id in indices:
            raise EvaluationError(f"two nodes have the id {node_id}")
        indices[node_id] = row
        if node.get("class_probabilities") is not None:
            class_scores[row] = _vector(node["class_probabilities"], class_count)
        else:
            class_scores[row] = _one_hot(node["class_index"], class_count)
    edge_scores = np.zeros((len(edges), predicate_count))
    ends = np.zeros((len(edges), 2), np.int64)
    for row, edge in enumerate(edges):
        ids = (int(edge["subject"]), int(edge["object"]))
        _refuse_negative(min(ids))
        if not indices.keys() >= set(ids):
            notes.append(f"edge {ids} names a node that does not exist: the edge is ignored")
        ends[row] = [indices.get(end, len(nodes)) for end in ids]
        if edge.get("predicate_probabilities") is not None:
            edge_scores[row] = _vector(edge["predicate_probabilities"], predicate_count)
        else:
            edge_scores[row] = _one_hot(edge["predicate_index"], predicate_count)
    points = tuple(_segment(node.get("points", [])) for node in nodes)
    return ScanPrediction(points, class_scores, ends, edge_scores, notes)


def _one_hot(index: Any, count: int) -> Float64:
    if not isinstance(index, int) or not 0 <= index < count:
        raise EvaluationError(f"index {index!r}: expected a whole number from 0 to {count - 1}")
    row = np.zeros(count)
    row[index] = 1.0
    return row


def _vector(values: Any, count: int) -> Float64:
    # Strict JSON writers write NaN as null, which numpy reads as NaN.
    vector = np.array(values, np.float64)
    if vector.shape != (count,):
        raise EvaluationError(f"vector of {vector.size} scores: expected {count}")
    return vector


def _segment(values: Any) -> NDArray[np.floating[Any]]:
    """Points (n, 3); float32 arrays stay float32."""
    points = np.array(values, np.float64) if isinstance(values, list) else np.asarray(values)
    if points.size == 0:
        return np.zeros((0, 3))
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iuf":
        raise EvaluationError(f"segment of shape {points.shape}: expected (n, 3) numbers")
    return points if points.dtype.kind == "f" else points.astype(np.float64)


def _from_official(content: Any, path: Path) -> dict[str, ScanPrediction]:
    if not isinstance(content, dict):
        raise EvaluationError(f"predictions {path}: expected a dictionary by scan")
    predictions = {}
    for scan, graph in content.items():
        try:
            predictions[str(scan)] = _official_scan(graph)
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            raise EvaluationError(
                f"predictions {path}, scan {scan}: {type(error).__name__}: {error}; expected pcd, "
                "cls, edge_index and edge_cls"
            ) from error
        except EvaluationError as error:
            raise EvaluationError(f"predictions {path}, scan {scan}: {error}") from error
    return predictions


def _official_scan(graph: Mapping[str, Any]) -> ScanPrediction:
    points = tuple(_segment(segment) for segment in graph["pcd"])
    class_scores = _table(graph["cls"], len(points), "cls")
    edges = np.asarray(graph["edge_index"])
    if edges.size == 0:
        edges = np.zeros((2, 0), np.int64)
    if edges.ndim != 2 or edges.shape[0] != 2:
        raise EvaluationError(f"edge_index of shape {edges.shape}: expected (2, E)")
    if edges.dtype.kind == "f" and not (edges == np.floor(edges)).all():
        raise EvaluationError("edge_index contains fractions: expected whole numbers")
    edges = edges.T.astype(np.int64)
    if len(edges):
        _refuse_negative(int(edges.min()))
    notes = []
    if (edges >= len(points)).any():
        notes.append(
            f"edge_index names node {int(edges.max())} of {len(points)}: such edges are ignored"
        )
    return ScanPrediction(
        points, class_scores, edges, _table(graph["edge_cls"], len(edges), "edge_cls"), notes
    )


def _table(values: Any, rows: int, name: str) -> NDArray[Any]:
    """Scores (rows, columns) in the number type of the file."""
    table = np.asarray(values) if not isinstance(values, Sequence) else _stack(values)
    if table.size == 0 and rows == 0:
        return np.zeros((0, table.shape[1] if table.ndim == 2 else 0))
    if table.ndim != 2 or len(table) != rows or table.dtype.kind not in "?biuf":
        raise EvaluationError(f"{name} has the shape {table.shape}: expected {rows} rows of scores")
    return table


def _stack(values: Sequence[Any]) -> NDArray[Any]:
    return np.array([np.asarray(row) for row in values]) if values else np.zeros((0, 0))


def _refuse_negative(smallest: int) -> None:
    if smallest < 0:
        raise EvaluationError(f"an edge names node {smallest}: expected 0 or more")
