"""Parallel arrays with compact rows, found by id."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from deworldsg_ros.scene.arrays import Int64


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
