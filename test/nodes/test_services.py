"""The services of graph_node, called by the live client, the command line, and as ROS does."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import typer.testing
import yaml
from diagnostic_msgs.srv import AddDiagnostics
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.nodes_bench import LIMIT_S, Bench
from support.surfaces import CUP, HERE, TABLE, slab, view

from deworldsg_ros.cli.app import app
from deworldsg_ros.client import ClientError, SceneGraphClient
from deworldsg_ros.client.mcp_server import EditTools, GraphTools
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map
from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.wire.codec import local_graph_to_message

LOCAL = "deworldsg/local_graph"
SERVICES = {
    "save", "load", "clear", "query", "goal_near", "explain", "set_label", "merge", "split",
    "delete", "undo",
}  # fmt: skip
FLOOR = slab((0, 0, 0.95), (1.2, 0.8, 0.01))
OBJECTS = ((HERE, CUP), (FLOOR, TABLE))
VALUES = {"output.min_existence": 0.0, "inputs.world_up": "z"}


class Robot:
    """A graph_node in this process; `ask` calls it from another thread."""

    def __init__(self, folder: Path) -> None:
        values = {**VALUES, "map_path": str(folder / "a.map"), "save_path": str(folder / "a.json")}
        overrides = [rclpy.parameter.Parameter(name, value=value) for name, value in values.items()]
        self.bench = Bench(GraphNode, {LOCAL: String}, parameter_overrides=overrides)
        self._threads = ThreadPoolExecutor(1)
        self._stamp = 0

    def see(self, frames: int = 1) -> None:
        for _ in range(frames):
            self._stamp += 1
            message = local_graph_to_message(view(self._stamp, *OBJECTS))
            self.bench.send(deworldsg__local_graph=message)
        self.bench.expect(lambda: self.newest_ns() == self._stamp * 10**8, "the frames")

    def newest_ns(self) -> int:
        return self.bench.node.graph.newest_ns

    def ask(self, call: Callable[[], Any]) -> Any:
        """Call something that waits for the node, while the node runs."""
        future = self._threads.submit(call)
        self.bench.expect(future.done, "the answer")
        return future.result()

    def refusals(self) -> int:
        return self.bench.node.health.drops.get("invalid_request", 0)

    def close(self) -> None:
        self._threads.shutdown()
        self.bench.close()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    robot = Robot(tmp_path)
    robot.see(5)
    yield robot
    robot.close()


def labels(client: SceneGraphClient) -> dict[int, str]:
    return {item.id: item.label for item in client.graph}


def test_edits_of_the_client_reach_everybody_and_the_files(robot: Robot, tmp_path: Path) -> None:
    with SceneGraphClient() as client, SceneGraphClient() as other:
        robot.ask(lambda: client.wait(1, LIMIT_S))
        answer = robot.ask(lambda: client.set_label(1, "chair"))
        assert answer == {"kind": "set_label", "nodes": [1], "text": "object 1 is a 'chair'"}
        expect = robot.bench.expect
        expect(lambda: other.graph[1].label == "chair", "the label")
        assert other.graph[1].is_labelled_by_hand
        merged = robot.ask(lambda: client.merge(1, 2))["nodes"][0]
        expect(lambda: labels(other) == {merged: "chair"}, "the merge")
        robot.see(5)
        assert labels(other) == {merged: "chair"}
        assert robot.ask(client.save).startswith(str(tmp_path / "a.json"))
        assert [node.id for node in read_graph(tmp_path / "a.json").nodes] == [merged]
        saved = read_map(Parameters(), tmp_path / "a.map")
        assert [edit.kind for edit in saved.graph.edits.edits] == ["set_label", "merge"]
        assert robot.ask(client.undo)["nodes"] == [1, 2]
        expect(lambda: labels(other) == {1: "chair", 2: "table"}, "the undo")
        one, two = robot.ask(lambda: client.split(2))["nodes"]
        expect(lambda: labels(other).keys() == {1, one, two}, "the split")
        robot.ask(lambda: client.delete(1))
        expect(lambda: labels(other).keys() == {one, two}, "the deletion")
        assert robot.refusals() == 0


def test_load_and_clear_begin_a_new_session(robot: Robot, tmp_path: Path) -> None:
    with SceneGraphClient() as client:
        robot.ask(lambda: client.wait(1, LIMIT_S))
        robot.ask(client.save)
        copy = tmp_path / "copy.map"
        copy.write_bytes((tmp_path / "a.map").read_bytes())
        assert robot.ask(client.clear) == "2 nodes are cleared"
        robot.bench.expect(lambda: len(client.graph) == 0, "the empty graph")
        robot.see(3)
        robot.bench.expect(lambda: len(client.graph) == 2, "a new graph")
        robot.ask(client.clear)
        robot.bench.expect(lambda: len(client.graph) == 0, "the empty graph")
        assert "2 nodes in frame 'world'" in robot.ask(lambda: client.load(str(copy)))
        robot.bench.expect(lambda: labels(client) == {1: "cup", 2: "table"}, "the map")
        with pytest.raises(ClientError, match=r"cannot be used"):
            robot.ask(lambda: client.load(str(tmp_path / "a.json")))
        assert labels(client) == {1: "cup", 2: "table"}
        assert robot.refusals() == 1


def test_the_graph_before_stays_until_a_loaded_map_is_prepared(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graphs = robot.bench.peer.collect("scene_graph")
    with SceneGraphClient() as client:
        robot.ask(lambda: client.wait(1, LIMIT_S))
        robot.ask(client.save)
        copy = tmp_path / "copy.map"
        copy.write_bytes((tmp_path / "a.map").read_bytes())
        robot.see(3)  # so that a whole graph is to be published when the map is loaded
        update, ready_s = GraphBuilder.update, time.monotonic() + 2.0
        monkeypatch.setattr(
            GraphBuilder, "update", lambda it: update(it) if time.monotonic() > ready_s else None
        )
        robot.ask(lambda: client.load(str(copy)))
        robot.bench.expect(lambda: time.monotonic() > ready_s, "the end of the preparation")
        before = len(graphs)
        robot.see()
        robot.bench.expect(lambda: len(graphs) > before, "the map")
    assert all(json.loads(text)["nodes"] for text in graphs)


def test_questions_are_answered_and_the_goal_is_published(robot: Robot) -> None:
    goals: list[PoseStamped] = []
    robot.bench.peer.node.create_subscription(PoseStamped, "deworldsg/goal", goals.append, 1)
    with SceneGraphClient() as client:
        found = robot.ask(lambda: client.command("query", question="cup"))
        assert found["answers"][0]["object"]["id"] == 1
        goal = robot.ask(lambda: client.command("goal_near", object=1, distance_m=0.8))
        assert goal["header"]["frame_id"] == "world" and goal["target"]["label"] == "cup"
        robot.bench.expect(lambda: bool(goals), "the pose")
        assert goals[0].pose.position.x == pytest.approx(goal["pose"]["position"]["x"], abs=1e-3)
        reason = robot.ask(lambda: client.command("explain", object="cup"))
        assert reason["lines"][0] == "detected in 5 frames over 0.4 s"


class WallAlongX(SeenSpace):
    """All is free, and a wall is where y > 0."""

    def __len__(self) -> int:
        return 1

    def look(self, points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return points_world[:, 1] <= 0, points_world[:, 1] > 0


def test_a_live_goal_is_before_the_walls_and_drives_no_robot(robot: Robot) -> None:
    goals: list[PoseStamped] = []
    robot.bench.peer.node.create_subscription(PoseStamped, "deworldsg/goal", goals.append, 1)
    runner = typer.testing.CliRunner()
    robot.bench.node.graph.builder.space = WallAlongX()
    with SceneGraphClient() as client:
        robot.ask(lambda: client.wait(1, LIMIT_S))
        assert client.graph.goal_near("cup", 0.8).seen_free is None
        goal = robot.ask(lambda: client.goal_near("cup", 0.8))
        assert goal["seen_free"] == 1.0 and goal["pose"]["position"]["y"] < 0
        agent = GraphTools(lambda: client.graph, client)
        assert robot.ask(lambda: agent.goal_near("cup", 0.8)) == goal
        call = ["goal", "--live", "cup", "--distance", "0.8"]
        assert "seen as free: 100%" in robot.ask(lambda: runner.invoke(app, call)).output
        done = robot.ask(lambda: runner.invoke(app, [*call, "--json"]))
        assert json.loads(done.output) == goal
        robot.ask(lambda: client.command("goal_near", object="cup"))
        robot.bench.expect(lambda: bool(goals), "the pose that was to be published")
    assert len(goals) == 1


@pytest.mark.parametrize(
    ("service", "request_", "says"),
    [
        ("set_label", "", "expected JSON with node, label"),
        ("set_label", '{"node": 1}', "missing required field `label`"),
        ("set_label", '{"node": 99, "label": "cup"}', "object 99 is not in the graph"),
        ("set_label", '{"node": 1, "label": "a\\nb"}', "regex"),
        ("merge", '{"nodes": [1]}', "length >= 2"),
        ("merge", '{"nodes": [1, 2], "force": true}', "unknown field `force`"),
        ("split", '{"node": 1, "near_m": [[0, 0, 0]]}', "length >= 2"),
        ("delete", '{"node": -1}', ">= 1"),
        ("query", '{"question": "cup near ("}', "cup near ("),
        ("goal_near", '{"object": "sofa"}', "no object of class 'sofa'"),
        ("goal_near", '{"object": 1, "distance_m": -1}', "expected a positive number"),
        ("load", '{"path": "/nowhere"}', "/nowhere"),
        ("query", '"' + "x" * 20000 + '"', "expected at most 10000"),
    ],
)
def test_a_bad_request_is_refused_counted_and_changes_nothing(
    robot: Robot, service: str, request_: str, says: str
) -> None:
    """The requests are those of `ros2 service call`."""
    peer, builder = robot.bench.peer, robot.bench.node.graph.builder
    assert robot.bench.node.graph.wait_idle(LIMIT_S)
    before = builder.full()
    client = peer.node.create_client(AddDiagnostics, f"/graph_node/{service}")
    robot.bench.expect(client.service_is_ready, "the service")
    future = client.call_async(AddDiagnostics.Request(load_namespace=request_))
    robot.bench.expect(future.done, "the answer")
    assert not future.result().success
    assert says in future.result().message
    assert robot.refusals() == 1
    assert robot.bench.node.graph.wait_idle(LIMIT_S)
    after = builder.full()
    assert (after.nodes, after.edges, after.hidden) == (before.nodes, before.edges, before.hidden)


def test_the_calls_in_the_documentation_work(robot: Robot, root_dir: Path) -> None:
    page = (root_dir / "docs" / "dev" / "nodes.md").read_text(encoding="utf-8")
    calls = [shlex.split(line) for line in page.splitlines() if "service call" in line[:20]]
    assert {call[3].split("/")[-1] for call in calls} == SERVICES
    kinds = {"std_srvs/srv/Trigger": Trigger, "diagnostic_msgs/srv/AddDiagnostics": AddDiagnostics}
    for call in calls:
        kind = kinds[call[4]]
        request = kind.Request(**(yaml.safe_load(call[5]) if len(call) > 5 else {}))
        client = robot.bench.peer.node.create_client(kind, call[3])
        robot.bench.expect(client.service_is_ready, "the service")
        future = client.call_async(request)
        robot.bench.expect(future.done, "the answer")
        said = future.result().message
        # The objects of the page are not those of this graph, but it reads the request.
        others = ("not in the graph", "nothing to undo", "room.map")
        assert future.result().success or any(words in said for words in others), said


def test_before_the_first_frame_there_is_no_graph(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    try:
        with SceneGraphClient() as client, pytest.raises(ClientError, match="no graph yet"):
            robot.ask(client.undo)
    finally:
        robot.close()


def test_without_a_node_the_client_says_so() -> None:
    with SceneGraphClient("/nobody") as client, pytest.raises(ClientError, match="is graph_node"):
        client.undo()


def test_the_command_line_edits_a_running_graph(robot: Robot) -> None:
    runner = typer.testing.CliRunner()
    call = ["edit", "--live", "set_label", "1", "tea", "cup"]
    done = robot.ask(lambda: runner.invoke(app, call))
    assert done.exit_code == 0, done.output
    assert "object 1 is a 'tea cup'; the detector does not know this class" in done.output
    done = robot.ask(lambda: runner.invoke(app, ["edit", "--live", "--json", "undo"]))
    assert json.loads(done.output)["nodes"] == [1]


def test_an_agent_with_leave_to_edit_edits(robot: Robot) -> None:
    with SceneGraphClient() as client:
        tools = EditTools(client)
        assert robot.ask(lambda: tools.delete(1))["text"] == "object 1 is deleted"
        assert robot.ask(tools.undo)["nodes"] == [1]
