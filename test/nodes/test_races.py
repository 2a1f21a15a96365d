"""Diagnostics are read in the executor's thread while other threads work."""

import time
from collections.abc import Sequence

import pytest
from support.nodes_bench import CAMERA, Bench, alone, fake_perception, send_frame
from support.races import beside

from deworldsg_ros.nodes.deworldsg_node import DeworldsgNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.ros.health import Health
from deworldsg_ros.ros.node import StageNode

pytestmark = pytest.mark.timeout(300)  # kernels may have to be compiled
TIMES = 20_000
FRAMES = 100


def look(node: StageNode, missing: Sequence[str] = ()) -> None:
    """Read what /diagnostics has of the node's other threads."""
    node.hung()
    node.health.report(time.monotonic(), missing, node.more_values(), in_turn=False)


def look_from_the_executor(node: StageNode) -> bool:
    """The same, and what is missing: only the executor's thread, which takes the messages, asks."""
    look(node, node.waiting_for(time.monotonic_ns()))
    return True


def test_diagnostics_while_frames_come(monkeypatch):
    fake_perception(monkeypatch)
    parameters = {
        "merging.association": "paper",
        "relations.world_model": "fake",
        "relations.clip_length": 4,
    }
    with Bench(DeworldsgNode, CAMERA, parameters=parameters) as at:
        send_frame(at)
        at.expect(lambda: at.products() > 0, "a first product")
        assert at.node.graph.wait_idle(120.0)
        with beside(lambda: look(at.node), lambda: look(at.node)):
            for _ in range(FRAMES):
                before = at.products()
                send_frame(at)
                at.expect(
                    lambda: look_from_the_executor(at.node) and at.products() > before,  # noqa: B023 - called at once
                    "a product",
                )
        assert "internal_error" not in at.node.health.drops


def test_frames_of_new_angles_while_diagnostics_are_read(monkeypatch):
    fake_perception(monkeypatch)
    with alone(SegmentationNode) as node:
        node._turns.clear()

        def turn():
            for quarter in range(1, 9):
                node._turns[quarter] += 1
            node._turns.clear()

        with beside(turn):
            for _ in range(TIMES):
                node.more_values()


def test_counts_of_four_threads_are_complete():
    health = Health("frames")

    def count():
        for reason in "abcdefgh":
            health.dropped(reason)
            health.received(reason)
            health.left_out({reason: 1})
            health.published(0.001)

    calls = [0] * 4

    def counting(at):
        def call():
            count()
            calls[at] += 1

        return call

    with beside(*map(counting, range(4))):
        for now_s in range(2000):
            health.report(float(now_s))
            assert set(health.drops) <= set("abcdefgh")
    assert health.drops == dict.fromkeys("abcdefgh", sum(calls))
    assert health.products == 8 * sum(calls)
