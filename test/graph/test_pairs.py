"""Pairs of nodes against plain dicts: evidence of edges, votes, rows, lists, and watchers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.merging import VOCABULARY

from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.pairs import PAIR, Pair, PairStore, frame_votes

WIDTH = len(VOCABULARY.predicates)
seeds = st.integers(0, 10_000)


def graph_of(count: int) -> GlobalGraph:
    graph = GlobalGraph(VOCABULARY, "world")
    for index in range(count):
        graph.add_node(np.array([float(index), 0, 0]), np.eye(3), np.ones(4), index)
    return graph


class Plain:
    """The same by ids: frames of sets of two, votes and evidence of directed pairs.

    The numbers are multiples of 1/64, so that sums are exact, also those in float32.
    """

    def __init__(self) -> None:
        self.shown: dict[frozenset[int], int] = {}
        self.votes: dict[Pair, np.ndarray] = {}
        self.logits: dict[Pair, np.ndarray] = {}
        # Frames, time, and frames as neighbours; as in `EdgeEvidence`.
        self.counts: dict[Pair, tuple[int, int, int]] = {}

    def see(self, pair: Pair, frames: int, stamp_ns: int, neighbour: int) -> None:
        known = self.counts.get(pair, (0, 0, 0))
        newest = max(known[1], stamp_ns)
        self.counts[pair] = (known[0] + frames, newest, known[2] + neighbour)

    def add(self, values: dict[Pair, np.ndarray], pair: Pair, row: np.ndarray) -> None:
        if row.any() or pair in values:
            values[pair] = values.get(pair, np.zeros(WIDTH)) + row

    def copy(self, of: int, to: int, without: set[int]) -> None:
        """Add what is known of a node's pairs to those of another one."""

        def renamed(pair: Pair) -> Pair | None:
            ends = tuple(to if end == of else end for end in pair)
            return None if of not in pair or without & set(pair) or ends[0] == ends[1] else ends

        for pair, frames in list(self.shown.items()):
            if (new := renamed(tuple(pair))) is not None:
                self.shown[frozenset(new)] = self.shown.get(frozenset(new), 0) + frames
        for values in (self.votes, self.logits):
            for pair, row in list(values.items()):
                if (new := renamed(pair)) is not None:
                    self.add(values, new, row)
        for pair, known in list(self.counts.items()):
            if (new := renamed(pair)) is not None:
                self.see(new, *known)

    def drop(self, node_id: int) -> None:
        for values in (self.shown, self.votes, self.logits, self.counts):
            for pair in [pair for pair in values if node_id in pair]:
                del values[pair]


def told(graph: GlobalGraph) -> Plain:
    """What a graph says of its pairs."""
    plain = Plain()
    assert len(graph.edges) == len(list(graph.edges)) and len(graph.votes) == len(list(graph.votes))
    for pair, edge in graph.edges.items():
        plain.counts[pair] = (edge.frames, edge.last_seen_ns, edge.neighbour_frames)
        plain.add(plain.logits, pair, edge.visual_logits)
    for (first, second), item in graph.votes.items():
        assert first < second
        plain.shown[frozenset((first, second))] = item.frames
        counts = () if item.counts is None else item.counts
        for pair, row in zip(((first, second), (second, first)), counts):
            plain.add(plain.votes, pair, row)
    return plain


def assert_equal(one: Plain, other: Plain) -> None:
    assert one.shown == other.shown and one.counts == other.counts
    for found, wanted in ((one.votes, other.votes), (one.logits, other.logits)):
        wanted = {pair: row for pair, row in wanted.items() if row.any()}
        assert {pair: row.tolist() for pair, row in found.items()} == {
            pair: row.tolist() for pair, row in wanted.items()
        }


def check_rows(graph: GlobalGraph) -> None:
    """Each list has each pair of its node once; what is free is zeros."""
    store, nodes = graph.pairs, graph.nodes
    used = np.flatnonzero(store.rows["ids"].any(axis=1))
    store.of([])  # it makes room for new nodes
    ends: dict[int, list[int]] = {slot: [] for slot in range(len(store.firsts))}
    for row in used.tolist():
        ids, slots = store.rows["ids"][row], store.rows["slots"][row]
        assert ids[0] < ids[1] and nodes.ids[slots].tolist() == ids.tolist()
        for pair in (slots, slots[::-1]):
            ends[pair[0]].append(row)
            assert store.find(pair.astype(np.int64)[None]).tolist() == [row]
    for slot, rows in ends.items():
        assert store.of([slot, slot]).tolist() == rows
    assert (np.delete(store.rows, used) == np.zeros((), PAIR)).all()
    for name, sums in (("votes", store.votes), ("logits", store.logits)):
        taken = store.rows[name][used].ravel()
        assert not np.delete(sums, taken[taken > 0], axis=0).any()


class Follower:
    """Follows the pairs of a store, by what its watcher is told."""

    def __init__(self, store: PairStore) -> None:
        self.store, self.changes = store, store.watch()
        self.known: dict[int, bytes] = {}

    def follow(self) -> None:
        for row, ids in self.changes.gone:
            known = self.known.pop(row, None)
            assert known is None or known.startswith(np.array(ids, np.int32).tobytes())
        for row in self.changes.votes | self.changes.edges:
            self.known[row] = self.content(row)
        self.changes.clear()
        rows = self.store.rows
        is_edge = (rows["frames"] > 0) | (rows["neighbour_frames"] > 0)
        evidence = np.flatnonzero((rows["shown"] > 0) | is_edge.any(axis=1))
        assert self.known == {row: self.content(row) for row in evidence.tolist()}

    def content(self, row: int) -> bytes:
        store, one = self.store, self.store.rows[row]
        names = ("ids", "slots", "shown", "frames", "neighbour_frames", "last_seen_ns")
        sums = store.votes[one["votes"]].tobytes() + store.logits[one["logits"]].tobytes()
        return b"".join(one[name].tobytes() for name in names) + sums


def change(graph: GlobalGraph, plain: Plain, rng: np.random.Generator) -> None:
    """One change of the pairs, at random."""
    ids = list(graph.nodes.slot_of)
    kinds = ["add", "frame", "frame", "votes", "visual", "neighbour", "merge", "take over"]
    kind = str(rng.choice([*kinds, "copy", "drop", "hold", "release"]))
    if kind == "add" or len(ids) < 4:
        graph.add_node(np.zeros(3), np.eye(3), np.ones(4), 1)
        return
    a, b, *_ = rng.permutation(ids).tolist()
    slots, stamp_ns = graph.nodes.slots_of([a, b]), int(rng.integers(100))
    values = rng.integers(0, 3, (2, WIDTH)) * rng.integers(0, 2, (2, 1)) / 64.0
    if kind == "frame":
        chosen = rng.permutation(ids)[:5].tolist()
        shown = [(i, j) for i in chosen for j in chosen if i < j and rng.random() < 0.5]
        voted = [pair[:: rng.choice([1, -1])] for pair in shown if rng.random() < 0.5]
        votes = rng.integers(0, 3, (len(voted), WIDTH)) / 64.0
        as_slots = [graph.nodes.slots_of(np.ravel(pairs).tolist()) for pairs in (shown, voted)]
        graph.pairs.add_frame(*(pairs.reshape(-1, 2) for pairs in as_slots), votes)
        for pair in shown:
            plain.shown[frozenset(pair)] = plain.shown.get(frozenset(pair), 0) + 1
        for pair, row in zip(voted, votes):
            plain.add(plain.votes, pair, row)
    elif kind == "votes":
        counts = values if rng.integers(2) else None
        graph.add_votes(a, b, counts)
        plain.shown[frozenset((a, b))] = plain.shown.get(frozenset((a, b)), 0) + 1
        for pair, row in zip(((a, b), (b, a)), () if counts is None else counts):
            plain.add(plain.votes, pair, row)
    elif kind == "visual":
        logits = rng.integers(-9, 9, WIDTH) / 64.0
        graph.add_visual(a, b, logits, stamp_ns)
        plain.see((a, b), 1, stamp_ns, 0)
        plain.add(plain.logits, (a, b), logits)
    elif kind == "neighbour":
        graph.add_neighbours([(a, b), (b, a), (0, a), (b, b)], stamp_ns)
        for pair in ((a, b), (b, a)):
            plain.see(pair, 0, stamp_ns, 1)
    elif kind == "merge":
        kept, gone = sorted((a, b))
        graph.merge_nodes(a, b)
        plain.copy(gone, kept, set())
        plain.drop(gone)
    elif kind == "take over":
        old, new = sorted((a, b))
        graph.take_over(old, new)
        plain.drop(old)
        plain.copy(new, old, set())
        plain.drop(new)
    elif kind == "copy":
        without = set(rng.choice(ids, 2).tolist()) - {a}
        graph.copy_relations(a, b, without)
        plain.copy(a, b, without)
    elif kind == "drop":
        graph.remove_node(a)
        plain.drop(a)
    elif kind == "hold":
        graph.pairs.hold(graph.pairs.ensure(slots[None]))
    else:
        graph.pairs.release(graph.pairs.of(slots))


@given(seed=seeds)
def test_any_changes_equal_those_of_plain_dicts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph, plain = graph_of(6), Plain()
    followers = [Follower(graph.pairs)]
    for _ in range(60):
        change(graph, plain, rng)
        assert_equal(told(graph), plain)
        if rng.random() < 0.3:
            followers[0].follow()
        if rng.random() < 0.05:  # one that begins late
            followers.append(Follower(graph.pairs))
        if rng.random() < 0.05:
            graph = GlobalGraph.from_state(graph.state())
            followers = [Follower(graph.pairs)]
    check_rows(graph)
    for follower in followers:
        follower.follow()
    graph.pairs.release(np.flatnonzero(graph.pairs.rows["held"]))
    for node_id in list(graph.nodes.slot_of):
        graph.remove_node(node_id)
    check_rows(graph)
    assert not graph.pairs.rows["ids"].any() and not graph.pairs.votes.any()


def test_rows_of_pairs_that_went_are_used_again() -> None:
    graph = graph_of(40)
    counts = np.ones((2, WIDTH))
    for _ in range(3):
        for first in range(1, 41):
            for second in range(first + 1, 41):
                graph.add_votes(second, first, counts)
        sizes = len(graph.pairs.rows), len(graph.pairs.votes)
        check_rows(graph)
        for node_id in range(2, 41):
            graph.pairs.drop(graph.nodes.slot(node_id))
        assert not graph.votes
    assert sizes[0] < 2 * 780 + 2 and sizes[1] < 4 * 780 + 4


def test_what_is_no_pair_has_no_evidence() -> None:
    graph = graph_of(3)
    graph.add_votes(1, 2, np.ones((2, WIDTH)))
    for pair in ((2, 1), (1, 3), (1, 1), (1, 9)):
        assert pair not in graph.votes
    for pair in ((1, 2), (1, 1), (1, 9)):
        assert pair not in graph.edges
    with pytest.raises(ValueError, match=r"\(2,\)"):
        graph.add_visual(1, 2, np.ones(2), 0)
    assert len(graph.edges) == 0


def test_evidence_for_removed_ids_reaches_their_successors() -> None:
    graph = graph_of(5)
    graph.merge_nodes(3, 4)
    graph.merge_nodes(3, 2)
    graph.remove_node(5)
    assert [graph.resolve(node_id) for node_id in range(7)] == [0, 1, 2, 2, 2, 0, 0]
    assert graph.add_visual(4, 1, np.ones(WIDTH), 0)
    assert not graph.add_visual(4, 3, np.ones(WIDTH), 0)  # became one node
    assert not graph.add_visual(1, 5, np.ones(WIDTH), 0)
    assert list(graph.edges) == [(2, 1)]


# --- the votes of a frame ------------------------------------------------------------------------


@given(seed=seeds, count=st.integers(0, 4), width=st.integers(0, 6))
def test_the_votes_of_a_frame_are_a_divided_sigmoid(seed: int, count: int, width: int) -> None:
    logits = np.random.default_rng(seed).normal(0, 5, (count, width))
    votes = frame_votes(logits)
    assert votes.shape == logits.shape
    assert (votes >= 0).all() and (votes.sum(axis=1) <= 1).all()
    for row, values in zip(votes, logits.tolist() if width else ()):
        best = 1 / (1 + math.exp(-max(values)))
        shares = [math.exp(value) for value in values]
        np.testing.assert_allclose(row, [best * x / sum(shares) for x in shares], rtol=1e-12)


def test_extreme_logits_give_votes_from_0_to_1() -> None:
    votes = frame_votes(np.array([[800.0, -800.0], [-800.0, -900.0], [800.0, 800.0]]))
    np.testing.assert_allclose(votes, [[1, 0], [0, 0], [0.5, 0.5]], atol=1e-12)
