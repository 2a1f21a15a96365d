"""The edges that a map file brings. Most of them never change."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.edges import EdgeArrays, EdgeEvidence, Pair


class SavedEdges:
    """The edges of a map as arrays; a value is made when somebody asks for it.

    Args:
        arrays: of all edges.

    Attributes:
        changed: pairs that have newer evidence, with their rows.
    """

    def __init__(self, arrays: EdgeArrays) -> None:
        self._arrays = arrays
        # Both ends of each pair (2 · row + end), those of one node after those of another.
        ends = arrays.pairs.ravel()
        self._places = ends.argsort(kind="stable")
        self._nodes = ends[self._places]
        # False for pairs that were removed, and the number of the others.
        self._live = np.ones(len(arrays), np.bool_)
        self._count = len(arrays)
        self.changed: dict[Pair, int] = {}

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Pair]:
        """The pairs in their order, also those that changed."""
        first, second = self._arrays.pairs[self._live].T.tolist()
        return zip(first, second)

    def get(self, pair: Pair) -> EdgeEvidence | None:
        """The evidence of a pair; None if there is none, or if it has changed."""
        row = self._row(pair)
        return None if row is None or pair in self.changed else self._arrays.at(row)

    def take(self, pair: Pair) -> EdgeEvidence | None:
        """As `get`, for a pair that is about to change."""
        row = self._row(pair)
        if row is None or pair in self.changed:
            return None
        self.changed[pair] = row
        return self._arrays.at(row)

    def remove(self, pair: Pair) -> None:
        """Forget a pair, if it is one of these."""
        row = self._row(pair)
        if row is not None:
            self._live[row] = False
            self._count -= 1
            self.changed.pop(pair, None)

    def partners(self, node_id: int) -> list[int]:
        """Ids of the nodes that share a pair with a node, in the order of the pairs."""
        others: list[int] = self._arrays.pairs.ravel()[self._places_of(node_id) ^ 1].tolist()
        return others

    def newest(self, values: Mapping[Pair, EdgeEvidence]) -> EdgeArrays:
        """Arrays of these pairs with the newest values, and then of all other values."""
        known, rows = self._arrays, np.flatnonzero(self._live)
        if not values and len(rows) == len(known):
            return known
        width, changed = known.visual_logits.shape[1], self.changed
        new = {pair: value for pair, value in values.items() if pair not in changed}
        more = EdgeArrays.of(new, width)
        if not len(rows):
            return more
        newer = EdgeArrays.of({pair: values[pair] for pair in changed}, width)
        at = rows.searchsorted(np.array(list(changed.values()), np.int64))
        logits = np.concatenate((known.visual_logits[rows], more.visual_logits))
        counts = np.concatenate((known.counts[rows], more.counts))
        logits[at], counts[at] = newer.visual_logits, newer.counts
        return EdgeArrays(np.concatenate((known.pairs[rows], more.pairs)), logits, counts)

    def _places_of(self, node_id: int) -> Int64:
        start, stop = self._nodes.searchsorted([node_id, node_id + 1])
        places = self._places[start:stop]
        live: Int64 = places[self._live[places >> 1]]
        return live

    def _row(self, pair: Pair) -> int | None:
        if not self._count:
            return None
        places = self._places_of(pair[0])
        rows = places[places & 1 == 0] >> 1
        rows = rows[self._arrays.pairs[rows, 1] == pair[1]]
        return int(rows[0]) if len(rows) else None
