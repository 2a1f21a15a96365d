"""A replay waits for a pipeline that works, and keeps its own pace without one."""

from __future__ import annotations

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


class FakeNode(MagicMock):
    """Answers discovery: all nodes but `gone`."""

    gone: tuple[str, ...] = ()
    starts = 1

    def resolve_topic_name(self, topic):
        return topic

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


def monitor_with_full_window(first_ns=1):
    node = FakeNode()
    monitor = PipelineMonitor(node, odometry=False)
    fill(monitor, first_ns)
    return node, monitor


def fill(monitor, first_ns):
    for stamp_ns in range(first_ns, first_ns + WINDOW_FRAMES):
        monitor.window.publish(stamp_ns)
        for role in LISTENERS_OF_INPUTS:
            monitor.window.passed(role, stamp_ns)
    assert monitor.window.is_full


def result(monitor, stamp_ns):
    monitor._on_local(String(data=wire.encode(local_graph(stamp_ns))))


def test_it_waits_for_nodes_that_work():
    _, monitor = monitor_with_full_window()
    assert monitor.has_to_wait(STALL_S, 100.0)
    assert monitor.has_to_wait(STALL_S, 100.0 + FIRST_RESULT_S)
    result(monitor, 1)
    assert not monitor.has_to_wait(STALL_S, 500.0)  # there is room


def test_without_results_it_waits_once_and_then_keeps_its_pace_until_there_are_some():
    node, monitor = monitor_with_full_window()
    result(monitor, 1)
    fill(monitor, 10)
    assert monitor.has_to_wait(STALL_S, 100.0)
    assert not monitor.has_to_wait(STALL_S, 131.0)
    for first_ns in (20, 30, 40):
        fill(monitor, first_ns)
        assert not monitor.has_to_wait(STALL_S, 131.0 + first_ns / 1000)
    assert monitor.window.given_up == 5 * WINDOW_FRAMES - 1
    assert node.get_logger().warning.call_count == 1
    fill(monitor, 50)
    result(monitor, 50)
    fill(monitor, 60)
    assert monitor.has_to_wait(STALL_S, 140.0)


def test_a_node_that_is_gone_is_not_waited_for():
    node, monitor = monitor_with_full_window()
    node.gone = ("lifting_node",)
    assert not monitor.has_to_wait(STALL_S, 100.0)
    (sentence,) = node.get_logger().warning.call_args.args
    assert sentence.startswith(
        "waiting for lifting_node to listen to deworldsg/frame_graph: stopped"
    )


def test_a_node_that_is_restarted_is_waited_for_without_its_frames():
    node, monitor = monitor_with_full_window()
    result(monitor, 1)
    fill(monitor, 10)
    assert monitor.has_to_wait(STALL_S, 100.0)
    node.starts = 2  # the endpoints of the killed node are still known
    assert monitor.has_to_wait(STALL_S, 101.5)
    assert monitor.has_to_wait(STALL_S, 102.0)
    assert not monitor.has_to_wait(STALL_S, 101.5 + SETTLE_S)
    assert monitor.window.in_flight == 0
    fill(monitor, 20)
    assert monitor.has_to_wait(STALL_S, 104.0)
    assert node.get_logger().warning.call_count == 1


def diagnostics(monitor, name, **values):
    status = DiagnosticStatus(name=f"{name}: /{name}", hardware_id="deworldsg_ros")
    status.values = [
        KeyValue(key=key.replace("__", " "), value=value) for key, value in values.items()
    ]
    monitor._on_diagnostics(DiagnosticArray(status=[status]))


def test_a_replay_starts_when_the_nodes_have_told_that_they_are_connected():
    node = FakeNode()
    node.get_namespace.return_value = "/"
    monitor = PipelineMonitor(node, odometry=False)
    for topic, (publishers, listeners) in BETWEEN.items():
        first = monitor.connections.missing({}, 100.0)[0]
        assert first == f"{min(publishers)} to connect to the listeners of {topic}"
        told = {f"listeners__of__{topic}": str(len(listeners))}
        for name in publishers:
            known = {key.replace(" ", "__"): text for key, text in
                     monitor.diagnostics.get(name, {}).items()}  # fmt: skip
            diagnostics(monitor, name, **known, **told)
    assert monitor.connections.missing({}, 100.0) == []
    node.gone = ("lifting_node",)
    assert monitor.connections.missing({}, 100.1) != []


def test_nodes_that_tell_nothing_are_given_time_to_connect():
    monitor = PipelineMonitor(FakeNode(), odometry=False)
    assert monitor.connections.missing({}, 100.0) != []
    assert monitor.connections.missing({}, 99.9 + SETTLE_S) != []
    assert monitor.connections.missing({}, 100.0 + SETTLE_S) == []


def test_counts_of_a_restarted_node_begin_again():
    node, monitor = monitor_with_full_window()
    node.get_namespace.return_value = "/"
    diagnostics(monitor, "segmentation_node", dropped__overrun="2")
    assert monitor.window.in_flight == 0
    result(monitor, WINDOW_FRAMES)
    diagnostics(monitor, "segmentation_node")
    fill(monitor, 10)
    diagnostics(monitor, "segmentation_node", dropped__overrun="1")
    assert monitor.window.in_flight == WINDOW_FRAMES - 1


def test_what_a_restarted_graph_node_missed_is_not_waited_for():
    node, monitor = monitor_with_full_window()
    node.get_namespace.return_value = "/"
    received = "received__deworldsg/local_graph"
    for stamp_ns in range(1, 6):
        result(monitor, stamp_ns)
    diagnostics(monitor, "graph_node", **{received: "1.0 per second, 5 in total"})
    result(monitor, 6)
    assert not monitor.drained(EVIDENCE_QUIET_S) and not monitor.drained(9 * EVIDENCE_QUIET_S)
    diagnostics(monitor, "graph_node", **{received: "0.0 per second, 0 in total"})
    assert monitor.drained(10 * EVIDENCE_QUIET_S)
    result(monitor, 7)
    assert not monitor.drained(20 * EVIDENCE_QUIET_S)


NO_COUNTS = ["many", "", "-3", "1e9", "9" * 5000, "3 "]


@pytest.mark.parametrize("value", NO_COUNTS)
def test_values_of_others_that_are_no_counts_are_left_out(value):
    """/diagnostics is shared with other programs."""
    node, monitor = monitor_with_full_window()
    node.get_namespace.return_value = "/"
    received = "received__deworldsg/local_graph"
    keys = ("nodes", "clips__pending", "dropped__x", "listeners__of__deworldsg/frame_graph")
    for name in ("segmentation_node", "lifting_node", "relation_node", "graph_node"):
        diagnostics(monitor, name, **dict.fromkeys(keys, value))
    diagnostics(
        monitor, "graph_node", nodes=value, **{received: f"1.0 per second, {value} in total"}
    )
    assert monitor.nodes == 0 and monitor.window.in_flight == WINDOW_FRAMES
    assert monitor.connections.missing({}, 100.0) != []
    monitor.window.give_up()
    assert monitor.drained(100.0)
    diagnostics(monitor, "graph_node", nodes="7")
    assert monitor.nodes == 7
