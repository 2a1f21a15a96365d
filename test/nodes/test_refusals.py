"""Each refusal, caused by a message on a topic; the node processes the next frame after it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import String
from support.nodes_bench import (
    CAMERA,
    HEIGHT,
    LIMIT_S,
    STEP_NS,
    Bench,
    bench,
    camera_info,
    changed,
    depth,
    evidence,
    frame_graph,
    instances,
    local_graph,
    pose,
    rgb,
    send_frame,
    works,
)

from deworldsg_ros.nodes.graph_node import GraphNode
from deworldsg_ros.nodes.lifting_node import LiftingNode
from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.ros import joining, models
from deworldsg_ros.streams import frames
from deworldsg_ros.streams.poses import stamp_ns_of
from deworldsg_ros.wire import messages as wire


@pytest.fixture(scope="module")
def segmentation() -> Iterator[Bench]:
    with pytest.MonkeyPatch.context() as patch:
        # A busy machine delays the worker for longer. One test below is about this wait.
        patch.setattr(models, "MAX_BUSY_S", LIMIT_S)
        yield from bench(SegmentationNode, CAMERA)


SEGMENTATION_CASES = {
    "unknown_encoding": {"rgb__image_raw": changed(rgb, encoding="yuv422")},
    "bad_step": {"rgb__image_raw": changed(rgb, step=5)},
    "short_buffer": {"rgb__image_raw": changed(rgb, data=bytes(10))},
    "empty_image": {"rgb__image_raw": changed(rgb, width=0)},
    "grid_mismatch": {"depth__image_raw": lambda stamp_ns: depth(stamp_ns, HEIGHT // 2)},
    "invalid_intrinsics": {"rgb__camera_info": changed(camera_info, k=[0.0] * 9)},
    "invalid_pose": {"camera__pose": lambda stamp_ns: pose(stamp_ns, math.nan)},
    "wrong_frame": {"camera__pose": lambda stamp_ns: pose(stamp_ns, frame_id="odom")},
    "pose_jump": {"camera__pose": lambda stamp_ns: pose(stamp_ns, 50.0)},
    "no_depth": {"depth__image_raw": None},
    "stale": {"depth__image_raw": lambda stamp_ns: depth(stamp_ns - STEP_NS)},
}


@pytest.mark.parametrize("reason", SEGMENTATION_CASES)
def test_segmentation_refuses_and_continues(segmentation: Bench, reason: str) -> None:
    works(segmentation, lambda: send_frame(segmentation))

    def provoke() -> None:
        send_frame(segmentation, **SEGMENTATION_CASES[reason])
        send_frame(segmentation)

    segmentation.refuses(reason, provoke)
    works(segmentation, lambda: send_frame(segmentation))


def test_a_zero_quaternion_is_refused(segmentation: Bench) -> None:
    def zero(stamp_ns: int) -> PoseStamped:
        message = pose(stamp_ns)
        message.pose.orientation.w = 0.0
        return message

    segmentation.refuses("invalid_pose", lambda: send_frame(segmentation, camera__pose=zero))
    works(segmentation, lambda: send_frame(segmentation))


def test_an_image_without_a_near_pose_is_refused(segmentation: Bench) -> None:
    works(segmentation, lambda: send_frame(segmentation))

    def provoke() -> None:
        for _ in range(5):
            send_frame(segmentation, camera__pose=None)
        send_frame(segmentation)

    segmentation.refuses("no_pose", provoke)
    works(segmentation, lambda: send_frame(segmentation))


def test_a_restarted_recording_is_processed(segmentation: Bench) -> None:
    works(segmentation, lambda: send_frame(segmentation))
    segmentation.stamp_ns -= 100 * 10**9
    segmentation.refuses("time_jump", lambda: [send_frame(segmentation) for _ in range(2)])
    works(segmentation, lambda: [send_frame(segmentation) for _ in range(3)])


def test_an_unexpected_exception_is_counted_and_the_node_continues(
    segmentation: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(frame: Any) -> None:
        raise ZeroDivisionError("for the test")

    with monkeypatch.context() as patch:
        patch.setattr(segmentation.node._perception, "perceive", fail)
        segmentation.refuses("internal_error", lambda: send_frame(segmentation))
    works(segmentation, lambda: send_frame(segmentation))


def test_a_slow_node_drops_the_oldest_frames(
    segmentation: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It decodes only the frames that it processes, the newest among them."""
    begin = threading.Event()
    perceive, decode = segmentation.node._perception.perceive, frames.rgb_from_message
    processed: list[int] = []
    decoded: list[int] = []

    def wait(frame: Any) -> Any:
        assert begin.wait(LIMIT_S)
        processed.append(frame.stamp_ns)
        return perceive(frame)

    def note(message: Any) -> Any:
        decoded.append(stamp_ns_of(message))
        return decode(message)

    with monkeypatch.context() as patch:
        patch.setattr(segmentation.node._perception, "perceive", wait)
        patch.setattr(frames, "rgb_from_message", note)
        worker = segmentation.node._worker
        patch.setattr(worker, "_max_busy_s", 0.0)

        def provoke() -> None:
            for waiting in range(7):
                send_frame(segmentation)
                segmentation.expect(lambda n=waiting: worker.waiting >= n, "a frame")  # type: ignore[misc]
            begin.set()

        segmentation.refuses("overrun", provoke, 5)
        segmentation.expect(lambda: processed[-1:] == [segmentation.stamp_ns], "the newest")
        assert segmentation.node.wait_idle(LIMIT_S)
    assert processed == decoded
    works(segmentation, lambda: send_frame(segmentation))


def test_images_that_come_too_fast_are_left_to_dds(
    segmentation: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are not received, and they are counted."""
    begin = threading.Event()
    perceive = segmentation.node._perception.perceive

    def wait(frame: Any) -> Any:
        assert begin.wait(LIMIT_S)
        return perceive(frame)

    works(segmentation, lambda: send_frame(segmentation))
    before, drops = segmentation.products(), dict(segmentation.node.health.drops)
    with monkeypatch.context() as patch:
        patch.setattr(segmentation.node._perception, "perceive", wait)
        patch.setattr(joining, "TAKE_PERIOD_S", LIMIT_S)  # nothing while a frame waits
        for _ in range(12):
            send_frame(segmentation)
            segmentation.peer.spin_for(0.1)  # serves one message at a time
        begin.set()

        def lost() -> int:
            return segmentation.node.health.drops.get("lost_rgb", 0) - drops.get("lost_rgb", 0)

        segmentation.expect(
            lambda: segmentation.products() - before + lost() == 12, "each to be processed or lost"
        )
    assert lost() > 0
    works(segmentation, lambda: send_frame(segmentation))


@pytest.fixture(scope="module")
def lifting() -> Iterator[Bench]:
    topics = {name: kind for name, kind in CAMERA.items() if name != "rgb/image_raw"}
    topics |= {"deworldsg/frame_graph": String, "deworldsg/instances": Image}
    yield from bench(LiftingNode, topics)


def send_lifting(at: Bench, **changes: Any) -> None:
    makers = {
        "rgb__image_raw": None,
        "deworldsg__instances": instances,
        "deworldsg__frame_graph": frame_graph,
    }
    send_frame(at, **{**makers, **changes})


LIFTING_CASES = {
    "invalid_message": {"deworldsg__frame_graph": lambda stamp_ns: "{not json"},
    "unknown_schema": {
        "deworldsg__frame_graph": lambda stamp_ns: changed(
            frame_graph, schema=wire.Schema("frame_graph", 99)
        )(stamp_ns)
    },
    "unknown_instance": {"deworldsg__instances": lambda stamp_ns: instances(stamp_ns, 1)},
    "grid_mismatch": {"depth__image_raw": lambda stamp_ns: depth(stamp_ns, HEIGHT // 2)},
    "unknown_encoding": {"deworldsg__instances": changed(instances, encoding="mono8")},
    "no_instances": {"deworldsg__instances": None},
    "no_depth": {"depth__image_raw": None},
    "unmatched_depth": {"deworldsg__frame_graph": lambda stamp_ns: "{not json"},
}


@pytest.mark.parametrize("reason", LIFTING_CASES)
def test_lifting_refuses_and_continues(lifting: Bench, reason: str) -> None:
    works(lifting, lambda: send_lifting(lifting))

    def provoke() -> None:
        send_lifting(lifting, **LIFTING_CASES[reason])
        send_lifting(lifting)

    lifting.refuses(reason, provoke)
    works(lifting, lambda: send_lifting(lifting))


@pytest.fixture(scope="module")
def relation() -> Iterator[Bench]:
    made = Bench(
        RelationNode,
        {"rgb/image_raw": Image, "deworldsg/local_graph": String},
        # Without clips, the node does not listen to images.
        parameter_overrides=[Parameter("relations.world_model", value="fake")],
    )
    yield made
    made.close()


def send_relation(at: Bench, **changes: Any) -> None:
    stamp_ns = at.next_stamp()
    makers = {"rgb__image_raw": rgb, "deworldsg__local_graph": local_graph, **changes}
    at.send(**{name: make(stamp_ns) for name, make in makers.items() if make is not None})


RELATION_CASES = {
    "no_rgb": {"rgb__image_raw": None},
    "unmatched_rgb": {"deworldsg__local_graph": None},
    "invalid_message": {"deworldsg__local_graph": lambda stamp_ns: "[]"},
    "unknown_encoding": {"rgb__image_raw": changed(rgb, encoding="yuv422")},
}


@pytest.mark.parametrize("reason", RELATION_CASES)
def test_relation_refuses_and_continues(relation: Bench, reason: str) -> None:
    works(relation, lambda: send_relation(relation))

    def provoke() -> None:
        send_relation(relation, **RELATION_CASES[reason])
        send_relation(relation)

    relation.refuses(reason, provoke)
    works(relation, lambda: send_relation(relation))


@pytest.fixture(scope="module")
def graph() -> Iterator[Bench]:
    topics = {"deworldsg/local_graph": String, "deworldsg/relation_evidence": String}
    yield from bench(GraphNode, topics)


def send_graph(at: Bench, make: Callable[[int], Any] = local_graph) -> None:
    at.send(deworldsg__local_graph=make(at.next_stamp()))


GRAPH_CASES = {
    "wrong_frame": changed(local_graph, frame_id="odom"),
    "vocabulary_mismatch": changed(local_graph, predicates=["on", "under"]),
    "out_of_order": lambda stamp_ns: local_graph(stamp_ns - 2 * STEP_NS),
    "invalid_message": changed(local_graph, T_world_camera=[0.0] * 15),
}


@pytest.mark.parametrize("reason", GRAPH_CASES)
def test_graph_refuses_and_continues(graph: Bench, reason: str) -> None:
    works(graph, lambda: send_graph(graph))
    graph.refuses(reason, lambda: send_graph(graph, GRAPH_CASES[reason]))
    works(graph, lambda: send_graph(graph))


def test_evidence_of_an_unknown_frame_is_refused(graph: Bench) -> None:
    works(graph, lambda: send_graph(graph))
    stray = evidence(graph.stamp_ns - 1)
    graph.refuses("unknown_frame", lambda: graph.send(deworldsg__relation_evidence=stray))
    works(graph, lambda: send_graph(graph))


HOUR_NS = 3600 * 10**9


@pytest.mark.parametrize("jump_ns", [HOUR_NS, -HOUR_NS, -1_700_000_000 * 10**9])
def test_one_wrong_stamp_costs_one_local_graph(graph: Bench, jump_ns: int) -> None:
    works(graph, lambda: send_graph(graph))
    before = dict(graph.node.health.drops)

    def provoke() -> None:
        send_graph(graph, lambda stamp_ns: local_graph(stamp_ns + jump_ns))
        send_graph(graph)

    graph.refuses("time_jump", provoke)
    works(graph, lambda: send_graph(graph))
    assert graph.products() == graph.stamp_ns
    drops = graph.node.health.drops
    assert drops.get("out_of_order", 0) == before.get("out_of_order", 0)


def test_a_clock_that_was_set_back_is_followed(graph: Bench) -> None:
    works(graph, lambda: send_graph(graph))
    graph.stamp_ns -= HOUR_NS
    graph.refuses("time_jump", lambda: [send_graph(graph) for _ in range(2)])
    graph.expect(lambda: graph.products() == graph.stamp_ns, "the new time")
    works(graph, lambda: send_graph(graph))
    graph.stamp_ns += 2 * HOUR_NS
    send_graph(graph)
    works(graph, lambda: send_graph(graph))


def test_evidence_waits_for_its_frame(graph: Bench) -> None:
    works(graph, lambda: send_graph(graph))
    drops = dict(graph.node.health.drops)
    graph.send(deworldsg__relation_evidence=evidence(graph.stamp_ns + STEP_NS))
    graph.expect(lambda: len(graph.node.graph._pending) == 1, "the evidence to wait")
    works(graph, lambda: send_graph(graph))
    assert len(graph.node.graph._pending) == 0
    assert graph.node.health.drops == drops
