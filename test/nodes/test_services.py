"""The services of graph_node, called by the live client, the command line, and as ROS does."""

import json
import shlex
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import typer.testing
import yaml
from diagnostic_msgs.srv import AddDiagnostics
from geometry_msgs.msg import PoseStamped
from msgspec.structs import replace
from nav_msgs.msg import OccupancyGrid
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.nodes_bench import LIMIT_S, Bench
from support.reference_updates import diff
from support.spaces import BOARD, ON_BOARD, seen_room, walk_round
from support.surfaces import CUP, HERE, TABLE, slab, view

from deworldsg_ros.cli.app import app
from deworldsg_ros.client import ClientError, SceneGraphClient
from deworldsg_ros.client import Robot as RobotSize
from deworldsg_ros.client.mcp_server import EditTools, GraphTools
from deworldsg_ros.client.questions import ask
from deworldsg_ros.graph.floor_plan import Things
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import first_id, read_map
from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.ros import graph_keeper, graph_output, graph_services
from deworldsg_ros.ros.graph_services import BUSY
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import local_graph_to_message
from deworldsg_ros.wire.follow import empty_scene_graph

FLOOR = slab((0, 0, 0.95), (1.2, 0.8, 0.01))
OBJECTS = ((HERE, CUP), (FLOOR, TABLE))


class Robot(Bench):
    """A graph_node in this process; `ask` calls it from another thread."""

    def __init__(self, folder, **more):
        files = {"map_path": str(folder / "a.map"), "save_path": str(folder / "a.json")}
        values = {"output.min_existence": 0.0, "inputs.world_up": "z", **files, **more}
        super().__init__(GraphNode, {"deworldsg/local_graph": String}, parameters=values)
        self._threads = self.enter_context(ThreadPoolExecutor(1))
        self._seen = 0

    def see(self, frames=1):
        for _ in range(frames):
            self._seen += 1
            message = local_graph_to_message(view(self._seen, *OBJECTS))
            self.send(deworldsg__local_graph=message)
        self.expect(lambda: self.node.graph.newest_ns == self._seen * 10**8, "the frames")

    def ask(self, call, *arguments, **options):
        """Call something that waits for the node, while the node runs."""
        future = self._threads.submit(call, *arguments, **options)
        self.expect(future.done, "the answer")
        return future.result()

    def call(self, kind, topic, request):
        client = self.peer.node.create_client(kind, topic)
        self.expect(client.service_is_ready, "the service")
        future = client.call_async(request)
        self.expect(future.done, "the answer")
        return future.result()

    def command(self, *words):
        done = self.ask(typer.testing.CliRunner().invoke, app, list(words))
        assert done.exit_code == 0, done.output
        return done.output

    def refusals(self):
        return self.node.health.drops.get("invalid_request", 0)


@pytest.fixture
def robot(tmp_path):
    with Robot(tmp_path) as robot:
        robot.see(5)
        yield robot


@pytest.fixture
def client(robot):
    with SceneGraphClient() as client:
        robot.ask(client.wait, 1, LIMIT_S)
        yield client


def labels(client):
    return {item.id: item.label for item in client.graph}


def test_edits_of_the_client_reach_everybody_and_the_files(robot, client, tmp_path):
    with SceneGraphClient() as other:
        answer = robot.ask(client.set_label, 1, "chair")
        assert answer == {"kind": "set_label", "nodes": [1], "text": "object 1 is a 'chair'"}
        robot.expect(lambda: other.graph[1].label == "chair", "the label")
        assert other.graph[1].is_labelled_by_hand
        merged = robot.ask(client.merge, 1, 2)["nodes"][0]
        robot.expect(lambda: labels(other) == {merged: "chair"}, "the merge")
        robot.see(5)
        assert labels(other) == {merged: "chair"}
        assert robot.ask(client.save).startswith(str(tmp_path / "a.json"))
        assert [node.id for node in read_graph(tmp_path / "a.json").nodes] == [merged]
        saved = read_map(Parameters(), tmp_path / "a.map")
        assert [edit.kind for edit in saved.graph.edits.edits] == ["set_label", "merge"]
        assert robot.ask(client.undo)["nodes"] == [1, 2]
        robot.expect(lambda: labels(other) == {1: "chair", 2: "table"}, "the undo")
        one, two = robot.ask(client.split, 2)["nodes"]
        robot.expect(lambda: labels(other).keys() == {1, one, two}, "the split")
        robot.ask(client.delete, 1)
        robot.expect(lambda: labels(other).keys() == {one, two}, "the deletion")
        assert robot.refusals() == 0


def test_the_command_line_and_an_agent_with_leave_edit_a_running_graph(robot, client):
    output = robot.command("edit", "--live", "set_label", "1", "tea", "cup")
    assert "object 1 is a 'tea cup'; the detector does not know this class" in output
    assert json.loads(robot.command("edit", "--live", "--json", "undo"))["nodes"] == [1]
    tools = EditTools(client)
    assert robot.ask(tools.delete, 1)["text"] == "object 1 is deleted"
    assert robot.ask(tools.undo)["nodes"] == [1]


def saved_copy(robot, client, folder):
    robot.ask(client.save)
    return str(shutil.copy(folder / "a.map", folder / "copy.map"))


def test_load_and_clear_begin_a_new_session(robot, client, tmp_path):
    copy = saved_copy(robot, client, tmp_path)
    assert robot.ask(client.clear) == "2 nodes are cleared"
    robot.expect(lambda: len(client.graph) == 0, "the empty graph")
    robot.see(3)
    robot.expect(lambda: len(client.graph) == 2, "a new graph")
    robot.ask(client.clear)
    assert "2 nodes in frame 'world'" in robot.ask(client.load, copy)
    robot.expect(lambda: labels(client) == {1: "cup", 2: "table"}, "the map")
    with pytest.raises(ClientError, match="a.json.* cannot be used"):
        robot.ask(client.load, str(tmp_path / "a.json"))
    assert labels(client) == {1: "cup", 2: "table"}
    assert robot.refusals() == 1


def test_the_graph_before_stays_until_a_loaded_map_is_prepared(
    robot, client, tmp_path, monkeypatch
):
    graphs = robot.peer.collect("scene_graph")
    copy = saved_copy(robot, client, tmp_path)
    robot.see(3)  # so that a whole graph is to be published when the map is loaded
    update, ready_s = GraphBuilder.update, time.monotonic() + 2.0
    monkeypatch.setattr(
        GraphBuilder, "update", lambda it: update(it) if time.monotonic() > ready_s else None
    )
    robot.ask(client.load, copy)
    robot.expect(lambda: time.monotonic() > ready_s, "the end of the preparation")
    before = len(graphs)
    robot.see()
    robot.expect(lambda: len(graphs) > before, "the map")
    assert all(json.loads(text)["nodes"] for text in graphs)


class WallAlongX(SeenSpace):
    """All is free, and a wall is where y > 0."""

    def __len__(self):
        return 1

    def look(self, points_world):
        return points_world[:, 1] <= 0, points_world[:, 1] > 0


def test_questions_are_answered_and_a_goal_is_published_on_request_only(robot, client):
    """A live goal is before the walls."""
    found = robot.ask(client.command, "query", question="cup")
    assert found["answers"][0]["object"]["id"] == 1
    reason = robot.ask(client.command, "explain", object="cup")
    assert reason["lines"][0] == "detected in 5 frames over 0.4 s"
    place = robot.ask(client.explain, "cup near (50, 50)")
    assert place["known"] == "never in view" and place["hidden"] == []
    live = robot.command("explain", "--live", "cup near (50, 50)")
    assert live.startswith("cup near (50.00, 50.00), within 1 m: never in view")
    goals = robot.peer.listen(PoseStamped, "deworldsg/goal", 1)
    robot.node.graph.builder.space = WallAlongX()
    assert client.graph.goal_near("cup", 0.8).seen_free is None
    goal = robot.ask(client.goal_near, "cup", 0.8)
    assert goal["seen_free"] == 1.0 and goal["pose"]["position"]["y"] < 0
    assert goal["header"]["frame_id"] == "world" and goal["target"]["label"] == "cup"
    agent = GraphTools(lambda: client.graph, client)
    assert robot.ask(agent.go_to_goal, "cup", 0.8) == goal
    words = ("goal", "--live", "cup", "--distance", "0.8")
    assert "seen as free: 100%" in robot.command(*words)
    assert json.loads(robot.command(*words, "--json")) == goal
    published = robot.ask(client.command, "goal_near", object=1, distance_m=0.8)
    robot.expect(lambda: bool(goals), "the pose that was to be published")
    (message,) = goals
    x_m = published["pose"]["position"]["x"]
    assert message.pose.position.x == pytest.approx(x_m, abs=1e-3)


def test_where_to_look_next_is_answered_and_published_on_request_only(robot, client):
    goals = robot.peer.listen(PoseStamped, "deworldsg/goal", 1)
    robot.node.graph.builder.space = seen_room()
    small = RobotSize(radius_m=0.2, height_m=1.0)
    found = robot.ask(client.next_view, small, (-0.5, 0.0, 1.2))
    assert found["reason"] and found["path_m"] >= 0.0 and found["header"]["frame_id"] == "world"
    agent = GraphTools(lambda: client.graph, client)
    assert robot.ask(agent.next_view, 0.2, 1.0)["pose"]
    request = {"radius_m": 0.2, "height_m": 1.0, "start": [-0.5, 0.0, 1.2]}
    published = robot.ask(client.command, "next_view", **request)
    assert published == found
    robot.expect(lambda: bool(goals), "the pose that was to be published")
    (message,) = goals
    assert message.pose.position.x == pytest.approx(found["pose"]["position"]["x"], abs=1e-3)
    refused = robot.call(
        AddDiagnostics,
        "/graph_node/next_view",
        AddDiagnostics.Request(load_namespace='{"start": [99, 0, 0]}'),
    )
    assert not refused.success and "beside what is known" in refused.message


@pytest.mark.parametrize(
    ("service", "request_", "says"),
    [
        ("set_label", "", "expected JSON with node, label"),
        ("set_label", '{"node": 99, "label": "cup"}', "object 99 is not in the graph"),
        ("set_label", '{"node": 1, "label": "a\\nb"}', "regex"),
        ("merge", '{"nodes": [1, 2], "force": true}', "unknown field `force`"),
        ("split", '{"node": 1, "near_m": [[0, 0, 0]]}', "length >= 2"),
        ("query", '{"question": "cup near ("}', "cup near ("),
        ("goal_near", '{"object": "sofa"}', "no object of class 'sofa'"),
        ("goal_near", '{"object": 1, "distance_m": -1}', "expected a positive number"),
        ("load", '{"path": "/nowhere"}', "/nowhere"),
        ("query", '"' + "x" * 20000 + '"', "expected at most 10000"),
    ],
)
def test_a_bad_request_is_refused_counted_and_changes_nothing(robot, service, request_, says):
    def graph():
        assert robot.node.graph.wait_idle(LIMIT_S)
        full = robot.node.graph.builder.full()
        return full.nodes, full.edges, full.hidden

    before = graph()
    request = AddDiagnostics.Request(load_namespace=request_)
    answer = robot.call(AddDiagnostics, f"/graph_node/{service}", request)
    assert not answer.success
    assert says in answer.message
    assert robot.refusals() == 1
    assert graph() == before


def test_frames_do_not_wait_for_questions_and_further_ones_are_told_that_it_is_busy(
    robot, monkeypatch
):
    asked, go_on = threading.Event(), threading.Event()

    def slow(graph, question):
        asked.set()
        assert go_on.wait(LIMIT_S)
        return ask(graph, question)

    monkeypatch.setattr(graph_services, "ask", slow)
    client = robot.peer.node.create_client(AddDiagnostics, "/graph_node/query")
    robot.expect(client.service_is_ready, "the service")
    request = AddDiagnostics.Request(load_namespace='{"question": "cup"}')
    calls = [client.call_async(request) for _ in range(40)]
    robot.expect(asked.is_set, "the first question")
    robot.see(2)  # the graph takes frames
    waiting = graph_services.MOST_WAITING
    robot.expect(lambda: sum(call.done() for call in calls) == 40 - waiting, "the refusals")
    assert all(call.result().message == BUSY for call in calls if call.done())
    assert robot.node.health.drops["busy"] == 40 - waiting
    go_on.set()
    robot.expect(lambda: all(call.done() for call in calls), "the answers")
    assert sum(call.result().success for call in calls) == waiting
    assert robot.call(AddDiagnostics, "/graph_node/query", request).success


def test_ids_of_a_session_that_is_over_are_refused(robot, client):
    old = client.session
    robot.ask(client.clear)
    robot.see(3)
    robot.expect(lambda: client.session != old and len(client.graph) == 2, "the new graph")
    # No id is given again, and the client's own ones are those of the new session.
    assert min(labels(client)) > 2
    assert robot.ask(client.delete, max(labels(client)))["kind"] == "delete"
    for service in ("delete", "explain"):
        name = {"delete": "node", "explain": "object"}[service]
        request = AddDiagnostics.Request(load_namespace=json.dumps({name: 3, "session": old}))
        answer = robot.call(AddDiagnostics, f"/graph_node/{service}", request)
        assert not answer.success and "read the graph again" in answer.message


def test_after_a_kill_no_id_is_given_again(tmp_path):
    killed, restarted = tmp_path / "a", tmp_path / "b"
    killed.mkdir()
    with Robot(killed) as robot:
        robot.see(5)
        robot.expect(lambda: (killed / "a.map.ids").exists(), "the reservation")
        # What a kill would leave: there is no map yet.
        shutil.copytree(killed, restarted, ignore=shutil.ignore_patterns("*.lock*", ".*"))
        assert not (restarted / "a.map").exists()
        published = set(robot.node.graph.builder.graph.nodes.slot_of)
    with Robot(restarted) as robot:
        robot.see(5)
        again = set(robot.node.graph.builder.graph.nodes.slot_of)
    assert published == {1, 2} and len(again) == 2 and min(again) > 100
    # The end of a node gives back what was reserved and not used.
    assert first_id(killed / "a.map") == 3 and first_id(restarted / "a.map") == max(again) + 1


@pytest.mark.parametrize("content", ["", "x", "-1", "9" * 30, "\0" * 10**6])
def test_a_damaged_reservation_is_no_reason_not_to_start(tmp_path, content):
    (tmp_path / "a.map.ids").write_text(content)
    with Robot(tmp_path) as robot:
        robot.see(3)
        assert set(robot.node.graph.builder.graph.nodes.slot_of) == {1, 2}


def test_a_failed_checkpoint_is_tried_again_without_a_change(tmp_path, monkeypatch):
    written = threading.Event()

    def full_disk(state, path):
        raise ConfigurationError(f"map {path} cannot be written: No space left on device")

    monkeypatch.setattr(graph_keeper, "RETRY_S", 0.3)
    monkeypatch.setattr(graph_keeper, "write_state", full_disk)
    with Robot(tmp_path, **{"map_period_s": 0.1}) as robot:
        robot.see(5)
        robot.expect(robot.node.graph.problems, "the failure")
        assert "No space left on device; tried again every" in robot.node.graph.problems()[0]
        assert robot.node.waiting_for(time.monotonic_ns()) == robot.node.graph.problems()
        monkeypatch.setattr(graph_keeper, "write_state", lambda state, path: written.set())
        robot.expect(written.is_set, "the checkpoint")
        robot.expect(lambda: not robot.node.graph.problems(), "the end of the problem")


def test_another_node_on_the_topic_is_noticed(robot):
    topic = "scene_graph/updates"
    publisher = robot.peer.node.create_publisher(String, topic, reliable(10))

    def notices():
        publisher.publish(String(data='{"schema": "x", "session": "another", "nodes": []}'))
        return robot.node.graph.problems()

    robot.expect(notices, "the other node")
    assert robot.node.graph.problems() == [
        f"another node publishes a graph on /{topic}: end one of the two, or give it a namespace"
    ]
    assert robot.node.health.drops["other_session"]


def test_clients_that_followed_another_node_come_back(robot, client):
    robot.see(5)
    robot.expect(lambda: client.has_graph and len(client.graph), "the graph")
    before, session = len(client.graph), client.session
    topic = "scene_graph/updates"
    publisher = robot.peer.node.create_publisher(String, topic, reliable(10))
    robot.expect(lambda: publisher.get_subscription_count() >= 2, "the node and the client")
    empty = empty_scene_graph("world")
    update = replace(diff(empty, replace(empty, sequence=1)), session="another")
    publisher.publish(String(data=wire.encode(update)))
    robot.expect(lambda: client.session == "another", "the other session")
    # No frame comes: graph_node tells its graph by itself.
    robot.expect(lambda: client.session == session and len(client.graph) == before, "the graph")


def test_the_calls_in_the_documentation_work(robot, root_dir):
    page = (root_dir / "docs" / "on_a_robot.md").read_text(encoding="utf-8")
    calls = [shlex.split(line) for line in page.splitlines() if "service call" in line[:20]]
    assert len({call[3] for call in calls}) == 12
    kinds = {"std_srvs/srv/Trigger": Trigger, "diagnostic_msgs/srv/AddDiagnostics": AddDiagnostics}
    for _, _, _, topic, name, *values in calls:
        request = kinds[name].Request(**(yaml.safe_load(values[0]) if values else {}))
        answer = robot.call(kinds[name], topic, request)
        # The objects of the page are not those of this graph, but it reads the request.
        others = (
            "not in the graph",
            "nothing to undo",
            "room.map",
            "nothing is known of the space",
        )
        assert answer.success or any(words in answer.message for words in others), answer.message


def test_without_a_graph_or_a_node_the_client_says_so(tmp_path):
    refused = pytest.raises(ClientError, match="no graph yet")
    with Robot(tmp_path) as robot, SceneGraphClient() as client, refused:
        robot.ask(client.undo)
    with SceneGraphClient("/nobody") as client, pytest.raises(ClientError, match="is graph_node"):
        client.undo()


def test_the_room_is_published_while_somebody_listens(robot):
    clouds, plans = [], []
    node = robot.peer.node
    latched = reliable(1, latched=True)
    robot.see()
    node.create_subscription(PointCloud2, "scene_graph/points", clouds.append, latched)
    robot.expect(lambda: clouds, "the points")
    assert not plans
    (cloud,) = clouds
    assert (cloud.header.frame_id, cloud.point_step) == ("world", 20)
    assert cloud.width > 100
    node.create_subscription(OccupancyGrid, "scene_graph/map", plans.append, latched)
    robot.expect(lambda: plans, "the floor plan")
    assert plans[0].info.width * plans[0].info.height == len(plans[0].data)
    # A new subscriber gets what is there.
    later = []
    node.create_subscription(PointCloud2, "scene_graph/points", later.append, latched)
    robot.expect(lambda: later, "the points")
    # Another height of the robot makes another plan.
    count = len(plans)
    changed = robot.node.set_parameters([Parameter("output.robot_height_m", value=0.3)])
    assert changed[0].successful
    robot.expect(lambda: len(plans) > count, "the plan of a low robot")


def things_of_table() -> Things:
    things = Things()
    for frame in walk_round(BOARD, ON_BOARD, steps=36):
        things.note(frame, 1)
    return things


def test_rooms_are_found_in_the_background_named_and_saved(robot, client, tmp_path, monkeypatch):
    monkeypatch.setattr(graph_output, "ROOMS_PERIOD_S", 0.2)
    builder = robot.node.graph.builder
    robot.node.graph.submit(lambda: setattr(builder, "space", seen_room()))
    robot.node.graph.submit(lambda: setattr(builder, "things", things_of_table()))
    robot.see()
    robot.expect(lambda: client.graph.rooms, "the room")
    robot.expect(lambda: "object" in {item.label for item in client.graph}, "what stands there")
    (room,) = client.graph.rooms
    assert 8.0 < room.area_m2 < 12.5
    answer = robot.ask(client.name_room, room.id, "study")
    assert answer["text"] == f"room {room.id} is called study"
    robot.expect(lambda: client.graph.rooms[0].label == "study", "the name")
    robot.see()
    robot.ask(client.save)
    assert read_graph(tmp_path / "a.json").rooms[0].label == "study"
    assert read_map(Parameters(), tmp_path / "a.map").rooms.names == {room.id: "study"}
    with pytest.raises(ClientError, match="room 9 is unknown"):
        robot.ask(client.name_room, 9, "attic")
