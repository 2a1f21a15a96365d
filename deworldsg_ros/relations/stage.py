"""Stage d on a stream of frames: pairs at once, predictions when there is time for them."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.clip_policy import ClipPolicy
from deworldsg_ros.relations.clip_queue import ClipQueue
from deworldsg_ros.relations.clips import FrameBuffer, QueuedClip, Rgb, crop_clip, union_box
from deworldsg_ros.relations.graph_view import GraphView
from deworldsg_ros.relations.pairing import neighbour_pairs
from deworldsg_ros.relations.prior import SUM_TOLERANCE
from deworldsg_ros.relations.world_model import ClipRequest, PairContext, WorldModel
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence

Waiting = tuple[QueuedClip, list[Rgb]]

# Frames kept, in clip lengths: a clip stays encodable while one more clip length of frames comes.
BUFFERED_CLIP_LENGTHS = 2


@dataclass(frozen=True)
class RelationCounters:
    """What became of the clips so far.

    Attributes:
        queued: clips that were put into the queue.
        pending: clips that wait now.
        ready: those of them that wait for the world model alone; the others wait for the graph,
            for their nodes to be confirmed, or for the budget.
        encoded: clips that the world model answered.
        dropped: clips that were not encoded, by reason: those of `ClipPolicy.judge` and of
            `ClipQueue`, ``world_model_error`` (the model failed on it), ``cleared`` (by a reset
            or at the end), and ``no_frame`` (never queued, because the frame's image did not come,
            came too late, or is of another size).
    """

    queued: int
    pending: int
    ready: int
    encoded: int
    dropped: dict[str, int]


class RelationReasoner:
    """Finds neighbour pairs (Eq. 8) and has the world model look at their clips.

    `observe` and `add_frame` never wait for the world model; `work` may be called in another
    thread. A world model that fails costs its clip and nothing else.

    Args:
        config: section ``relations`` of the configuration.
        world_model: None for neighbour pairs alone; then no image is kept and no clip queued.
        report: told each new failure of the world model in one sentence; default: the log.

    Raises:
        ConfigurationError: where the model wants clips of another length than configured.
    """

    def __init__(
        self,
        config: RelationsConfig,
        world_model: WorldModel | None,
        report: Callable[[str], None] | None = None,
    ) -> None:
        if world_model is not None and world_model.clip_length != config.clip_length:
            raise ConfigurationError(
                f"relations.clip_length is {config.clip_length}: world model "
                f"'{world_model.name}' wants clips of {world_model.clip_length} frames"
            )
        self.source = "none" if world_model is None else world_model.name
        self._config = config
        self._world_model = world_model
        self._report = logging.getLogger(__name__).warning if report is None else report
        self._reported = ""
        self._lock = threading.Lock()
        self._frames = FrameBuffer(BUFFERED_CLIP_LENGTHS * config.clip_length)
        self._queued = 0
        self._encoded = 0
        self._dropped: Counter[str] = Counter()
        self._policy = ClipPolicy(config)
        self._queue = ClipQueue(config.queue_size, self._policy, self._drop)

    def watch(self, graph: GraphView) -> None:
        """Choose clips by what this graph says of their pairs, from now on."""
        with self._lock:
            self._policy.watch(graph)

    def learn(self, change: Callable[[], None]) -> None:
        """Change the graph that is watched, with nobody looking at it meanwhile."""
        with self._lock:
            change()

    def add_frame(self, stamp_ns: int, rgb: Rgb) -> None:
        """Keep an image, (H, W, 3) uint8, for clips; it must not be changed afterwards.

        For images that come before their local graph, or without one.
        """
        if self._world_model is not None:
            with self._lock:
                self._keep(stamp_ns, rgb)

    def observe(self, local: LocalGraph, rgb: Rgb | None = None) -> RelationEvidence:
        """Neighbour pairs of a frame (Eq. 8); their clips are queued.

        Args:
            local: the frame's local graph.
            rgb: its image; None where `add_frame` was given it.

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
        if self._world_model is not None:
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
        """Encode the first queued clip that may be; None where there is none.

        Returns:
            the predictions of both directions of its pair, rows of the local graph with that
            stamp.
        """
        return next(iter(self.work_batch(1)), None)

    def work_batch(self, size: int | None = None) -> list[RelationEvidence]:
        """Encode the first queued clips that may be, at once; empty where there are none.

        Args:
            size: most clips; default: `relations.batch_size`.

        Returns:
            one for each clip that the world model answered, as from `work`.
        """
        size = self._config.batch_size if size is None else size
        while True:
            batch = self._take(size)
            if not batch:
                return []
            # The model takes its time: outside of the lock.
            evidence = self._encode_batch(batch)
            with self._lock:
                self._encoded += len(evidence)
                if len(evidence) < len(batch):
                    self._dropped["world_model_error"] += len(batch) - len(evidence)
            if evidence:
                return evidence

    def drain(self) -> list[RelationEvidence]:
        """Encode everything that is queued and may be, first to last.

        After each `observe`, this makes a run in one thread deterministic.
        """
        drained: list[RelationEvidence] = []
        while evidence := self.work_batch():
            drained += evidence
        return drained

    def clear(self) -> None:
        """Forget images and queued clips: time has jumped, or the end has come."""
        with self._lock:
            count = self._queue.clear()
            self._frames.clear()
            self._policy.clear()
            if count:
                self._dropped["cleared"] += count

    def counters(self) -> RelationCounters:
        """What became of the clips so far."""
        with self._lock:
            ready = self._queue.ready()
            return RelationCounters(
                self._queued, len(self._queue), ready, self._encoded, dict(self._dropped)
            )

    def _queue_clips(
        self, local: LocalGraph, rgb: Rgb | None, pairs: Int64, classes: Int64, costs: Float64
    ) -> None:
        # One clip serves both directions.
        once = np.flatnonzero(pairs[:, 0] < pairs[:, 1])
        with self._lock:
            # In an image of another size, the boxes are elsewhere.
            if rgb is not None and rgb.shape[:2] == (local.height, local.width):
                self._keep(local.stamp_ns, rgb)
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

    def _keep(self, stamp_ns: int, rgb: Rgb) -> None:
        """Keep an image; what waits for a frame that has to go for it is cut first."""
        leaving_ns = self._frames.leaving(stamp_ns)
        if leaving_ns is not None:
            self._queue.cut(leaving_ns, self._frames, self._config.clip_length)
        self._frames.add(stamp_ns, rgb)

    def _drop(self, reason: str) -> None:
        self._dropped[reason] += 1

    def _take(self, size: int) -> list[Waiting]:
        """The first clips that may be encoded, and their frames."""
        batch: list[Waiting] = []
        with self._lock:
            while len(batch) < size and (taken := self._queue.take(size - len(batch))):
                for item in taken:
                    images = self._frames.images(item.frame_stamps_ns)
                    if images is None and item.pixels is None:  # images of another size came
                        self._dropped["stale"] += 1
                    else:
                        batch.append((item, images or []))
        return batch

    def _encode_batch(self, batch: list[Waiting]) -> list[RelationEvidence]:
        """Predictions of both directions of each clip; without those that the model failed on."""
        model = self._world_model
        assert model is not None  # nothing is queued without one
        requests = [_request_of(item, images, self._config.clip_length) for item, images in batch]
        try:
            answers = model.predict_batch(requests)
            if len(answers) != len(batch):
                wanted = "one clip" if len(batch) == 1 else f"{len(batch)} clips"
                raise ValueError(f"{len(answers)} answers for {wanted}")
            predictions = [
                _checked(answer, len(request.pairs), len(request.vocabulary.predicates))
                for answer, request in zip(answers, requests)
            ]
        except Exception as error:  # whatever a backend raises, the other stages go on
            self._report_once(f"world model '{model.name}' failed: {type(error).__name__}: {error}")
            if len(batch) == 1:
                return []
            # One clip must not cost the others, and alone each needs less memory.
            return [evidence for clip in batch for evidence in self._encode_batch([clip])]
        return [
            self._evidence(item, distributions)
            for (item, _), distributions in zip(batch, predictions)
        ]

    def _evidence(self, item: QueuedClip, predictions: Float64) -> RelationEvidence:
        i, j = item.rows
        return RelationEvidence(
            stamp_ns=item.stamp_ns,
            vocabulary=item.vocabulary,
            pairs=np.array([[i, j], [j, i]], np.int64),
            pair_classes=np.array([item.classes, item.classes[::-1]], np.int64),
            geo_costs=np.full(2, item.geo_cost),
            predictions=predictions,
            source=self.source,
        )

    def _report_once(self, message: str) -> None:
        """Every failure is counted; only a new one is told."""
        if message != self._reported:
            self._reported = message
            self._report(message)


def _clip_of(
    local: LocalGraph, stamps_ns: tuple[int, ...], pair: Int64, classes: Int64, geo_cost: float
) -> QueuedClip:
    """The clip of one pair of rows of a local graph."""
    i, j = pair.tolist()
    boxes = (local.boxes_xyxy[i], local.boxes_xyxy[j])
    return QueuedClip(
        stamp_ns=local.stamp_ns,
        frame_stamps_ns=stamps_ns,
        crop_xyxy=union_box(*boxes, local.width, local.height),
        vocabulary=local.vocabulary,
        rows=(i, j),
        classes=(int(classes[0]), int(classes[1])),
        boxes_xyxy=boxes,
        geo_cost=geo_cost,
    )


def _request_of(item: QueuedClip, images: list[Rgb], clip_length: int) -> ClipRequest:
    """The clip of a queued pair, and both directions of the pair in it."""
    x1, y1, _, _ = item.crop_xyxy
    boxes = [box - np.array([x1, y1, x1, y1], np.float64) for box in item.boxes_xyxy]
    names = [item.vocabulary.classes[index] for index in item.classes]
    directions = tuple(
        PairContext(
            subject_box_xyxy=boxes[subject],
            object_box_xyxy=boxes[object_],
            subject_class=item.classes[subject],
            object_class=item.classes[object_],
            subject_name=names[subject],
            object_name=names[object_],
        )
        for subject, object_ in ((0, 1), (1, 0))
    )
    pixels = item.pixels
    if pixels is None:
        pixels = crop_clip(images, item.crop_xyxy, clip_length)
    return ClipRequest(pixels, directions, item.vocabulary)


def _checked(answer: Float64, pair_count: int, predicate_count: int) -> Float64:
    """A world model's answer as distributions in float64; ValueError where it is none."""
    values = np.asarray(answer, dtype=np.float64)
    if values.shape != (pair_count, predicate_count):
        raise ValueError(f"answer of shape {values.shape}: wanted {(pair_count, predicate_count)}")
    sums = values.sum(axis=1)
    if (
        not (np.isfinite(values).all() and (values >= 0).all())
        or (np.abs(sums - 1) > SUM_TOLERANCE).any()
    ):
        raise ValueError(f"answer {values.tolist()}: wanted distributions that sum to one")
    distributions: Float64 = values / sums[:, None]
    return distributions
