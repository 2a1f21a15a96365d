"""region_node: a client of its topics has the part, also when the centre or the region changes."""

import msgspec
import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from std_msgs.msg import String
from support.nodes import NodeProcess, peer
from support.nodes_bench import alone
from support.reference_updates import diff
from support.view import SAVED

from deworldsg_ros.client import SceneGraph, SceneGraphClient
from deworldsg_ros.nodes.region_node import RegionNode, region_of
from deworldsg_ros.ros.options import RegionOptions
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire

ROOM = SceneGraph.load(SAVED)
LIMIT_S = 60.0


def ids_near(center: list[float], radius_m: float = 1.0) -> set[int]:
    """The objects of the room in a region, by hand."""

    def distance(item: wire.NodeState) -> float:
        return sum((a - b) ** 2 for a, b in zip(item.mean_m, center)) ** 0.5

    return {item.id for item in ROOM.message.nodes if distance(item) <= radius_m}


def test_a_client_gets_the_part_and_follows_a_pose(tmp_path):
    near, far = ROOM[1].mean_m, max((item.mean_m for item in ROOM), key=lambda m: abs(m[0]))
    message = msgspec.structs.replace(ROOM.message, session="run", sequence=1)
    with (
        NodeProcess("region_node", tmp_path, parameters={"radius_m": 1.0}) as node,
        peer() as test,
        SceneGraphClient("/region", test.context) as client,
    ):
        whole = test.node.create_publisher(String, "/scene_graph", reliable(1, latched=True))
        updates = test.node.create_publisher(String, "/scene_graph/updates", reliable(50))
        centers = test.node.create_publisher(PoseStamped, "/region/center", reliable(1))
        whole.publish(String(data=wire.encode(message)))

        def part() -> set[int]:
            return {item.id for item in client.newest or ()}

        for center in (near, far, near):
            wanted = ids_near(center)
            pose = PoseStamped()
            pose.header.frame_id = ROOM.frame_id
            pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = center

            def is_there(pose=pose, wanted=wanted) -> bool:
                centers.publish(pose)
                return part() == wanted

            assert 0 < len(wanted) < len(ROOM)
            test.spin_until(is_there, LIMIT_S, "the part around the centre")
        gone = msgspec.structs.replace(
            message,
            sequence=2,
            nodes=[item for item in message.nodes if item.id != 1],
            edges=[item for item in message.edges if 1 not in (item.subject, item.object)],
        )
        update = msgspec.structs.replace(diff(message, gone), session="run")
        updates.publish(String(data=wire.encode(update)))
        test.spin_until(lambda: 1 not in part(), LIMIT_S, "the object to go")
        assert part() == ids_near(near) - {1}
        assert node.interrupt() == 0


def test_the_region_changes_while_the_node_runs():
    center = ",".join(map(str, ROOM[1].mean_m))
    with alone(RegionNode, {"center": center, "radius_m": 1.0}) as node:
        node._add(ROOM.message)
        assert node._part.size == len(ids_near(ROOM[1].mean_m)) < len(ROOM)
        cups = len(ROOM.objects("cup"))
        for name, value, size in (
            ("radius_m", 1000.0, len(ROOM)),
            ("classes", "cup", cups),
            ("center", "1,2", cups),  # counted, and changes nothing
            ("center", "300,300,0", cups),
            ("radius_m", 1.0, 0),
        ):
            (result,) = node.set_parameters([Parameter(name, value=value)])
            assert result.successful and node._part.size == size
        (result,) = node.set_parameters([Parameter("radius_m", value=-1.0)])
        assert not result.successful
        assert node.health.drops == {"invalid_region": 1}


def test_a_message_that_fails_is_counted(monkeypatch):
    with alone(RegionNode) as node:
        monkeypatch.setattr(node._part, "add", lambda message: 1 / 0)
        for listener in node._client._replica.listeners:
            listener(ROOM.message)
        assert node.health.drops == {"internal_error": 1}


def test_the_region_of_the_parameters():
    region = region_of(RegionOptions(center=" 1, -2,3.5", classes="cup, dining table,"))
    assert region.center == (1.0, -2.0, 3.5) and region.classes == ("cup", "dining table")
    assert region_of(RegionOptions()).center is None
    for center in ("1,2", "a,b,c", "1,2,inf", "1,2,3,4", ","):
        with pytest.raises(ConfigurationError, match="parameter center is .*: expected X,Y,Z"):
            region_of(RegionOptions(center=center))
