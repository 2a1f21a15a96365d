"""Feeds and followers over a real Zenoh router; which robots are asked, over an imitated one."""

import threading
import time
import zlib
from types import SimpleNamespace as Value

import msgspec
import pytest
from support.races import beside, filling
from support.view import make_graph, make_node

from deworldsg_ros.fleet import zenoh_link
from deworldsg_ros.fleet.zenoh_link import (
    GONE_S,
    PATIENCE_S,
    Feed,
    Follower,
    Robots,
    open_session,
    robot_key,
)
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import ChangeLog

LIMIT_S = 20.0


def graph(sequence, *labels):
    nodes = [make_node(i, label) for i, label in enumerate(labels, 1)]
    return msgspec.structs.replace(make_graph(nodes), session="s", sequence=sequence)


def log_of(sequence, *labels):
    log = ChangeLog()
    log.set(graph(sequence, *labels))
    return log


@pytest.fixture
def opened(endpoint):
    """Opens sessions of a router, which is there at first; `opened.router` ends it."""
    pytest.importorskip("zenoh", reason="needs the extra fleet: eclipse-zenoh")
    sessions = []

    def opened(connect=endpoint, listen=""):
        sessions.append(open_session(connect, listen))
        return sessions[-1]

    opened.router = opened("", endpoint)
    yield opened
    for session in sessions:
        session.close()


def until(condition):
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.1)


def test_a_follower_has_the_graph_also_after_the_router_was_away(endpoint, opened):
    log = ChangeLog()
    feed = Feed(opened(), robot_key("ada"), log)
    follower = Follower(opened(), robot_key("ada"))
    until(lambda: follower.ask(1.0) is False)  # there is no graph yet
    log.set(graph(1, "cup", "bowl"))
    until(lambda: follower.ask(1.0))
    assert follower.replica.message() == graph(1, "cup", "bowl")
    assert follower.ask(1.0) is False
    assert follower.received_bytes == feed.sent_bytes > 0

    opened.router.close()
    log.set(graph(2, "cup"))
    log.set(graph(3, "cup", "bowl", "chair"))
    assert follower.ask(0.5) is None
    opened("", endpoint)
    until(lambda: follower.ask(1.0))
    assert follower.replica.message() == graph(3, "cup", "bowl", "chair")


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (b"no zlib", "invalid_message"),
        (zlib.compress(b"[" * 1000), "invalid_message"),
        (zlib.compress(b" " * 2_000_000), "message_too_large"),
        (zlib.compress(b"x" * 100)[:-5], "message_too_large"),
        (bytes(200_000), "message_too_large"),
    ],
)
def test_hostile_answers_are_refused_and_change_nothing(opened, answer, reason, monkeypatch):
    monkeypatch.setattr(zenoh_link, "MAX_ANSWER_BYTES", 1_000_000)
    monkeypatch.setattr(zenoh_link, "MAX_PACKED_BYTES", 100_000)
    opened().declare_queryable("k", lambda query: query.reply(query.key_expr, answer))
    follower = Follower(opened(), "k")
    with pytest.raises(RefusedInput) as refused:
        until(lambda: follower.ask(1.0) is not None)
    assert refused.value.reason == reason
    assert follower.replica.sequence == 0


def test_of_two_robots_with_one_name_the_first_is_followed(opened):
    feeds = [opened() for _ in range(2)]
    first = Feed(feeds[0], robot_key("ada"), log_of(1, "cup"))
    robots = Robots(opened())
    token = feeds[0].liveliness().declare_token(robot_key("ada"))
    until(lambda: robots.ask(1.0).get("ada"))
    other = ChangeLog()
    other.set(msgspec.structs.replace(graph(1, "chair", "bowl"), session="other"))
    second = Feed(feeds[1], robot_key("ada"), other)
    reasons = []

    def is_told():
        robots.ask(1.0)
        reasons.extend(errors(robots))
        return len(reasons) > 2

    until(is_told)
    assert set(reasons) == {"same_name"}
    follower = robots.followers["ada"]
    assert follower.replica.message() == graph(1, "cup")
    first.close()  # the first one has ended: the other one is the robot of this name
    until(lambda: robots.ask(1.0).get("ada"))
    assert follower.replica.message().session == "other"
    second.close()
    token.undeclare()


def test_questions_that_nobody_would_ask_get_the_whole_graph(opened):
    feed = Feed(opened(), "k", log_of(1, "cup"))
    asker = opened()
    time.sleep(0.5)
    for parameters in ("", "since=", "since=-1", "since=1e9;session=s", "since=" + "9" * 400):
        (reply,) = asker.get(f"k?{parameters}", timeout=2.0)
        assert b'"cup"' in zlib.decompress(reply.ok.payload.to_bytes())
    assert feed.sent_bytes


def test_endpoints_that_cannot_be_used_are_refused_in_one_line(endpoint, opened):
    for connect, listen in (("no endpoint", ""), ("", endpoint)):
        with pytest.raises(ConfigurationError, match="no Zenoh session with connect"):
            opened(connect, listen)


class Payload(bytes):
    """The bytes of a reply."""

    def to_bytes(self):
        return bytes(self)


class Network:
    """A Zenoh session: who is there, the logs of those that answer, and who was asked."""

    def __init__(self):
        self.tokens, self.logs, self.asked = [], {}, []

    def liveliness(self):
        replies = [Value(ok=Value(key_expr=robot_key(name))) for name in self.tokens]
        return Value(get=lambda key, timeout: replies)

    def get(self, selector, timeout, consolidation):
        name = selector.partition("?")[0][len(robot_key("")) :]
        self.asked.append(name)
        log = self.logs.get(name)
        if log is None:
            return []
        if isinstance(log, Exception):
            raise log
        packed = zlib.compress(wire.encode(log.since(None, 0)).encode())
        return [Value(ok=Value(payload=Payload(packed)), replier_id=name)]


@pytest.fixture
def network():
    pytest.importorskip("zenoh", reason="needs the extra fleet: eclipse-zenoh")
    return Network()


@pytest.fixture
def robots(network):
    return Robots(network)


@pytest.fixture
def clock(monkeypatch):
    clock = Value(now_s=100.0, monotonic=lambda: clock.now_s)
    monkeypatch.setattr(zenoh_link, "time", clock)
    return clock


def errors(robots):
    return [getattr(error, "reason", repr(error)) for error in robots.take_errors()]


@pytest.mark.parametrize("name", ["a/b", "", "a?since=0", "**", "ä", "x" * 65, "a\nb"])
def test_a_name_that_is_none_is_refused_and_not_asked(network, robots, name):
    network.tokens = [name, "ada"]
    assert robots.ask(1.0) == {"ada": None}
    assert network.asked == ["ada"]
    assert errors(robots) == ["invalid_robot"] and errors(robots) == []


def test_robots_that_are_gone_are_forgotten(network, robots, clock):
    network.tokens = ["ada", "bob", "cat"]
    network.logs = {"ada": log_of(1, "cup"), "bob": log_of(1, "pot")}
    assert robots.ask(1.0) == {"ada": True, "bob": True, "cat": None}
    received = robots.received_bytes
    assert received > 0
    network.tokens = ["ada"]
    del network.logs["ada"]  # it is there, and does not answer
    clock.now_s += GONE_S  # bob answers, without a token
    assert set(robots.ask(1.0)) == {"ada", "bob", "cat"}
    del network.logs["bob"]
    clock.now_s += GONE_S + 1.0
    assert set(robots.ask(1.0)) == set(robots.followers) == {"ada"}
    assert robots.received_bytes > received
    network.tokens = ["ada", "bob"]
    network.logs["bob"] = log_of(1, "pot")
    assert robots.ask(1.0) == {"ada": None, "bob": True}  # its whole graph again


def test_ever_new_names_take_the_places_of_those_that_are_gone(network, robots, clock, monkeypatch):
    monkeypatch.setattr(zenoh_link, "MAX_ROBOTS", 3)
    for number in range(5):  # one at a time
        clock.now_s += GONE_S + 1.0
        network.tokens, network.logs = [f"robot{number}"], {f"robot{number}": log_of(1, "cup")}
        assert robots.ask(1.0) == {f"robot{number}": True}
    assert errors(robots) == [] and robots.take_forgotten() == ["robot0", "robot1"]
    # Those that are there keep their places.
    network.tokens = names = ["robot2", "robot3", "robot4", "late"]
    network.logs = {name: log_of(1, "cup") for name in names}
    assert set(robots.ask(1.0)) == {"robot2", "robot3", "robot4"}
    assert errors(robots) == ["too_many_robots"] and robots.take_forgotten() == []


def test_names_that_never_answer_do_not_lock_out_a_robot(network, robots, clock, monkeypatch):
    monkeypatch.setattr(zenoh_link, "MAX_ROBOTS", 4)
    network.tokens = ["ada", "x1", "x2", "x3", "bob"]
    network.logs = {"ada": log_of(1, "cup"), "bob": log_of(1, "pot")}
    robots.ask(1.0)
    assert "bob" not in robots.followers and errors(robots) == ["too_many_robots"]
    clock.now_s += PATIENCE_S + 1.0
    assert {"ada", "bob"} <= {name for name, new in robots.ask(1.0).items() if new is not None}


def test_nobody_waits_for_a_robot_that_does_not_answer(network, robots):
    network.tokens, network.logs = ["ada", "mute"], {"ada": log_of(1, "cup")}
    answer, waits = network.get, threading.Event()

    def get(selector, **options):
        if "mute" in selector and robots._silent:
            waits.wait(LIMIT_S)
        return answer(selector, **options)

    network.get = get
    assert robots.ask(1.0) == {"ada": True, "mute": None}
    for _ in range(3):
        started_s = time.monotonic()
        assert robots.ask(1.0)["mute"] is None
        assert time.monotonic() - started_s < 0.5 * LIMIT_S
    network.logs["mute"] = log_of(1, "pot")
    waits.set()
    until(lambda: robots.ask(1.0)["mute"])


def test_a_graph_that_grows_without_end_is_dropped(network, robots, monkeypatch):
    monkeypatch.setattr(zenoh_link, "MAX_PARTS", 2)
    network.tokens, network.logs = ["ada"], {"ada": log_of(1, "cup", "pot", "pan")}
    assert robots.ask(1.0) == {"ada": None}
    assert errors(robots) == ["message_too_large"]
    assert not robots.followers["ada"].replica.nodes


def test_counts_may_be_read_while_robots_come_and_go(robots):
    with beside(filling(robots.followers, Follower(None, "ada"))):
        for _ in range(20_000):
            assert robots.received_bytes == 0


def test_a_robot_that_fails_does_not_stop_the_others(network, robots):
    network.tokens = ["ada", "bob"]
    network.logs = {"ada": ZeroDivisionError("odd"), "bob": log_of(1, "pot")}
    assert robots.ask(1.0) == {"ada": None, "bob": True}
    assert errors(robots) == ["ZeroDivisionError('odd')"]
