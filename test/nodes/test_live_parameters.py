"""Parameters that change while a node runs, those that do not, and the QoS of its topics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from support.failing_backend import Backend
from support.nodes_bench import CAMERA, Bench, send_frame, works

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.nodes.deworldsg_node import DeworldsgNode
from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.perception import Perception
from deworldsg_ros.ros import models
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.ros.parameters import fields
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire

# A first start compiles.
pytestmark = pytest.mark.timeout(300)

PAPER = [Parameter("merging.association", value="paper")]
UPDATES, GRAPHS = "/scene_graph/updates.publisher", "/deworldsg/local_graph.subscription"


@pytest.fixture(autouse=True)
def perception(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(config: PerceptionConfig, *, world_up: str) -> Perception:
        backend = Backend()
        return Perception(backend, backend, backend, config, world_up=world_up)

    monkeypatch.setattr(models, "build_perception", build)


@pytest.fixture
def whole() -> Iterator[Bench]:
    made = Bench(DeworldsgNode, CAMERA, parameter_overrides=PAPER)
    yield made
    made.close()


@pytest.fixture
def context() -> Iterator[rclpy.Context]:
    made = rclpy.Context()
    rclpy.init(context=made)
    yield made
    rclpy.try_shutdown(context=made)


def change(node: StageNode, name: str, value: Any) -> tuple[bool, str]:
    """Set a parameter; whether it was taken, and the reason."""
    (result,) = node.set_parameters([Parameter(name, value=value)])
    return result.successful, result.reason


def test_thresholds_and_rates_change_while_the_node_runs(whole: Bench) -> None:
    node = whole.node
    for name in DeworldsgNode.LIVE:
        section, key = name.split(".")
        value = getattr(getattr(node.parameters, section), key)
        new = value + 1 if isinstance(value, int) else 0.25
        assert change(node, name, new) == (True, "")
        assert getattr(getattr(node.parameters, section), key) == new
        assert node.get_parameter(name).value == new
    assert node.graph.wait_idle(120.0)  # kernels may be compiled
    assert node._perception.score_threshold == 0.25
    assert node._lifting._config.tau == 0.25
    assert node._relating._reasoner._config.geo_cost_threshold == 0.25
    assert node.graph._times._period_s > 1.0
    works(whole, lambda: send_frame(whole))
    whole.expect(lambda: node.graph._builder is not None, "a graph")
    before = node.graph._builder.merging._bound
    assert change(node, "merging.hellinger_threshold", 0.5)[0]
    assert node.graph.wait_idle(5.0)
    assert node.graph._builder.merging._bound > before  # the first one was made with 0.25


def test_a_score_threshold_is_that_of_the_next_frame() -> None:
    at = Bench(SegmentationNode, CAMERA)
    texts = at.peer.collect("deworldsg/frame_graph")
    try:
        works(at, lambda: send_frame(at))
        assert change(at.node, "perception.score_threshold", 0.85)[0]
        works(at, lambda: send_frame(at))
        at.expect(lambda: len(texts) == 2, "frame graphs")
        scores = [
            [item.score for item in wire.decode(text, wire.FrameGraphMessage).objects]
            for text in texts
        ]
        assert min(scores[0]) < 0.85 < min(scores[1])
    finally:
        at.close()


def test_other_parameters_and_values_out_of_range_are_refused(whole: Bench) -> None:
    node = whole.node
    before = node.parameters
    for field in fields(Parameters):
        if field.name not in node.LIVE:
            expected = f"Trying to set a read-only parameter: {field.name}."
            assert change(node, field.name, field.default) == (False, expected)
    for name, value in (("output.rate_hz", -1.0), ("merging.overlap_threshold", 0.0)):
        taken, reason = change(node, name, value)
        assert not taken
        assert name in reason
    taken, reason = change(node, "relations.max_clips_per_s", 0.0)
    assert not taken
    assert "needs a restart" in reason
    assert node.parameters == before


def graph_node(context: rclpy.Context, overrides: dict[str, Any]) -> GraphNode:
    given = [Parameter(f"qos_overrides.{name}", value=value) for name, value in overrides.items()]
    return GraphNode(context=context, parameter_overrides=given)


def test_qos_overrides_are_honoured(context: rclpy.Context) -> None:
    overrides = {
        f"{UPDATES}.reliability": "best_effort",
        f"{GRAPHS}.depth": 3,
        "/no/such/topic.subscription.depth": 3,
    }
    node = graph_node(context, overrides)
    try:
        (updates,) = (item for item in node.publishers if item.topic_name == "/scene_graph/updates")
        (graphs,) = (
            item for item in node.subscriptions if item.topic_name == "/deworldsg/local_graph"
        )
        assert updates.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        assert graphs.qos_profile.depth == 3
        assert node.unused_overrides() == ["qos_overrides./no/such/topic.subscription.depth"]
    finally:
        node.close()
        node.destroy_node()


def test_a_camera_topic_follows_its_override() -> None:
    name = "qos_overrides./rgb/image_raw.subscription.reliability"
    at = Bench(SegmentationNode, CAMERA, parameter_overrides=[Parameter(name, value="best_effort")])
    try:
        listening = [item.describe() for item in at.node._subscriptions_to_check]
        assert "/rgb/image_raw [sensor_msgs/msg/Image] best effort" in listening
        assert "/depth/image_raw [sensor_msgs/msg/Image] reliable" in listening
        # A best-effort reader misses what is sent before it knows the writer.
        for _ in range(20):
            send_frame(at)
            at.peer.spin_for(0.5)
            if at.products():
                break
        assert at.products()
    finally:
        at.close()


@pytest.mark.parametrize(
    ("policy", "value"), [("colour", 1), ("reliability", "sometimes"), ("depth", "many")]
)
def test_an_override_that_rclpy_does_not_take_is_refused(
    context: rclpy.Context, policy: str, value: Any
) -> None:
    with pytest.raises(ConfigurationError, match=f"{policy} = {value!r}: .*expected policies"):
        graph_node(context, {f"{UPDATES}.{policy}": value})
