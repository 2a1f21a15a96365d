"""Two robots in two namespaces keep two graphs apart."""

import contextlib

from std_msgs.msg import String
from support.nodes_bench import Bench, local_graph

from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.wire import messages as wire

LOCAL = "deworldsg/local_graph"


def test_two_robots_keep_two_graphs_apart():
    robots = {"/robot1": 1.0, "/robot2": 2.0}
    with contextlib.ExitStack() as stack:
        benches = {
            robot: stack.enter_context(
                Bench(GraphNode, {f"{robot}/{LOCAL}": String}, namespace=robot)
            )
            for robot in robots
        }
        one, two = benches.values()
        peer = one.peer
        peer.also_spin += two.peer.also_spin
        updates = {robot: peer.collect(f"{robot}/scene_graph/updates") for robot in robots}
        shared, statuses = peer.collect("/scene_graph/updates"), peer.statuses()
        peer.spin_for(0.5)
        for robot, at in benches.items():
            topic = f"{robot}/{LOCAL}".replace("/", "__")
            for _ in range(12):
                message = local_graph(at.next_stamp())
                message.objects[0].mean_m = [robots[robot], 0.0, 1.0]
                at.send(**{topic: message})
        names = {f"graph_node: {robot}/graph_node" for robot in robots}
        peer.spin_until(
            lambda: all(updates.values()) and {status.name for status in statuses} == names,
            20.0,
            "both graphs",
        )
        sessions = set()
        for robot, x_m in robots.items():
            decoded = [wire.decode(text, wire.SceneGraphUpdateMessage) for text in updates[robot]]
            assert {node.mean_m[0] for update in decoded for node in update.nodes} == {x_m}
            sessions |= {update.session for update in decoded}
        assert len(sessions) == 2 and shared == []
        services = dict(peer.node.get_service_names_and_types())
        assert {f"{robot}/graph_node/save" for robot in robots} <= services.keys()
        for robot in robots:
            published = dict(peer.node.get_publisher_names_and_types_by_node("graph_node", robot))
            assert f"{robot}/scene_graph/markers" in published
            at_root = {name for name in published if not name.startswith(f"{robot}/")}
            assert at_root <= {"/diagnostics", "/parameter_events", "/rosout", "/tf", "/tf_static"}
