"""Votes of single frames on the relation of two nodes, also of frames that show no relation."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float64, Int32, Int64
from deworldsg_ros.scene.columns import Columns
from deworldsg_ros.scene.edges import Pair, ends_of, key
from deworldsg_ros.scene.softmax import SoftmaxWeights, softmax_weights


@dataclass(frozen=True)
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


class VoteMap(Columns):
    """Unordered pairs (smaller id, larger id) with their votes; the id of a row is `key` of both.

    Args:
        predicate_count: R.

    Attributes:
        frames, revisions: (n,) int64; see `PairVotes`.
        sums: (n, 2) int32, the row of the votes of each direction; 0 = a row of zeros.
    """

    frames: Int64
    revisions: Int64
    sums: Int32

    def __init__(self, predicate_count: int) -> None:
        super().__init__(
            {"frames": (np.int64, ()), "revisions": (np.int64, ()), "sums": (np.int32, (2,))}
        )
        self.predicate_count = predicate_count
        # Most pairs have votes in one direction, so each direction has a row of its own.
        self._votes = np.zeros((64, predicate_count))
        self._used, self._free = 1, list[int]()
        self._partners: dict[int, array[int]] = {}
        self._changed: set[int] = set()

    @property
    def pairs(self) -> VotesByPair:
        """The map itself, read only."""
        return VotesByPair(self)

    def partners(self, node_id: int) -> set[int]:
        """Ids of the nodes that were seen together with a node."""
        return set(self._partners.get(node_id, ()))

    def take_changed(self) -> set[int]:
        """Keys of the pairs whose votes changed since the last call; some may be dropped."""
        changed, self._changed = self._changed, set()
        return changed

    def of(self, nodes: Int64) -> tuple[Int64, Float64]:
        """Frames (m,) and votes (m, 2, R) of pairs of ids (m, 2), smaller first; 0 if unknown."""
        rows = self._rows_of(key(nodes[:, 0], nodes[:, 1]).tolist())
        if rows.min(initial=0) >= 0:
            return self.frames[rows], self._votes[self.sums[rows]]
        known = rows >= 0
        frames, sums = np.zeros(len(rows), np.int64), np.zeros((len(rows), 2), np.int32)
        frames[known], sums[known] = self.frames[rows[known]], self.sums[rows[known]]
        return frames, self._votes[sums]

    def add(self, pair: Pair, frames: int, counts: Float64 | None, revision: int) -> None:
        """Add frames and votes to a pair of different nodes.

        Args:
            pair: ids, in any order.
            frames: number of frames that showed both.
            counts: (2, R), first row with pair[0] as the subject; None = no votes.
            revision: of the graph.
        """
        self.see(np.array([sorted(pair)]), np.array([frames]), np.array([revision]))
        if counts is not None:
            self.vote(np.array([pair, pair[::-1]], np.int64), np.ascontiguousarray(counts))

    def add_frame(self, seen: Int64, voted: Int64, votes: Float64, revision: int) -> None:
        """Add a frame.

        Args:
            seen: (m, 2) pairs that it showed, the smaller id first.
            voted: (k, 2) subject and object; each is one of these pairs.
            votes: (k, R).
            revision: of the graph after the first pair; each pair adds one.
        """
        revisions = np.arange(revision, revision + len(seen))
        self.see(seen, np.ones(len(seen), np.int64), revisions)
        self.vote(voted, votes)

    def see(self, nodes: Int64, frames: Int64, revisions: Int64) -> None:
        """Add frames (m,) to m pairs of ids (m, 2), the smaller first."""
        keys = key(nodes[:, 0], nodes[:, 1]).tolist()
        rows = self._rows_of(keys)
        if (rows < 0).any():
            new = [one for one in dict.fromkeys(keys) if one not in self.places]
            self.extend(new)
            for first, second in map(ends_of, new):
                self._partners.setdefault(first, array("q")).append(second)
                self._partners.setdefault(second, array("q")).append(first)
            rows = self._rows_of(keys)
        _see(self.frames, self.revisions, rows, frames, revisions)
        self._changed.update(keys)

    def _rows_of(self, keys: list[int]) -> Int64:
        return np.fromiter(map(self.places.get, keys, repeat(-1)), np.int64, len(keys))

    def vote(self, nodes: Int64, votes: Float64) -> None:
        """Add votes (m, R) to m known pairs (m, 2), subject and object."""
        if self._used + len(nodes) > len(self._votes):
            # Zeros that were never written take no memory.
            larger = np.zeros((2 * (self._used + len(nodes)), self.predicate_count))
            larger[: self._used] = self._votes[: self._used]
            self._votes = larger
        rows = self._rows_of([key(min(pair), max(pair)) for pair in nodes.tolist()])
        free = np.array(self._free, np.int64)
        self._used, left = _vote(self.sums, self._votes, self._used, free, rows, nodes, votes)
        del self._free[left:]

    def restore(self, pairs: Mapping[Pair, PairVotes]) -> None:
        """Fill an empty map with the `pairs` of another one."""
        nodes, votes = np.array(list(pairs), np.int64).reshape(-1, 2), list(pairs.values())
        frames, revisions = [one.frames for one in votes], [one.revision for one in votes]
        self.see(nodes, np.array(frames, np.int64), np.array(revisions, np.int64))
        voted = [index for index, one in enumerate(votes) if one.counts is not None]
        counts = np.array([votes[index].counts for index in voted], np.float64)
        directed = np.stack([nodes[voted], nodes[voted, ::-1]], axis=1)
        self.vote(directed.reshape(-1, 2), counts.reshape(2 * len(voted), self.predicate_count))

    def repoint(self, old_id: int, new_id: int, revision: int) -> None:
        """Move the votes of one node to another; votes between the two are dropped."""
        for partner, votes in self.drop(old_id):
            if partner != new_id:
                counts = _seen_from(old_id, partner, votes)
                self.add((new_id, partner), votes.frames, counts, revision)

    def copy(self, old_id: int, new_id: int, without: Collection[int], revision: int) -> None:
        """Give a node the votes of another one, except those with some nodes."""
        for partner in sorted(self.partners(old_id) - set(without)):
            votes = self.pairs[min(old_id, partner), max(old_id, partner)]
            counts = _seen_from(old_id, partner, votes)
            self.add((new_id, partner), votes.frames, counts, revision)

    def drop(self, node_id: int) -> list[tuple[int, PairVotes]]:
        """Remove all votes of a node; returns them with the other node of each pair."""
        dropped = []
        for partner in sorted(self._partners.pop(node_id, ())):
            self._partners[partner].remove(node_id)
            pair = (min(node_id, partner), max(node_id, partner))
            dropped.append((partner, self.pairs[pair]))
            pair_key = key(*pair)
            self._changed.add(pair_key)
            places = self.sums[self.row(pair_key)]
            self._votes[places] = 0.0
            self._free.extend(places[places > 0].tolist())
            self.remove(pair_key)
        return dropped


class VotesByPair(Mapping[Pair, PairVotes]):
    """A vote map by pairs."""

    def __init__(self, votes: VoteMap) -> None:
        self._map = votes

    def of(self, nodes: Int64) -> tuple[Int64, Float64]:
        """See `VoteMap.of`."""
        return self._map.of(nodes)

    def __len__(self) -> int:
        return len(self._map)

    def __iter__(self) -> Iterator[Pair]:
        return (ends_of(key) for key in self._map.places)

    def __getitem__(self, pair: Pair) -> PairVotes:
        votes = self._map
        row = votes.places.get(key(*pair))
        if row is None:
            raise KeyError(pair)
        counts = votes.of(np.array([pair]))[1][0] if votes.sums[row].any() else None
        return PairVotes(int(votes.frames[row]), counts, int(votes.revisions[row]))


def _seen_from(node_id: int, partner: int, votes: PairVotes) -> Float64 | None:
    """The votes of a pair, first row with the node as the subject."""
    return votes.counts if votes.counts is None or node_id < partner else votes.counts[::-1]


@kernel
def _see(frames: Int64, revisions: Int64, rows: Int64, more: Int64, newest: Int64) -> None:
    for index in range(len(rows)):
        frames[rows[index]] += more[index]
        revisions[rows[index]] = newest[index]


@kernel
def _vote(
    sums: Int32,
    known: Float64,
    used: int,
    free: Int64,
    rows: Int64,
    nodes: Int64,
    votes: Float64,
) -> tuple[int, int]:
    """Sum votes by pair and direction; returns how many rows of votes are used, and still free."""
    left = len(free)
    for index in range(len(rows)):
        row, end = rows[index], int(nodes[index, 0] > nodes[index, 1])
        if not votes[index].any():
            continue
        if sums[row, end] == 0:
            if left > 0:
                left -= 1
                sums[row, end] = free[left]
            else:
                sums[row, end] = used
                used += 1
        for predicate in range(votes.shape[1]):
            known[sums[row, end], predicate] += votes[index, predicate]
    return used, left


def frame_votes(logits: Float64, weights: SoftmaxWeights | None = None) -> Float64:
    """The votes of one frame: the probability of each predicate, or of none.

    The best sigmoid is the probability that the pair is related; it is divided by the softmax.

    Args:
        logits: (m, R) float64, before the sigmoid.
        weights: those of the logits, if they are known.

    Returns:
        (m, R) float64, row sums from 0 to 1.
    """
    if not logits.size:
        return np.zeros(logits.shape)
    best, exponentials, totals = weights or softmax_weights(logits)
    related = np.exp(-np.logaddexp(0.0, -best))
    votes: Float64 = related * exponentials / totals
    return votes
