"""Votes of single frames on the relation of two nodes, also of frames that show no relation."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.edges import Pair


@dataclass(slots=True)
class PairVotes:
    """The votes on one unordered pair of nodes (R predicates).

    Attributes:
        frames: number of frames that showed both nodes.
        counts: (2, R) float64, sum over these frames of the probability of each predicate. Row 0:
            the node with the smaller id is the subject. Row 1: it is the object. None = no votes.
        revision: graph revision at which this last changed.
    """

    frames: int
    counts: Float64 | None
    revision: int


class VoteMap:
    """Unordered pairs (smaller id, larger id) with their votes.

    Args:
        predicate_count: R.
    """

    def __init__(self, predicate_count: int) -> None:
        self.predicate_count = predicate_count
        self._votes: dict[Pair, PairVotes] = {}
        self._partners: dict[int, set[int]] = {}
        self._changed: set[Pair] = set()

    @property
    def pairs(self) -> Mapping[Pair, PairVotes]:
        """The map itself, read only."""
        return MappingProxyType(self._votes)

    def partners(self, node_id: int) -> set[int]:
        """Ids of the nodes that were seen together with a node; do not change it."""
        return self._partners.get(node_id, set())

    def take_changed(self) -> set[Pair]:
        """Pairs whose votes changed since the last call; some may have been dropped."""
        changed, self._changed = self._changed, set()
        return changed

    def add(self, pair: Pair, frames: int, counts: Float64 | None, revision: int) -> None:
        """Add frames and votes to a pair of different nodes.

        Args:
            pair: ids, in any order.
            frames: number of frames that showed both.
            counts: (2, R), first row with pair[0] as the subject; None = no votes.
            revision: of the graph.
        """
        if pair[0] > pair[1]:
            pair = (pair[1], pair[0])
            counts = None if counts is None else counts[::-1]
        known = self._votes.get(pair)
        if known is None:
            known = self._votes[pair] = PairVotes(0, None, revision)
            self._partners.setdefault(pair[0], set()).add(pair[1])
            self._partners.setdefault(pair[1], set()).add(pair[0])
        self._changed.add(pair)
        known.frames += frames
        known.revision = revision
        if counts is not None:
            known.counts = counts.copy() if known.counts is None else known.counts + counts

    def repoint(self, old_id: int, new_id: int, revision: int) -> None:
        """Move the votes of one node to another; votes between the two are dropped."""
        for partner, votes in self.drop(old_id):
            if partner == new_id:
                continue
            counts = votes.counts
            if counts is not None and old_id > partner:
                counts = counts[::-1]
            self.add((new_id, partner), votes.frames, counts, revision)

    def copy(self, old_id: int, new_id: int, without: Collection[int], revision: int) -> None:
        """Give a node the votes of another one, except those with some nodes."""
        for partner in sorted(self.partners(old_id) - set(without)):
            votes = self._votes[min(old_id, partner), max(old_id, partner)]
            counts = votes.counts
            if counts is not None and old_id > partner:
                counts = counts[::-1]
            self.add((new_id, partner), votes.frames, counts, revision)

    def drop(self, node_id: int) -> list[tuple[int, PairVotes]]:
        """Remove all votes of a node; returns them with the other node of each pair."""
        dropped = []
        for partner in sorted(self._partners.pop(node_id, set())):
            self._partners[partner].discard(node_id)
            pair = (min(node_id, partner), max(node_id, partner))
            dropped.append((partner, self._votes.pop(pair)))
            self._changed.add(pair)
        return dropped


def frame_votes(logits: Float64) -> Float64:
    """The votes of one frame: the probability of each predicate, or of none.

    The best sigmoid is the probability that the pair is related; it is divided by the softmax.

    Args:
        logits: (m, R) float64, before the sigmoid.

    Returns:
        (m, R) float64, row sums from 0 to 1.
    """
    if not logits.size:
        return np.zeros(logits.shape)
    best = logits.max(axis=1, keepdims=True)
    weights = np.exp(logits - best)
    related = np.exp(-np.logaddexp(0.0, -best))
    votes: Float64 = related * weights / weights.sum(axis=1, keepdims=True)
    return votes
