"""Stage d on a stream of frames: neighbour pairs at once, predictions when time allows."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.clip_policy import ClipPolicy
from deworldsg_ros.relations.clip_queue import ClipQueue
from deworldsg_ros.relations.clips import FrameBuffer, QueuedClip, Rgb, interval_start, union_box
from deworldsg_ros.relations.encoding import ClipEncoder
from deworldsg_ros.relations.graph_view import GraphView
from deworldsg_ros.relations.pairing import neighbour_pairs
from deworldsg_ros.relations.world_model import WorldModel
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence

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
        """Keep an image. Clips that need the frame it replaces are cut first."""
        leaving_ns = self._frames.leaving(stamp_ns)
        if leaving_ns is not None:
            self._queue.cut(leaving_ns, self._frames, self._config.clip_length)
        self._frames.add(stamp_ns, rgb)

    def _drop(self, reason: str) -> None:
        self._dropped[reason] += 1

    def _take(self) -> tuple[QueuedClip, list[Rgb]] | None:
        """The first clip that is ready, and its frames (none if the clip holds its pixels)."""
        with self._lock:
            while (clip := self._queue.take()) is not None:
                images = self._frames.images(clip.frame_stamps_ns)
                if images is not None or clip.pixels is not None:
                    return replace(clip, skipped=self._invalid(clip)), images or []
                self._drop("stale")  # images of another size have replaced its frames
        return None

    def _invalid(self, clip: QueuedClip) -> int:
        """Number of first frames that the world model wants left out.

        The graph knows which objects a frame shows. Without it, all frames count as valid.
        """
        if not self._valid_only or self._graph is None:
            return 0
        nodes_of_frame = self._graph.nodes_of_frame
        nodes = nodes_of_frame(clip.stamp_ns)
        if nodes is None or max(clip.rows) >= len(nodes):
            return 0
        pair = {nodes[row] for row in clip.rows}
        frames = [nodes_of_frame(stamp_ns) for stamp_ns in clip.frame_stamps_ns]
        return interval_start([None if ids is None else pair <= set(ids) for ids in frames])


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
