"""The four stages in one process, without ROS; the graph equals that of the four nodes."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ParamSpec, Protocol, TypeVar

from deworldsg_ros.base.timing import Times, timed, watch
from deworldsg_ros.checkpoints.catalogue import require_checkpoints
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived, Perception
from deworldsg_ros.relations.clips import LiveGraph
from deworldsg_ros.relations.stage import RelationReasoner, build_world_model
from deworldsg_ros.relations.world_model import require_predicates
from deworldsg_ros.scene.camera import RgbdFrame, UprightFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence
from deworldsg_ros.wire import messages as wire

if TYPE_CHECKING:
    from deworldsg_ros.relocalisation import Returning

# --- Work ahead of its use, in threads: bounded, in order, and ended with its consumer.

Item = TypeVar("Item")
Result = TypeVar("Result")

# A reader that waits for its consumer looks this often whether there still is one, seconds.
POLL_S = 0.1


def read_ahead(items: Iterable[Item], count: int) -> Iterator[Item]:
    """The items, read by a thread, at most `count` before they are taken.

    An error of `items` is raised after the items before it. If the iteration is closed, the thread
    ends after the item that it reads.
    """
    found: queue.Queue[tuple[Item] | BaseException | None] = queue.Queue(count)
    ended = threading.Event()

    def hand_over(entry: tuple[Item] | BaseException | None) -> bool:
        while not ended.is_set():
            try:
                found.put(entry, timeout=POLL_S)
            except queue.Full:
                continue
            return True
        return False

    def read() -> None:
        try:
            for item in items:
                if not hand_over((item,)):
                    return
        except BaseException as error:  # raised where the items are used
            hand_over(error)
        else:
            hand_over(None)

    reader = threading.Thread(target=read, name="read_ahead", daemon=True)
    reader.start()
    try:
        while (entry := found.get()) is not None:
            if isinstance(entry, BaseException):
                raise entry
            yield entry[0]
    finally:
        ended.set()
        reader.join()


def apply_ahead(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int
) -> Iterator[tuple[Item, Future[Result]]]:
    """Each item with the future result of a function of it, in order.

    The function runs in `threads` threads, for as many items besides the one that is in use, and
    one more. If the iteration is closed, items that wait are not started.
    """
    with ThreadPoolExecutor(threads, thread_name_prefix="apply_ahead") as pool:
        running: deque[tuple[Item, Future[Result]]] = deque()
        try:
            for item in items:
                running.append((item, pool.submit(function, item)))
                if len(running) > threads + 1:
                    yield running.popleft()
            while running:
                yield running.popleft()
        finally:
            for _, future in running:
                future.cancel()


# --- The four stages in one process, without ROS; the graph equals that of the four nodes.

P = ParamSpec("P")

# Methods of perception that are timed, with the names of their times.
PERCEPTION_PARTS = {"detect": "detection", "segment": "masks", "relate": "relation_inference"}
# Frames that are read before their detector runs. One is enough to keep the threads busy if all
# frames take equally long; more only need memory.
FRAMES_READ_AHEAD = 2


@dataclass(frozen=True)
class FrameResult:
    """The results of the stages for one frame.

    Attributes:
        perceived: 2D scene graph and instance labels.
        local: local 3D graph.
        node_ids: node of the global graph that each row of `local` became.
    """

    perceived: Perceived
    local: LocalGraph
    node_ids: list[int]


class Perceiver(Protocol):
    """Perception (stage a), as the pipeline uses it."""

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The 2D scene graph and the instance labels of `frame`."""
        ...


class Pipeline:
    """perceive → lift → merge → relate, for one frame at a time.

    Args:
        config: the whole configuration.
        perceiver: replaces the configured perception, e.g. by recorded detections.
        overlapped: whether `process_all` detects frames at the same time, where the detector can.

    Attributes:
        builder: keeps the global graph; None before the first frame, which gives the world frame.
        returning: to a map; then the graph waits apart until it is found there.
        drops: number of dropped inputs and objects, by reason.
        times_s: seconds of each frame in each stage, in each part of perception, and to
            read it (only `process_all`).
    """

    def __init__(
        self, config: Config, perceiver: Perceiver | None = None, *, overlapped: bool = False
    ) -> None:
        self.config = config
        require_checkpoints(config.perception if perceiver is None else None, config.relations)
        world_model = build_world_model(config.relations, config.perception.device)
        self.perception: Perceiver
        if perceiver is None:
            perception = build_perception(
                config.perception, world_up=config.inputs.world_up, overlapped=overlapped
            )
            require_predicates(world_model, perception.vocabulary.predicates)
            self.perception = perception
        else:  # recorded detections have their vocabulary in each frame
            self.perception = perceiver
        self.lifting = Lifting(config.lifting)
        self.relations = RelationReasoner(config.relations, world_model)
        self.builder: GraphBuilder | None = None
        self.returning: Returning | None = None
        self.drops: Counter[str] = Counter()
        self.times_s: dict[str, Times] = {
            name: Times() for name in ("reading", "perception", "lifting", "merging", "relations")
        }
        watch_parts(self.perception, self.times_s)

    def go_on_with(self, builder: GraphBuilder) -> None:
        """Continue with an existing graph, e.g. that of a map."""
        self.builder = builder
        self.relations.watch(LiveGraph(builder.graph))

    def process(self, frame: RgbdFrame) -> FrameResult:
        """Process one frame into the graph.

        Raises:
            RefusedInput: if the frame does not fit the earlier ones; the graph is unchanged.
        """
        self._follow(frame)
        with timed(self.times_s["perception"]):
            perceived = self.perception.perceive(frame)
        return self._add(frame, perceived)

    def process_all(
        self, frames: Iterable[RgbdFrame]
    ) -> Generator[tuple[RgbdFrame, FrameResult | RefusedInput], None, None]:
        """Process frames in order; each with its result, or with the reason why it was refused.

        The graph is the same as with `process`, but stages overlap: a thread reads the frames, and
        others detect objects in the next frames, while this thread does the rest of a frame. Close
        the iteration to end the threads.

        Args:
            frames: read by a thread.
        """
        frames = read_ahead(_timed(frames, self.times_s["reading"]), FRAMES_READ_AHEAD)
        perception = self.perception
        if not isinstance(perception, Perception) or not perception.detectors:
            for frame in frames:
                yield frame, _result_or_refusal(self.process, frame)
            return
        upright = map(perception.turn_upright, frames)
        for seen, detections in apply_ahead(self._detect, upright, perception.detectors):
            yield seen.original, _result_or_refusal(self._process_detected, seen, detections)

    def _detect(self, seen: UprightFrame) -> tuple[Detections, float]:
        """The detections of a frame, and the seconds that they took."""
        assert isinstance(self.perception, Perception)
        start = time.perf_counter()
        return self.perception.detect(seen.upright), time.perf_counter() - start

    def _process_detected(
        self, seen: UprightFrame, found: Future[tuple[Detections, float]]
    ) -> FrameResult:
        assert isinstance(self.perception, Perception)
        self._follow(seen.original)
        wait([found])
        start = time.perf_counter()
        perceived = self.perception.perceive_detected(seen, lambda: found.result()[0])
        self.times_s["perception"].append(time.perf_counter() - start + found.result()[1])
        return self._add(seen.original, perceived)

    def _follow(self, frame: RgbdFrame) -> None:
        """Correct the graph, also if the frame that closed a loop is refused afterwards."""
        if frame.trajectory is not None and self.builder is not None:
            self.builder.apply_trajectory(*frame.trajectory[:2])

    def _add(self, frame: RgbdFrame, perceived: Perceived) -> FrameResult:
        with timed(self.times_s["lifting"]):
            local = self.lifting.lift_frame(perceived.frame_graph, perceived.instances, frame)
        returning = self.returning
        if self.builder is None:
            begin = partial(GraphBuilder, self.config) if returning is None else returning.begin
            self.go_on_with(begin(local.vocabulary, local.frame_id))
        assert self.builder is not None
        with timed(self.times_s["merging"]):
            node_ids = self.builder.integrate(local)
            self.drops.update(self.builder.refused.keys())
            if returning is not None and returning.waits:
                node_ids = self._return(returning, local, node_ids)
        with timed(self.times_s["relations"]):
            self._add_evidence(self.relations.observe(local, frame.rgb))
            for evidence in self.relations.drain():
                self._add_evidence(evidence)
        self.drops.update(perceived.drops)
        self.drops.update(local.drops)
        return FrameResult(perceived, local, node_ids)

    def _return(self, returning: Returning, local: LocalGraph, node_ids: list[int]) -> list[int]:
        """Continue the map if the graph is found in it; returns the node ids of the frame."""
        assert self.builder is not None
        continued = returning.note(self.builder, local)
        if continued is None:
            return node_ids
        self.go_on_with(continued)
        self.drops.update(returning.refused)
        return continued.graph.nodes_of_frame(local.stamp_ns) or [0] * len(local)

    def _add_evidence(self, evidence: RelationEvidence) -> None:
        assert self.builder is not None
        self.builder.add_evidence(evidence)
        if self.returning is not None:
            self.returning.note_evidence(evidence)

    def graph(self) -> wire.SceneGraphMessage:
        """The whole graph so far, with surface points, and things if they are configured.

        Raises:
            RefusedInput: ``no_frames`` before the first frame.
        """
        if self.builder is None:
            raise RefusedInput("no_frames", "there is no graph: no frame was processed")
        self.builder.find_things()
        return self.builder.full()


def watch_parts(perceiver: Perceiver, times_s: dict[str, Times]) -> None:
    """Time the parts of perception from now on; other perceivers have no parts."""
    if isinstance(perceiver, Perception):
        for method, name in PERCEPTION_PARTS.items():
            watch(perceiver, method, times_s.setdefault(name, Times()))


def _timed(frames: Iterable[RgbdFrame], times_s: Times) -> Iterator[RgbdFrame]:
    """The frames; the time to read each is appended."""
    start = time.perf_counter()
    for frame in frames:
        times_s.append(time.perf_counter() - start)
        yield frame
        start = time.perf_counter()


def _result_or_refusal(
    process: Callable[P, FrameResult], *args: P.args, **kwargs: P.kwargs
) -> FrameResult | RefusedInput:
    try:
        return process(*args, **kwargs)
    except RefusedInput as refusal:
        return refusal
