"""Directed edges: pairs of ids, and their evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple, TypeVar

import numpy as np

from deworldsg_ros.scene.arrays import Float64, Int64

Pair = tuple[int, int]
# A `key` has two ids.
MAX_ID = 2**31 - 1
Ids = TypeVar("Ids", int, Int64)


def key(first: Ids, second: Ids) -> Ids:
    """One number for a pair of ids, the smaller first."""
    return first << 31 | second


def ends_of(pair_key: int) -> Pair:
    """The two ids of a `key`."""
    return pair_key >> 31, pair_key & 0x7FFFFFFF


class EdgeEvidence(NamedTuple):
    """Evidence of one directed pair of nodes (R predicates); a value, never changed in place.

    Attributes:
        visual_logits: (R,) float64, the sum of the visual relation logits (Eq. 9). Zeros if there
            were none, which is the uniform distribution.
        frames: number of frames with visual evidence; 0 = a geometric neighbour only.
        last_seen_ns: time of the newest evidence of either kind.
        neighbour_frames: number of frames in which the pair was a geometric neighbour (Eq. 8).
        revision: graph revision at which this last changed.
    """

    visual_logits: Float64
    frames: int
    last_seen_ns: int
    neighbour_frames: int
    revision: int


@dataclass(frozen=True)
class EdgeArrays:
    """Evidence of m directed pairs; a value, never changed in place.

    Attributes:
        pairs: (m, 2) int64, ids of subject and object.
        visual_logits: (m, R) float64.
        counts: (m, 4) int64, the other fields of `EdgeEvidence` in their order.
    """

    pairs: Int64
    visual_logits: Float64
    counts: Int64

    @classmethod
    def of(cls, evidence: Mapping[Pair, EdgeEvidence], predicate_count: int) -> EdgeArrays:
        """The arrays of some pairs, in their order."""
        logits, *counts = zip(*evidence.values()) if evidence else [()] * 5
        return cls(
            np.fromiter(chain.from_iterable(evidence), np.int64, 2 * len(evidence)).reshape(-1, 2),
            np.concatenate([np.zeros(0), *logits]).reshape(len(evidence), predicate_count),
            np.array(counts, np.int64).T.copy(),
        )

    def __len__(self) -> int:
        return len(self.pairs)

    def at(self, row: int) -> EdgeEvidence:
        """The evidence of a row."""
        return EdgeEvidence(self.visual_logits[row], *self.counts[row].tolist())
