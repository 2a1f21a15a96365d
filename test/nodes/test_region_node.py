"""region_node as a process: a client of its topics has the part, also when the centre moves."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from std_msgs.msg import String
from support.nodes import NodeProcess, peer
from support.reference_updates import diff

from deworldsg_ros.client import SceneGraph, SceneGraphClient
from deworldsg_ros.nodes.region_node import RegionNode, region_of
from deworldsg_ros.ros.options import RegionOptions
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire

SAVED = Path(__file__).parents[1] / "client" / "saved" / "scene_graph_v1.json"
LIMIT_S = 60.0


def ids_near(room: SceneGraph, center: tuple[float, float, float], radius_m: float) -> set[int]:
    """The objects of the room in a region, by hand."""

    def distance(item: wire.NodeState) -> float:
        return sum((a - b) ** 2 for a, b in zip(item.mean_m, center)) ** 0.5

    return {item.id for item in room.message.nodes if distance(item) <= radius_m}


def test_a_client_gets_the_part_and_follows_a_pose(tmp_path: Path) -> None:
    room = SceneGraph.load(SAVED)
    near, far = room[1].mean_m, max((i.mean_m for i in room), key=lambda m: abs(m[0]))
    message = msgspec.structs.replace(room.message, session="run", sequence=1)
    words = ["--ros-args", "-p", "radius_m:=1.0"]
    node = NodeProcess("region_node", tmp_path, *words)
    try:
        with peer() as test, SceneGraphClient("/region", test.context) as client:
            whole = test.node.create_publisher(String, "/scene_graph", reliable(1, latched=True))
            updates = test.node.create_publisher(String, "/scene_graph/updates", reliable(50))
            centers = test.node.create_publisher(PoseStamped, "/region/center", reliable(1))
            whole.publish(String(data=wire.encode(message)))

            def part() -> set[int]:
                graph = client.newest
                return set() if graph is None else {item.id for item in graph}

            for center in (near, far, near):
                wanted = ids_near(room, center, 1.0)

                def is_there(center=center, wanted=wanted) -> bool:
                    pose = PoseStamped()
                    pose.header.frame_id = room.frame_id
                    where = pose.pose.position
                    where.x, where.y, where.z = center
                    centers.publish(pose)
                    return part() == wanted

                assert 0 < len(wanted) < len(room)
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
            assert part() == ids_near(room, near, 1.0) - {1}
        assert node.interrupt() == 0
    finally:
        node.end()


def test_the_region_changes_while_the_node_runs() -> None:
    room = SceneGraph.load(SAVED)
    center = ",".join(map(str, room[1].mean_m))
    context = rclpy.Context()
    rclpy.init(context=context)
    start = [Parameter("center", value=center), Parameter("radius_m", value=1.0)]
    node = RegionNode(context=context, parameter_overrides=start)
    try:
        node._add(room.message)
        few = node._part.size
        assert few == len(ids_near(room, room[1].mean_m, 1.0)) < len(room)
        changes = [
            ("radius_m", 1000.0, len(room)),
            ("classes", "cup", len(room.objects("cup"))),
            ("center", "1,2", len(room.objects("cup"))),  # counted, and changes nothing
            ("center", "300,300,0", len(room.objects("cup"))),
            ("radius_m", 1.0, 0),
        ]
        for name, value, size in changes:
            (result,) = node.set_parameters([Parameter(name, value=value)])
            assert result.successful and node._part.size == size
        (result,) = node.set_parameters([Parameter("radius_m", value=-1.0)])
        assert not result.successful
        assert node.health.drops["invalid_region"] == 1
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def test_a_message_that_fails_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    node = RegionNode(context=context)
    try:
        monkeypatch.setattr(node._part, "add", lambda message: 1 / 0)
        for listener in node._client._replica.listeners:
            listener(SceneGraph.load(SAVED).message)
        assert node.health.drops == {"internal_error": 1}
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


@pytest.mark.parametrize("center", ["1,2", "a,b,c", "1,2,inf", "1,2,3,4", ","])
def test_no_centre(center: str) -> None:
    with pytest.raises(ConfigurationError, match=r"parameter center is .*: expected X,Y,Z"):
        region_of(RegionOptions(center=center))


def test_the_region_of_the_parameters() -> None:
    region = region_of(RegionOptions(center=" 1, -2,3.5", classes="cup, dining table,"))
    assert region.center == (1.0, -2.0, 3.5) and region.classes == ("cup", "dining table")
    assert region_of(RegionOptions()).center is None
