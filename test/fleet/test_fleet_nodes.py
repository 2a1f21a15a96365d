"""fleet_link_node and fleet_node as processes: a graph on a topic goes to the fleet and back."""

import contextlib
import json
import time
from types import SimpleNamespace

import pytest
from msgspec.structs import replace
from std_msgs.msg import String
from support.nodes import NodeProcess, peer, run_to_end
from support.nodes_bench import alone
from support.races import beside, filling
from support.view import SAVED

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.nodes.fleet_node import FleetNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.wire import messages as wire

ROOM = SceneGraph.load(SAVED)

pytest.importorskip("zenoh", reason="needs the extra fleet: eclipse-zenoh")


def part(keep):
    """The objects of a part of a room, as graph_node would publish them."""
    nodes = [item.state for item in ROOM if keep(item.position_m[1])]
    ids = {node.id for node in nodes}
    edges = [edge for edge in ROOM.message.edges if {edge.subject, edge.object} <= ids]
    return replace(ROOM.message, session="run", sequence=1, nodes=nodes, edges=edges)


def test_two_robots_over_two_links(tmp_path, endpoint):
    halves = {"ada": part(lambda y: y < 0.5), "bob": part(lambda y: y > -0.6)}
    with contextlib.ExitStack() as stack:
        nodes = []
        for name in halves:
            folder = tmp_path / name
            folder.mkdir()
            words = ("--ros-args", "-r", f"__ns:=/{name}")
            link = {"robot": name, "connect": endpoint}
            nodes.append(NodeProcess("fleet_link_node", folder, *words, parameters=link))
        nodes.append(NodeProcess("fleet_node", tmp_path, parameters={"listen": endpoint}))
        for node in nodes:
            stack.enter_context(node)
        with peer() as test:
            for name, graph in halves.items():
                publisher = test.node.create_publisher(
                    String, f"/{name}/scene_graph", reliable(1, latched=True)
                )
                publisher.publish(String(data=wire.encode(graph)))
            robots = test.collect("/fleet/robots", latched=True)
            whole = test.collect("/fleet/scene_graph", latched=True)
            others = {
                name: test.collect(f"/{name}/others/scene_graph", latched=True) for name in halves
            }

            def is_complete() -> bool:
                known = json.loads(robots[-1]) if robots else []
                return sum(item["located"] for item in known) == 2 and all(others.values())

            test.spin_until(is_complete, 60.0, "both robots to be located")
            test.spin_for(2.0)
        fleet = wire.decode(whole[-1], wire.SceneGraphMessage)
        assert len(fleet.nodes) == len(ROOM)
        for name, texts in others.items():
            told = wire.decode(texts[-1], wire.SceneGraphMessage)
            assert len(told.nodes) == len(ROOM) - len(halves[name].nodes)
            assert told.frame_id == ROOM.frame_id
        assert [node.interrupt() for node in nodes] == [0, 0, 0]


@pytest.mark.parametrize("name", ["", "a/b", "*"])
def test_a_link_without_a_usable_name_is_refused_in_one_line(tmp_path, name):
    code, log = run_to_end("fleet_link_node", tmp_path, parameters={"robot": f"'{name}'"})
    assert code == 2
    assert "expected a name of letters" in log
    assert "Traceback" not in log


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("fleet_link_node", "no answer of fleet_node over {}"),
        ("fleet_node", "no router answers at {}"),
    ],
)
def test_a_node_without_a_router_says_so_and_ends_at_once(tmp_path, endpoint, name, words):
    link = {"connect": endpoint} | ({"robot": "ada"} if name == "fleet_link_node" else {})
    with NodeProcess(name, tmp_path, parameters=link) as node, peer() as test:
        statuses = test.statuses()
        node.wait_ready()
        test.spin_until(
            lambda: any(words.format(endpoint) in str(s) for s in statuses),
            60.0,
            "the missing router",
        )
        assert node.interrupt() == 0, node.log


def test_robots_that_come_and_go_while_diagnostics_are_read(endpoint):
    with alone(FleetNode, {"listen": endpoint}) as node:
        node._loop.stop()
        member = SimpleNamespace(T_fleet_world=None, reason="no object in common")
        tables = (
            (node._answered_s, 0.0),
            (node._fleet.members, member),
            (node._feeds, SimpleNamespace(sent_bytes=1)),
        )
        with beside(*(filling(*table) for table in tables)):
            for _ in range(20_000):
                node.waiting_for(time.monotonic_ns())
                node.more_values()
        for table, _ in tables:
            table.clear()
