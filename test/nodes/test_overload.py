"""What hangs, stalls or floods does not stop a node: queues are bounded, losses counted."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from std_msgs.msg import String
from support.failing_backend import Backend
from support.nodes_bench import (
    CAMERA,
    LIMIT_S,
    Bench,
    depth,
    local_graph,
    pose,
    rgb,
    send_frame,
    works,
)

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.nodes.deworldsg_node import DeworldsgNode
from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.nodes.lifting_node import LiftingNode
from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.perception.stage import Perception
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.ros import models
from deworldsg_ros.ros.graph_keeper import QUEUE_JOBS
from deworldsg_ros.ros.health import received_in
from deworldsg_ros.ros.joining import COLLECT_PERIOD_S, MAX_BUSY_S
from deworldsg_ros.ros.node import Waiting, serve
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.wire import messages as wire

# A first start compiles.
pytestmark = pytest.mark.timeout(300)

PAPER = [Parameter("merging.association", value="paper")]


@pytest.fixture
def graph() -> Iterator[Bench]:
    made = Bench(GraphNode, {"deworldsg/local_graph": String}, parameter_overrides=PAPER)
    yield made
    made.close()


def test_diagnostics_continue_while_the_graph_hangs(
    graph: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = threading.Event()
    integrate = GraphBuilder.integrate
    merged: list[int] = []

    def hang(builder: GraphBuilder, local: Any) -> list[int]:
        assert begin.wait(4 * LIMIT_S)
        merged.append(local.stamp_ns)
        return integrate(builder, local)

    statuses: list[DiagnosticArray] = []
    graph.peer.node.create_subscription(DiagnosticArray, "/diagnostics", statuses.append, 10)
    monkeypatch.setattr(GraphBuilder, "integrate", hang)
    sent = QUEUE_JOBS + 20

    def flood() -> None:
        for _ in range(sent):
            graph.send(deworldsg__local_graph=local_graph(graph.next_stamp()))
            graph.peer.spin_for(0.05)

    graph.refuses("overrun", flood, 10)
    seen = len(statuses)
    graph.expect(lambda: len(statuses) > seen + 1, "diagnostics")
    assert graph.node.graph._worker.waiting <= QUEUE_JOBS
    begin.set()
    graph.expect(lambda: graph.node.graph.newest_ns == graph.stamp_ns, "the newest frame")
    assert len(merged) + graph.node.health.drops["overrun"] == sent


def test_a_stalled_subscriber_does_not_delay_the_graph(graph: Bench) -> None:
    """It is reliable, and never takes a message."""
    stalled = graph.peer.node.create_subscription(
        String, "/scene_graph/updates", print, reliable(1)
    )
    graph.peer._executor.remove_node(graph.peer.node)
    for _ in range(60):
        graph.send(deworldsg__local_graph=local_graph(graph.next_stamp()))
        graph.peer.spin_for(0.05)
    graph.expect(lambda: graph.node.graph.newest_ns == graph.stamp_ns, "the newest frame")
    assert graph.node.health.products > 0
    assert graph.node.health.drops == {}
    graph.peer.node.destroy_subscription(stalled)


class Hanging(FakeWorldModel):
    """A world model that does not return before it is released."""

    release = threading.Event()

    def predict(self, request: Any) -> Any:
        assert self.release.wait(4 * LIMIT_S)
        return super().predict(request)


def test_evidence_continues_while_the_world_model_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models, "build_world_model", lambda config, device: Hanging(2))
    options = {"relations.clip_length": 2, "relations.max_clips_per_s": 0.0}
    at = Bench(
        RelationNode,
        {"rgb/image_raw": CAMERA["rgb/image_raw"], "deworldsg/local_graph": String},
        parameter_overrides=[Parameter(name, value=value) for name, value in options.items()],
    )

    def send() -> None:
        stamp_ns = at.next_stamp()
        at.send(rgb__image_raw=rgb(stamp_ns), deworldsg__local_graph=local_graph(stamp_ns))

    try:
        for _ in range(10):
            works(at, send)
    finally:
        Hanging.release.set()
        at.close()


@pytest.fixture
def whole() -> Iterator[Bench]:
    def build(config: PerceptionConfig, *, world_up: str) -> Perception:
        backend = Backend()
        return Perception(backend, backend, backend, config, world_up=world_up)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models, "build_perception", build)
        made = Bench(DeworldsgNode, CAMERA, parameter_overrides=PAPER)
        yield made
        made.close()


def test_one_process_builds_and_publishes_the_graph(whole: Bench) -> None:
    updates = whole.peer.collect("/scene_graph/updates")
    for _ in range(3):
        works(whole, lambda: send_frame(whole))
    whole.expect(lambda: whole.node.graph.newest_ns == whole.stamp_ns, "the newest frame")
    whole.expect(lambda: "edges" in whole.node.more_values(), "the whole graph")
    for text in updates:
        assert wire.decode(text, wire.SceneGraphUpdateMessage).associations
    assert whole.node.health.drops == {}


def test_a_node_that_does_not_keep_up_goes_on_with_the_newest_image(
    whole: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes all images that wait in DDS at once: a frame is not old when its turn comes."""
    begin, begun = threading.Event(), list[int]()
    perceive = whole.node._perception.perceive

    def wait(frame: Any) -> Any:
        begun.append(frame.stamp_ns)
        assert begin.wait(4 * LIMIT_S)
        return perceive(frame)

    monkeypatch.setattr(whole.node._perception, "perceive", wait)
    waiting = Waiting(whole.node, whole._executor)
    whole.peer.also_spin.clear()

    def serve_until(condition: Callable[[], bool]) -> None:
        end_s = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < end_s
            serve(whole.node, waiting)

    send_frame(whole)
    serve_until(lambda: len(begun) == 1)
    worker = whole.node._worker
    for _ in range(3):
        send_frame(whole)
    time.sleep(2 * MAX_BUSY_S)  # DDS has them all
    serve_until(lambda: worker.waiting > 0)
    assert worker.waiting == 3
    begin.set()
    serve_until(lambda: len(begun) == 2)
    assert begun[1] == whole.stamp_ns
    assert whole.node.health.drops == {"overrun": 2}


def test_messages_that_no_frame_waits_for_are_taken_together() -> None:
    topics = ("camera/pose", "depth/image_raw")
    at = Bench(LiftingNode, {topic: CAMERA[topic] for topic in topics})
    waiting = Waiting(at.node, at._executor)
    at.peer.also_spin.clear()
    turns = sent = 0
    started_s = time.monotonic()
    try:
        while sent < 200:
            sent += 1
            stamp_ns = at.next_stamp()
            at.send(camera__pose=pose(stamp_ns), depth__image_raw=depth(stamp_ns))
            end_s = time.monotonic() + 0.005
            while time.monotonic() < end_s:
                serve(at.node, waiting)
                turns += 1
        for _ in range(5):
            serve(at.node, waiting)
        taken_s = time.monotonic() - started_s
        report = at.node.health.report(0.0).values
        # A busy machine may lose some on the way.
        assert received_in(report, "pose") > sent // 2
        # Timers and the wait for nothing are turns, too.
        assert turns < 2 * taken_s / COLLECT_PERIOD_S + 20
    finally:
        at.close()
