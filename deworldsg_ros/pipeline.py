"""The four stages in one process, without ROS; the graph equals that of the four nodes."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import ParamSpec, Protocol

from deworldsg_ros.ahead import apply_ahead, read_ahead
from deworldsg_ros.checkpoints.required import require_checkpoints
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived, Perception
from deworldsg_ros.perception.upright import UprightFrame
from deworldsg_ros.relations.graph_view import LiveGraph
from deworldsg_ros.relations.registry import build_world_model
from deworldsg_ros.relations.stage import RelationReasoner
from deworldsg_ros.relations.world_model import require_predicates
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.timing import Times, timed, watch

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
        wait([found])
        start = time.perf_counter()
        perceived = self.perception.perceive_detected(seen, lambda: found.result()[0])
        self.times_s["perception"].append(time.perf_counter() - start + found.result()[1])
        return self._add(seen.original, perceived)

    def _add(self, frame: RgbdFrame, perceived: Perceived) -> FrameResult:
        with timed(self.times_s["lifting"]):
            local = self.lifting.lift_frame(perceived.frame_graph, perceived.instances, frame)
        if self.builder is None:
            self.go_on_with(GraphBuilder(self.config, local.vocabulary, local.frame_id))
        assert self.builder is not None
        with timed(self.times_s["merging"]):
            node_ids = self.builder.integrate(local)
        with timed(self.times_s["relations"]):
            self.builder.add_evidence(self.relations.observe(local, frame.rgb))
            for evidence in self.relations.drain():
                self.builder.add_evidence(evidence)
        self.drops.update(perceived.drops)
        self.drops.update(local.drops)
        return FrameResult(perceived, local, node_ids)

    def graph(self) -> wire.SceneGraphMessage:
        """The whole graph so far, with surface points.

        Raises:
            RefusedInput: ``no_frames`` before the first frame.
        """
        if self.builder is None:
            raise RefusedInput("no_frames", "there is no graph: no frame was processed")
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
