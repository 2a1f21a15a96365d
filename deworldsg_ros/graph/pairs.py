"""The pairs of nodes of the global graph: votes of frames, and the evidence of directed edges.

A pair of nodes has one row, in which everything about it stands. The row stays as long as the pair
is of any interest: a frame has shown both nodes, an edge has evidence, or somebody holds it. Other
modules have arrays by row, too. The rows of a node are a list that is linked through the rows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.scene.arrays import (
    Bool,
    Float32,
    Float64,
    Int32,
    Int64,
    SoftmaxWeights,
    softmax_weights,
)

# Subject and object of a directed pair, by their ids.
Pair = tuple[int, int]

# A pair. Its first end is the node with the smaller id. Fields of two values have one for each
# direction; in direction 0, the first end is the subject.
PAIR = np.dtype(
    [
        # 0 in rows that are free.
        ("ids", np.int32, 2),
        ("slots", np.int32, 2),
        # The next place in the list of either node. A place is 2 · row + end + 1 of an end of a
        # pair; 0 = none.
        ("links", np.int32, 2),
        # Frames that showed both nodes, and rows of the sums of their votes; 0 = no votes.
        ("shown", np.int64),
        ("votes", np.int32, 2),
        # See `EdgeEvidence`. Rows of the sums of the logits; 0 = zeros.
        ("logits", np.int32, 2),
        ("frames", np.int64, 2),
        ("neighbour_frames", np.int64, 2),
        ("last_seen_ns", np.int64, 2),
        # Whether somebody wants the row, without any evidence.
        ("held", np.bool_),
    ],
    align=True,
)
FIRST_ROWS = 64


class EdgeEvidence(NamedTuple):
    """Evidence of one directed pair of nodes (R predicates).

    Attributes:
        visual_logits: (R,) float64, the sum of the visual relation logits (Eq. 9). Zeros if there
            were none, which is the uniform distribution.
        frames: number of frames with visual evidence; 0 = a geometric neighbour only.
        last_seen_ns: time of the newest evidence of either kind.
        neighbour_frames: number of frames in which the pair was a geometric neighbour (Eq. 8).
    """

    visual_logits: Float64
    frames: int
    last_seen_ns: int
    neighbour_frames: int


class PairVotes(NamedTuple):
    """The votes on one unordered pair of nodes (R predicates).

    Attributes:
        frames: number of frames that showed both nodes.
        counts: (2, R) float32, sum over these frames of the probability of each predicate. Row 0:
            the node with the smaller id is the subject. Row 1: it is the object. None = no votes.
    """

    frames: int
    counts: Float32 | None


@dataclass(frozen=True)
class PairArrays:
    """Everything about the pairs of a graph, by ascending ids.

    Attributes:
        edge_pairs: (m, 2) int64, ids of subject and object.
        edge_visual_logits: (m, R) float64.
        edge_counts: (m, 3) int64, the other fields of `EdgeEvidence` in their order.
        vote_pairs: (k, 2) int64, the smaller id first.
        vote_known: (k, 2) int64, number of frames, and whether there are votes.
        vote_counts: (l, 2, R) float64, the votes of those that have some.
    """

    edge_pairs: Int64
    edge_visual_logits: Float64
    edge_counts: Int64
    vote_pairs: Int64
    vote_known: Int64
    vote_counts: Float64


@dataclass
class PairChanges:
    """Changes since the reader emptied it.

    Attributes:
        votes: rows of the pairs that more frames have shown.
        edges: rows of the pairs with other evidence of an edge.
        gone: rows that have become free, with the ids of their pairs. The row may have another pair
            by now.
    """

    votes: set[int] = field(default_factory=set)
    edges: set[int] = field(default_factory=set)
    gone: list[tuple[int, Pair]] = field(default_factory=list)

    def clear(self) -> None:
        """Forget all changes."""
        self.votes.clear()
        self.edges.clear()
        self.gone.clear()


class _Sums:
    """Sums of R values each. Row 0 is zeros."""

    def __init__(self, width: int, dtype: type[np.floating[Any]]) -> None:
        self.rows: NDArray[Any] = np.zeros((FIRST_ROWS, width), dtype)
        self._used, self._free = 1, list[int]()

    def take(self, count: int) -> list[int]:
        """Rows of zeros."""
        taken = [self._free.pop() for _ in range(min(count, len(self._free)))]
        missing = count - len(taken)
        if self._used + missing > len(self.rows):
            # Zeros that were never written take no memory.
            larger = np.zeros((2 * (self._used + missing), self.rows.shape[1]), self.rows.dtype)
            larger[: self._used] = self.rows[: self._used]
            self.rows = larger
        taken += range(self._used, self._used + missing)
        self._used += missing
        return taken

    def free(self, rows: list[int]) -> None:
        """Give rows back; 0 is ignored."""
        known = [row for row in rows if row]
        self.rows[known] = 0
        self._free += known


class PairStore:
    """The pairs of the nodes of a graph.

    Args:
        nodes: of the graph.
        predicate_count: R.

    Attributes:
        rows: (n,) of `PAIR`; read only. A new pair may replace the array by a larger one.
        firsts: by slot of a node, the first place of its list; read only.
    """

    def __init__(self, nodes: NodeTable, predicate_count: int) -> None:
        self.predicate_count = predicate_count
        self.rows: NDArray[np.void] = np.zeros(FIRST_ROWS, PAIR)
        self.firsts: Int32 = np.zeros(FIRST_ROWS, np.int32)
        self._nodes = nodes
        # By slot, the number of its pairs.
        self._degrees: Int32 = np.zeros(FIRST_ROWS, np.int32)
        self._used, self._free = 0, list[int]()
        self._votes = _Sums(predicate_count, np.float32)
        self._logits = _Sums(predicate_count, np.float64)
        self._watchers: list[PairChanges] = []

    def watch(self) -> PairChanges:
        """All changes from now on. It starts with all pairs."""
        changes = PairChanges(set(np.flatnonzero(self.rows["shown"]).tolist()))
        changes.edges.update(np.flatnonzero(self._is_edge().any(axis=1)).tolist())
        self._watchers.append(changes)
        return changes

    @property
    def votes(self) -> Float32:
        """Sums of votes, (l, R), by the rows that ``votes`` names."""
        return self._votes.rows

    @property
    def logits(self) -> Float64:
        """Sums of logits, (l, R), by the rows that ``logits`` names."""
        return self._logits.rows

    def of(self, slots: Sequence[int] | Int64) -> Int64:
        """The rows of the pairs of nodes, ascending, each once."""
        self._make_slots()
        return rows_of_nodes(self.rows, self.firsts, np.asarray(slots, np.int64))

    def find(self, slots: Int64) -> Int64:
        """The row (m,) of each pair of slots (m, 2), in any order; -1 = there is none."""
        self._make_slots()
        return _find(self.rows, self.firsts, self._degrees, np.ascontiguousarray(slots))

    def ensure(self, slots: Int64) -> Int64:
        """The row (m,) of each pair of different slots (m, 2); missing pairs are added."""
        rows = self.find(slots)
        missing = rows < 0
        if not missing.any():
            return rows
        pairs = list(dict.fromkeys((min(a, b), max(a, b)) for a, b in slots[missing].tolist()))
        self._add(np.array(pairs, np.int64))
        return self.find(slots)

    def hold(self, rows: Int64) -> None:
        """Keep pairs, whatever evidence there is."""
        self.rows["held"][rows] = True

    def release(self, rows: Int64) -> None:
        """Keep pairs no longer if there is no evidence."""
        self.rows["held"][rows] = False
        self._drop(rows[~_has_evidence(self.rows.take(rows))])

    def add_frame(self, shown: Int64, voted: Int64, votes: Float64) -> None:
        """Add a frame.

        Args:
            shown: (m, 2) slots of different nodes that it showed together.
            voted: (k, 2) slots of subject and object; each is one of these pairs, in any order.
            votes: (k, R).
        """
        rows = self.ensure(shown)
        np.add.at(self.rows["shown"], rows, 1)
        counted = votes.any(axis=1)
        if counted.any():
            self._sum(self._votes, "votes", voted[counted], votes[counted])
        for changes in self._watchers:
            changes.votes.update(rows.tolist())

    def add_visual(self, pairs: Int64, logits: Float64, stamp_ns: int) -> None:
        """Sum a frame's relation logits (m, R) into m different directed pairs of slots (Eq. 9).

        Raises:
            ValueError: if the logits have another shape.
        """
        if logits.shape != (len(pairs), self.predicate_count):
            raise ValueError(
                f"relation logits have shape {logits.shape[1:]}: expected {(self.predicate_count,)}"
            )
        self._see(*self._sum(self._logits, "logits", pairs, logits), stamp_ns, 1, 0)

    def add_neighbours(self, pairs: Int64, stamp_ns: int) -> None:
        """Count a frame in which directed pairs (m, 2) were geometric neighbours (Eq. 8)."""
        rows, ends = self._directed(pairs)
        self._see(rows, ends, stamp_ns, 0, 1)

    def merge(self, slot: int, into: int) -> None:
        """Add everything about the pairs of a node to those of another one, and drop it.

        A pair of the two would become one of a node with itself and is dropped.
        """
        for row in self.of([slot]).tolist():
            self._add_to(row, slot, into)
        self.drop(slot)

    def copy(self, slot: int, to: int, without: Collection[int]) -> None:
        """Give a node everything about the pairs of another one, except those with some slots."""
        for row in self.of([slot]).tolist():
            if not set(self.rows["slots"][row].tolist()) & set(without) - {slot}:
                self._add_to(row, slot, to)

    def drop(self, slot: int) -> None:
        """Drop all pairs of a node."""
        self._drop(self.of([slot]))

    def evidence(self, row: int, end: int) -> EdgeEvidence:
        """The evidence of an edge."""
        known = self.rows[row]
        return EdgeEvidence(
            self.logits[known["logits"][end]],
            int(known["frames"][end]),
            int(known["last_seen_ns"][end]),
            int(known["neighbour_frames"][end]),
        )

    def counts(self, rows: Int64) -> Float32:
        """The sums of votes (m, 2, R) on pairs."""
        counts: Float32 = self.votes[self.rows["votes"][rows]]
        return counts

    def arrays(self) -> PairArrays:
        """Everything, for `restore`."""
        rows, ends = np.nonzero(self._is_edge())
        known, ids = self.rows.take(rows), self.rows["ids"][rows].astype(np.int64)
        at = np.arange(len(rows))
        pairs = np.stack([ids[at, ends], ids[at, 1 - ends]], axis=1)
        edges = np.lexsort(pairs.T[::-1])
        counts = [known[name][at, ends] for name in EdgeEvidence._fields[1:]]
        shown = np.flatnonzero(self.rows["shown"])
        shown = shown[np.lexsort(self.rows["ids"][shown].T[::-1])]
        votes = self.rows["votes"][shown]
        voted = votes.any(axis=1)
        frames = self.rows["shown"][shown]
        # Sums in float32 may exceed the number of frames by rounding.
        most = frames[voted, None, None].astype(np.float64)
        return PairArrays(
            edge_pairs=pairs[edges],
            edge_visual_logits=self.logits[known["logits"][at, ends]][edges],
            edge_counts=np.stack(counts, axis=1)[edges],
            vote_pairs=self.rows["ids"][shown].astype(np.int64),
            vote_known=np.stack([frames, voted.astype(np.int64)], axis=1),
            vote_counts=np.minimum(self.votes[votes[voted]].astype(np.float64), most),
        )

    def restore(self, arrays: PairArrays) -> None:
        """Fill an empty store with the `arrays` of another one."""
        edges, voted = arrays.edge_pairs, arrays.vote_pairs
        pairs = np.concatenate([np.sort(edges, axis=1), voted])
        ids, place = np.unique(pairs, axis=0, return_inverse=True)
        known, slots = self._nodes.ids, self._nodes.ids.argsort()
        at = slots[known[slots].searchsorted(ids)]
        rows = self._add(at)[place.ravel()]
        row, end = rows[: len(edges)], (edges[:, 0] > edges[:, 1]).astype(np.int64)
        for name, column in zip(EdgeEvidence._fields[1:], arrays.edge_counts.T):
            self.rows[name][row, end] = column
        visual = arrays.edge_counts[:, 0] > 0
        taken = self._logits.take(int(visual.sum()))
        self.rows["logits"][row[visual], end[visual]] = taken
        self.logits[taken] = arrays.edge_visual_logits[visual]
        row = rows[len(edges) :]
        self.rows["shown"][row] = arrays.vote_known[:, 0]
        row, places = np.nonzero(arrays.vote_counts.any(axis=2))
        taken = self._votes.take(len(row))
        of_pair = rows[len(edges) :][arrays.vote_known[:, 1] > 0]
        self.rows["votes"][of_pair[row], places] = taken
        self.votes[taken] = arrays.vote_counts[row, places]

    def _is_edge(self) -> Bool:
        """(n, 2), whether a direction has evidence."""
        found: Bool = (self.rows["frames"] > 0) | (self.rows["neighbour_frames"] > 0)
        return found

    def _directed(self, pairs: Int64) -> tuple[Int64, Int64]:
        """Rows and directions (m,) of directed pairs of slots (m, 2)."""
        rows = self.ensure(pairs)
        ends = (self.rows["slots"][rows, 0] != pairs[:, 0]).astype(np.int64)
        return rows, ends

    def _sum(self, sums: _Sums, name: str, pairs: Int64, values: Float64) -> tuple[Int64, Int64]:
        """Add values (m, R) to the sums of directed pairs (m, 2); returns rows and directions."""
        rows, ends = self._directed(pairs)
        places = self.rows[name]
        new = dict.fromkeys(
            (row, end)
            for row, end, place in zip(rows.tolist(), ends.tolist(), places[rows, ends].tolist())
            if not place
        )
        for (row, end), place in zip(new, sums.take(len(new))):
            places[row, end] = place
        _add(sums.rows, places[rows, ends], values)
        return rows, ends

    def _see(
        self, rows: Int64, ends: Int64, stamp_ns: int, frames: int, neighbour_frames: int
    ) -> None:
        at = rows, ends
        np.add.at(self.rows["frames"], at, frames)
        np.add.at(self.rows["neighbour_frames"], at, neighbour_frames)
        np.maximum.at(self.rows["last_seen_ns"], at, stamp_ns)
        for changes in self._watchers:
            changes.edges.update(rows.tolist())

    def _add_to(self, row: int, slot: int, to: int) -> None:
        """Add everything about a pair of a node to the pair of another node with the same one."""
        of = self.rows["slots"][row].tolist()
        end = of.index(slot)
        if of[1 - end] == to or not _has_evidence(self.rows[row]):
            return
        pair = np.array([[to, of[1 - end]]], np.int64)
        new, turned = (int(one[0]) for one in self._directed(pair))
        old, ends = self.rows[row], [end, 1 - end]
        into = [turned, 1 - turned]
        known = self.rows[new]
        known["shown"] += old["shown"]
        for name in ("frames", "neighbour_frames"):
            known[name][into] += old[name][ends]
        known["last_seen_ns"][into] = np.maximum(
            known["last_seen_ns"][into], old["last_seen_ns"][ends]
        )
        for sums, name in ((self._votes, "votes"), (self._logits, "logits")):
            for direction in (pair, pair[:, ::-1]):
                source = self.rows[name][row, ends[int(direction is not pair)]]
                if source:
                    self._sum(sums, name, direction, sums.rows[[source]].astype(np.float64))
        for changes in self._watchers:
            changes.votes.add(new)
            changes.edges.add(new)

    def _add(self, slots: Int64) -> Int64:
        """Add new pairs of slots (m, 2); returns their rows."""
        self._make_slots()
        taken = [self._free.pop() for _ in range(min(len(slots), len(self._free)))]
        missing = len(slots) - len(taken)
        if self._used + missing > len(self.rows):
            larger = np.zeros(2 * (self._used + missing), PAIR)
            larger[: self._used] = self.rows[: self._used]
            self.rows = larger
        rows = np.array([*taken, *range(self._used, self._used + missing)], np.int64)
        self._used += missing
        ids = self._nodes.ids[slots]
        turned = ids[:, 0] > ids[:, 1]
        ids[turned], slots = ids[turned, ::-1], np.where(turned[:, None], slots[:, ::-1], slots)
        self.rows["ids"][rows], self.rows["slots"][rows] = ids, slots
        link(self.rows, self.firsts, self._degrees, rows)
        return rows

    def _drop(self, rows: Int64) -> None:
        """Free the rows of pairs."""
        for row in rows.tolist():
            known = self.rows[row]
            first, second = known["ids"].tolist()
            for changes in self._watchers:
                changes.gone.append((row, (first, second)))
                changes.votes.discard(row)
                changes.edges.discard(row)
            self._votes.free(known["votes"].tolist())
            self._logits.free(known["logits"].tolist())
            _unlink(self.rows, self.firsts, self._degrees, row)
            self.rows[row] = np.zeros((), PAIR)
            self._free.append(row)

    def _make_slots(self) -> None:
        """Make room for lists of the nodes."""
        count = len(self._nodes.ids)
        while len(self.firsts) < count:
            self.firsts = np.concatenate([self.firsts, np.zeros_like(self.firsts)])
            self._degrees = np.concatenate([self._degrees, np.zeros_like(self._degrees)])


def _has_evidence(known: NDArray[np.void]) -> Bool:
    """Whether a frame has shown pairs (...), or an edge of theirs has evidence."""
    is_edge = (known["frames"] > 0) | (known["neighbour_frames"] > 0)
    found: Bool = (known["shown"] > 0) | is_edge.any(axis=-1)
    return found


@kernel
def _add(sums: NDArray[Any], rows: Int32, values: Float64) -> None:
    """Add values (m, R) to rows (m,) of sums."""
    for index in range(len(rows)):
        for place in range(values.shape[1]):
            sums[rows[index], place] += values[index, place]


@kernel
def rows_of_nodes(pairs: NDArray[Any], firsts: Int32, slots: Int64) -> Int64:
    """Rows of the pairs of nodes (k,), ascending, each once."""
    count = 0
    for slot in slots:
        place = firsts[slot]
        while place:
            count += 1
            place = pairs[(place - 1) >> 1].links[(place - 1) & 1]
    rows = np.empty(count, np.int64)
    count = 0
    for slot in slots:
        place = firsts[slot]
        while place:
            rows[count] = (place - 1) >> 1
            count += 1
            place = pairs[(place - 1) >> 1].links[(place - 1) & 1]
    rows.sort()
    kept = 0
    for index in range(count):
        if kept == 0 or rows[index] != rows[kept - 1]:
            rows[kept] = rows[index]
            kept += 1
    return rows[:kept].copy()


@kernel
def _find(pairs: NDArray[Any], firsts: Int32, degrees: Int32, slots: Int64) -> Int64:
    """The row of each pair of slots (m, 2); -1 = none. The shorter list of both is searched."""
    rows = np.empty(len(slots), np.int64)
    for index in range(len(slots)):
        a, b = slots[index, 0], slots[index, 1]
        if degrees[b] < degrees[a]:
            a, b = b, a
        rows[index], place = -1, firsts[a]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            if pairs[row].slots[1 - end] == b:
                rows[index] = row
                break
            place = pairs[row].links[end]
    return rows


@kernel
def link(pairs: NDArray[Any], firsts: Int32, degrees: Int32, rows: Int64) -> None:
    """Enter pairs in the lists of both their nodes."""
    for row in rows:
        for end in range(2):
            slot = pairs[row].slots[end]
            pairs[row].links[end] = firsts[slot]
            firsts[slot] = 2 * row + end + 1
            degrees[slot] += 1


@kernel
def _unlink(pairs: NDArray[Any], firsts: Int32, degrees: Int32, row: int) -> None:
    """Take a pair out of the lists of both its nodes."""
    for end in range(2):
        slot, wanted = pairs[row].slots[end], 2 * row + end + 1
        degrees[slot] -= 1
        place = firsts[slot]
        if place == wanted:
            firsts[slot] = pairs[row].links[end]
            continue
        while pairs[(place - 1) >> 1].links[(place - 1) & 1] != wanted:
            place = pairs[(place - 1) >> 1].links[(place - 1) & 1]
        pairs[(place - 1) >> 1].links[(place - 1) & 1] = pairs[row].links[end]


class EdgesByPair(Mapping[Pair, EdgeEvidence]):
    """The evidence of the edges of a graph by subject and object, in the order of their rows."""

    def __init__(self, nodes: NodeTable, store: PairStore) -> None:
        self._nodes, self._store = nodes, store

    def __len__(self) -> int:
        return int(self._store._is_edge().sum())

    def __iter__(self) -> Iterator[Pair]:
        rows, ends = np.nonzero(self._store._is_edge())
        for (first, second), end in zip(self._store.rows["ids"][rows].tolist(), ends.tolist()):
            yield (second, first) if end else (first, second)

    def __getitem__(self, pair: Pair) -> EdgeEvidence:
        row = _row(self._nodes, self._store, pair)
        end = int(pair[0] > pair[1])
        known = self._store.rows[row]
        if not (known["frames"][end] or known["neighbour_frames"][end]):
            raise KeyError(pair)
        return self._store.evidence(row, end)


class VotesByPair(Mapping[Pair, PairVotes]):
    """The votes on the pairs of a graph, the smaller id first, in the order of their rows."""

    def __init__(self, nodes: NodeTable, store: PairStore) -> None:
        self._nodes, self._store = nodes, store

    def __len__(self) -> int:
        return int((self._store.rows["shown"] > 0).sum())

    def __iter__(self) -> Iterator[Pair]:
        rows = np.flatnonzero(self._store.rows["shown"])
        return ((first, second) for first, second in self._store.rows["ids"][rows].tolist())

    def __getitem__(self, pair: Pair) -> PairVotes:
        row = _row(self._nodes, self._store, pair)
        known = self._store.rows[row]
        if pair[0] > pair[1] or not known["shown"]:
            raise KeyError(pair)
        counts = self._store.counts(np.array([row]))[0] if known["votes"].any() else None
        return PairVotes(int(known["shown"]), counts)


def _row(nodes: NodeTable, store: PairStore, pair: Pair) -> int:
    """The row of a pair of ids; KeyError if there is none."""
    slots = [nodes.slot_of.get(node_id) for node_id in pair]
    if None in slots or slots[0] == slots[1]:
        raise KeyError(pair)
    row = int(store.find(np.array([slots], np.int64))[0])
    if row < 0:
        raise KeyError(pair)
    return row


# --- Votes of single frames on the relation of two nodes, also of frames that show no relation.


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


# --- What the measured geometry of two objects contradicts, whatever was seen otherwise.
#
# The limits are beyond the error of measured bounds, also with masks that bleed.

# What touches has no wider horizontal gap, and what is near none of a metre.
TOUCH_GAP_M, NEAR_GAP_M = 0.15, 1.0
# What rests on or in something begins no higher above its top, and on one that has no place below
# its top, no deeper.
RISE_M, SUNK_M = 0.2, 0.3


class Between(NamedTuple):
    """Measured geometry of n ordered pairs, (n,) each, metres.

    Attributes:
        gap_m: horizontal gap of the bounds of both; 0 if they overlap.
        rise_m: bottom of the subject above the top of the object.
        fall_m: bottom of the object above the top of the subject.
    """

    gap_m: Float64
    rise_m: Float64
    fall_m: Float64


def contradicted(between: Between, on_top: Bool) -> Bool:
    """Which relations the geometry of pairs contradicts, (n, 7), in the order of their names.

    The names are those of `scene.vocabulary.PREDICATES`.

    Args:
        between: subjects and objects.
        on_top: (n,) whether the object is of `scene.vocabulary.CARRY_ON_TOP`.
    """
    gap_m, rise_m, fall_m = between
    apart = gap_m > TOUCH_GAP_M
    unborne = apart | (rise_m > RISE_M) | (fall_m > 0.0)
    sunk = on_top & (rise_m < -SUNK_M)
    above, under = apart | (fall_m > 0.0), apart | (rise_m > 0.0)
    far = gap_m > NEAR_GAP_M
    return np.stack([unborne | sunk, unborne, apart, apart, above, under, far], axis=-1)
