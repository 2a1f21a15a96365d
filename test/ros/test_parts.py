"""Parts of the nodes: choice of a subscription, worker thread, pending evidence, markers."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import CompressedImage, Image
from visualization_msgs.msg import Marker

from deworldsg_ros.ros.graph_output import marker_array
from deworldsg_ros.ros.inputs import image_sources
from deworldsg_ros.ros.qos import LossCounter, Offer, choose
from deworldsg_ros.ros.threads import Worker
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import RelationEvidence, Vocabulary
from deworldsg_ros.streams.assembler import PendingEvidence

RAW = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
AUTO = image_sources("/rgb", "/compressed", "auto")


@pytest.mark.parametrize(
    ("offers", "topic", "kind", "reliable"),
    [
        ([], "/rgb", Image, True),
        ([Offer("/rgb", RAW, True)], "/rgb", Image, True),
        ([Offer("/rgb", RAW, False)], "/rgb", Image, False),
        ([Offer("/rgb", RAW, True), Offer("/rgb", RAW, False)], "/rgb", Image, False),
        ([Offer("/rgb/compressed", COMPRESSED, True)], "/rgb/compressed", CompressedImage, True),
        ([Offer("/rgb", COMPRESSED, False)], "/rgb", CompressedImage, False),
        (
            [Offer("/rgb/compressed", COMPRESSED, False), Offer("/rgb", RAW, True)],
            "/rgb",
            Image,
            True,
        ),
        ([Offer("/rgb", "std_msgs/msg/String", False)], "/rgb", Image, True),
    ],
)
def test_the_first_published_source_is_chosen(
    offers: list[Offer], topic: str, kind: type, reliable: bool
) -> None:
    choice = choose(AUTO, offers, "auto")
    assert (choice.source.topic, choice.source.kind, choice.reliable) == (topic, kind, reliable)


@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
def test_a_configured_reliability_is_used(reliability: str) -> None:
    for offered in (True, False):
        choice = choose(AUTO, [Offer("/rgb", RAW, offered)], reliability)
        assert choice.reliable == (reliability == "reliable")


def test_a_configured_transport_is_used() -> None:
    offers = [Offer("/rgb", RAW, True), Offer("/rgb/compressed", COMPRESSED, True)]
    sources = image_sources("/rgb", "/compressed", "compressed")
    assert choose(sources, offers, "auto").source.kind is CompressedImage


def test_a_worker_keeps_the_order_and_drops_the_oldest() -> None:
    begin, done, overruns = threading.Event(), [], []

    def work(item: int) -> None:
        assert begin.wait(10)
        done.append(item)

    worker: Worker[int] = Worker("test", work, size=3, on_overrun=overruns.append)
    worker.submit(0)
    while worker.waiting:  # taken by the thread
        threading.Event().wait(0.001)
    for item in range(1, 6):
        worker.submit(item)
    assert (worker.waiting, overruns) == (3, [1, 2])
    assert not worker.wait_idle(0.0)
    begin.set()
    assert worker.wait_idle(10)
    assert done == [0, 3, 4, 5]
    assert worker.stop(10)


def test_a_worker_that_does_not_keep_up_takes_the_newest() -> None:
    """One that had a pause processes all."""
    begin, done, overruns = threading.Event(), [], []

    def work(item: int) -> None:
        assert begin.wait(10)
        done.append(item)

    worker: Worker[int] = Worker("test", work, size=9, on_overrun=overruns.append, max_busy_s=0.2)
    worker.submit(0)
    while worker.waiting:  # taken by the thread
        time.sleep(0.001)
    for item in range(1, 5):
        worker.submit(item)
    time.sleep(0.3)
    begin.set()
    assert worker.wait_idle(10)
    assert (done, overruns) == ([0, 4], [1, 2, 3])
    for item in range(5, 9):
        worker.submit(item)
    assert worker.wait_idle(10)
    assert (done, overruns) == ([0, 4, 5, 6, 7, 8], [1, 2, 3])
    assert worker.stop(10)


def test_a_worker_calls_again_after_the_time_that_was_asked_for() -> None:
    calls, enough = [], threading.Event()

    def after() -> float | None:
        calls.append(len(calls))
        if len(calls) < 3:
            return 0.01
        enough.set()
        return None

    worker: Worker[int] = Worker("test", print, size=1, on_overrun=print, after=after)
    worker.submit(0)
    assert enough.wait(10)
    assert worker.wait_idle(10)
    assert len(calls) == 3
    assert worker.stop(10)


def test_a_worker_stops_with_items_in_its_queue() -> None:
    begin, done = threading.Event(), []
    worker: Worker[int] = Worker(
        "test", lambda item: (begin.wait(10), done.append(item)), size=9, on_overrun=print
    )
    for item in range(5):
        worker.submit(item)
    while worker.waiting == 5:  # the first is taken by the thread
        threading.Event().wait(0.001)
    assert not worker.stop(0.01)
    begin.set()
    assert worker.stop(10)
    assert len(done) <= 1


@pytest.mark.parametrize("wait_s", [1e10, 1e308, float("inf")])
def test_a_worker_that_waits_for_ages_takes_the_next_item(wait_s: float) -> None:
    done: list[int] = []
    worker: Worker[int] = Worker(
        "test", done.append, size=2, on_overrun=print, after=lambda: wait_s
    )
    for item in range(2):
        worker.submit(item)
        assert worker.wait_idle(10)
    assert done == [0, 1]
    assert worker.stop(10)


def evidence(stamp_ns: int) -> RelationEvidence:
    return RelationEvidence(
        stamp_ns=stamp_ns,
        vocabulary=Vocabulary(("chair",), ("on",)),
        pairs=np.zeros((0, 2), np.int64),
        pair_classes=np.zeros((0, 2), np.int64),
        geo_costs=np.zeros(0),
        predictions=np.zeros((0, 1)),
        source="none",
    )


def test_evidence_waits_for_its_frame() -> None:
    waiting = PendingEvidence()
    for stamp_ns in (3, 1, 2, 2, 5):
        waiting.add(evidence(stamp_ns))
    assert [item.stamp_ns for item in waiting.take(2)] == [2, 2]
    assert len(waiting) == 2
    assert waiting.take(4) == []
    assert [item.stamp_ns for item in waiting.take(5)] == [5]


def test_pending_evidence_is_bounded() -> None:
    waiting = PendingEvidence(capacity=2)
    waiting.add(evidence(1))
    waiting.add(evidence(2))
    with pytest.raises(RefusedInput) as caught:
        waiting.add(evidence(3))
    assert caught.value.reason == "unmatched_evidence"
    assert [item.stamp_ns for item in waiting.take(3)] == [3]


def test_the_bytes_of_pending_evidence_are_bounded() -> None:
    pairs = np.tile(np.array([[0, 1]]), (4, 1))
    large = replace(
        evidence(2),
        pairs=pairs,
        pair_classes=np.zeros((4, 2), np.int64),
        geo_costs=np.zeros(4),
        predictions=np.ones((4, 1)),
    )
    waiting = PendingEvidence(most_bytes=40)
    waiting.add(large)
    with pytest.raises(RefusedInput):
        waiting.add(replace(large, stamp_ns=3))
    assert [item.stamp_ns for item in waiting.take(3)] == [3]


def test_a_marker_array_replaces_all_markers() -> None:
    item = SimpleNamespace(
        namespace="nodes",
        id=7,
        kind="sphere",
        position=np.array([1.0, 2.0, 3.0]),
        quat_xyzw=(0.0, 0.0, 0.0, 1.0),
        scale=(0.1, 0.2, 0.3),
        rgba=(1.0, 0.0, 0.0, 0.5),
        text="",
        points=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    )
    array = marker_array([item], "map", Time(sec=5))
    clear, marker = array.markers
    assert clear.action == Marker.DELETEALL
    assert (marker.ns, marker.id, marker.type) == ("nodes", 7, Marker.SPHERE)
    assert (marker.header.frame_id, marker.header.stamp.sec) == ("map", 5)
    assert (marker.pose.position.z, marker.scale.y, marker.color.a) == (3.0, 0.2, 0.5)
    assert marker.points[1].x == 1.0
    assert [m.action for m in marker_array([], "map", Time()).markers] == [Marker.DELETEALL]


def test_losses_of_one_publisher_are_counted() -> None:
    lost: list[int] = []
    losses = LossCounter(lost.append)

    def arrive(*numbers: int) -> None:
        for number in numbers:
            losses.count({"publication_sequence_number": number})

    arrive(5, 6, 9)
    assert lost == [2]
    arrive(1, 2)  # the publisher was restarted
    losses.publishers = 2
    arrive(7, 3)
    losses.publishers = 1
    arrive(20)
    assert lost == [2]
    losses.restart()
    arrive(30, 32)
    assert lost == [2, 1]
