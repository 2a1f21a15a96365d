"""What hangs, stalls or floods does not stop a node: queues are bounded, losses counted."""

import contextlib
import threading
import time

import pytest
from std_msgs.msg import String
from support.nodes_bench import (
    CAMERA,
    LIMIT_S,
    Bench,
    fake_perception,
    local_graph,
    send_frame,
    works,
)

from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.nodes.deworldsg_node import DeworldsgNode
from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.ros import joining, models
from deworldsg_ros.ros.graph_keeper import QUEUE_JOBS
from deworldsg_ros.ros.joining import MAX_BUSY_S
from deworldsg_ros.ros.node import Waiting, serve
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.streams import frames
from deworldsg_ros.streams.poses import stamp_ns_of

# A first start compiles.
pytestmark = pytest.mark.timeout(300)

PAPER = {"merging.association": "paper"}


@pytest.fixture
def graph():
    with Bench(GraphNode, {"deworldsg/local_graph": String}, parameters=PAPER) as made:
        yield made


@pytest.fixture
def segmentation(monkeypatch):
    monkeypatch.setattr(models, "MAX_BUSY_S", LIMIT_S)  # a busy machine delays the worker
    with Bench(SegmentationNode, CAMERA) as made:
        works(made, lambda: send_frame(made))
        yield made


@pytest.fixture
def whole(monkeypatch):
    fake_perception(monkeypatch)
    with Bench(DeworldsgNode, CAMERA, parameters=PAPER) as made:
        yield made


@contextlib.contextmanager
def held(at):
    """Perception waits until the event is set; gives it, and the stamps that were begun."""
    begin, begun = threading.Event(), list[int]()
    perceive = at.node._perception.perceive

    def wait(frame):
        begun.append(frame.stamp_ns)
        assert begin.wait(4 * LIMIT_S)
        return perceive(frame)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(at.node._perception, "perceive", wait)
        yield begin, begun


def flood(graph, count):
    for _ in range(count):
        graph.send_made(deworldsg__local_graph=local_graph)
        graph.peer.spin_for(0.05)


def test_diagnostics_continue_while_the_graph_hangs(graph, monkeypatch):
    begin, merged = threading.Event(), []
    integrate = GraphBuilder.integrate

    def hang(builder, local):
        assert begin.wait(4 * LIMIT_S)
        merged.append(local.stamp_ns)
        return integrate(builder, local)

    statuses = graph.peer.statuses()
    monkeypatch.setattr(GraphBuilder, "integrate", hang)
    sent = QUEUE_JOBS + 20
    graph.refuses("overrun", lambda: flood(graph, sent), 10)
    seen = len(statuses)
    graph.expect(lambda: len(statuses) > seen + 1, "diagnostics")
    assert graph.node.graph._worker.waiting <= QUEUE_JOBS
    begin.set()
    graph.expect(lambda: graph.node.graph.newest_ns == graph.stamp_ns, "the newest frame")
    assert len(merged) + graph.node.health.drops["overrun"] == sent


def test_a_stalled_subscriber_does_not_delay_the_graph(graph):
    """It is reliable, and never takes a message."""
    stalled = graph.peer.node.create_subscription(
        String, "/scene_graph/updates", print, reliable(1)
    )
    graph.peer._executor.remove_node(graph.peer.node)
    flood(graph, 60)
    graph.expect(lambda: graph.node.graph.newest_ns == graph.stamp_ns, "the newest frame")
    assert graph.node.health.products > 0
    assert graph.node.health.drops == {}
    graph.peer.node.destroy_subscription(stalled)


def test_images_that_come_too_fast_are_left_to_dds(segmentation, monkeypatch):
    """They are not received, and they are counted."""
    at, before = segmentation, segmentation.products()

    def lost() -> int:
        return at.node.health.drops.get("lost_rgb", 0)

    with held(at) as (begin, _), monkeypatch.context() as patch:
        patch.setattr(joining, "TAKE_PERIOD_S", LIMIT_S)  # nothing while a frame waits
        for _ in range(12):
            send_frame(at)
            at.peer.spin_for(0.1)  # serves one message at a time
        begin.set()
        # On a busy machine, a frame of the fixture may come as late as this.
        at.expect(lambda: at.products() - before + lost() >= 12, "each to be processed or lost")
    assert lost() > 0
    works(at, lambda: send_frame(at))


def test_a_node_that_does_not_keep_up_goes_on_with_the_newest_image(whole, monkeypatch):
    """It takes all images that wait in DDS at once, and decodes only those that it processes."""
    decode, decoded = frames.rgb_from_message, []

    def note(message):
        decoded.append(stamp_ns_of(message))
        return decode(message)

    monkeypatch.setattr(frames, "rgb_from_message", note)
    waiting = Waiting(whole.node)
    whole.peer.also_spin.clear()
    worker = whole.node._worker

    def serve_until(condition) -> None:
        end_s = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < end_s
            serve(whole.node, waiting)

    with held(whole) as (begin, begun):
        send_frame(whole)
        serve_until(lambda: len(begun) == 1)
        for _ in range(3):
            send_frame(whole)
        time.sleep(2 * MAX_BUSY_S)  # DDS has them all
        serve_until(lambda: worker.waiting > 0)
        assert worker.waiting == 3
        begin.set()
        serve_until(lambda: len(begun) == 2)
        assert begun[1] == whole.stamp_ns
        assert begun == decoded
        assert whole.node.health.drops == {"overrun": 2}
    waiting.close()
