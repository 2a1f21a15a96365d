"""The live client over DDS: the first graph, updates, a gap, changes, the end."""

import threading
import time
from collections.abc import Callable

import pytest

pytest.importorskip("rclpy")

from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.nodes import Peer, peer, wait_until
from support.reference_updates import diff
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.client import ClientError, SceneGraph, SceneGraphClient
from deworldsg_ros.client.live import FIND_S
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.wire import messages as wire

LIMIT_S = 20.0


def graph(sequence: int, *labels: str) -> wire.SceneGraphMessage:
    """A snapshot: objects 1, 2, … in a row, the second one on the first."""
    nodes = [make_node(i + 1, label, (i, 0, 0)) for i, label in enumerate(labels)]
    edges = [make_edge(2, 1, "on")] if len(nodes) > 1 else []
    return make_graph(nodes, edges, sequence=sequence)


def growing(count: int) -> list[wire.SceneGraphMessage]:
    """The first graphs of a session: one object more in each."""
    return [graph(i, *["table", "cup", "book", "vase", "bowl"][:i]) for i in range(count)]


class Robot:
    """Publishes what graph_node would publish."""

    def __init__(self, me: Peer, namespace: str = "") -> None:
        self._snapshots = me.node.create_publisher(
            String, f"{namespace}/scene_graph", reliable(1, latched=True)
        )
        self._updates = me.node.create_publisher(
            String, f"{namespace}/scene_graph/updates", reliable(50)
        )

    def wait(self, count: int = 1) -> None:
        wait_until(lambda: self._updates.get_subscription_count() >= count, LIMIT_S, "the client")

    def latch(self, message: wire.SceneGraphMessage) -> None:
        self._snapshots.publish(String(data=wire.encode(message)))

    def update(self, before: wire.SceneGraphMessage, after: wire.SceneGraphMessage) -> None:
        self._updates.publish(String(data=wire.encode(diff(before, after))))

    def text(self, text: str) -> None:
        self._updates.publish(String(data=text))


def test_a_client_follows_the_graph_and_closes_a_gap_by_itself():
    steps = growing(6)
    with peer("robot") as me, SceneGraphClient("/robot_1/") as client:
        Robot(me).latch(graph(7, "a", "graph", "of", "another", "robot"))
        robot = Robot(me, "/robot_1")
        seen: list[list[str]] = []
        threads = set()
        client.on_change(lambda now, changes: threads.add(threading.get_ident()))
        client.on_change(lambda now, changes: seen.append(changes.lines))
        robot.latch(steps[2])
        first = client.graph
        assert [item.label for item in first.on("table")] == ["cup"]
        robot.wait()

        robot.update(steps[2], steps[3])
        assert len(client.wait(3, LIMIT_S)) == 3
        assert len(first) == 2  # a graph never changes
        assert client.gaps == 0

        robot.update(steps[4], steps[5])  # update 4 was lost
        wait_until(lambda: client.gaps == 1, LIMIT_S, "the gap")
        # The snapshot is older than the update that arrived in the gap.
        robot.latch(steps[4])
        assert len(client.wait(5, LIMIT_S)) == 5
        assert client.gaps == 1

        robot.text("{}")
        wait_until(lambda: client.refused == 1, LIMIT_S, "the refusal")
        assert [line.split(" at")[0] for line in seen[0]] == ["added table #1", "added cup #2"]
        assert seen[1] == ["added book #3 at 2.00 0.00 0.00"]
        assert len(seen[2]) == 2
        assert threads.isdisjoint({threading.get_ident()})


def test_without_a_graph_the_reason_is_told():
    with (
        SceneGraphClient("/nobody") as client,
        pytest.raises(ClientError, match="/nobody/scene_graph within 0.1 s"),
    ):
        client.wait(timeout_s=0.1)


def test_functions_of_the_user_that_raise_do_not_end_the_client(capfd, monkeypatch):
    steps = growing(5)

    def fail(*arguments):
        raise KeyError("a mistake of the user")

    with peer("robot") as me, SceneGraphClient() as client:
        robot = Robot(me)
        seen: list[object] = []
        client.on_message(fail)
        client.on_message(lambda message: seen.append(message.sequence))
        client.on_change(fail)
        client.on_change(lambda now, changes: seen.append(changes.lines))
        robot.latch(steps[1])
        assert len(client.graph) == 1
        robot.wait()
        robot.update(steps[1], steps[2])
        wait_until(lambda: len(seen) == 4, LIMIT_S, "the second change")
        assert len(client.newest) == 2
        monkeypatch.setattr(SceneGraph, "changes_since", fail)
        robot.update(steps[2], steps[3])
        assert len(client.wait(3, LIMIT_S)) == 3
        monkeypatch.undo()
        robot.update(steps[3], steps[4])
        assert len(client.wait(4, LIMIT_S)) == 4
        wait_until(lambda: len(seen) == 7, LIMIT_S, "the last change")
    assert (client.gaps, client.refused) == (0, 0)
    log = capfd.readouterr().err
    assert "KeyError('a mistake of the user')" in log and "Traceback" in log


def outcome(call: Callable[[], object], outcomes: list[str]) -> None:
    """Append the reason why a call is refused."""
    try:
        call()
    except ClientError as error:
        outcomes.append(str(error))


def test_a_function_of_the_client_cannot_wait_for_it():
    refusals: list[str] = []

    with peer("graph_node") as me, SceneGraphClient() as client:
        called = threading.Event()
        me.node.create_service(Trigger, "~/save", lambda request, response: response)
        client.on_message(lambda message: outcome(lambda: client.wait(2), refusals))
        client.on_change(lambda now, changes: outcome(client.save, refusals))
        client.on_change(lambda now, changes: outcome(lambda: client.goal_near("cup"), refusals))
        client.on_change(lambda now, changes: refusals.append(f"{len(client.graph)} object"))
        client.on_change(lambda now, changes: called.set())
        Robot(me).latch(graph(1, "cup"))
        assert called.wait(LIMIT_S)
    assert refusals.pop() == "1 object"  # what has arrived needs no waiting
    assert len(refusals) == 3
    assert all("call this from another thread" in refusal for refusal in refusals)


def test_a_fleet_has_no_services_and_nobody_waits_for_them():
    # In a namespace of its own: a graph that somebody else publishes, too, is not the fleet's.
    with peer("fleet_node") as me, SceneGraphClient("/fleet_1") as client:
        Robot(me, "/fleet_1").latch(graph(1, "cup"))
        client.wait(1, LIMIT_S)
        start_s = time.monotonic()
        assert client.goal_near("cup")["target"]["label"] == "cup"
        assert client.explain("cup")["subject"].startswith("cup")
        with pytest.raises(ClientError, match="is published by another node than graph_node"):
            client.save()
        assert time.monotonic() - start_s < FIND_S


def test_closing_a_client_ends_those_who_wait_for_it():
    errors: list[str] = []
    closed = threading.Event()

    def answer(request, response):
        client.close()
        closed.set()
        return response

    with peer("graph_node") as me, SceneGraphClient() as client:
        me.node.create_service(Trigger, "~/save", answer)
        # Waiting for an answer, for a service, and for a graph.
        threads = [
            threading.Thread(target=outcome, args=(call, errors), daemon=True)
            for call in (client.save, client.clear, client.wait)
        ]
        for thread in threads:
            thread.start()
        me.spin_until(closed.is_set, LIMIT_S, "the request")
        for thread in threads:
            thread.join(LIMIT_S)
        outcome(client.save, errors)
    assert errors == ["the client is closed"] * 4
