"""Four node processes over DDS: the graph, its updates, its file, and the end of the nodes."""

import itertools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace
from std_srvs.srv import Trigger
from support.cli import DEMO_ROOM
from support.nodes import Camera, NodeProcess, peer
from visualization_msgs.msg import MarkerArray

from deworldsg_ros.config import Config
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import open_recording, open_source
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.ros.health import LISTENERS
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")
# Listeners of the topics between the nodes; the test listens to the evidence, too.
BETWEEN = {
    "/deworldsg/frame_graph": 1,
    "/deworldsg/instances": 1,
    "/deworldsg/local_graph": 2,
    "/deworldsg/relation_evidence": 2,
}
FRAMES = 12
LIMIT_S = 60.0

pytestmark = pytest.mark.timeout(240)


def values_of(run):
    """The newest diagnostics, by node."""
    return {
        status.name.split(":")[0]: {item.key: item.value for item in status.values}
        for status in run.statuses
    }


def are_nodes_connected(run):
    told = {key: value for values in values_of(run).values() for key, value in values.items()}
    return all(int(told.get(f"{LISTENERS}{topic}", 0)) >= n for topic, n in BETWEEN.items())


def latest(run):
    return wire.decode(run.graphs[-1], wire.SceneGraphMessage)


def associations(run):
    decoded = [wire.decode(text, wire.SceneGraphUpdateMessage) for text in run.updates]
    return [item for update in decoded for item in update.associations]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nodes")
    source = open_source(DEMO_ROOM)
    stamps = itertools.islice((m.stamp_ns for m in source.messages() if m.role is Role.RGB), FRAMES)
    last_ns = max(stamps)
    messages = list(
        itertools.takewhile(lambda item: item.stamp_ns <= last_ns, source.raw_messages())
    )
    parameters = {"output.rate_hz": 20.0, "save_path": folder / "saved.json"}
    processes = {name: NodeProcess(name, folder, parameters=parameters) for name in NODES}
    try:
        for process in processes.values():
            process.wait_ready()
        with peer() as me:
            result = SimpleNamespace(
                processes=processes,
                peer=me,
                statuses=me.statuses(),
                graphs=me.collect("/scene_graph", 1, latched=True),
                updates=me.collect("/scene_graph/updates"),
                evidence=me.collect("deworldsg/relation_evidence"),
                markers=me.listen(MarkerArray, "/scene_graph/markers", 1, latched=True),
            )
            camera = Camera(me, messages)
            camera.wait_for_subscribers()
            me.spin_until(lambda: are_nodes_connected(result), LIMIT_S, "the nodes to connect")
            for count, _ in enumerate(camera.frames(), 1):
                # Nodes that fall behind drop frames: one at a time, and the next for its pose.
                me.spin_until(lambda n=count: len(result.evidence) >= n - 1, LIMIT_S, "evidence")
            me.spin_until(lambda: len(result.evidence) >= FRAMES, LIMIT_S, "all evidence")
            # A start with an empty cache compiles for seconds.
            me.spin_until(lambda: len(associations(result)) >= FRAMES, LIMIT_S, "all frames")
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


def test_the_updates_rebuild_the_published_graph_exactly(run):
    graph = latest(run)
    assert graph.nodes
    assert graph.frame_id
    assert {node.id for node in graph.nodes} >= {edge.subject for edge in graph.edges}
    assert len(associations(run)) == FRAMES
    replica = GraphReplica()
    for text in run.updates:
        assert replica.apply(wire.decode(text, wire.SceneGraphUpdateMessage))
    assert replica.message() == graph
    assert wire.encode(replica.message()) == run.graphs[-1]


def test_one_process_gives_the_same_graph(run):
    pipeline = Pipeline(Config())
    for frame in itertools.islice(open_recording(DEMO_ROOM).frames(), FRAMES):
        pipeline.process(frame)
    while pipeline.builder.update() or pipeline.builder.waiting:
        pass
    ours, theirs = pipeline.builder.snapshot(), latest(run)
    assert [(node.id, node.label, node.observations) for node in ours.nodes] == [
        (node.id, node.label, node.observations) for node in theirs.nodes
    ]
    np.testing.assert_allclose(
        [node.mean_m for node in ours.nodes], [node.mean_m for node in theirs.nodes], atol=1e-9
    )
    # A count alone is no reason to tell an edge again.
    told = [[replace(edge, shown=0) for edge in graph.edges] for graph in (ours, theirs)]
    assert told[0] == told[1] and ours.nodes == theirs.nodes


def test_a_late_subscriber_gets_the_graph(run):
    with peer("late_peer") as late:
        graphs = late.collect("/scene_graph", 1, latched=True)
        late.spin_until(lambda: bool(graphs), LIMIT_S, "the latched graph")
        assert graphs[-1] == run.graphs[-1]


def test_markers_are_published(run):
    run.peer.spin_until(lambda: bool(run.markers), LIMIT_S, "markers")
    assert len(run.markers[-1].markers) > len(latest(run).nodes)
    assert {marker.header.frame_id for marker in run.markers[-1].markers} == {latest(run).frame_id}


def test_every_node_publishes_diagnostics(run):
    run.peer.spin_until(lambda: values_of(run).keys() >= set(NODES), LIMIT_S, "diagnostics")
    for name in NODES:
        values = values_of(run)[name]
        assert int(values["total"]) > 0
        assert not any(key.startswith("dropped") for key in values), values


def test_the_graph_is_saved_on_request(run):
    client = run.peer.node.create_client(Trigger, "/graph_node/save")
    run.peer.spin_until(client.service_is_ready, LIMIT_S, "the service")
    future = client.call_async(Trigger.Request())
    run.peer.spin_until(future.done, LIMIT_S, "the answer")
    assert future.result().success, future.result().message
    path = Path(future.result().message.split(":")[0])
    saved = wire.decode(path.read_bytes(), wire.SceneGraphMessage)
    assert [node.id for node in saved.nodes] == [node.id for node in latest(run).nodes]
    assert all(len(surface_points(node)) for node in saved.nodes)


def test_an_interrupt_ends_each_node_with_0(run):
    for process in run.processes.values():
        assert process.interrupt() == 0, process.log
        assert "Traceback" not in process.log
