"""Readers of a graph that ask now and then, and miss what came between."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.wire import follow
from deworldsg_ros.wire.follow import ChangeLog, GraphReplica


def graph(session: str, sequence: int, names: dict[int, str], pairs=()) -> object:
    message = make_graph(
        [make_node(i, names[i]) for i in sorted(names)], [make_edge(*pair) for pair in pairs]
    )
    return msgspec.structs.replace(message, session=session, sequence=sequence)


def ask(log: ChangeLog, reader: GraphReplica) -> int:
    """Number of nodes that were sent."""
    update = log.since(reader.session, reader.sequence)
    if update is None:
        return 0
    assert reader.apply(update)
    return len(update.nodes)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), most=st.sampled_from([2, 10_000]))
def test_a_reader_that_asks_at_random_times_has_the_graph(seed: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    log, reader, session, sequence = ChangeLog(), GraphReplica(), "a", 0
    names: dict[int, str] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(follow, "MOST_REMOVED", most)
        for _ in range(30):
            if rng.random() < 0.05:
                session, sequence, names = session + "x", 0, {}
            for _ in range(rng.integers(4)):
                node_id = int(rng.integers(1, 9))
                if rng.random() < 0.4:
                    names.pop(node_id, None)
                else:
                    names[node_id] = str(rng.choice(["cup", "bowl"]))
            pairs = [(i, j) for i in names for j in names if i < j and (i + j + sequence) % 3 == 0]
            sequence += int(rng.integers(1, 3))
            whole = graph(session, sequence, names, sorted(pairs))
            log.set(whole)
            if rng.random() < 0.4:
                ask(log, reader)
                assert reader.message() == whole


def test_a_node_that_changed_often_is_sent_once_and_others_not_at_all() -> None:
    log, reader = ChangeLog(), GraphReplica()
    assert log.since(None, 0) is None
    log.set(graph("a", 1, {1: "cup", 2: "bowl", 3: "bowl"}, [(1, 2)]))
    assert ask(log, reader) == 3
    assert ask(log, reader) == 0
    for sequence in range(2, 50):
        log.set(graph("a", sequence, {1: f"cup {sequence}", 2: "bowl"}, [(1, 2)]))
    assert ask(log, reader) == 1
    assert reader.nodes[1].label == "cup 49"
    assert set(reader.nodes) == {1, 2}


def test_an_older_graph_of_the_session_is_ignored() -> None:
    log, reader = ChangeLog(), GraphReplica()
    log.set(graph("a", 5, {1: "cup"}))
    log.set(graph("a", 4, {2: "bowl"}))
    ask(log, reader)
    assert set(reader.nodes) == {1}


def test_a_log_that_was_started_again_sends_everything_to_a_reader_from_before() -> None:
    reader = GraphReplica()
    first = ChangeLog()
    first.set(graph("a", 5, {1: "cup", 2: "bowl"}))
    ask(first, reader)
    second = ChangeLog()
    second.set(graph("a", 9, {2: "bowl"}))
    ask(second, reader)
    assert reader.message() == graph("a", 9, {2: "bowl"})
