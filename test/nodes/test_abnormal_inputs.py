"""Abnormal input on each live topic: it is counted under its reason, and the node continues."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import String
from support.abnormal import CASES, Case
from support.nodes_bench import (
    CAMERA,
    Bench,
    evidence,
    frame_graph,
    instances,
    local_graph,
    rgb,
    send_frame,
    works,
)

from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.nodes.lifting_node import LiftingNode
from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode

pytestmark = pytest.mark.slow

LOCAL, EVIDENCE = "deworldsg/local_graph", "deworldsg/relation_evidence"
NODES = {
    "segmentation_node": (SegmentationNode, CAMERA),
    "lifting_node": (
        LiftingNode,
        {**CAMERA, "deworldsg/frame_graph": String, "deworldsg/instances": Image},
    ),
    "relation_node": (RelationNode, {"rgb/image_raw": Image, LOCAL: String}),
    "graph_node": (GraphNode, {LOCAL: String, EVIDENCE: String}),
}
# Seconds in which a node has to process good input again; a good frame takes milliseconds, and
# machines of CI are slow.
RECOVERY_S = 5.0


@pytest.fixture(scope="module")
def benches() -> Iterator[dict[str, Bench]]:
    """Each node once, made when it is needed."""
    made: dict[str, Bench] = {}
    yield made
    for bench in made.values():
        bench.close()


def send(at: Bench, node: str, **changes) -> None:
    if node == "segmentation_node":
        send_frame(at, **changes)
    elif node == "lifting_node":
        good = {"deworldsg__instances": instances, "deworldsg__frame_graph": frame_graph}
        send_frame(at, rgb__image_raw=None, **{**good, **changes})
    else:
        stamp_ns = at.next_stamp()
        makers = {"deworldsg__local_graph": local_graph}
        makers |= {"rgb__image_raw": rgb} if node == "relation_node" else {}
        makers |= {"deworldsg__relation_evidence": evidence} if node == "graph_node" else {}
        makers |= changes
        at.send(**{name: make(stamp_ns) for name, make in makers.items() if make is not None})


@pytest.mark.timeout(600)
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.node}-{case.topic}-{case.text}")
def test_abnormal_input_is_counted_and_the_node_continues(
    benches: dict[str, Bench], case: Case
) -> None:
    if case.node not in benches:
        # relation_node takes images for a world model of clips only.
        clips = [Parameter("relations.world_model", value="fake")]
        options = {"parameter_overrides": clips} if case.node == "relation_node" else {}
        benches[case.node] = Bench(*NODES[case.node], **options)
    bench = benches[case.node]
    works(bench, lambda: send(bench, case.node))

    def provoke() -> None:
        send(bench, case.node, **{case.topic: case.make})
        send(bench, case.node)

    bench.refuses(case.reason, provoke)
    started_s = time.monotonic()
    works(bench, lambda: send(bench, case.node))
    assert time.monotonic() - started_s < RECOVERY_S
    assert "internal_error" not in bench.node.health.drops, bench.node.health.drops
