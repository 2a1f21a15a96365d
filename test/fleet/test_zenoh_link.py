"""Feeds and followers over a real Zenoh router, which is ended and started again."""

from __future__ import annotations

import socket
import time
import zlib

import msgspec
import pytest
from support.view import make_graph, make_node

from deworldsg_ros.fleet.zenoh_link import Feed, Follower, Robots, open_session, robot_key
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import ChangeLog

pytest.importorskip("zenoh", reason="needs the extra fleet: eclipse-zenoh")
LIMIT_S = 20.0


def graph(sequence: int, *labels: str):
    nodes = [make_node(i, label) for i, label in enumerate(labels, 1)]
    return msgspec.structs.replace(make_graph(nodes), session="s", sequence=sequence)


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


@pytest.fixture
def opened():
    sessions = []
    yield lambda *args: sessions.append(open_session(*args)) or sessions[-1]
    for session in sessions:
        session.close()


def ask_until(follower: Follower, wanted: bool) -> None:
    """Ask until the graph changed, or until there is an answer."""
    end_s = time.monotonic() + LIMIT_S
    while time.monotonic() < end_s:
        answer = follower.ask(1.0)
        if answer or (answer is not None and not wanted):
            return
        time.sleep(0.1)
    raise AssertionError("no answer")


def test_a_follower_has_the_graph_also_after_the_router_was_away(endpoint: str, opened) -> None:
    router = opened("", endpoint)
    log = ChangeLog()
    feed = Feed(opened(endpoint), robot_key("ada"), log)
    follower = Follower(opened(endpoint), robot_key("ada"))
    ask_until(follower, False)  # there is no graph yet
    log.set(graph(1, "cup", "bowl"))
    ask_until(follower, True)
    assert follower.replica.message() == graph(1, "cup", "bowl")
    assert follower.ask(1.0) is False
    assert follower.received_bytes == feed.sent_bytes > 0

    router.close()
    log.set(graph(2, "cup"))
    log.set(graph(3, "cup", "bowl", "chair"))
    assert follower.ask(0.5) is None
    opened("", endpoint)
    ask_until(follower, True)
    assert follower.replica.message() == graph(3, "cup", "bowl", "chair")


def test_robots_are_found_and_asked_at_the_same_time(endpoint: str, opened) -> None:
    opened("", endpoint)
    robots = Robots(opened(endpoint))
    assert robots.ask(1.0) == {}
    feeds = []
    for name in ("ada", "bob"):
        log, session = ChangeLog(), opened(endpoint)
        log.set(graph(1, name))
        feeds.append(Feed(session, robot_key(name), log))
        feeds.append(session.liveliness().declare_token(robot_key(name)))
    end_s = time.monotonic() + LIMIT_S
    while set(robots.followers) != {"ada", "bob"} and time.monotonic() < end_s:
        robots.ask(1.0)
    robots.ask(1.0)
    labels = {name: item.replica.nodes[1].label for name, item in robots.followers.items()}
    assert labels == {"ada": "ada", "bob": "bob"}


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (b"no zlib", "invalid_message"),
        (zlib.compress(b"[" * 1000), "invalid_message"),
        (zlib.compress(b" " * 2_000_000), "message_too_large"),
        (zlib.compress(b"x" * 100)[:-5], "message_too_large"),
    ],
)
def test_hostile_answers_are_refused_and_change_nothing(
    endpoint: str, opened, answer: bytes, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wire, "MAX_GRAPH_BYTES", 1_000_000)
    opened("", endpoint)
    session = opened(endpoint)
    session.declare_queryable("k", lambda query: query.reply(query.key_expr, answer))
    follower = Follower(opened(endpoint), "k")
    with pytest.raises(RefusedInput) as refused:
        ask_until(follower, False)
    assert refused.value.reason == reason
    assert follower.replica.sequence == 0


def test_questions_that_nobody_would_ask_get_the_whole_graph(endpoint: str, opened) -> None:
    opened("", endpoint)
    log = ChangeLog()
    log.set(graph(1, "cup"))
    feed = Feed(opened(endpoint), "k", log)
    asker = opened(endpoint)
    time.sleep(0.5)
    for parameters in ("", "since=", "since=-1", "since=1e9;session=s", "since=" + "9" * 400):
        (reply,) = asker.get(f"k?{parameters}", timeout=2.0)
        assert b'"cup"' in zlib.decompress(reply.ok.payload.to_bytes())
    assert feed.sent_bytes


def test_endpoints_that_cannot_be_used_are_refused_in_one_line(endpoint: str, opened) -> None:
    opened("", endpoint)
    for connect, listen in (("no endpoint", ""), ("", endpoint)):
        with pytest.raises(ConfigurationError, match="no Zenoh session with connect"):
            opened(connect, listen)
