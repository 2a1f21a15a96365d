"""Stages of a node with models, which may raise, hang or be lost: the others go on without them."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, TimeoutError
from dataclasses import replace
from typing import Any

import msgspec

from deworldsg_ros.checkpoints.cards import graph_predicates
from deworldsg_ros.checkpoints.catalogue import require_checkpoints
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.relations.clips import PublishedGraph
from deworldsg_ros.relations.stage import EvidenceWorker, RelationReasoner, build_world_model
from deworldsg_ros.relations.world_model import require_predicates
from deworldsg_ros.ros.health import TURNED
from deworldsg_ros.ros.inputs import (
    WANTED_DEPTH,
    listen_camera_info,
    listen_depth,
    listen_detections,
    listen_pose,
    listen_rgb,
)
from deworldsg_ros.ros.joining import MAX_BUSY_S, JoiningNode
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import RelationEvidence
from deworldsg_ros.streams.frames import FrameAssembler, PairingFrame
from deworldsg_ros.wire import messages as wire

# --- Models of a node that may raise, hang or be lost: their stage goes on without them.
#
# Every call of a model runs in a thread of its own and has a time limit. A model that fails again
# and again is loaded again, on the CPU. Faults can be injected, to try what the robot does then.

PARTS = ("detector", "segmenter", "relation_head", "embedder", "world_model")
# The slowest step of perception, a large network on a CPU, takes seconds.
PERCEPTION_LIMIT_S = 30.0
# A clip of the largest world model takes a minute on a CPU.
WORLD_MODEL_LIMIT_S = 300.0
# An image that a model cannot take is followed by others that it can: its model is not at fault.
RELOAD_AFTER_FAILURES = 3
# Between two attempts to load a model again, which takes seconds.
RELOAD_PERIOD_S = 5.0
# A call that takes longer than this many times its limit counts as hung. Python cannot end a
# thread: the process has to be started again.
HUNG_LIMITS = 2
# /diagnostics warns about a call that takes longer.
SLOW_S = 5.0
# Methods whose result a stage waits for.
CALLS = ("detect", "segment", "relate", "predict", "embed")


class ModelError(Exception):
    """A model hangs or is missing."""


class Supervised:
    """A model whose calls raise an exception rather than hang.

    Other attributes are those of the model. If a call takes longer than `limit_s`, it is abandoned;
    until it returns, further calls fail at once.

    Args:
        name: for messages.
        model: detector, segmenter, relation head or world model.
        limit_s: maximum time of a call.
        reload: loads the model again and calls `replace`; it may raise.
    """

    def __init__(self, name: str, model: Any, limit_s: float, reload: Callable[[], None]) -> None:
        self._name = name
        self._model = model
        self._limit_s = limit_s
        self._reload = reload
        self._failures = 0
        self._tried_s = -RELOAD_PERIOD_S
        self._error = ""
        self._call: Future[Any] | None = None
        self._since_s = 0.0
        self._calls: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = queue.SimpleQueue()
        # A daemon: a model that never returns cannot keep the process alive.
        threading.Thread(target=self._serve, name=name, daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        if name not in CALLS:
            return getattr(self._model, name)
        return lambda *arguments: self._watch(name, arguments)

    def replace(self, model: Any) -> None:
        """Use another model from now on."""
        self._model, self._failures = model, 0

    def hung(self) -> str:
        """The fault of a model that never returns, in words; "" = it may return."""
        call, busy_s = self._call, time.monotonic() - self._since_s
        if call is None or call.done() or busy_s < HUNG_LIMITS * self._limit_s:
            return ""
        return (
            f"the {self._name} ({type(self._model).__name__}) has given no result for "
            f"{busy_s:.0f} s: start the node again"
        )

    def problem(self) -> str:
        """The fault, in words; "" = none."""
        if hung := self.hung():
            return hung
        call, busy_s = self._call, time.monotonic() - self._since_s
        if call is not None and busy_s > SLOW_S:
            return f"the {self._name} has given no result for {busy_s:.0f} s"
        return f"the {self._name} fails: {self._error}" if self._error else ""

    def _watch(self, name: str, arguments: tuple[Any, ...]) -> Any:
        call = self._call
        if call is not None:
            if not call.done():
                raise ModelError(self.problem() or f"the {self._name} is busy")
            self._call = None
        try:
            self._load_again()
            result = self._run(lambda: getattr(self._model, name)(*arguments))
        except Exception as error:
            self._failures += 1
            self._error = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise
        self._failures, self._error = 0, ""
        return result

    def _load_again(self) -> None:
        """Load a model that keeps failing; at most every RELOAD_PERIOD_S."""
        now_s = time.monotonic()
        if self._failures >= RELOAD_AFTER_FAILURES and now_s - self._tried_s >= RELOAD_PERIOD_S:
            self._tried_s = now_s
            self._reload()

    def _run(self, function: Callable[[], Any]) -> Any:
        call: Future[Any] = Future()
        self._call, self._since_s = call, time.monotonic()
        self._calls.put((call, function))
        try:
            result = call.result(self._limit_s)
        except TimeoutError as error:
            if call.done():  # the model itself raised it
                self._call = None
                raise
            raise ModelError(f"no result in {self._limit_s:g} s: the call is abandoned") from error
        except Exception:
            self._call = None
            raise
        self._call = None
        return result

    def _serve(self) -> None:
        while True:
            call, function = self._calls.get()
            try:
                call.set_result(function())
            except BaseException as error:
                call.set_exception(error)


# --- A node that takes the camera's frames and runs perception on them.


class PerceivingNode(JoiningNode[RgbdFrame]):
    """Stage a on the frames of the camera, for segmentation_node and deworldsg_node.

    Args:
        name: node name.
        product: name of the output in /diagnostics.
        options: arguments of rclpy's Node.
    """

    LIVE: tuple[str, ...] = (
        "perception.score_threshold",
        "perception.max_relations",
        "perception.words",
    )

    def __init__(self, name: str, product: str, **options: Any) -> None:
        super().__init__(name, product, max_busy_s=MAX_BUSY_S, **options)
        inputs = self.parameters.inputs
        require_checkpoints(self.parameters.perception)
        self._perception = build_perception(self.parameters.perception, world_up=inputs.world_up)
        self._models: dict[str, Supervised] = {}

        def supervise(part: str, backend: Any) -> Supervised:
            name = part.replace("_", " ")
            self._models[part] = Supervised(name, backend, PERCEPTION_LIMIT_S, self._reload)
            return self._models[part]

        self._perception.watch(supervise)
        self._with_detections = self.parameters.perception.detector == "topic"
        self._frames = FrameAssembler(
            inputs, **self.assembler_options(), with_detections=self._with_detections
        )
        self._turns: Counter[int] = Counter()

    def listen_to_camera(self, work: Callable[[RgbdFrame], None]) -> None:
        """Subscribe to the camera, and call `work` with each complete frame."""
        frames = self._frames
        self.join(frames, work)
        listen_camera_info(self, self.taking(frames.add_camera_info))
        listen_pose(self, frames)
        if self._with_detections:
            listen_detections(self, frames)
        listen_depth(self, self.taking(frames.add_depth), self.wants_depth, WANTED_DEPTH)
        listen_rgb(self, self.taking(frames.add_rgb), self.wants_images, WANTED_DEPTH)

    def check(self, parameters: Any) -> None:
        """Refuse words that the detector cannot look for."""
        self._perception.check(parameters.perception)

    def configure(self) -> None:
        """Take changed parameters."""
        self._perception.configure(self.parameters.perception)

    def waiting_for(self, now_ns: int) -> list[str]:
        """Missing inputs, and models that fail or hang, in words."""
        problems = [model.problem() for model in self._models.values()]
        return [*super().waiting_for(now_ns), *filter(None, problems)]

    def hung(self) -> str:
        """A model that never returns, in words."""
        return next(filter(None, (model.hung() for model in self._models.values())), "")

    def _reload(self) -> None:
        """Load all models again, on the CPU: a GPU that failed once fails for this process."""
        config = msgspec.structs.replace(self.parameters.perception, device="cpu")
        self.get_logger().warning("loading the models again, on the CPU")
        fresh = build_perception(config, world_up=self.parameters.inputs.world_up)
        fresh.take_over(self._perception, config)
        fresh.watch(lambda part, backend: self._models[part].replace(backend))

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The results of a frame, in the camera's frame; failures and drops are counted."""
        perceived = self._perception.perceive(frame)
        self._turns[perceived.turns] += 1
        self.health.left_out(perceived.drops)
        for reason, message in perceived.failures.items():
            self.drop(reason, message)
        graph = replace(perceived.frame_graph, frame_id=self._frames.camera_frame)
        return replace(perceived, frame_graph=graph)

    def more_values(self) -> dict[str, str]:
        """Frames that were turned upright for the detector, by angle."""
        turns = self._turns.copy()  # the thread of the frames adds to them
        turned = {f"{TURNED}{90 * n} degrees": str(k) for n, k in turns.items() if n}
        return {**super().more_values(), **turned}


# --- Relations of frames in a node: pairs at once, predictions from the world model's thread.


class Relating:
    """Stage d, for relation_node and deworldsg_node.

    Args:
        node: gives the parameters and the log.
        deliver: called with the evidence of each frame, and in another thread with each prediction.

    Attributes:
        graph: the published graph, which selects the pairs for the world model.
        needs_images: whether the world model cuts clips from images.
        follows_graph: whether the clips depend on the published graph: `learn` its updates.
    """

    def __init__(self, node: StageNode, deliver: Callable[[RelationEvidence], None]) -> None:
        config = node.parameters.relations
        report = node.get_logger().warning
        require_checkpoints(relations=config)
        world_model: Any = build_world_model(config, node.parameters.perception.device)
        if world_model is not None:
            world_model = Supervised("world model", world_model, WORLD_MODEL_LIMIT_S, self._reload)
        self._config, self._model = config, world_model
        predicates = graph_predicates(node.parameters.perception)
        if predicates is not None:  # else the first local graph contains them
            require_predicates(world_model, predicates)
        self._deliver = deliver
        self._reasoner = RelationReasoner(config, world_model, report)
        self._world_model = EvidenceWorker(self._reasoner, deliver, report)
        self._world_model.start()
        self._newest_ns = 0
        self.graph = PublishedGraph()
        self.needs_images = world_model is not None
        self.follows_graph = self.needs_images and config.max_clips_per_s > 0
        if self.follows_graph:
            self._reasoner.watch(self.graph)

    def configure(self, config: RelationsConfig) -> None:
        """Use another threshold and another rate from the next frame on."""
        self._reasoner.configure(config)

    def problems(self) -> list[str]:
        """The fault of the world model, in words."""
        return [] if self._model is None else list(filter(None, [self._model.problem()]))

    def hung(self) -> str:
        """A world model that never returns, in words."""
        return "" if self._model is None else str(self._model.hung())

    def _reload(self) -> None:
        """Load the world model again, on the CPU."""
        self._model.replace(build_world_model(self._config, "cpu"))

    def relate(self, frame: PairingFrame) -> None:
        """Deliver the evidence of a frame; queue its clips."""
        if frame.local.stamp_ns < self._newest_ns:  # a recording was restarted
            self._reasoner.clear()
        self._newest_ns = frame.local.stamp_ns
        self._deliver(self._world_model.observe(frame.local, frame.rgb))

    def apply(self, update: wire.SceneGraphUpdateMessage) -> None:
        """Note an update of the published graph."""
        self._world_model.learn(lambda: self.graph.apply(update))

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Take the published graph from a snapshot."""
        self._world_model.learn(lambda: self.graph.reset(snapshot))

    def values(self) -> dict[str, str]:
        """Numbers of clips by their state, for /diagnostics."""
        counters = self._reasoner.counters()
        clips = {"queued": counters.queued, "encoded": counters.encoded}
        clips["pending"] = counters.ready
        clips["waiting"] = counters.pending - counters.ready
        clips.update((f"dropped {reason}", n) for reason, n in sorted(counters.dropped.items()))
        return {f"clips {name}": str(count) for name, count in clips.items()}

    def close(self) -> None:
        """End the world model's thread."""
        self._world_model.stop()
