"""Stage d on a stream of frames: neighbour pairs at once, predictions when time allows."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from deworldsg_ros.base.plugins import PluginError, load_plugin
from deworldsg_ros.checkpoints.cards import Crop
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.clips import (
    BoxPair,
    ClipPolicy,
    ClipQueue,
    FrameBuffer,
    GraphView,
    QueuedClip,
    Rgb,
    clip_regions,
    crop_clip,
    interval_start,
    union_box,
)
from deworldsg_ros.relations.paper import neighbour_pairs
from deworldsg_ros.relations.world_model import ClipRequest, FakeWorldModel, PairContext, WorldModel
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence
from deworldsg_ros.scene.limits import MAX_PREDICTION_SUM_ERROR

# --- One clip at a time through the world model, with its output checked.


class ClipEncoder:
    """Runs the world model on clips. A failure of the model costs one clip and nothing else.

    Args:
        world_model: encodes the clips.
        report: called with one sentence on each new failure; default: the log.

    Attributes:
        failure: reason of the last failure: that of a refusal, else ``world_model_error``.
    """

    def __init__(
        self, world_model: WorldModel, report: Callable[[str], None] | None = None
    ) -> None:
        self._world_model = world_model
        self._report = logging.getLogger(__name__).warning if report is None else report
        self._last_report = ""
        self.failure = ""

    def encode(self, clip: QueuedClip, images: list[Rgb]) -> RelationEvidence | None:
        """Predictions for both directions of a clip's pair; None if the world model failed.

        Args:
            clip: a queued clip.
            images: its frames, oldest first; not used if the clip holds its pixels.
        """
        request = clip_request(clip, images, self._world_model.clip_length)
        try:
            predictions = checked_distributions(
                self._world_model.predict(request),
                len(request.pairs),
                len(request.vocabulary.predicates),
            )
        except Exception as error:  # a backend may raise anything; the other stages go on
            self.failure = "world_model_error"
            if isinstance(error, RefusedInput):
                self.failure = error.reason
            self._report_once(
                f"world model '{self._world_model.name}' failed: {type(error).__name__}: {error}"
            )
            return None
        i, j = clip.rows
        return RelationEvidence(
            stamp_ns=clip.stamp_ns,
            vocabulary=clip.vocabulary,
            pairs=np.array([[i, j], [j, i]], np.int64),
            pair_classes=np.array([clip.classes, clip.classes[::-1]], np.int64),
            geo_costs=np.full(2, clip.geo_cost),
            predictions=predictions,
            source=self._world_model.name,
        )

    def _report_once(self, message: str) -> None:
        """Report a failure unless it repeats the last one; the caller counts all of them."""
        if message != self._last_report:
            self._last_report = message
            self._report(message)


def clip_request(clip: QueuedClip, images: list[Rgb], clip_length: int) -> ClipRequest:
    """The pixels of a queued clip and both directions of its pair, in pixels of the crop."""
    x1, y1, _, _ = clip.regions_xyxy[-1]
    boxes = [box - np.array([x1, y1, x1, y1], np.float64) for box in clip.boxes_xyxy]
    names = [clip.vocabulary.classes[index] for index in clip.classes]
    directions = tuple(
        PairContext(
            subject_box_xyxy=boxes[subject],
            object_box_xyxy=boxes[object_],
            subject_class=clip.classes[subject],
            object_class=clip.classes[object_],
            subject_name=names[subject],
            object_name=names[object_],
        )
        for subject, object_ in ((0, 1), (1, 0))
    )
    pixels = clip.pixels
    if pixels is None:
        pixels = crop_clip(images, clip.regions_xyxy, clip_length)
    return ClipRequest(pixels, directions, clip.vocabulary)


def checked_distributions(output: Float64, pair_count: int, predicate_count: int) -> Float64:
    """A world model's output as float64 rows that sum to one.

    Args:
        output: (pair_count, predicate_count), any float type; sums within
            `MAX_PREDICTION_SUM_ERROR` of one.
        pair_count: rows expected.
        predicate_count: columns expected.

    Raises:
        ValueError: another shape, or rows that are not distributions.
    """
    values = np.asarray(output, dtype=np.float64)
    if values.shape != (pair_count, predicate_count):
        raise ValueError(
            f"output has shape {values.shape}: expected {(pair_count, predicate_count)}"
        )
    sums = values.sum(axis=1)
    if (
        not (np.isfinite(values).all() and (values >= 0).all())
        or (np.abs(sums - 1) > MAX_PREDICTION_SUM_ERROR).any()
    ):
        raise ValueError(
            f"output is {values.tolist()}: expected rows >= 0 that sum to one, one per pair"
        )
    distributions: Float64 = values / sums[:, None]
    return distributions


# --- Stage d on a stream of frames: neighbour pairs at once, predictions when time allows.

# Length of the frame buffer, in clip lengths. With 2, a clip can still be cut from the buffer one
# whole clip length of frames after it was queued.
BUFFERED_CLIP_LENGTHS = 2
# Clips that may wait. Four frames with 12 objects, all neighbours, give 264.
QUEUE_SIZE = 256


@dataclass(frozen=True)
class RelationCounters:
    """Numbers of clips since the start.

    Attributes:
        queued: clips put into the queue.
        pending: clips that wait now.
        ready: pending clips that wait only for the world model. The others wait for the graph, for
            their nodes to be confirmed, or for the budget.
        encoded: clips with predictions.
        dropped: clips that were not encoded, by reason: the reasons of `ClipPolicy.judge` and
            `ClipQueue`; ``world_model_error`` (the world model failed), ``nan_features`` (its
            features are not numbers); ``cleared`` (by `clear`);
            ``no_frame`` (never queued: the frame's image came too late or has another size).
    """

    queued: int
    pending: int
    ready: int
    encoded: int
    dropped: dict[str, int]


class RelationReasoner:
    """Finds neighbour pairs (Eq. 8) and lets the world model predict their predicates.

    `observe` never waits for the world model. `work` may be called in another thread.

    Args:
        config: section ``relations`` of the configuration.
        world_model: None finds neighbour pairs only, keeps no image and queues no clip.
        report: called with one sentence on each new failure of the world model; default: the log.
        queue_size: clips that may wait.

    Raises:
        ConfigurationError: the world model's clip length differs from the configured one.
    """

    def __init__(
        self,
        config: RelationsConfig,
        world_model: WorldModel | None,
        report: Callable[[str], None] | None = None,
        *,
        queue_size: int = QUEUE_SIZE,
    ) -> None:
        if world_model is not None and world_model.clip_length != config.clip_length:
            raise ConfigurationError(
                f"relations.clip_length is {config.clip_length}: world model "
                f"'{world_model.name}' expects {world_model.clip_length}; set it to that"
            )
        self.source = "none" if world_model is None else world_model.name
        self._config = config
        self._encoder = None if world_model is None else ClipEncoder(world_model, report)
        self._valid_only = getattr(world_model, "window", "") == "valid_interval"
        self._crop: Crop = getattr(world_model, "crop", "last_frame")
        self._graph: GraphView | None = None
        self._lock = threading.Lock()
        self._frames = FrameBuffer(BUFFERED_CLIP_LENGTHS * config.clip_length)
        self._queued = 0
        self._encoded = 0
        self._dropped: Counter[str] = Counter()
        self._policy = ClipPolicy(config)
        self._queue = ClipQueue(queue_size, self._policy, self._drop)

    def configure(self, config: RelationsConfig) -> None:
        """Use another `geo_cost_threshold` and `max_clips_per_s` from the next frame on."""
        with self._lock:
            self._config = config
            self._policy.limit(config.max_clips_per_s)

    def watch(self, graph: GraphView) -> None:
        """Choose clips by the state of this graph from now on."""
        with self._lock:
            self._graph = graph
            self._policy.watch(graph)

    def learn(self, change: Callable[[], None]) -> None:
        """Change the watched graph while no other thread reads it."""
        with self._lock:
            change()

    def observe(self, local: LocalGraph, rgb: Rgb) -> RelationEvidence:
        """Find the neighbour pairs of a frame (Eq. 8) and queue their clips.

        Args:
            local: the frame's local graph.
            rgb: the frame's image, (H, W, 3) uint8. It is kept by reference: do not change it.

        Returns:
            both directions of every neighbour pair, without predictions.
        """
        pairs, costs = neighbour_pairs(
            local.boxes_xyxy,
            local.depths_m,
            local.width,
            local.height,
            self._config.geo_cost_threshold,
        )
        classes = local.class_probabilities.argmax(axis=1).astype(np.int64)[pairs].reshape(-1, 2)
        if self._encoder is not None:
            self._queue_clips(local, rgb, pairs, classes, costs)
        return RelationEvidence(
            stamp_ns=local.stamp_ns,
            vocabulary=local.vocabulary,
            pairs=pairs,
            pair_classes=classes,
            geo_costs=costs,
            predictions=np.full((len(pairs), len(local.vocabulary.predicates)), np.nan),
            source=self.source,
        )

    def work(self) -> RelationEvidence | None:
        """Encode the first clip that is ready.

        Returns:
            predictions for both directions of the clip's pair, as rows of the local graph with the
            same stamp; None if no clip is ready.
        """
        while self._encoder is not None and (taken := self._take()) is not None:
            # The world model is slow: it runs outside of the lock.
            evidence = self._encoder.encode(*taken)
            with self._lock:
                if evidence is not None:
                    self._encoded += 1
                    return evidence
                self._drop(self._encoder.failure)
        return None

    def drain(self) -> list[RelationEvidence]:
        """Encode all clips that are ready, in order.

        A run in one thread that drains after each `observe` is deterministic.
        """
        drained: list[RelationEvidence] = []
        while (evidence := self.work()) is not None:
            drained.append(evidence)
        return drained

    def clear(self) -> None:
        """Drop images and queued clips: after a jump in time, or at the end."""
        with self._lock:
            count = self._queue.clear()
            self._frames.clear()
            self._policy.clear()
            if count:
                self._dropped["cleared"] += count

    def counters(self) -> RelationCounters:
        """Numbers of clips since the start."""
        with self._lock:
            ready = self._queue.ready()
            return RelationCounters(
                self._queued, len(self._queue), ready, self._encoded, dict(self._dropped)
            )

    def _queue_clips(
        self, local: LocalGraph, rgb: Rgb, pairs: Int64, classes: Int64, costs: Float64
    ) -> None:
        # One clip serves both directions of a pair.
        once = np.flatnonzero(pairs[:, 0] < pairs[:, 1])
        with self._lock:
            # Boxes are in pixels: they do not fit an image of another size.
            if rgb.shape[:2] == (local.height, local.width):
                self._keep(local, rgb)
            self._policy.advance(local.stamp_ns)
            stamps_ns = self._frames.window(local.stamp_ns, self._config.clip_length)
            if not stamps_ns:
                if len(once):
                    self._dropped["no_frame"] += len(once)
                return
            self._queued += len(once)
            self._queue.put(
                _clip_of(local, stamps_ns, pairs[row], classes[row], float(costs[row]))
                for row in once.tolist()
            )

    def _keep(self, local: LocalGraph, rgb: Rgb) -> None:
        """Keep an image. Clips that need the frame it replaces are cut first."""
        leaving_ns = self._frames.leaving(local.stamp_ns)
        if leaving_ns is not None:
            self._queue.cut(leaving_ns, self._frames, self._config.clip_length, self._chosen)
        self._frames.add(local.stamp_ns, rgb, local.boxes_xyxy)

    def _drop(self, reason: str) -> None:
        self._dropped[reason] += 1

    def _take(self) -> tuple[QueuedClip, list[Rgb]] | None:
        """The first clip that is ready, and its frames (none if the clip holds its pixels)."""
        with self._lock:
            while (clip := self._queue.take()) is not None:
                if clip.pixels is not None:
                    return clip, []
                clip = self._chosen(clip)
                images = self._frames.images(clip.frame_stamps_ns)
                if images is not None:
                    return clip, images
                self._drop("stale")  # images of another size have replaced its frames
        return None

    def _chosen(self, clip: QueuedClip) -> QueuedClip:
        """A clip with the frames and regions that the world model wants, see `ProbeCard`.

        The graph knows which objects a frame shows. Without it, a clip has all frames and the
        region of the last one.
        """
        if self._graph is None or not (self._valid_only or self._crop != "last_frame"):
            return clip
        nodes_of_frame = self._graph.nodes_of_frame
        nodes = nodes_of_frame(clip.stamp_ns)
        if nodes is None or max(clip.rows) >= len(nodes):
            return clip
        pair = [nodes[row] for row in clip.rows]
        if not all(pair):  # a removed node
            return clip
        frames = [nodes_of_frame(stamp_ns) for stamp_ns in clip.frame_stamps_ns]
        if self._valid_only:
            seen = [None if ids is None else set(pair) <= set(ids) for ids in frames]
            first = interval_start(seen)
            frames = frames[first:]
            stamps_ns, regions = clip.frame_stamps_ns[first:], clip.regions_xyxy[first:]
            clip = replace(clip, frame_stamps_ns=stamps_ns, regions_xyxy=regions)
        if self._crop == "last_frame":
            return clip
        boxes: list[BoxPair] = []
        for ids, stamp_ns in zip(frames, clip.frame_stamps_ns):
            own = self._frames.boxes(stamp_ns)
            rows = [-1 if ids is None or node not in ids else ids.index(node) for node in pair]
            a, b = (own[row] if 0 <= row < len(own) else None for row in rows)
            boxes.append((a, b))
        regions = clip_regions([*boxes[:-1], clip.boxes_xyxy], self._crop, *self._frames.size)
        return replace(clip, regions_xyxy=regions)


def _clip_of(
    local: LocalGraph, stamps_ns: tuple[int, ...], pair: Int64, classes: Int64, geo_cost: float
) -> QueuedClip:
    """The clip of one pair of rows of a local graph."""
    i, j = pair.tolist()
    boxes = (local.boxes_xyxy[i], local.boxes_xyxy[j])
    return QueuedClip(
        stamp_ns=local.stamp_ns,
        frame_stamps_ns=stamps_ns,
        regions_xyxy=(union_box(*boxes, local.width, local.height),) * len(stamps_ns),
        vocabulary=local.vocabulary,
        rows=(i, j),
        classes=(int(classes[0]), int(classes[1])),
        boxes_xyxy=boxes,
        geo_cost=geo_cost,
    )


# --- A thread for the world model, so that frames never wait for it.


class EvidenceWorker:
    """Runs `work` of a reasoner in a separate thread.

    `observe` returns the neighbour pairs at once. Predictions come later, through `deliver`, in the
    worker's thread. To run in one thread, call `observe` and `drain` of the reasoner instead.

    Args:
        reasoner: queues the clips; its counters report dropped clips.
        deliver: called with each prediction. An exception in it is reported, and the worker
            continues.
        report: called with one sentence on each error; default: the log.
    """

    def __init__(
        self,
        reasoner: RelationReasoner,
        deliver: Callable[[RelationEvidence], None],
        report: Callable[[str], None] | None = None,
    ) -> None:
        self.reasoner = reasoner
        self._deliver = deliver
        self._report = logging.getLogger(__name__).warning if report is None else report
        self._changed = threading.Condition()
        self._stopping = False
        self._busy = False
        # A frame or a change of the graph came since the worker last ran out of ready clips.
        self._news = False
        # A daemon: a world model that never returns cannot keep the process alive.
        self._thread = threading.Thread(target=self._run, name="world-model", daemon=True)

    def start(self) -> None:
        """Start the thread; once."""
        self._thread.start()

    def observe(self, local: LocalGraph, rgb: Rgb) -> RelationEvidence:
        """Find the neighbour pairs of a frame; see `RelationReasoner.observe`."""
        evidence = self.reasoner.observe(local, rgb)
        self._wake()
        return evidence

    def learn(self, change: Callable[[], None]) -> None:
        """Change the graph by which clips are chosen; see `RelationReasoner.learn`."""
        self.reasoner.learn(change)
        self._wake()

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until all ready clips are encoded and delivered; False after the timeout."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._stopping or not (self._busy or self._news), timeout_s
            )

    def stop(self, timeout_s: float = 5.0) -> bool:
        """Drop all queued clips and end the thread.

        Returns:
            False if the world model still encodes its last clip after the timeout. The thread then
            ends as soon as the model returns, and delivers nothing.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self.reasoner.clear()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _wake(self) -> None:
        with self._changed:
            self._news = True
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._stopping or self._news)
                self._news = False
                self._busy = True
            while not self._stopping and (evidence := self._work_safely()) is not None:
                self._deliver_safely(evidence)
            if self._stopping:
                return

    def _work_safely(self) -> RelationEvidence | None:
        try:
            return self.reasoner.work()
        except Exception as error:  # the next frame begins again; without a thread, none would
            self._report(f"a clip was not judged: {type(error).__name__}: {error}")
            return None

    def _deliver_safely(self, evidence: RelationEvidence) -> None:
        if self._stopping:
            return
        try:
            self._deliver(evidence)
        except Exception as error:  # an error in the receiver must not end this thread
            self._report(f"evidence was not delivered: {type(error).__name__}: {error}")


# --- World models by their name in the configuration.
#
# The libraries of a network are imported only if the configuration names it.

# Libraries of the optional world models; the extra `models` of this package installs them.
MODEL_LIBRARIES = ("torch", "transformers", "safetensors")


def _no_clips(config: RelationsConfig, device: str) -> None:
    """No model of clips: edges have visual evidence, and with ``physics`` that of surfaces."""
    del config, device


def _fake(config: RelationsConfig, device: str) -> WorldModel:
    del device
    return FakeWorldModel(config.clip_length)


def _vjepa2(config: RelationsConfig, device: str) -> WorldModel:
    from deworldsg_ros.relations.clip_models import build_probed, load_vjepa2

    return build_probed(config, load_vjepa2, device)


def _dinov2(config: RelationsConfig, device: str) -> WorldModel:
    from deworldsg_ros.relations.clip_models import build_probed, load_dinov2

    return build_probed(config, load_dinov2, device)


# By the name in the configuration. `physics` judges the fused geometry of pairs in the graph: it
# needs no images.
WORLD_MODELS: dict[str, Callable[[RelationsConfig, str], WorldModel | None]] = {
    "dinov2": _dinov2,
    "fake": _fake,
    "none": _no_clips,
    "physics": _no_clips,
    "vjepa2": _vjepa2,
}


def build_world_model(config: RelationsConfig, device: str = "auto") -> WorldModel | None:
    """The configured world model, on a device (auto, cpu or cuda).

    None if the configured one reads no clips. The libraries of a network are imported only here.

    Raises:
        ConfigurationError: unknown name, missing library, or a checkpoint or probe that cannot be
            used.
    """
    name = config.world_model
    if name not in WORLD_MODELS:
        try:
            make = load_plugin("relations.world_model", name, WORLD_MODELS)
        except PluginError as error:
            raise ConfigurationError(str(error)) from error
        made: WorldModel | None = make(config, device)
        return made
    try:
        return WORLD_MODELS[name](config, device)
    except ImportError as error:
        if (error.name or "").split(".")[0] not in MODEL_LIBRARIES:
            raise
        raise ConfigurationError(
            f"world model '{config.world_model}' needs {' and '.join(MODEL_LIBRARIES)}: "
            f"pip install torch transformers safetensors ({error})"
        ) from error
