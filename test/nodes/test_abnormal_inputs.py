"""Abnormal input on each live topic: it is counted under its reason, and the node continues."""

import time
from collections.abc import Callable
from functools import partial

import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import String
from support.abnormal import CASES
from support.nodes_bench import (
    CAMERA,
    FRAME,
    PAIRING,
    STEP_NS,
    Bench,
    evidence,
    frame_graph,
    instances,
    local_graph,
    rgb,
    works,
)

from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.nodes.lifting_node import LiftingNode
from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode

# A first start compiles.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

# Of each node: what makes it, its topics, its parameters, and the messages of a frame.
NODES = {
    "segmentation_node": (SegmentationNode, CAMERA, {}, FRAME),
    "lifting_node": (
        LiftingNode,
        {**CAMERA, "deworldsg/frame_graph": String, "deworldsg/instances": Image},
        {},
        {**FRAME, "deworldsg__instances": instances, "deworldsg__frame_graph": frame_graph},
    ),
    "relation_node": (
        RelationNode,
        PAIRING,
        {"relations.world_model": "fake"},  # without clips it takes no images
        {"rgb__image_raw": rgb, "deworldsg__local_graph": local_graph},
    ),
    "graph_node": (
        GraphNode,
        {"deworldsg/local_graph": String, "deworldsg/relation_evidence": String},
        {},
        {"deworldsg__local_graph": local_graph, "deworldsg__relation_evidence": evidence},
    ),
}
del NODES["lifting_node"][1]["rgb/image_raw"], NODES["lifting_node"][3]["rgb__image_raw"]
# Seconds in which a node has to process good input again; a good frame takes milliseconds, and
# machines of CI are slow.
RECOVERY_S = 5.0
HOUR_NS = 3600 * 10**9


def send(at: Bench, **changes: Callable | None) -> None:
    """Send a frame; `changes` as in `send_frame`."""
    *_, makers = NODES[at.node.get_name()]
    at.send_made(**{**makers, **changes})


@pytest.fixture(scope="module")
def node():
    """Gives a node by its name, one at a time: they would hear each other's messages."""
    current: list[Bench] = []

    def get(name: str) -> Bench:
        if not current or current[0].node.get_name() != name:
            while current:
                current.pop().close()
            kind, topics, parameters, _ = NODES[name]
            current.append(Bench(kind, topics, parameters=parameters))
        works(current[0], partial(send, current[0]))
        return current[0]

    yield get
    for at in current:
        at.close()


def refuses_and_continues(at: Bench, reason: str, *frames: dict) -> None:
    """Frames of which one is abnormal, and a good one."""
    at.refuses(reason, lambda: [send(at, **changes) for changes in (*frames, {})])
    started_s = time.monotonic()
    works(at, partial(send, at))
    assert time.monotonic() - started_s < RECOVERY_S
    assert "internal_error" not in at.node.health.drops, at.node.health.drops


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.node}-{case.topic}-{case.text}")
def test_abnormal_input_is_counted_and_the_node_continues(node, case):
    refuses_and_continues(node(case.node), case.reason, {case.topic: case.make})


def test_images_without_a_near_pose_are_refused(node):
    at = node("segmentation_node")
    refuses_and_continues(at, "no_pose", *[{"camera__pose": None}] * 5)


@pytest.mark.parametrize("name", ["segmentation_node", "graph_node"])
def test_a_recording_that_restarts_is_processed(node, name):
    """As a clock that was set back, and forward again."""
    at = node(name)
    at.stamp_ns -= HOUR_NS
    refuses_and_continues(at, "time_jump", {})
    if name == "graph_node":
        at.expect(lambda: at.products() == at.stamp_ns, "the new time")
    at.stamp_ns += 2 * HOUR_NS
    send(at)
    works(at, partial(send, at))


def test_an_unexpected_exception_is_counted_and_the_node_continues(node, monkeypatch):
    at = node("segmentation_node")
    with monkeypatch.context() as patch:
        patch.setattr(at.node._perception, "perceive", lambda frame: 1 / 0)
        at.refuses("internal_error", partial(send, at))
    works(at, partial(send, at))


def test_evidence_waits_for_its_frame(node):
    at = node("graph_node")
    drops = dict(at.node.health.drops)
    at.send(deworldsg__relation_evidence=evidence(at.stamp_ns + STEP_NS))
    at.expect(lambda: len(at.node.graph._pending) == 1, "the evidence to wait")
    works(at, partial(send, at, deworldsg__relation_evidence=None))
    assert len(at.node.graph._pending) == 0
    assert at.node.health.drops == drops
