"""The time slider shows exactly the graph of each update."""

from __future__ import annotations

import msgspec
import pytest
from support.reference_updates import diff
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.view.live.state import BLOCK, History
from deworldsg_ros.wire import messages as wire


def graph(step):
    """Cups appear one after the other, move, and disappear again."""
    ids = range(max(1, step - 4), step + 1)
    nodes = [make_node(i, "cup", (step * 0.1, i, 0)) for i in ids]
    edges = [make_edge(i, i + 1, probability=1 / (step + 1)) for i in ids if i + 1 in ids]
    message = make_graph(nodes, edges)
    return msgspec.structs.replace(message, sequence=step, stamp=wire.Stamp(sec=step, nanosec=0))


def updates(count):
    return [diff(graph(step - 1), graph(step)) for step in range(1, count + 1)]


@pytest.mark.parametrize("count", [1, 7, BLOCK, 2 * BLOCK + 3])
def test_each_moment_is_the_graph_of_its_update(count):
    history = History()
    for update in updates(count):
        assert history.apply(update)
    assert (history.first, history.last) == (0, count - 1)
    for moment in {0, count // 2, count - 1}:
        assert history.at(moment).message() == graph(moment + 1)
    assert history.newest.message() == graph(count)


def test_the_oldest_moments_are_forgotten_and_numbers_stay():
    history = History(most_updates=2 * BLOCK)
    for update in updates(4 * BLOCK):
        history.apply(update)
    assert history.first > 0 and history.last == 4 * BLOCK - 1
    assert history.last - history.first < 2 * BLOCK
    assert history.at(history.first).message() == graph(history.first + 1)
    assert history.at(0).message() == graph(history.first + 1)


def test_a_gap_is_refused_and_a_snapshot_closes_it():
    history = History()
    first, _, third = updates(3)
    history.apply(first)
    with pytest.raises(RefusedInput, match="lost_updates|reset"):
        history.apply(third)
    history.reset(graph(3))
    assert [history.at(moment).sequence for moment in (0, 1)] == [1, 3]


def test_an_empty_history_has_an_empty_graph():
    history = History()
    assert history.last == -1
    assert not history.at(0).nodes
