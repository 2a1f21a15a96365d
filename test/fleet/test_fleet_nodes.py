"""fleet_link_node and fleet_node as processes: a graph on a topic goes to the fleet and back."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import msgspec
import pytest
from rclpy.qos import DurabilityPolicy
from std_msgs.msg import String
from support.nodes import NodeProcess, peer, wait_until

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.wire import messages as wire

SAVED = Path(__file__).parents[1] / "client" / "saved" / "scene_graph_v1.json"
LIMIT_S = 60.0

pytest.importorskip("zenoh", reason="needs the extra fleet: eclipse-zenoh")


def half(keep) -> wire.SceneGraphMessage:
    """The objects of a part of a room, as graph_node would publish them."""
    room = SceneGraph.load(SAVED)
    nodes = [item.state for item in room if keep(item.position_m[1])]
    ids = {node.id for node in nodes}
    return msgspec.structs.replace(
        room.message,
        session="run",
        sequence=1,
        nodes=nodes,
        edges=[edge for edge in room.message.edges if {edge.subject, edge.object} <= ids],
    )


def test_two_robots_over_two_links(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    nodes = []
    for name in ("ada", "bob"):
        folder = tmp_path / name
        folder.mkdir()
        words = ["--ros-args", "-r", f"__ns:=/{name}", "-p", f"robot:={name}"]
        nodes.append(NodeProcess("fleet_link_node", folder, *words, "-p", f"connect:={endpoint}"))
    try:
        nodes.append(NodeProcess("fleet_node", tmp_path, "--ros-args", "-p", f"listen:={endpoint}"))
        with peer() as test:
            profile = reliable(1, latched=True)
            assert profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            halves = {"ada": half(lambda y: y < 0.5), "bob": half(lambda y: y > -0.6)}
            for name, graph in halves.items():
                publisher = test.node.create_publisher(String, f"/{name}/scene_graph", profile)
                publisher.publish(String(data=wire.encode(graph)))
            robots = test.collect("/fleet/robots", latched=True)
            whole = test.collect("/fleet/scene_graph", latched=True)
            others = {
                name: test.collect(f"/{name}/others/scene_graph", latched=True) for name in halves
            }

            def is_complete() -> bool:
                known = json.loads(robots[-1]) if robots else []
                return sum(item["located"] for item in known) == 2 and all(others.values())

            test.spin_until(is_complete, LIMIT_S, "both robots to be located")
            test.spin_for(2.0)
        room = SceneGraph.load(SAVED)
        fleet = wire.decode(whole[-1], wire.SceneGraphMessage)
        assert len(fleet.nodes) == len(room)
        for name, texts in others.items():
            part = wire.decode(texts[-1], wire.SceneGraphMessage)
            assert len(part.nodes) == len(room) - len(halves[name].nodes)
            assert part.frame_id == room.frame_id
        assert [node.interrupt() for node in nodes] == [0, 0, 0]
    finally:
        for node in nodes:
            node.end()


@pytest.mark.parametrize("name", ["", "a/b", "*"])
def test_a_link_without_a_usable_name_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    node = NodeProcess("fleet_link_node", tmp_path, "--ros-args", "-p", f"robot:='{name}'")
    try:
        wait_until(lambda: not node.alive, LIMIT_S, "the node to end")
        assert node.wait(1) == 2
        assert "expected a name of letters" in node.log
        assert "Traceback" not in node.log
    finally:
        node.end()
