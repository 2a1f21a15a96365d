"""Directed pairs of nodes: their evidence, the votes of frames, and a map of both."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, repeat
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import (
    Columns,
    Float64,
    Int32,
    Int64,
    SoftmaxWeights,
    softmax_weights,
)

# --- Directed edges: pairs of ids, and their evidence.

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

    def by_ids(self) -> EdgeArrays:
        """The same, by ascending ids."""
        order = np.lexsort(self.pairs.T[::-1])
        return EdgeArrays(self.pairs[order], self.visual_logits[order], self.counts[order])

    def at(self, row: int) -> EdgeEvidence:
        """The evidence of a row."""
        return EdgeEvidence(self.visual_logits[row], *self.counts[row].tolist())


# --- The edges that a map file brings. Most of them never change.


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


# --- The directed edges of the global graph: a sparse map, and the neighbours of each node.


class EdgeMap:
    """Directed pairs (subject id, object id) with their evidence."""

    def __init__(self, predicate_count: int) -> None:
        # All pairs without visual evidence share one row of zeros.
        self._no_logits = np.zeros(predicate_count)
        self._no_logits.flags.writeable = False
        # All but those of a map that did not change since.
        self._evidence: dict[Pair, EdgeEvidence] = {}
        self._partners: dict[int, dict[int, None]] = {}
        self._changed: set[Pair] = set()
        self._saved = SavedEdges(EdgeArrays.of({}, predicate_count))
        # Whether all saved edges count as changed.
        self._restored = False

    @property
    def evidence(self) -> Mapping[Pair, EdgeEvidence]:
        """The map itself, read only.

        Pairs with `frames == 0` are geometric neighbours without visual evidence.
        """
        if not len(self._saved):
            return MappingProxyType(self._evidence)
        return _Newest(self._evidence, self._saved)

    def arrays(self) -> EdgeArrays:
        """The map as arrays, for `restore`."""
        return self._saved.newest(self._evidence)

    def partners(self, node_id: int) -> Collection[int]:
        """Ids of the nodes that share a pair with a node; do not change it."""
        known = self._partners.get(node_id)
        return dict.fromkeys(self._saved.partners(node_id)) if known is None else known.keys()

    def take_changed(self) -> set[Pair]:
        """Pairs that changed since the last call; some may have been dropped."""
        changed, self._changed = self._changed, set()
        if self._restored:
            changed.update(self._saved)
            self._restored = False
        return changed

    def add_visual(self, logits: Mapping[Pair, Float64], stamp_ns: int, revision: int) -> None:
        """Sum a frame's relation logits (R,) into pairs (Eq. 9).

        Args:
            logits: of each subject and object.
            stamp_ns: of the frame.
            revision: of the graph before the first pair; each pair adds one.

        Raises:
            ValueError: if the logits have another shape.
        """
        evidence = self._evidence
        for pair, summand in logits.items():
            if summand.shape != self._no_logits.shape:
                raise ValueError(
                    f"relation logits have shape {summand.shape}: expected {self._no_logits.shape}"
                )
            revision += 1
            known = evidence.get(pair) or self._saved.take(pair)
            if known is None:
                self.add(pair, EdgeEvidence(summand, 1, stamp_ns, 0, revision))
                continue
            self._changed.add(pair)
            summed, frames, last_ns, neighbour_frames, _ = known
            evidence[pair] = EdgeEvidence(
                summed + summand, frames + 1, max(last_ns, stamp_ns), neighbour_frames, revision
            )

    def add_neighbours(self, pairs: Sequence[Pair], stamp_ns: int, revision: int) -> None:
        """Count a frame in which pairs were geometric neighbours (Eq. 8).

        Args:
            pairs: subject and object of each.
            stamp_ns: of the frame.
            revision: of the graph before the first pair; each pair adds one.
        """
        evidence = self._evidence
        self._changed.update(pairs)
        for pair in pairs:
            revision += 1
            known = evidence.get(pair) or self._saved.take(pair)
            if known is None:
                self.add(pair, EdgeEvidence(self._no_logits, 0, stamp_ns, 1, revision))
                continue
            summed, frames, last_ns, neighbour_frames, _ = known
            evidence[pair] = EdgeEvidence(
                summed, frames, max(last_ns, stamp_ns), neighbour_frames + 1, revision
            )

    def add(self, pair: Pair, more: EdgeEvidence) -> None:
        """Add evidence to a pair: logits and frames are summed."""
        known = self._evidence.get(pair) or self._saved.take(pair)
        if known is None:
            known = EdgeEvidence(self._no_logits, 0, more.last_seen_ns, 0, more.revision)
            self._partners_of(pair[0])[pair[1]] = None
            self._partners_of(pair[1])[pair[0]] = None
        self._changed.add(pair)
        self._evidence[pair] = EdgeEvidence(
            known.visual_logits + more.visual_logits if more.frames else known.visual_logits,
            known.frames + more.frames,
            max(known.last_seen_ns, more.last_seen_ns),
            known.neighbour_frames + more.neighbour_frames,
            more.revision,
        )

    def restore(self, arrays: EdgeArrays) -> None:
        """Fill an empty map with the `arrays` of another one."""
        self._saved, self._restored = SavedEdges(arrays), True

    def repoint(self, old_id: int, new_id: int, revision: int) -> None:
        """Move all edges of one node to another, summing evidence; O(degree of `old_id`).

        An edge between the two would become one from a node to itself and is dropped.
        """
        for (subject, object_), evidence in self._pop_all(old_id):
            pair = (
                new_id if subject == old_id else subject,
                new_id if object_ == old_id else object_,
            )
            if pair[0] != pair[1]:
                self.add(pair, evidence._replace(revision=revision))

    def copy(self, old_id: int, new_id: int, without: Collection[int], revision: int) -> None:
        """Give a node the edges of another one, except those to some nodes."""
        for partner in list(self.partners(old_id)):
            for pair, new in (
                ((old_id, partner), (new_id, partner)),
                ((partner, old_id), (partner, new_id)),
            ):
                evidence = self._evidence.get(pair) or self._saved.get(pair)
                if partner not in without and evidence is not None:
                    self.add(new, evidence._replace(revision=revision))

    def drop(self, node_id: int) -> None:
        """Drop all edges of a node."""
        self._pop_all(node_id)

    def _partners_of(self, node_id: int) -> dict[int, None]:
        partners = self._partners.get(node_id)
        if partners is None:
            partners = self._partners[node_id] = dict.fromkeys(self._saved.partners(node_id))
        return partners

    def _pop_all(self, node_id: int) -> list[tuple[Pair, EdgeEvidence]]:
        popped = []
        for partner in self._partners_of(node_id):
            self._partners_of(partner).pop(node_id)
            for pair in ((node_id, partner), (partner, node_id)):
                evidence = self._evidence.pop(pair, None) or self._saved.get(pair)
                if evidence is not None:
                    self._saved.remove(pair)
                    popped.append((pair, evidence))
                    self._changed.add(pair)
        del self._partners[node_id]
        return popped


class _Newest(Mapping[Pair, EdgeEvidence]):
    """Saved edges and newer evidence, in the order in which the pairs came."""

    def __init__(self, newer: Mapping[Pair, EdgeEvidence], saved: SavedEdges) -> None:
        self._newer = newer
        self._saved = saved

    def __len__(self) -> int:
        return len(self._saved) + len(self._newer) - len(self._saved.changed)

    def __iter__(self) -> Iterator[Pair]:
        changed = self._saved.changed
        return chain(self._saved, (pair for pair in self._newer if pair not in changed))

    def __getitem__(self, pair: Pair) -> EdgeEvidence:
        evidence = self._newer.get(pair) or self._saved.get(pair)
        if evidence is None:
            raise KeyError(pair)
        return evidence


# --- Votes of single frames on the relation of two nodes, also of frames that show no relation.


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
