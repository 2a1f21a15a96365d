"""Parameters that change while a node runs, those that do not, and the QoS of its topics."""

from typing import Any

import pytest
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from support.failing_backend import Backend
from support.nodes_bench import CAMERA, Bench, alone, fake_perception, send_frame, works

from deworldsg_ros.nodes.deworldsg_node import DeworldsgNode
from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.perception import Perception
from deworldsg_ros.ros import models
from deworldsg_ros.ros.node import StageNode, run
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.ros.parameters import fields
from deworldsg_ros.scene.errors import ConfigurationError

# A first start compiles.
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(autouse=True)
def perception(monkeypatch):
    fake_perception(monkeypatch)


@pytest.fixture
def whole():
    with Bench(DeworldsgNode, CAMERA, parameters={"merging.association": "paper"}) as made:
        yield made


def change(node: StageNode, name: str, value: Any) -> tuple[bool, str]:
    """Set a parameter; whether it was taken, and the reason."""
    (result,) = node.set_parameters([Parameter(name, value=value)])
    return result.successful, result.reason


def test_thresholds_and_rates_change_while_the_node_runs(whole):
    node = whole.node
    for name in DeworldsgNode.LIVE:
        section, key = name.split(".")
        value = getattr(getattr(node.parameters, section), key)
        if isinstance(value, tuple):
            continue  # the words, which need another detector
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


def test_other_parameters_and_values_out_of_range_are_refused(whole):
    node = whole.node
    before = node.parameters
    for field in fields(Parameters):
        if field.name not in node.LIVE:
            expected = f"Trying to set a read-only parameter: {field.name}."
            assert change(node, field.name, field.default) == (False, expected)
    for name, value, says in (
        ("output.rate_hz", -1.0, "output.rate_hz"),
        ("merging.overlap_threshold", 0.0, "merging.overlap_threshold"),
        ("relations.max_clips_per_s", 0.0, "needs a restart"),
    ):
        taken, reason = change(node, name, value)
        assert not taken
        assert says in reason
    assert node.parameters == before


class WordsDetector(Backend):
    words = ()

    def check_words(self, words):
        if "unicorn" in words:
            raise ConfigurationError("perception.words 'unicorn': there are none")

    def use_words(self, words, before=()):
        self.words = words


def test_words_change_while_the_node_runs_and_a_bad_list_is_refused(whole, monkeypatch):
    assert "needs a detector of free text" in change(whole.node, "perception.words", ["mug"])[1]
    detector, parts = WordsDetector(), (Backend(), Backend())
    monkeypatch.setattr(
        models, "build_perception", lambda config, **more: Perception(detector, *parts, config)
    )
    with alone(SegmentationNode) as node:
        name = "perception.words"
        assert change(node, name, ["mug", "red mug"]) == (True, "")
        assert detector.words == node.parameters.perception.words == ("mug", "red mug")
        for words, says in (
            (["unicorn"], "'unicorn'"),
            (["mug", ""], "1 to 64 characters"),
            (["mug"] * 201, "at most 200"),
            ("mug", "expected list"),
        ):
            taken, reason = change(node, name, words)
            assert not taken and says in reason
        assert detector.words == ("mug", "red mug")
        assert change(node, name, ["drill"])[0] and detector.words == ("drill",)


UPDATES, GRAPHS = "/scene_graph/updates.publisher", "/deworldsg/local_graph.subscription"


def test_qos_overrides_are_honoured():
    unused = "qos_overrides./no/such/topic.subscription.depth"
    overrides = {
        f"qos_overrides.{UPDATES}.reliability": "best_effort",
        f"qos_overrides.{GRAPHS}.depth": 3,
        unused: 3,
    }
    with alone(GraphNode, overrides) as node:
        topics = (*node.publishers, *node.subscriptions)
        profiles = {item.topic_name: item.qos_profile for item in topics}
        assert profiles["/scene_graph/updates"].reliability == ReliabilityPolicy.BEST_EFFORT
        assert profiles["/deworldsg/local_graph"].depth == 3
        assert node.unused_overrides() == [unused]


def test_a_camera_topic_follows_its_override():
    overrides = {"qos_overrides./rgb/image_raw.subscription.reliability": "best_effort"}
    with Bench(SegmentationNode, CAMERA, parameters=overrides) as at:
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


@pytest.mark.parametrize(
    ("policy", "value"), [("colour", 1), ("reliability", "sometimes"), ("depth", "many")]
)
def test_an_override_that_rclpy_does_not_take_is_refused(policy, value):
    refused = pytest.raises(ConfigurationError, match=f"{policy} = {value!r}: .*expected policies")
    with refused, alone(GraphNode, {f"qos_overrides.{UPDATES}.{policy}": value}):
        pass


def test_a_node_whose_start_fails_leaves_nothing_to_dds():
    ended = []

    class Failing(StageNode):
        def __init__(self):
            super().__init__("failing", "nothing")
            raise ConfigurationError("crystal ball")

        def destroy_node(self):
            super().destroy_node()
            ended.append(self)

    assert run(Failing, []) == 2
    assert len(ended) == 1
