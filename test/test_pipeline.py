"""The four stages composed: frames in, one consistent graph and its updates out."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from support.failing_backend import Backend
from support.scripted import INTRINSICS, PAPER, VOCABULARY, Scripted, frame

from deworldsg_ros.config import Config, MergingConfig, RelationsConfig
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.perception.stage import Perception
from deworldsg_ros.pipeline import (
    PERCEPTION_PARTS,
    FrameResult,
    Pipeline,
    apply_ahead,
    read_ahead,
)
from deworldsg_ros.relations.stage import RelationReasoner, build_world_model
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, Vocabulary
from deworldsg_ros.wire import messages as wire

ASKING = msgspec.structs.replace(
    PAPER,
    relations=RelationsConfig(world_model="fake", edge_belief="paper"),
)


def local_graph(index: int) -> LocalGraph:
    seen = frame(index)
    perceived = Scripted().perceive(seen)
    return Lifting(PAPER.lifting).lift(
        perceived.frame_graph,
        perceived.instances,
        seen.depth_m,
        INTRINSICS,
        seen.T_world_camera,
        "map",
    )


@pytest.mark.parametrize("association", ["paper", "surface"])
def test_a_camera_that_stands_still_for_200_frames_sees_one_node_an_object(
    association: str,
) -> None:
    # All objects are at one depth: only the sum of Eq. 9 says that one is on the other.
    relations = RelationsConfig(edge_belief="paper", world_model="none")
    config = Config(merging=MergingConfig(association=association), relations=relations)
    pipeline = Pipeline(config, Scripted())
    for index in range(200):
        result = pipeline.process(frame(index))
        assert result.node_ids == [1, 2, 3]
    graph = pipeline.graph()
    assert [node.label for node in graph.nodes] == ["cup", "table", "chair"]
    assert [node.observations for node in graph.nodes] == [200, 200, 200]
    assert all(len(surface_points(node)) for node in graph.nodes)
    (edge,) = graph.edges
    assert (edge.subject, edge.object, edge.predicate, edge.provenance) == (1, 2, "on", "visual")
    assert edge.observations == 200
    assert edge.probability > 0.999


def test_evidence_that_comes_late_gives_the_same_graph() -> None:
    # Without a graph the reasoner encodes every clip; so must the pipeline.
    every_clip = msgspec.structs.replace(ASKING.relations, max_clips_per_s=0.0)
    config = msgspec.structs.replace(ASKING, relations=every_clip)
    pipeline = Pipeline(config, Scripted())
    late = GraphBuilder(config, VOCABULARY, "map")
    reasoner = RelationReasoner(every_clip, build_world_model(every_clip))
    evidence = []
    for index in range(8):
        pipeline.process(frame(index))
        late.integrate(local_graph(index))
        evidence.append(reasoner.observe(local_graph(index), frame(index).rgb))
        evidence += reasoner.drain()
    for item in reversed(evidence):
        late.add_evidence(item)
    now, then = pipeline.graph(), late.full()
    assert now.nodes == then.nodes
    assert [(e.subject, e.object, e.predicate, e.provenance) for e in now.edges] == [
        (e.subject, e.object, e.predicate, e.provenance) for e in then.edges
    ]
    for one, other in zip(now.edges, then.edges):
        assert one.probability == pytest.approx(other.probability, abs=1e-12)


def test_a_late_update_contains_the_remembered_frames_only() -> None:
    builder = GraphBuilder(PAPER, VOCABULARY, "map")
    seen = local_graph(0)
    for stamp_ns in range(1100):
        builder.integrate(replace(seen, stamp_ns=stamp_ns))
    update = builder.update()
    assert update is not None and len(update.associations) == builder.graph.remembered_frames
    assert wire.ns_from_stamp(update.associations[-1].stamp) == 1099


def test_evidence_of_an_unknown_frame_or_vocabulary_is_refused() -> None:
    evidence = RelationReasoner(PAPER.relations, None).observe(local_graph(0), frame(0).rgb)
    names = VOCABULARY
    other, fewer = Vocabulary(names.classes, ("on",)), Vocabulary(("cup",), names.predicates)
    mismatch = "vocabulary_mismatch"
    for known, reason in ((names, "unknown_frame"), (other, mismatch), (fewer, mismatch)):
        with pytest.raises(RefusedInput) as refused:
            GraphBuilder(PAPER, known, "map").add_evidence(evidence)
        assert refused.value.reason == reason
    with pytest.raises(RefusedInput, match="no frame was processed"):
        Pipeline(PAPER, Scripted()).graph()


# --- work ahead of its use -----------------------------------------------------------------------


def wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(500):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("it did not happen within 5 s")


def threads_ahead() -> list[str]:
    return [t.name for t in threading.enumerate() if "_ahead" in t.name]


def test_reading_is_in_another_thread_and_bounded() -> None:
    taken: list[int] = []
    threads = set()

    def items() -> Iterator[int]:
        for item in range(100):
            threads.add(threading.current_thread())
            taken.append(item)
            yield item

    ahead = read_ahead(items(), 2)
    assert next(ahead) == 0
    # One is used, two wait, and the thread holds one more.
    wait_until(lambda: len(taken) == 4)
    time.sleep(0.05)
    assert len(taken) == 4 and threading.current_thread() not in threads
    ahead.close()
    assert threads_ahead() == []


def test_errors_come_with_their_items() -> None:
    def items() -> Iterator[int]:
        yield from (1, 2)
        raise OSError("the disk is gone")

    seen = []
    with pytest.raises(OSError, match="the disk is gone"):
        for item in read_ahead(items(), 5):
            seen.append(item)
    assert seen == [1, 2]
    found = [
        (item, future.exception()) for item, future in apply_ahead((4).__floordiv__, [0, 2], 2)
    ]
    assert isinstance(found[0][1], ZeroDivisionError) and found[1] == (2, None)


def test_an_interrupt_of_the_consumer_ends_all_threads() -> None:
    started: list[int] = []

    def slow(item: int) -> int:
        started.append(item)
        time.sleep(0.05)
        return item

    with pytest.raises(KeyboardInterrupt):
        for item, _ in apply_ahead(slow, read_ahead(iter(range(1000)), 2), 2):
            if item == 3:
                raise KeyboardInterrupt
    wait_until(lambda: threads_ahead() == [])
    assert len(started) < 12


class Slowest:
    """A detector whose first frames take longest, and whose third one fails."""

    classes = ("table", "cup")
    default_score_threshold = 0.5

    def __init__(self) -> None:
        self.threads: set[threading.Thread] = set()

    def detect(self, rgb, score_threshold):  # type: ignore[no-untyped-def]
        number = int(rgb[0, 0, 0])
        self.threads.add(threading.current_thread())
        time.sleep(0.002 * (5 - number))
        if number == 2:
            raise RuntimeError("CUDA out of memory")
        return Backend().detect(rgb, score_threshold)


def overlapped_pipeline(detectors: int) -> tuple[Pipeline, Slowest]:
    detector, backend = Slowest(), Backend()
    perception = Perception(detector, backend, backend, PAPER.perception, detectors=detectors)
    return Pipeline(PAPER, perception), detector


def numbered_frames(count: int) -> list[RgbdFrame]:
    frames = [frame(index) for index in range(count)]
    return [
        replace(seen, rgb=np.full_like(seen.rgb, index), depth_m=np.full_like(seen.depth_m, 1.5))
        for index, seen in enumerate(frames)
    ]


@pytest.mark.parametrize("detectors", [0, 1, 2])
def test_overlapped_stages_give_the_same_results_in_order(detectors: int, caplog) -> None:  # type: ignore[no-untyped-def]
    frames = numbered_frames(5)
    frames.insert(4, frames[1])  # not newer than those before it
    alone, _ = overlapped_pipeline(0)
    expected: list[FrameResult | str] = []
    for seen in frames:
        try:
            expected.append(alone.process(seen))
        except RefusedInput as refusal:
            expected.append(refusal.reason)
    together, detector = overlapped_pipeline(detectors)
    results = list(together.process_all(iter(frames)))
    assert [seen for seen, _ in results] == frames
    assert expected[2] == "detector_error" and expected[4] == "out_of_order"
    for (_, found), wanted in zip(results, expected):
        if isinstance(found, RefusedInput):
            assert found.reason == wanted
        else:
            assert isinstance(wanted, FrameResult)
            assert found.node_ids == wanted.node_ids
            np.testing.assert_array_equal(found.local.means_world, wanted.local.means_world)
    assert together.graph() == alone.graph()
    assert together.drops == alone.drops
    assert len(detector.threads) <= max(1, detectors)
    assert (threading.current_thread() in detector.threads) == (detectors == 0)
    for part in ("reading", "perception", "lifting", "merging", "relations"):
        assert together.times_s[part].count == {"reading": 6, "perception": 5, "lifting": 5}.get(
            part, 4
        )
    assert all(callable(getattr(Perception, method)) for method in PERCEPTION_PARTS)
    # The time of perception includes that of its detector, wherever that ran.
    assert together.times_s["perception"].total_s > together.times_s["masks"].total_s + 0.002 * 9
