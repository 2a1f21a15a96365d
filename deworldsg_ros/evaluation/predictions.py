"""Predicted scene graphs of the protocol, read from JSON or from official pickles."""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.files import parse_any_json, parse_json, read_regular
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.errors import EvaluationError

# --- Official prediction pickles, read without executing their code.
#
# A pickle is a program that names functions to call. Each name of a short list resolves to a
# placeholder that stores its arguments, and every other name is refused. The arrays are built
# afterwards, after a check of type, shape and length: numpy's own constructors allocate any shape,
# and its dtypes take any offsets.

# An array takes about 20 operations, and an item of a list one.
MAX_OPERATIONS = 10_000_000
# Numbers in all arrays and lists, as often as they are reached: 10^5 points of a thousand segments.
MAX_ITEMS = 300_000_000
_KINDS = frozenset("?biuf")


class _Dtype:
    """Placeholder of numpy.dtype: its text, and the byte order of its state."""

    def __init__(self, text: Any = "", *_: Any) -> None:
        self.text = text.decode("ascii", errors="replace") if isinstance(text, bytes) else text

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        order = order.decode("ascii", errors="replace") if isinstance(order, bytes) else order
        if order in ("<", ">") and str(self.text)[:1] not in "<>=|":
            self.text = order + str(self.text)

    def dtype(self) -> np.dtype[Any]:
        if isinstance(self.text, str):
            with suppress(TypeError):
                made = np.dtype(self.text)
                if made.kind in _KINDS:
                    return made
        raise EvaluationError(f"pickle has a dtype {self.text!r}: refused, expected numbers")


class _Array:
    """Placeholder of an ndarray, filled by the constructor or by __setstate__."""

    def __init__(self, shape: Any = (0,), dtype: Any = "f8", buffer: Any = None, *rest: Any):
        # Prediction files have no offsets or strides into a shared buffer.
        self.strided = any(item not in (None, 0, "C", "F") for item in rest)
        self.shape, self.dtype, self.buffer, self.fortran = shape, dtype, buffer, "F" in rest

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise EvaluationError("pickle has an array with an unknown state")
        self.shape, self.dtype, self.fortran, self.buffer = state[-4:]

    def array(self) -> np.ndarray[Any, Any]:
        dtype = (self.dtype if isinstance(self.dtype, _Dtype) else _Dtype(self.dtype)).dtype()
        shape = self.shape if isinstance(self.shape, tuple) else (self.shape,)
        if not all(isinstance(side, int) and side >= 0 for side in shape) or self.strided:
            raise EvaluationError(f"pickle has an array of shape {self.shape!r}")
        data = self.buffer
        if isinstance(data, str):
            data = data.encode("latin1")
        if isinstance(data, pickle.PickleBuffer) or (data is None and math.prod(shape) == 0):
            data = bytes(data or b"")
        if not isinstance(data, bytes | bytearray):
            raise EvaluationError(f"pickle has an array of {type(data).__name__}: expected bytes")
        if len(data) != math.prod(shape) * dtype.itemsize:
            raise EvaluationError(
                f"pickle has an array of shape {shape} and {len(data)} bytes: expected "
                f"{math.prod(shape) * dtype.itemsize}"
            )
        made = np.frombuffer(data, dtype).reshape(shape, order="F" if self.fortran else "C")
        return made.astype(dtype.newbyteorder("="), copy=True)


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    """Bytes in old pickle protocols."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise EvaluationError(f"pickle encodes with {encoding!r}: refused")
    return text.encode("latin1")


_NAMES: dict[tuple[str, str], Callable[..., Any]] = {
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): lambda: b"",
    ("builtins", "bytes"): lambda: b"",
    ("collections", "OrderedDict"): lambda *items: dict(*items),
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
}
for _core in ("numpy.core", "numpy._core"):
    # _reconstruct(class, shape, type code): an array that __setstate__ fills.
    _NAMES[f"{_core}.multiarray", "_reconstruct"] = lambda *_: _Array()
    _NAMES[f"{_core}.multiarray", "scalar"] = lambda dtype, data=None: _Array((), dtype, data)
    _NAMES[f"{_core}.numeric", "_frombuffer"] = lambda buffer, dtype, shape, order="C": _Array(
        shape, dtype, buffer, order
    )


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _NAMES:
            raise EvaluationError(
                f"pickle names {module}.{name}: refused; expected only dictionaries, lists, "
                "numbers, text and numpy arrays"
            )
        function = _NAMES[module, name]
        # A new one each time: a pickle may set attributes of what it names.
        return lambda *arguments: function(*arguments)

    def persistent_load(self, pid: Any) -> Any:
        raise EvaluationError("pickle refers to an object outside the file: refused")


def load_pickle(content: bytes, source: str) -> Any:
    """Plain containers and numpy arrays of a pickle.

    Args:
        content: the file.
        source: name of the file in errors.

    Raises:
        EvaluationError: the pickle names anything but plain data, or is damaged.
    """
    try:
        _check_operations(content)
        return _Resolver().resolve(_Unpickler(io.BytesIO(content)).load())
    except EvaluationError as error:
        raise EvaluationError(f"{source}: {error}") from error
    # A damaged pickle raises nearly anything.
    except Exception as error:
        raise EvaluationError(
            f"{source} is no readable pickle ({type(error).__name__}: {error})"
        ) from error


def _check_operations(content: bytes) -> None:
    """Refuse programs whose cost is out of proportion to their length.

    The unpickler makes a table as long as the largest memo index: 5 bytes may ask for gigabytes.
    """
    for count, (operation, argument, _) in enumerate(pickletools.genops(content)):
        if count > MAX_OPERATIONS:
            raise EvaluationError(f"pickle has more than {MAX_OPERATIONS} operations")
        is_index = operation.name in ("PUT", "BINPUT", "LONG_BINPUT")
        # Programs that pickle writes count from 0 and store at most one value an operation.
        if is_index and isinstance(argument, int) and argument > count:
            raise EvaluationError(f"pickle has the memo index {argument}")


class _Resolver:
    """Replaces placeholders by arrays. Shared containers stay shared.

    A few lists that contain each other stand for any number of items, and every later step would
    visit them all. So the items are counted as often as they are reached.
    """

    def __init__(self) -> None:
        # By the id of a value: its result, and its number of items; None while it is made.
        self._made: dict[int, tuple[Any, int] | None] = {}

    def resolve(self, value: Any) -> Any:
        """The value with arrays; raises EvaluationError for anything but plain data."""
        return self._resolve(value)[0]

    def _resolve(self, value: Any) -> tuple[Any, int]:
        if value is None or isinstance(value, str | bytes | bool | int | float):
            return value, 1
        if id(value) not in self._made:
            self._made[id(value)] = None
            self._made[id(value)] = self._make(value)
        made = self._made[id(value)]
        if made is None:
            raise EvaluationError("pickle has a container that contains itself")
        return made

    def _make(self, value: Any) -> tuple[Any, int]:
        if isinstance(value, _Array):
            array = value.array()
            return array, 1 + array.size
        if isinstance(value, dict):
            keys, key_size = self._each(value)
            items, item_size = self._each(value.values())
            return dict(zip(keys, items)), key_size + item_size
        if isinstance(value, list | tuple):
            items, size = self._each(value)
            return type(value)(items), size
        raise EvaluationError(f"pickle holds a {type(value).__name__}: refused")

    def _each(self, values: Iterable[Any]) -> tuple[list[Any], int]:
        made = [self._resolve(item) for item in values]
        size = 1 + sum(size for _, size in made)
        if size > MAX_ITEMS:
            raise EvaluationError(f"pickle stands for more than {MAX_ITEMS} items")
        return [item for item, _ in made], size


# --- Predicted scene graphs of the protocol, and the two formats that they are read from.
#
# The open format (JSON) and the official pickle are described in docs/dev/evaluation/protocol.md.

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
