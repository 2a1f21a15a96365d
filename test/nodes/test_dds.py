"""Four node processes over DDS: the graph, its updates, its file, and the end of the nodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger
from support.nodes import Camera, NodeProcess, Peer, peer
from visualization_msgs.msg import MarkerArray

from deworldsg_ros.config import Config
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import open_recording, open_source
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.ros.health import LISTENERS
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")
FRAMES = 12
LIMIT_S = 60.0

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module")
def recording_path(root_dir: Path, request: pytest.FixtureRequest) -> Path:
    """The recording that ships, else the kitchen."""
    shipped = sorted((root_dir / "bags").glob("*/metadata.yaml"))
    if shipped:
        return shipped[0].parent
    return request.getfixturevalue("shared_dir") / "data" / "redkitchen"


# Listeners of the topics between the nodes; the test listens to the evidence, too.
BETWEEN = {
    "/deworldsg/frame_graph": 1,
    "/deworldsg/instances": 1,
    "/deworldsg/local_graph": 2,
    "/deworldsg/relation_evidence": 2,
}


@dataclass
class Run:
    """The output of four nodes for the first frames of a recording."""

    processes: dict[str, NodeProcess]
    peer: Peer
    graphs: list[str]
    updates: list[str]
    evidence: list[str]
    markers: list[MarkerArray] = field(default_factory=list)
    diagnostics: dict[str, Any] = field(default_factory=dict)

    def watch_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name.split(":")[0]] = status

    def are_nodes_connected(self) -> bool:
        """Whether all listeners of the topics between the nodes are connected."""
        told = {
            value.key: int(value.value)
            for status in self.diagnostics.values()
            for value in status.values
            if value.key.startswith(LISTENERS)
        }
        return all(told.get(f"{LISTENERS}{topic}", 0) >= n for topic, n in BETWEEN.items())

    def latest(self) -> wire.SceneGraphMessage:
        return wire.decode(self.graphs[-1], wire.SceneGraphMessage)

    def associations(self) -> list[wire.Association]:
        decoded = [wire.decode(text, wire.SceneGraphUpdateMessage) for text in self.updates]
        return [item for update in decoded for item in update.associations]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, recording_path: Path) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("nodes")
    arguments = ("--ros-args", "-p", "output.rate_hz:=20.0")
    arguments += ("-p", f"save_path:={folder / 'saved.json'}")
    source = open_source(recording_path)
    stamps = itertools.islice((m.stamp_ns for m in source.messages() if m.role is Role.RGB), FRAMES)
    last_ns = max(stamps)
    messages = list(
        itertools.takewhile(lambda item: item.stamp_ns <= last_ns, source.raw_messages())
    )
    processes = {name: NodeProcess(name, folder, *arguments) for name in NODES}
    try:
        for process in processes.values():
            process.wait_ready()
        with peer() as me:
            result = Run(
                processes,
                me,
                me.collect("/scene_graph", 1, latched=True),
                me.collect("/scene_graph/updates"),
                me.collect("deworldsg/relation_evidence"),
            )
            me.node.create_subscription(
                MarkerArray,
                "/scene_graph/markers",
                result.markers.append,
                reliable(1, latched=True),
            )
            me.node.create_subscription(
                DiagnosticArray, "/diagnostics", result.watch_diagnostics, 10
            )
            camera = Camera(me, messages)
            camera.wait_for_subscribers()
            me.spin_until(result.are_nodes_connected, LIMIT_S, "the nodes to connect")
            for count, _ in enumerate(camera.frames(), 1):
                # Nodes that fall behind drop frames: one at a time, and the next for its pose.
                me.spin_until(lambda n=count: len(result.evidence) >= n - 1, LIMIT_S, "evidence")
            me.spin_until(lambda: len(result.evidence) >= FRAMES, LIMIT_S, "all evidence")
            # A start with an empty cache compiles for seconds.
            me.spin_until(lambda: len(result.associations()) >= FRAMES, LIMIT_S, "all frames")
            # What waits to be measured and judged comes with further updates. The whole graph
            # follows once a second.
            known = 0
            while len(result.updates) > known:
                known = len(result.updates)
                me.spin_for(2.5)
            yield result
    finally:
        for process in processes.values():
            process.end()


def test_a_graph_is_published(run: Run) -> None:
    graph = run.latest()
    assert graph.nodes
    assert graph.frame_id
    assert {node.id for node in graph.nodes} >= {edge.subject for edge in graph.edges}
    assert [len(item.nodes) >= 0 for item in run.associations()] == [True] * FRAMES


def test_the_updates_rebuild_the_graph_exactly(run: Run) -> None:
    replica = GraphReplica()
    for text in run.updates:
        assert replica.apply(wire.decode(text, wire.SceneGraphUpdateMessage))
    assert replica.message() == run.latest()
    assert wire.encode(replica.message()) == run.graphs[-1]


def test_one_process_gives_the_same_graph(run: Run, recording_path: Path) -> None:
    pipeline = Pipeline(Config())
    for frame in itertools.islice(open_recording(recording_path).frames(), FRAMES):
        pipeline.process(frame)
    assert pipeline.builder is not None
    while pipeline.builder.update() or pipeline.builder.waiting:
        pass
    ours, theirs = pipeline.builder.snapshot(), run.latest()
    assert [(node.id, node.label, node.observations) for node in ours.nodes] == [
        (node.id, node.label, node.observations) for node in theirs.nodes
    ]
    np.testing.assert_allclose(
        [node.mean_m for node in ours.nodes], [node.mean_m for node in theirs.nodes], atol=1e-9
    )
    assert ours.edges == theirs.edges
    assert ours.nodes == theirs.nodes


def test_a_late_subscriber_gets_the_graph(run: Run) -> None:
    with peer("late_peer") as late:
        graphs = late.collect("/scene_graph", 1, latched=True)
        late.spin_until(lambda: bool(graphs), LIMIT_S, "the latched graph")
        assert graphs[-1] == run.graphs[-1]


def test_markers_are_published(run: Run) -> None:
    run.peer.spin_until(lambda: bool(run.markers), LIMIT_S, "markers")
    assert len(run.markers[-1].markers) > len(run.latest().nodes)
    assert {marker.header.frame_id for marker in run.markers[-1].markers} == {run.latest().frame_id}


def test_every_node_publishes_diagnostics(run: Run) -> None:
    run.peer.spin_until(lambda: set(run.diagnostics) >= set(NODES), LIMIT_S, "diagnostics")
    for name in NODES:
        values = {item.key: item.value for item in run.diagnostics[name].values}
        assert int(values["total"]) > 0
        unexpected = {key for key in values if key.startswith("dropped")}
        assert unexpected == set(), values


def test_the_graph_is_saved_on_request(run: Run) -> None:
    client = run.peer.node.create_client(Trigger, "/graph_node/save")
    run.peer.spin_until(client.service_is_ready, LIMIT_S, "the service")
    future = client.call_async(Trigger.Request())
    run.peer.spin_until(future.done, LIMIT_S, "the answer")
    assert future.result().success, future.result().message
    path = Path(future.result().message.split(":")[0])
    saved = wire.decode(path.read_bytes(), wire.SceneGraphMessage)
    assert [node.id for node in saved.nodes] == [node.id for node in run.latest().nodes]
    assert all(len(surface_points(node)) for node in saved.nodes)


def test_an_interrupt_ends_each_node_with_0(run: Run) -> None:
    for process in run.processes.values():
        assert process.interrupt() == 0, process.log
        assert "Traceback" not in process.log


@pytest.mark.parametrize(
    ("argument", "says"),
    [
        ("lifting.tau:=7.0", "parameter lifting.tau is 7.0, expected float >= 0 and <= 1"),
        ("lifting.tua:=0.1", "there is no parameter lifting.tua (did you mean lifting.tau?)"),
        ("inputs.world_up:=y", "put it in quotes"),
    ],
)
def test_a_bad_parameter_ends_the_start_with_2(tmp_path: Path, argument: str, says: str) -> None:
    process = NodeProcess("graph_node", tmp_path, "--ros-args", "-p", argument)
    try:
        assert process.wait(LIMIT_S) == 2
    finally:
        process.end()
    (line,) = [line for line in process.log.splitlines() if line.startswith("error: ")]
    assert says in line
    assert "Traceback" not in process.log


def test_a_missing_parameter_file_ends_the_start_with_2(tmp_path: Path) -> None:
    process = NodeProcess("graph_node", tmp_path, "--ros-args", "--params-file", "missing.yaml")
    try:
        assert process.wait(LIMIT_S) == 2
    finally:
        process.end()
    assert "missing.yaml" in process.log
    assert "Traceback" not in process.log


def test_parameters_come_from_a_file(tmp_path: Path, root_dir: Path) -> None:
    arguments = ("--ros-args", "--params-file", str(root_dir / "config" / "paper_rules.yaml"))
    process = NodeProcess("graph_node", tmp_path, *arguments, "-p", "use_sim_time:=true")
    try:
        process.wait_ready()
        with peer() as me:
            statuses: list[DiagnosticArray] = []
            me.node.create_subscription(DiagnosticArray, "/diagnostics", statuses.append, 10)
            # Diagnostics do not wait for a /clock that never comes.
            me.spin_until(lambda: len(statuses) >= 2, LIMIT_S, "diagnostics")
        assert process.interrupt() == 0, process.log
    finally:
        process.end()
