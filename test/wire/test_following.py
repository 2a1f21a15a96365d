"""Copies of a graph that follow its updates: gaps, sessions, late starts, and rare questions."""

from collections.abc import Iterable, Mapping

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.reference_updates import diff
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import follow
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import (
    SILENT_S,
    ChangeLog,
    GraphFollower,
    GraphReplica,
    empty_scene_graph,
)

seeds = st.integers(0, 10_000)


def graph(
    sequence: int,
    session: str = "a",
    names: Mapping[int, str] | None = None,
    pairs: Iterable[tuple[int, int]] = (),
) -> wire.SceneGraphMessage:
    """A snapshot; unless told, with a new cup each time."""
    names = dict.fromkeys(range(1, sequence + 1), "cup") if names is None else names
    message = make_graph(
        [make_node(i, names[i]) for i in sorted(names)], [make_edge(*pair) for pair in pairs]
    )
    return msgspec.structs.replace(message, session=session, sequence=sequence)


def between(one: wire.SceneGraphMessage, other: wire.SceneGraphMessage):
    return msgspec.structs.replace(diff(one, other), session=other.session)


def update(sequence: int, session: str = "a") -> wire.SceneGraphUpdateMessage:
    before = graph(sequence - 1, session) if sequence > 1 else empty_scene_graph("map")
    return between(before, graph(sequence, session))


def change(names: dict[int, str], rng: np.random.Generator) -> list[tuple[int, int]]:
    """Change the names of nodes; returns pairs that have an edge now."""
    for _ in range(rng.integers(4)):
        node_id = int(rng.integers(1, 9))
        if rng.random() < 0.4:
            names.pop(node_id, None)
        else:
            names[node_id] = str(rng.choice(["cup", "bowl"]))
    odd = int(rng.integers(3))
    return [(i, j) for i in sorted(names) for j in sorted(names) if i < j and (i + j) % 3 == odd]


@given(seed=seeds)
def test_a_replica_that_missed_nothing_is_the_graph(seed: int) -> None:
    rng = np.random.default_rng(seed)
    from_start, joined_late = GraphReplica(), GraphReplica()
    names: dict[int, str] = {}
    previous = empty_scene_graph("map")
    for sequence in range(1, 12):
        current = graph(sequence, "a", names, change(names, rng))
        sent = wire.decode(wire.encode(between(previous, current)), wire.SceneGraphUpdateMessage)
        assert from_start.apply(sent)
        if sequence == 5:
            joined_late.reset(current)
        if sequence >= 5:
            assert joined_late.apply(sent) == (sequence > 5)
            assert joined_late.message() == current
        assert from_start.message() == current
        previous = current


def test_a_lost_update_is_noticed_and_a_snapshot_mends_it() -> None:
    replica = GraphReplica()
    replica.apply(update(1))
    with pytest.raises(RefusedInput, match="update 4 after 1: 2 lost") as refused:
        replica.apply(update(4))
    assert refused.value.reason == "lost_updates"
    assert replica.message() == graph(1)
    replica.reset(graph(3))
    assert not replica.apply(update(2))
    assert replica.sequence == 3
    assert replica.apply(update(4))
    assert replica.message() == graph(4)


def test_another_session_needs_its_first_update_or_a_snapshot() -> None:
    replica = GraphReplica()
    for sequence in (1, 2, 3):
        replica.apply(update(sequence))
    assert replica.session == "a"
    with pytest.raises(RefusedInput, match="session 'b'") as refused:
        replica.apply(update(4, "b"))  # the next number, of another session
    assert refused.value.reason == "other_session"
    assert replica.message() == graph(3)
    replica.reset(graph(4, "b"))
    assert not replica.apply(update(4, "b"))
    assert replica.message() == graph(4, "b")
    assert replica.apply(update(1, "c"))
    assert replica.message() == graph(1, "c")


# --- followers -----------------------------------------------------------------------------------


def test_from_the_first_update_on_no_snapshot_is_needed() -> None:
    copy = GraphReplica()
    follower = GraphFollower(copy)
    assert not follower.has_graph
    assert [follower.update(update(n)) for n in (1, 2, 2, 3)] == [True, True, False, True]
    assert follower.has_graph and follower.gaps == 0
    assert copy.message() == graph(3)
    assert not follower.snapshot(graph(2)), "an older snapshot changes nothing"
    assert follower.snapshot(graph(2, "b")), "fewer updates, but of another session"
    assert follower.update(update(3, "b"))
    assert copy.message() == graph(3, "b")


@pytest.mark.parametrize(("first", "gaps"), [(1, 1), (None, 0)])
def test_a_gap_waits_for_a_snapshot_and_a_late_start_is_none(first: int | None, gaps: int) -> None:
    copy = GraphReplica()
    follower = GraphFollower(copy)
    if first is not None:
        follower.update(update(first))
    assert not follower.update(update(4)) and not follower.update(update(5))
    assert follower.gaps == gaps and copy.sequence == (first or 0)
    assert follower.snapshot(graph(3))
    assert copy.message() == graph(5)


def test_of_two_nodes_on_one_topic_the_first_is_followed() -> None:
    copy, now_s = GraphReplica(), [0.0]
    follower = GraphFollower(copy, lambda: now_s[0])
    assert follower.update(update(1, "a"))
    # Another session is that of a restarted node, until the first one goes on.
    now_s[0] = 1.0
    assert follower.update(update(1, "b")) and copy.session == "b"
    now_s[0] = 2.0
    assert not follower.snapshot(graph(3, "a")), "it was under way"
    now_s[0] = 4.0
    assert follower.snapshot(graph(5, "a")) and copy.session == "a"
    for second in range(5, 60):
        now_s[0] = second
        with pytest.raises(RefusedInput, match="'b' is of a second node"):
            follower.snapshot(graph(second, "b"))
        assert follower.update(update(second + 1, "a"))
    assert copy.session == "a"
    # The first node has ended.
    now_s[0] += SILENT_S
    assert follower.snapshot(graph(99, "b")) and copy.session == "b"


def test_a_new_session_is_followed_at_once() -> None:
    copy = GraphReplica()
    follower = GraphFollower(copy, lambda: 0.0)
    for session in "abcdef":
        assert follower.update(update(1, session)) and copy.session == session
        assert follower.update(update(2, session))


# --- readers that ask now and then ---------------------------------------------------------------


def ask(log: ChangeLog, reader: GraphReplica) -> int:
    """Number of nodes that were sent."""
    found = log.since(reader.session, reader.sequence)
    if found is None:
        return 0
    assert reader.apply(found)
    return len(found.nodes)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, most=st.sampled_from([2, 10_000]))
def test_a_reader_that_asks_at_random_times_has_the_graph(seed: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    log, reader, session, sequence = ChangeLog(), GraphReplica(), "a", 0
    names: dict[int, str] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(follow, "MOST_REMOVED", most)
        for _ in range(30):
            if rng.random() < 0.05:
                session, sequence, names = session + "x", 0, {}
            pairs = change(names, rng)
            sequence += int(rng.integers(1, 3))
            whole = graph(sequence, session, names, pairs)
            log.set(whole)
            if rng.random() < 0.4:
                ask(log, reader)
                assert reader.message() == whole


def test_a_node_that_changed_often_is_sent_once_and_others_not_at_all() -> None:
    log, reader = ChangeLog(), GraphReplica()
    assert log.since(None, 0) is None
    log.set(graph(1, names={1: "cup", 2: "bowl", 3: "bowl"}, pairs=[(1, 2)]))
    assert ask(log, reader) == 3
    assert ask(log, reader) == 0
    for sequence in range(2, 50):
        names = {1: f"cup {sequence}", 2: "bowl"}
        log.set(graph(sequence, names=names, pairs=[(1, 2)]))
    log.set(graph(4))  # an older graph of the session is ignored
    assert ask(log, reader) == 1
    assert reader.nodes[1].label == "cup 49" and set(reader.nodes) == {1, 2}
    # A log that was started again sends everything to a reader from before.
    again = ChangeLog()
    again.set(graph(90, names={2: "bowl"}))
    ask(again, reader)
    assert reader.message() == graph(90, names={2: "bowl"})


def room(room_id: int, label: str) -> wire.RoomState:
    corners = [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 2.0, 0.0]]
    return wire.RoomState(room_id, label, [wire.Belief(label, 0.9)], 0, corners, 3.0, [], [])


def test_rooms_reach_every_kind_of_copy() -> None:
    """Update 2 brings rooms, 3 nothing about them, and 4 others."""
    rooms = [None, [room(1, "kitchen")], None, [room(1, "kitchen"), room(2, "office")]]
    updates, known, wholes = [], msgspec.UNSET, []
    for number, told in enumerate(rooms, 1):
        known = known if told is None else told
        storeys = msgspec.UNSET if known is msgspec.UNSET else [0.0]
        whole = msgspec.structs.replace(graph(number), rooms=known, storeys_m=storeys)
        wholes.append(wire.decode(wire.encode(whole), wire.SceneGraphMessage))
        sent = update(number)
        if told is not None:
            sent.rooms, sent.storeys_m = told, [0.0]
        updates.append(wire.decode(wire.encode(sent), wire.SceneGraphUpdateMessage))
    replica, late, log, reader = GraphReplica(), GraphReplica(), ChangeLog(), GraphReplica()
    late.reset(wholes[2])
    for sent, whole in zip(updates, wholes):
        replica.apply(sent)
        assert replica.message() == whole
        log.set(whole)
        ask(log, reader)
        assert reader.message() == whole
    late.apply(updates[3])
    assert late.message() == wholes[3]
    for first in range(4):
        joined = GraphReplica()
        if first:
            joined.reset(wholes[first - 1])
        joined.apply(follow.join(updates[first:]))
        assert joined.message() == wholes[3]
    assert log.since("a", 3).rooms == rooms[3]
    log.set(msgspec.structs.replace(wholes[3], sequence=5))
    assert log.since("a", 4).rooms is msgspec.UNSET  # not again
