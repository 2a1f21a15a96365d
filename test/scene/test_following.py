"""Following a graph: snapshots, updates, gaps, and another session."""

from __future__ import annotations

import msgspec
import pytest
from support.reference_updates import diff
from support.view import make_graph, make_node

from deworldsg_ros.wire.follow import GraphFollower, GraphReplica


def graph(sequence, session="a"):
    made = make_graph([make_node(i, "cup") for i in range(1, sequence + 1)])
    return msgspec.structs.replace(made, sequence=sequence, session=session)


def update(sequence, session="a"):
    made = diff(graph(sequence - 1, session), graph(sequence, session))
    return msgspec.structs.replace(made, session=session)


@pytest.fixture()
def copy():
    return GraphReplica()


def test_from_the_first_update_on_no_snapshot_is_needed(copy):
    follower = GraphFollower(copy)
    assert not follower.has_graph
    assert [follower.update(update(n)) for n in (1, 2, 2, 3)] == [True, True, False, True]
    assert follower.has_graph and follower.gaps == 0
    assert copy.message() == graph(3)
    assert not follower.snapshot(graph(2)), "an older snapshot changes nothing"


def test_a_gap_waits_for_a_snapshot_and_loses_nothing(copy):
    follower = GraphFollower(copy)
    follower.update(update(1))
    assert not follower.update(update(4)) and not follower.update(update(5))
    assert follower.gaps == 1 and copy.sequence == 1
    assert follower.snapshot(graph(3))
    assert copy.message() == graph(5)


def test_a_late_start_is_no_gap(copy):
    follower = GraphFollower(copy)
    assert not follower.update(update(7))
    assert follower.snapshot(graph(6))
    assert follower.gaps == 0 and copy.message() == graph(7)


def test_another_session_begins_anew(copy):
    follower = GraphFollower(copy)
    follower.snapshot(graph(5))
    assert follower.snapshot(graph(2, "b")), "fewer updates, but of another session"
    assert follower.update(update(3, "b"))
    assert copy.message() == graph(3, "b")
