"""The votes of frames on pairs of nodes, against votes kept in a plain dict."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.merging import VOCABULARY

from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph.pairs import Pair, VoteMap, ends_of, frame_votes

WIDTH = 3
seeds = st.integers(0, 10_000)


class PlainVotes:
    """The same with a number of frames for each set of two ids, and votes for each direction."""

    def __init__(self) -> None:
        self.frames: dict[frozenset[int], int] = {}
        self.votes: dict[tuple[int, int], np.ndarray] = {}

    def add(self, a: int, b: int, frames: int, counts: np.ndarray | None) -> None:
        pair = frozenset((a, b))
        self.frames[pair] = self.frames.get(pair, 0) + frames
        if counts is not None:
            for direction, row in (((a, b), counts[0]), ((b, a), counts[1])):
                self.votes[direction] = self.votes.get(direction, np.zeros(WIDTH)) + row

    def drop(self, node_id: int) -> None:
        self.frames = {pair: n for pair, n in self.frames.items() if node_id not in pair}
        self.votes = {pair: row for pair, row in self.votes.items() if node_id not in pair}

    def repoint(self, old_id: int, new_id: int) -> None:
        frames, votes = self.frames, self.votes
        self.frames, self.votes = {}, {}
        for pair, count in frames.items():
            a, b = (new_id if end == old_id else end for end in pair)
            if a == b:
                continue
            self.add(a, b, count, None)
            for (subject, object_), row in votes.items():
                if {subject, object_} == pair:
                    subject = new_id if subject == old_id else subject
                    self.add(subject, b if subject == a else a, 0, np.array([row, 0 * row]))


def directed(votes: VoteMap) -> Iterator[tuple[tuple[int, int], int, np.ndarray | None]]:
    for (first, second), item in votes.pairs.items():
        assert first < second
        for end, pair in enumerate(((first, second), (second, first))):
            yield pair, item.frames, None if item.counts is None else item.counts[end]


def assert_equal(votes: VoteMap, plain: PlainVotes) -> None:
    assert {frozenset(pair) for pair in votes.pairs} == set(plain.frames)
    for pair, frames, row in directed(votes):
        assert frames == plain.frames[frozenset(pair)]
        assert (row is None) == (pair not in plain.votes)
        if row is not None:
            np.testing.assert_allclose(row, plain.votes[pair], atol=1e-12)
    for node_id in range(1, 7):
        expected = {b for a, b in plain.frames for a, b in ((a, b), (b, a)) if a == node_id}
        assert votes.partners(node_id) == expected


def test_no_votes() -> None:
    votes = VoteMap(WIDTH)
    assert not votes.pairs and not votes.take_changed() and votes.partners(1) == set()
    assert votes.drop(1) == []
    votes.repoint(1, 2, 5)
    assert not votes.pairs


def test_the_order_of_the_ids_does_not_matter() -> None:
    counts = np.arange(6.0).reshape(2, WIDTH)
    one, other = VoteMap(WIDTH), VoteMap(WIDTH)
    one.add((2, 7), 3, counts, 1)
    other.add((7, 2), 3, counts[::-1], 1)
    assert list(one.pairs) == list(other.pairs) == [(2, 7)]
    np.testing.assert_array_equal(one.pairs[2, 7].counts, counts)
    np.testing.assert_array_equal(other.pairs[2, 7].counts, counts)


def test_what_was_added_is_a_copy() -> None:
    counts = np.ones((2, WIDTH))
    votes = VoteMap(WIDTH)
    votes.add((1, 2), 1, counts, 1)
    votes.add((1, 2), 1, counts, 1)
    counts[:] = 9.0
    assert (votes.pairs[1, 2].counts == 2.0).all()


def test_frames_without_votes_count() -> None:
    votes = VoteMap(WIDTH)
    votes.add((1, 2), 1, None, 4)
    assert votes.pairs[1, 2].counts is None
    votes.add((2, 1), 1, np.ones((2, WIDTH)), 5)
    votes.add((1, 2), 1, None, 6)
    item = votes.pairs[1, 2]
    assert (item.frames, item.revision) == (3, 6) and (item.counts == 1.0).all()


def test_votes_between_merged_nodes_are_dropped() -> None:
    votes = VoteMap(WIDTH)
    votes.add((1, 2), 5, np.ones((2, WIDTH)), 1)
    votes.repoint(2, 1, 2)
    assert not votes.pairs and votes.partners(1) == votes.partners(2) == set()


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_any_changes_equal_those_of_a_plain_dict(seed: int) -> None:
    rng = np.random.default_rng(seed)
    votes, plain = VoteMap(WIDTH), PlainVotes()
    seen: dict[Pair, int] = {}  # revision of each pair at the last call of take_changed
    for revision in range(1, 40):
        a, b = rng.choice(np.arange(1, 7), 2, replace=False).tolist()
        kind = rng.choice(["add", "repoint", "drop"], p=[0.8, 0.12, 0.08])
        if kind == "add":
            frames = int(rng.integers(1, 4))
            counts = rng.uniform(0, 1, (2, WIDTH)) if rng.integers(2) else None
            votes.add((a, b), frames, counts, revision)
            plain.add(a, b, frames, counts)
        elif kind == "repoint":
            votes.repoint(a, b, revision)
            plain.repoint(a, b)
        else:
            votes.drop(a)
            plain.drop(a)
        assert_equal(votes, plain)
        if rng.random() < 0.3:
            now = {pair: item.revision for pair, item in votes.pairs.items()}
            changed = {pair for pair in seen.keys() | now.keys() if seen.get(pair) != now.get(pair)}
            assert changed <= set(map(ends_of, votes.take_changed()))
            assert votes.take_changed() == set()
            seen = now


def graph_of(count: int) -> SceneGraph:
    graph = SceneGraph(VOCABULARY, "world")
    for index in range(count):
        graph.add_node(np.array([float(index), 0, 0]), np.eye(3), np.ones(4), index)
    return graph


def plain(graph: SceneGraph) -> dict[Pair, tuple[int, list[list[float]] | None, int]]:
    return {
        pair: (item.frames, None if item.counts is None else item.counts.tolist(), item.revision)
        for pair, item in graph.votes.items()
    }


def changed(graph: SceneGraph) -> set[Pair]:
    return set(map(ends_of, graph.take_changed_votes()))


def test_the_votes_of_a_graph_follow_its_nodes() -> None:
    graph = graph_of(4)
    rows = np.array([[1.0, 0, 0], [0, 0, 0.5]])
    graph.add_votes(4, 1, rows)  # 4 is the subject of the first row
    graph.add_votes(1, 2, None)
    graph.add_votes(2, 4, rows)
    graph.add_votes(3, 4, None)
    assert graph.seen_together(4) == {1, 2, 3}
    graph.take_changed_votes()
    graph.merge_nodes(2, 1)
    assert plain(graph).keys() == {(1, 4), (3, 4)}
    np.testing.assert_array_equal(graph.votes[1, 4].counts, rows + rows[::-1])
    assert graph.votes[1, 4].frames == 2
    assert changed(graph) == {(1, 2), (1, 4), (2, 4)}
    graph.take_over(3, 4)  # the votes of 3 itself are gone, also those with 4
    assert plain(graph).keys() == {(1, 3)}
    np.testing.assert_array_equal(graph.votes[1, 3].counts, rows + rows[::-1])
    graph.remove_node(1)
    assert not graph.votes
    assert changed(graph) == {(1, 3), (1, 4), (3, 4)}


def test_a_file_keeps_the_votes(tmp_path: Path) -> None:
    graph = graph_of(4)
    graph.add_votes(3, 1, np.arange(6.0).reshape(2, 3) / 6)
    graph.add_votes(1, 2, None)
    graph.add_votes(4, 2, np.ones((2, 3)))
    graph.add_votes(1, 3, None)
    graph_files.save(graph, tmp_path / "graph.npz")
    loaded = graph_files.load(tmp_path / "graph.npz")
    assert plain(loaded) == plain(graph) and len(plain(graph)) == 3
    assert loaded.seen_together(2) == {1, 4}
    assert changed(loaded) == {(1, 2), (1, 3), (2, 4)}


def test_a_file_of_an_older_release_has_no_votes(tmp_path: Path) -> None:
    graph = graph_of(2)
    graph.add_votes(1, 2, None)
    arrays = graph_files.to_arrays(graph.state())
    old = {name: values for name, values in arrays.items() if not name.startswith("vote_")}
    assert len(old) == len(arrays) - 3
    graph_files.write(tmp_path / "old.npz", old)
    loaded = graph_files.load(tmp_path / "old.npz")
    assert len(loaded) == 2 and not loaded.votes and loaded.seen_together(1) == set()


def test_the_votes_of_a_state_do_not_change_with_its_graph() -> None:
    graph = graph_of(2)
    graph.add_votes(1, 2, np.ones((2, 3)))
    state = graph.state()
    again = SceneGraph.from_state(state)
    before = plain(again)
    graph.add_votes(1, 2, np.ones((2, 3)))
    assert plain(SceneGraph.from_state(state)) == before
    again.add_votes(1, 2, np.ones((2, 3)))
    assert plain(again) == plain(graph)
    assert plain(SceneGraph.from_state(state)) == before


def votes_of(logits: list[float]) -> list[float]:
    """Probability that the best predicate holds, divided by the softmax."""
    best = 1 / (1 + math.exp(-max(logits)))
    exponentials = [math.exp(value) for value in logits]
    return [best * value / sum(exponentials) for value in exponentials]


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (0, 0)])
def test_votes_of_nothing(shape: tuple[int, int]) -> None:
    assert frame_votes(np.zeros(shape)).shape == shape


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_the_votes_of_a_frame_are_a_divided_sigmoid(seed: int) -> None:
    logits = np.random.default_rng(seed).normal(0, 5, (4, 6))
    votes = frame_votes(logits)
    for row, expected in zip(votes, logits.tolist()):
        np.testing.assert_allclose(row, votes_of(expected), rtol=1e-12)
    assert (votes >= 0).all() and (votes.sum(axis=1) <= 1).all()


def test_extreme_logits_give_votes_from_0_to_1() -> None:
    votes = frame_votes(np.array([[800.0, -800.0], [-800.0, -900.0], [800.0, 800.0]]))
    np.testing.assert_allclose(votes, [[1, 0], [0, 0], [0.5, 0.5]], atol=1e-12)
