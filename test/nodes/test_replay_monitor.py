"""A replay waits for a pipeline that works, and keeps its own pace without one."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import String
from support.nodes_bench import local_graph

from deworldsg_ros.nodes.replay_node import (
    BETWEEN,
    EVIDENCE_QUIET_S,
    FIRST_RESULT_S,
    LISTENERS_OF_INPUTS,
    SETTLE_S,
    WINDOW_FRAMES,
    PipelineMonitor,
)
from deworldsg_ros.wire import messages as wire

STALL_S = 30.0
RECEIVED = "received deworldsg/local_graph"


class FakeNode(MagicMock):
    """Answers discovery: all nodes but `gone`."""

    gone: tuple[str, ...] = ()
    starts = 1

    def resolve_topic_name(self, topic):
        return topic

    def get_namespace(self):
        return "/"

    def _infos(self, names):
        gids = [[number] * 16 for number in range(self.starts)]
        return [
            SimpleNamespace(node_name=name, endpoint_gid=gid)
            for name in names
            if name not in self.gone
            for gid in gids
        ]

    def get_publishers_info_by_topic(self, topic):
        return self._infos(BETWEEN[topic][0])

    def get_subscriptions_info_by_topic(self, topic):
        return self._infos(BETWEEN[topic][1])


class Watched(PipelineMonitor):
    """A monitor of nodes that do not exist, after a full window of frames."""

    def __init__(self):
        self.node = FakeNode()
        super().__init__(self.node, odometry=False)
        self.fill(1)

    def fill(self, first_ns):
        for stamp_ns in range(first_ns, first_ns + WINDOW_FRAMES):
            self.window.publish(stamp_ns)
            for role in LISTENERS_OF_INPUTS:
                self.window.passed(role, stamp_ns)
        assert self.window.is_full

    def waits(self, now_s):
        return self.has_to_wait(STALL_S, now_s)

    def result(self, stamp_ns):
        self._on_local(String(data=wire.encode(local_graph(stamp_ns))))

    def tell(self, name, values=()):
        status = DiagnosticStatus(name=f"{name}: /{name}", hardware_id="deworldsg_ros")
        status.values = [KeyValue(key=key, value=value) for key, value in dict(values).items()]
        self._on_diagnostics(DiagnosticArray(status=[status]))

    @property
    def warnings(self):
        return [call.args[0] for call in self.node.get_logger().warning.call_args_list]


@pytest.fixture
def monitor():
    return Watched()


def test_without_results_it_waits_once_and_then_keeps_its_pace_until_there_are_some(monitor):
    assert monitor.waits(1.0) and monitor.waits(1.0 + FIRST_RESULT_S)
    monitor.result(1)
    assert not monitor.waits(50.0)  # there is room
    monitor.fill(10)
    assert monitor.waits(100.0)
    assert not monitor.waits(131.0)
    for first_ns in (20, 30, 40):
        monitor.fill(first_ns)
        assert not monitor.waits(131.0 + first_ns / 1000)
    assert monitor.window.given_up == 5 * WINDOW_FRAMES - 1
    assert len(monitor.warnings) == 1
    monitor.fill(50)
    monitor.result(50)
    monitor.fill(60)
    assert monitor.waits(140.0)


def test_a_node_that_is_gone_is_not_waited_for(monitor):
    monitor.node.gone = ("lifting_node",)
    assert not monitor.waits(100.0)
    (sentence,) = monitor.warnings
    assert sentence.startswith("waiting for lifting_node to listen to deworldsg/frame_graph:")


def test_a_node_that_is_restarted_is_waited_for_without_its_frames(monitor):
    monitor.result(1)
    monitor.fill(10)
    assert monitor.waits(100.0)
    monitor.node.starts = 2  # the endpoints of the killed node are still known
    assert monitor.waits(101.5)
    assert monitor.waits(102.0)
    assert not monitor.waits(101.5 + SETTLE_S)
    assert monitor.window.in_flight == 0
    monitor.fill(20)
    assert monitor.waits(104.0)
    assert len(monitor.warnings) == 1


def test_a_replay_starts_when_the_nodes_have_told_that_they_are_connected(monitor):
    connections = monitor.connections
    for topic, (publishers, listeners) in BETWEEN.items():
        first = connections.missing({}, 100.0)[0]
        assert first == f"{min(publishers)} to connect to the listeners of {topic}"
        told = {f"listeners of {topic}": str(len(listeners))}
        for name in publishers:
            monitor.tell(name, {**monitor.diagnostics.get(name, {}), **told})
    assert connections.missing({}, 100.0) == []
    monitor.node.gone = ("lifting_node",)
    assert connections.missing({}, 100.1) != []


def test_counts_of_a_restarted_node_begin_again(monitor):
    """What a restarted graph_node missed is not waited for."""
    monitor.tell("segmentation_node", {"dropped overrun": "2"})
    assert monitor.window.in_flight == 0
    monitor.tell("segmentation_node")
    monitor.fill(10)
    monitor.tell("segmentation_node", {"dropped overrun": "1"})
    assert monitor.window.in_flight == WINDOW_FRAMES - 1
    monitor.window.give_up()
    for stamp_ns in range(21, 26):
        monitor.result(stamp_ns)
    monitor.tell("graph_node", {RECEIVED: "1.0 per second, 5 in total"})
    monitor.result(26)
    assert not monitor.drained(EVIDENCE_QUIET_S) and not monitor.drained(9 * EVIDENCE_QUIET_S)
    monitor.tell("graph_node", {RECEIVED: "0.0 per second, 0 in total"})
    assert monitor.drained(10 * EVIDENCE_QUIET_S)
    monitor.result(27)
    assert not monitor.drained(20 * EVIDENCE_QUIET_S)
