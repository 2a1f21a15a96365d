"""Which robots the fleet asks: names that are none, robots that are gone, one that fails."""

from __future__ import annotations

import zlib
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from support.view import make_graph, make_node

from deworldsg_ros.fleet import zenoh_link
from deworldsg_ros.fleet.zenoh_link import GONE_S, Robots, robot_key
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import ChangeLog


class Network:
    """A Zenoh session: the tokens, and the graphs of robots that answer.

    Attributes:
        tokens: names of the robots that are there.
        graphs: by name; an exception is raised, a robot without a graph does not answer.
        asked: names of the robots that were asked.
    """

    def __init__(self) -> None:
        self.tokens: list[str] = []
        self.graphs: dict[str, Any] = {}
        self.asked: list[str] = []

    def liveliness(self) -> Any:
        ok = [SimpleNamespace(key_expr=robot_key(name)) for name in self.tokens]
        replies = [SimpleNamespace(ok=one) for one in ok]
        return SimpleNamespace(get=lambda key, timeout: replies)

    def get(self, selector: str, timeout: float) -> list[Any]:
        name = selector.partition("?")[0][len(robot_key("")) :]
        self.asked.append(name)
        graph = self.graphs.get(name)
        if isinstance(graph, Exception):
            raise graph
        if graph is None:
            return []
        log = ChangeLog()
        log.set(graph)
        packed = zlib.compress(wire.encode(log.since(None, 0)).encode())
        return [
            SimpleNamespace(ok=SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: packed)))
        ]


@pytest.fixture
def network() -> Network:
    return Network()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr(zenoh_link, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    return clock


def graph(label: str) -> wire.SceneGraphMessage:
    return msgspec.structs.replace(make_graph([make_node(1, label)]), session=label, sequence=1)


def reasons(robots: Robots) -> list[str]:
    errors = robots.take_errors()
    return [error.reason if isinstance(error, RefusedInput) else repr(error) for error in errors]


@pytest.mark.parametrize("name", ["a/b", "", "a?since=0", "**", "ä", "x" * 65, "a\nb"])
def test_a_name_that_is_none_is_refused_and_not_asked(network: Network, name: str) -> None:
    robots = Robots(network)
    network.tokens = [name, "ada"]
    assert robots.ask(1.0) == {"ada": None}
    assert network.asked == ["ada"]
    assert reasons(robots) == ["invalid_robot"] and reasons(robots) == []


def test_robots_that_are_gone_are_forgotten(network: Network, clock: SimpleNamespace) -> None:
    robots = Robots(network)
    network.tokens = ["ada", "bob", "cat"]
    network.graphs = {"ada": graph("cup"), "bob": graph("pot")}
    assert robots.ask(1.0) == {"ada": True, "bob": True, "cat": None}
    received = robots.received_bytes
    assert received > 0
    network.tokens = ["ada"]
    del network.graphs["ada"]  # it is there, and does not answer
    clock.now_s += GONE_S  # bob answers, without a token
    assert set(robots.ask(1.0)) == {"ada", "bob", "cat"}
    del network.graphs["bob"]
    clock.now_s += GONE_S + 1.0
    assert set(robots.ask(1.0)) == set(robots.followers) == {"ada"}
    assert robots.received_bytes > received
    network.tokens = ["ada", "bob"]
    network.graphs["bob"] = graph("pot")
    assert robots.ask(1.0) == {"ada": None, "bob": True}  # its whole graph again


def test_the_number_of_robots_is_bounded(
    network: Network, clock: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_link, "MAX_ROBOTS", 3)
    robots = Robots(network)
    network.tokens = ["silent"]
    robots.ask(1.0)
    clock.now_s += GONE_S + 1.0
    names = [f"robot{number}" for number in range(5)]
    for name in names:  # ever new names, one at a time
        network.tokens, network.graphs = [name], {name: graph("cup")}
        robots.ask(1.0)
        clock.now_s += GONE_S + 1.0
    assert reasons(robots) == ["too_many_robots"] * 2
    network.tokens, network.graphs = names[:1], {names[0]: graph("cup")}
    assert robots.ask(1.0) == {names[0]: True}  # one that is known may come back


def test_a_robot_that_fails_does_not_stop_the_others(network: Network) -> None:
    robots = Robots(network)
    network.tokens = ["ada", "bob"]
    network.graphs = {"ada": ZeroDivisionError("odd"), "bob": graph("pot")}
    assert robots.ask(1.0) == {"ada": None, "bob": True}
    assert reasons(robots) == ["ZeroDivisionError('odd')"]
