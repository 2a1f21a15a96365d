"""Array types, parallel arrays found by id, softmax, and boxes in images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

# --- Names of the array types that the package uses.

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]
Int16 = NDArray[np.int16]
Int8 = NDArray[np.int8]
UInt64 = NDArray[np.uint64]
UInt32 = NDArray[np.uint32]
UInt16 = NDArray[np.uint16]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]


# --- Parallel arrays with compact rows, found by id.


class Columns:
    """n rows of several arrays. Row r of every array belongs to the id `ids[r]`.

    Rows are compact: if a row is removed, the last row takes its place. So rows move and ids do
    not. Each array is an attribute: a view of the live rows. Adding or removing a row replaces the
    views, so do not keep them.

    Args:
        layout: dtype and shape of a row of each array, by name; ``ids`` is added.

    Attributes:
        ids: (n,) int64.
    """

    ids: Int64

    def __init__(self, layout: Mapping[str, tuple[DTypeLike, tuple[int, ...]]]) -> None:
        self._rows: dict[int, int] = {}
        self._storage: dict[str, NDArray[Any]] = {
            name: np.zeros((64, *shape), dtype)
            for name, (dtype, shape) in {"ids": (np.int64, ()), **layout}.items()
        }
        self._show(0)

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._rows

    @property
    def places(self) -> Mapping[int, int]:
        """The present row of each id; read only. Loops are faster with it than with `row`."""
        return self._rows

    def row(self, node_id: int) -> int:
        """The present row of an id; KeyError if there is none."""
        try:
            return self._rows[node_id]
        except KeyError:
            raise KeyError(f"node {node_id} is not in the graph") from None

    def rows_at(self, ids: Sequence[int]) -> Int64:
        """The present row of each id (n,); KeyError if there is none."""
        try:
            return np.fromiter(map(self._rows.__getitem__, ids), np.int64, len(ids))
        except KeyError as missing:
            raise KeyError(f"node {missing} is not in the graph") from None

    def append(self, node_id: int) -> int:
        """Add a row of zeros for a new id and return it."""
        self.extend([node_id])
        return len(self) - 1

    def extend(self, ids: Sequence[int]) -> None:
        """Add a row of zeros for each of these new ids, in their order."""
        if not ids:
            return
        first, count = len(self._rows), len(self._rows) + len(ids)
        capacity = known = len(self._storage["ids"])
        while count > capacity:
            capacity *= 2
        for name, column in self._storage.items() if capacity > known else ():
            # Zeros that were never written take no memory; a copy of zeros would.
            larger = np.zeros((capacity, *column.shape[1:]), column.dtype)
            larger[:first] = column[:first]
            self._storage[name] = larger
        self._rows.update(zip(ids, range(first, count)))
        self._show(count)
        self.ids[first:] = ids

    def remove(self, node_id: int) -> None:
        """Remove a row; the last row takes its place."""
        row, last = self.row(node_id), len(self._rows) - 1
        moved = int(self.ids[last])
        for column in self._storage.values():
            column[row] = column[last]
            column[last] = 0  # free rows are zeros
        self._rows[moved] = row
        del self._rows[node_id]
        self._show(last)

    def _show(self, count: int) -> None:
        for name, column in self._storage.items():
            setattr(self, name, column[:count])


# --- Softmax. scipy.special has it, too, but takes a third of the start of a node to import.


class SoftmaxWeights(NamedTuple):
    """What the softmax of logits (..., C) is made from.

    Attributes:
        best: (..., 1) the greatest logits.
        exponentials: (..., C) of the logits without the greatest one.
        totals: (..., 1) sums of the exponentials.
    """

    best: Float64
    exponentials: Float64
    totals: Float64


def softmax_weights(logits: Float64) -> SoftmaxWeights:
    """See `SoftmaxWeights`; logits (..., C) float64, C > 0."""
    best = logits.max(axis=-1, keepdims=True)
    exponentials = np.exp(logits - best)
    return SoftmaxWeights(best, exponentials, exponentials.sum(axis=-1, keepdims=True))


def softmax(logits: Float64) -> Float64:
    """The distributions of logits (..., C) float64; each sums to 1."""
    _, exponentials, totals = softmax_weights(logits)
    return np.asarray(exponentials / totals)


# --- Axis-aligned boxes in an image: x1, y1, x2, y2.


def areas(boxes: Float64) -> Float64:
    """Areas (n,) of boxes (n, 4); 0 for an inverted box."""
    return np.asarray(np.clip(boxes[:, 2:] - boxes[:, :2], 0.0, None).prod(axis=1))


def shared_areas(boxes: Float64, others: Float64) -> Float64:
    """Areas (n, m) that boxes (n, 4) share with others (m, 4)."""
    # One array per side: numpy is several times slower with a last axis of two.
    x1, y1, x2, y2 = (np.ascontiguousarray(side)[:, None] for side in boxes.T)
    left, top, right, bottom = np.ascontiguousarray(others.T)
    width = np.maximum(np.minimum(x2, right) - np.maximum(x1, left), 0.0)
    return np.asarray(width * np.maximum(np.minimum(y2, bottom) - np.maximum(y1, top), 0.0))


def pairwise_iou(boxes: Float64, others: Float64) -> Float64:
    """Intersection over union, (n, m), of boxes (n, 4) and others (m, 4); 0 for empty boxes."""
    shared = shared_areas(boxes, others)
    union = areas(boxes)[:, None] + areas(others)[None, :] - shared
    return np.asarray(shared / np.maximum(union, 1e-12))
