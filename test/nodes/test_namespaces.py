"""Two robots in two namespaces keep two graphs apart; without a namespace topics stay global."""

from __future__ import annotations

import contextlib

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String
from support.nodes_bench import Bench, local_graph

from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.wire import messages as wire

LOCAL = "deworldsg/local_graph"


def seen_at(stamp_ns: int, x_m: float) -> wire.LocalGraphMessage:
    message = local_graph(stamp_ns)
    message.objects[0].mean_m = [x_m, 0.0, 1.0]
    return message


def test_two_robots_keep_two_graphs_apart() -> None:
    robots = {"/robot1": 1.0, "/robot2": 2.0}
    with contextlib.ExitStack() as stack:
        benches = {}
        for robot in robots:
            bench = Bench(GraphNode, {f"{robot}/{LOCAL}": String}, namespace=robot)
            stack.callback(bench.close)
            benches[robot] = bench
        peer = benches["/robot1"].peer
        updates = {robot: peer.collect(f"{robot}/scene_graph/updates") for robot in robots}
        shared = peer.collect("/scene_graph/updates")
        names: set[str] = set()
        peer.node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda message: names.update(status.name for status in message.status),
            10,
        )
        for bench in benches.values():
            peer.also_spin += [e for e in bench.peer.also_spin if e not in peer.also_spin]
        peer.spin_for(0.5)
        for robot, x_m in robots.items():
            bench = benches[robot]
            for _ in range(12):
                message = seen_at(bench.next_stamp(), x_m)
                bench.send(**{f"{robot}/{LOCAL}".replace("/", "__"): message})
        peer.spin_until(lambda: all(updates.values()) and len(names) == 2, 20.0, "both graphs")
        sessions = set()
        for robot, x_m in robots.items():
            decoded = [wire.decode(text, wire.SceneGraphUpdateMessage) for text in updates[robot]]
            assert {node.mean_m[0] for update in decoded for node in update.nodes} == {x_m}
            sessions |= {update.session for update in decoded}
        assert len(sessions) == 2
        assert shared == []
        assert names == {f"graph_node: {robot}/graph_node" for robot in robots}
        services = dict(peer.node.get_service_names_and_types())
        assert {f"{robot}/graph_node/save" for robot in robots} <= services.keys()
        topics = dict[str, list[str]]()

        def no_shared_graph() -> bool:
            topics.clear()
            topics.update(peer.node.get_topic_names_and_types())
            return "/scene_graph" not in topics

        # A node that another test killed is known for 20 s.
        peer.spin_until(no_shared_graph, 30.0, "no /scene_graph")
        assert {f"{robot}/scene_graph/markers" for robot in robots} <= topics.keys()


def test_without_a_namespace_the_topics_are_global() -> None:
    bench = Bench(GraphNode, {LOCAL: String})
    try:
        assert {"/scene_graph", "/scene_graph/updates", "/scene_graph/markers"} <= dict(
            bench.node.get_topic_names_and_types()
        ).keys()
    finally:
        bench.close()
