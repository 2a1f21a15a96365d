"""Clips of object pairs: how they are cut, which wait, and which the world model encodes next."""

from __future__ import annotations

import math
import sys
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from msgspec import UNSET, UnsetType

from deworldsg_ros.checkpoints.cards import Crop
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import DECIMALS
from deworldsg_ros.relations.paper import entropy_nats, visual_distribution
from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

# --- Clips of object pairs: the last frames, cropped to the union box of the pair.
#
# Frames are kept by reference and cropped when a clip is encoded. A pair that is never encoded
# costs no copy.

Rgb = UInt8
CropBox = tuple[int, int, int, int]
# The boxes of a pair in a frame, each (4,) float64 xyxy pixels; None = not seen.
BoxPair = tuple[Float64 | None, Float64 | None]
NO_BOXES: Float64 = np.zeros((0, 4))


@dataclass(frozen=True)
class QueuedClip:
    """A neighbour pair of one frame whose clip may be encoded.

    Attributes:
        stamp_ns: last frame in which both objects were seen.
        frame_stamps_ns: the clip's frames, oldest first; the last is `stamp_ns`.
        regions_xyxy: its region of each frame, whole pixels, e.g. the union box of the two objects.
        vocabulary: of the frame's local graph.
        rows: rows of the two objects in that local graph, the smaller first.
        classes: indices of their classes.
        boxes_xyxy: their boxes, each (4,) float64 pixels of the image.
        geo_cost: the geometric cost of Eq. 8.
        pixels: (T, h, w, 3) uint8, the cropped clip; None while its frames are in the frame
            buffer.
    """

    stamp_ns: int
    frame_stamps_ns: tuple[int, ...]
    regions_xyxy: tuple[CropBox, ...]
    vocabulary: Vocabulary
    rows: tuple[int, int]
    classes: tuple[int, int]
    boxes_xyxy: tuple[Float64, Float64]
    geo_cost: float
    pixels: Rgb | None = None


class FrameBuffer:
    """The last frames of the RGB stream with the boxes of their objects, ordered by stamp.

    Images are kept by reference: do not change one after adding it. An image of another size than
    the stored ones replaces them all: the camera has changed, and a clip cannot mix two sizes.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"frame buffer of {capacity} frames: expected at least 1")
        self.capacity = capacity
        self._stamps_ns: list[int] = []
        self._images: dict[int, Rgb] = {}
        self._boxes_xyxy: dict[int, Float64] = {}

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, stamp_ns: int, rgb: Rgb, boxes_xyxy: Float64 = NO_BOXES) -> None:
        """Keep one image, (H, W, 3) uint8, and boxes (n, 4); a full buffer drops its oldest image.

        A full buffer ignores an image older than all of its own. An image whose stamp is already
        here is ignored, too.
        """
        if stamp_ns in self._images:
            return
        if self._stamps_ns and self._images[self._stamps_ns[-1]].shape != rgb.shape:
            self.clear()
        insort(self._stamps_ns, stamp_ns)
        self._images[stamp_ns] = rgb
        self._boxes_xyxy[stamp_ns] = boxes_xyxy
        if len(self._stamps_ns) > self.capacity:
            oldest_ns = self._stamps_ns.pop(0)
            del self._images[oldest_ns], self._boxes_xyxy[oldest_ns]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images, pixels; there is at least one."""
        height, width = self._images[self._stamps_ns[-1]].shape[:2]
        return width, height

    def leaving(self, stamp_ns: int) -> int | None:
        """Stamp of the frame that an image with this stamp would replace; None if none."""
        full = len(self) == self.capacity and stamp_ns not in self._images
        return self._stamps_ns[0] if full and stamp_ns > self._stamps_ns[0] else None

    def window(self, stamp_ns: int, length: int) -> tuple[int, ...]:
        """Stamps of the last `length` frames up to this stamp, or of fewer if there are fewer.

        Empty if the frame with this stamp is not in the buffer.
        """
        if stamp_ns not in self._images:
            return ()
        end = bisect_right(self._stamps_ns, stamp_ns)
        return tuple(self._stamps_ns[max(0, end - length) : end])

    def images(self, stamps_ns: Sequence[int]) -> list[Rgb] | None:
        """The images with these stamps; None if one of them has left the buffer."""
        if not all(stamp_ns in self._images for stamp_ns in stamps_ns):
            return None
        return [self._images[stamp_ns] for stamp_ns in stamps_ns]

    def boxes(self, stamp_ns: int) -> Float64:
        """Boxes (n, 4) float64 of the objects in a frame; none of a frame that has left."""
        return self._boxes_xyxy.get(stamp_ns, NO_BOXES)

    def clear(self) -> None:
        """Drop all frames."""
        self._stamps_ns.clear()
        self._images.clear()
        self._boxes_xyxy.clear()


def union_box(box_a_xyxy: Float64, box_b_xyxy: Float64, width: int, height: int) -> CropBox:
    """The smallest rectangle of whole pixels that contains two boxes, clipped to the image.

    Pixel centres are at integers: pixel k reaches from k - 1/2 to k + 1/2.

    Args:
        box_a_xyxy: (4,) float64 pixels.
        box_b_xyxy: likewise.
        width: image width in pixels.
        height: image height in pixels.

    Returns:
        x1, y1, x2, y2, the far edges exclusive; at least one pixel wide and high, even if the boxes
        lie outside of the image.
    """
    left, top = np.minimum(box_a_xyxy[:2], box_b_xyxy[:2]).tolist()
    right, bottom = np.maximum(box_a_xyxy[2:], box_b_xyxy[2:]).tolist()
    x1 = min(max(math.floor(left + 0.5), 0), width - 1)
    y1 = min(max(math.floor(top + 0.5), 0), height - 1)
    x2 = max(min(math.ceil(right + 0.5), width), x1 + 1)
    y2 = max(min(math.ceil(bottom + 0.5), height), y1 + 1)
    return x1, y1, x2, y2


def interval_start(seen: Sequence[bool | None]) -> int:
    """First frame of the valid interval of a clip: since then, both objects were seen in each.

    Args:
        seen: for each frame whether both objects were seen, oldest first; None = not known, which
            does not end the interval. In the last frame both were seen.

    Returns:
        the index of a frame in which both were seen.
    """
    start = last = len(seen) - 1
    for index in range(last - 1, -1, -1):
        if seen[index] is False:
            break
        if seen[index]:
            start = index
    return start


def clip_regions(
    boxes_xyxy: Sequence[BoxPair], crop: Crop, width: int, height: int
) -> tuple[CropBox, ...]:
    """The region of each frame of a clip. An unseen object has its box of the next frame.

    Args:
        boxes_xyxy: of the pair in each frame, oldest first; in the last both are seen.
        crop: see `ProbeCard`.
        width: image width in pixels.
        height: image height in pixels.
    """
    unions: list[CropBox] = []
    a, b = boxes_xyxy[-1]
    for seen_a, seen_b in reversed(boxes_xyxy if crop != "last_frame" else boxes_xyxy[-1:]):
        a, b = a if seen_a is None else seen_a, b if seen_b is None else seen_b
        if a is None or b is None:
            raise ValueError("the last frame of a clip shows one object: expected both")
        unions.append(union_box(a, b, width, height))
    if crop == "each_frame":
        return tuple(reversed(unions))
    x1, y1, x2, y2 = zip(*unions)
    return ((min(x1), min(y1), max(x2), max(y2)),) * len(boxes_xyxy)


def crop_clip(images: Sequence[Rgb], regions_xyxy: Sequence[CropBox], length: int) -> Rgb:
    """A clip of fixed length, cropped out of frames.

    Args:
        images: 1 to `length` images (H, W, 3) uint8, oldest first; the last is the most recent
            frame in which both objects were seen.
        regions_xyxy: box of whole pixels in each image, far edges exclusive; a region of another
            size than the last is resized to that.
        length: T, frames of the clip; the last image is repeated at the end to fill it.

    Returns:
        (T, h, w, 3) uint8, a copy.

    Raises:
        ValueError: no image, or more than `length`.
    """
    if not 1 <= len(images) <= length:
        raise ValueError(f"clip of {len(images)} frames: expected 1 to {length}")
    import cv2  # slow: graph_node, which cuts no clip, starts without it

    x1, y1, x2, y2 = regions_xyxy[-1]
    size = (x2 - x1, y2 - y1)
    clip = np.empty((length, size[1], size[0], 3), np.uint8)
    for row, (image, (x1, y1, x2, y2)) in enumerate(zip(images, regions_xyxy)):
        part = image[y1:y2, x1:x2]
        same = (x2 - x1, y2 - y1) == size
        clip[row] = part if same else cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    clip[len(images) :] = clip[len(images) - 1]
    return clip


# --- The state of the global graph that the choice of clips needs, from memory or from messages.

# Frames whose nodes are remembered: 34 s at 30 frames/s. Clips wait for a few seconds.
REMEMBERED_FRAMES = 1024
# Removed nodes whose successors are remembered, to bound memory.
REMEMBERED_REMOVALS = 65536


class NodeView(NamedTuple):
    """A confirmed node.

    Attributes:
        label: name of its most probable class.
        observations: number of frames in which it was detected.
    """

    label: str
    observations: int


class GraphView(Protocol):
    """The queries that the choice of clips makes on the graph."""

    @property
    def generation(self) -> int:
        """A counter that changes when a new graph, with new node ids, replaces the old one."""
        ...

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest frame that the graph has processed; None = no graph is known."""
        ...

    def nodes_of_frame(self, stamp_ns: int) -> Sequence[int] | None:
        """The current node id of each row of a frame, 0 = removed; None = frame not known."""
        ...

    def node(self, node_id: int) -> NodeView | None:
        """A published node; None if it is hidden."""
        ...

    def visual_entropy_nats(self, a_id: int, b_id: int) -> float:
        """Entropy of P_vis (Eq. 9) of a pair: the greater one of its two directions.

        Directions without visual evidence are ignored; infinite if both have none.
        """
        ...


class LiveGraph:
    """The graph of the same process."""

    def __init__(self, graph: GlobalGraph) -> None:
        self.generation = 0
        # In one process a frame is merged before its clips are ranked: no frame is still to come.
        self.newest_ns = sys.maxsize
        self._graph = graph

    def nodes_of_frame(self, stamp_ns: int) -> Sequence[int] | None:
        """See `GraphView`."""
        return self._graph.nodes_of_frame(stamp_ns)

    def node(self, node_id: int) -> NodeView | None:
        """See `GraphView`."""
        nodes = self._graph.nodes
        row = nodes.slot(node_id)
        if not nodes.confirmed[row]:
            return None
        names = self._graph.vocabulary
        classes = self._graph.edits.believed_classes(nodes, names, [row])
        label = names.classes[int(classes.argmax())]
        return NodeView(label, int(nodes.observations[row]))

    def visual_entropy_nats(self, a_id: int, b_id: int) -> float:
        """See `GraphView`."""
        edges = [self._graph.edges.get(pair) for pair in ((a_id, b_id), (b_id, a_id))]
        return max(
            (
                round(float(entropy_nats(visual_distribution(edge.visual_logits))), DECIMALS)
                for edge in edges
                if edge is not None and edge.frames
            ),
            default=math.inf,
        )


class PublishedGraph:
    """A copy of another process's graph, kept up to date from `/scene_graph/updates`.

    It needs a snapshot when it starts late and after lost updates, and keeps its last state until
    the snapshot arrives. Another session, or sequence numbers that start again, mean a new graph,
    which replaces the old one.

    Attributes:
        wants_snapshot: whether it needs a snapshot, by `reset`.
    """

    def __init__(self) -> None:
        self.generation = 0
        self.newest_ns: int | None = None
        self.wants_snapshot = True
        self._replica = GraphReplica()
        self._last_sequence = 0
        self._session: str | UnsetType = UNSET
        self._frames: dict[int, list[int]] = {}
        # The node that each removed node was merged into; 0 = none.
        self._successors: dict[int, int] = {}

    def apply(self, update: wire.SceneGraphUpdateMessage) -> None:
        """Apply an update; call it in the order of publication."""
        if update.session != self._session or update.sequence <= self._last_sequence:
            if self._last_sequence:
                self.generation += 1
            self._replica = GraphReplica()
            self._frames.clear()
            self._successors.clear()
            self._session = update.session
        self._last_sequence = update.sequence
        for removed in update.removed_nodes:
            self._successors[removed.id] = removed.merged_into or 0
        # A node that is hidden is published as removed. It may return under the same id.
        for node in update.nodes:
            self._successors.pop(node.id, None)
        for association in update.associations:
            self._frames[wire.ns_from_stamp(association.stamp)] = association.nodes
        _forget_oldest(self._successors, REMEMBERED_REMOVALS)
        _forget_oldest(self._frames, REMEMBERED_FRAMES)
        self.newest_ns = wire.ns_from_stamp(update.stamp)
        try:
            self._replica.apply(update)
            self.wants_snapshot = False
        except RefusedInput:
            self.wants_snapshot = True

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Take the nodes and edges of a snapshot; ignore one older than the last update.

        A snapshot of another session than the last update is ignored, too: one of both is old.
        """
        if self._last_sequence and (
            snapshot.session != self._session or snapshot.sequence < self._last_sequence
        ):
            return
        self._session = snapshot.session
        self._replica.reset(snapshot)
        self.wants_snapshot = False
        if self.newest_ns is None:
            self.newest_ns = wire.ns_from_stamp(snapshot.stamp)

    def nodes_of_frame(self, stamp_ns: int) -> Sequence[int] | None:
        """See `GraphView`."""
        node_ids = self._frames.get(stamp_ns)
        return None if node_ids is None else [self._resolve(node_id) for node_id in node_ids]

    def node(self, node_id: int) -> NodeView | None:
        """See `GraphView`."""
        state = self._replica.nodes.get(node_id)
        if state is None or not state.confirmed:
            return None
        # The best class, also of a node without a name.
        label = state.classes[0].label if state.classes else state.label
        return NodeView(label, state.observations)

    def visual_entropy_nats(self, a_id: int, b_id: int) -> float:
        """See `GraphView`. Every edge with visual evidence is published."""
        edges = [self._replica.edges.get(pair) for pair in ((a_id, b_id), (b_id, a_id))]
        seen = [edge.entropy_nats for edge in edges if edge is not None and edge.observations]
        return max(seen, default=math.inf)

    def _resolve(self, node_id: int) -> int:
        passed = set()
        # graph_node never sends a circle of merges, but somebody else may.
        while node_id in self._successors and node_id not in passed:
            passed.add(node_id)
            node_id = self._successors[node_id]
        return node_id


def _forget_oldest(remembered: dict[int, Any], count: int) -> None:
    while len(remembered) > count:
        del remembered[next(iter(remembered))]


# --- Which waiting clips the world model encodes, in which order, and how many per second.
#
# The prior enters an edge only if the edge's visual distribution is uncertain, and it is kept per
# class pair. A clip is therefore encoded only if
#
# - its pair of nodes is uncertain;
# - the frame gives both objects the classes that the graph gives them, because the prediction would
#   otherwise update the prior of another class pair;
# - its pair was not encoded yet, or was observed twice as often since: n observations of a pair
#   cost log2 n clips.
#
# The policy has no clock. Time is the stamps of the frames.

Order = tuple[float, ...]

# A pair is encoded again when its observations have grown by this factor.
ENCODE_AGAIN_FACTOR = 2
# Pairs whose encodings are remembered, to bound memory; the pair encoded longest ago is forgotten.
REMEMBERED_PAIRS = 65536


class PairKey(NamedTuple):
    """A pair of nodes with their current classes, the smaller id first."""

    nodes: tuple[int, int]
    classes: tuple[int, int]


@dataclass(frozen=True)
class Rank:
    """The position of a waiting clip among the others.

    Attributes:
        order: clips are encoded from the greatest order to the least; the least is dropped first.
        pair: the clip's pair of nodes; only the newest clip of a pair waits. None = not known.
        observations: frames in which the less observed node of the pair was seen.
        ready: whether it may be encoded now.
    """

    order: Order
    pair: PairKey | None = None
    observations: int = 0
    ready: bool = True


class ClipPolicy:
    """Ranks clips by the state of the graph, within a budget of clips per second.

    Without a graph every clip is encoded: the newest frame first, then the nearest pair.

    Args:
        config: `max_clips_per_s` and `entropy_threshold_nats` are used. With `max_clips_per_s` 0
            every clip is encoded, and the graph is not used.
    """

    def __init__(self, config: RelationsConfig) -> None:
        self._graph: GraphView | None = None
        self._generation = 0
        self._entropy_threshold_nats = config.entropy_threshold_nats
        self.limit(config.max_clips_per_s)
        self._credit = self._most_credit
        self._newest_ns: int | None = None
        # Encodings of each pair, and its observations at the last one; the longest ago first.
        self._encodings: dict[PairKey, tuple[int, int]] = {}
        self._class_encodings: Counter[tuple[int, int]] = Counter()

    def limit(self, max_clips_per_s: float) -> None:
        """Use another budget from now on."""
        self._max_clips_per_s = max_clips_per_s
        # At most the clips of one second are saved up, and at least one clip.
        self._most_credit = max(1.0, max_clips_per_s)

    def watch(self, graph: GraphView) -> None:
        """Rank by the state of this graph from now on, unless every clip is encoded."""
        if self._max_clips_per_s:
            self._graph = graph

    def advance(self, stamp_ns: int) -> None:
        """Move time forward to this stamp: the budget grows."""
        if self._newest_ns is not None and stamp_ns > self._newest_ns:
            earned = 1e-9 * (stamp_ns - self._newest_ns) * self._max_clips_per_s
            self._credit = min(self._most_credit, self._credit + earned)
        self._newest_ns = max(stamp_ns, self._newest_ns or stamp_ns)

    def allowance(self, count: int) -> int:
        """The number of clips, at most `count`, that the budget allows now."""
        return count if not self._max_clips_per_s else min(count, math.floor(self._credit + 1e-9))

    def judge(self, clips: Iterable[QueuedClip]) -> Iterator[Rank | str]:
        """The rank of each clip, or the reason to drop it.

        The reasons: ``certain`` (the visual evidence of the pair is certain); ``already_encoded``
        (the pair was encoded, and was not observed twice as often since); ``other_class`` (the
        frame and the graph disagree on the class of an object); ``node_removed`` (a node was
        removed, the two nodes were merged, or the graph refused the frame).
        """
        graph = self._graph
        if graph is None or graph.newest_ns is None:
            yield from (Rank(_newest_first(clip)) for clip in clips)
            return
        if graph.generation != self._generation:
            self._generation = graph.generation
            self._encodings.clear()
            self._class_encodings.clear()
        frames: dict[int, Sequence[int] | None] = {}
        for clip in clips:
            if clip.stamp_ns not in frames:
                frames[clip.stamp_ns] = graph.nodes_of_frame(clip.stamp_ns)
            yield self._judge(clip, frames[clip.stamp_ns], graph, graph.newest_ns)

    def _judge(
        self, clip: QueuedClip, node_ids: Sequence[int] | None, graph: GraphView, newest_ns: int
    ) -> Rank | str:
        newest_first = _newest_first(clip)
        if node_ids is None:
            # A frame newer than the graph is still being merged; an older one was refused or lost.
            still_merging = clip.stamp_ns > newest_ns
            return Rank((1, *newest_first), ready=False) if still_merging else "node_removed"
        if max(clip.rows) >= len(node_ids):
            return "node_removed"
        (a_id, a_class), (b_id, b_class) = sorted(
            (node_ids[row], kind) for row, kind in zip(clip.rows, clip.classes)
        )
        if a_id == 0 or a_id == b_id:
            return "node_removed"
        pair = PairKey((a_id, b_id), (a_class, b_class))
        a, b = graph.node(a_id), graph.node(b_id)
        if a is None or b is None:
            return Rank((0, *newest_first), pair, ready=False)
        names = clip.vocabulary.classes
        if (a.label, b.label) != (names[a_class], names[b_class]):
            return "other_class"
        observations = min(a.observations, b.observations)
        encodings, observations_then = self._encodings.get(pair, (0, 0))
        if observations < ENCODE_AGAIN_FACTOR * observations_then:
            return "already_encoded"
        uniform_nats = math.log(len(clip.vocabulary.predicates))
        entropy_nats = min(graph.visual_entropy_nats(a_id, b_id), uniform_nats)
        if entropy_nats <= self._entropy_threshold_nats:
            return "certain"
        # An edge whose class pair has no prior yet gains most.
        without_prior = not self._class_encodings[_unordered(pair.classes)]
        order = (2, without_prior, -encodings, entropy_nats, observations, *newest_first)
        return Rank(order, pair, observations)

    def spend(self, rank: Rank) -> None:
        """Count a clip as encoded."""
        self._credit -= 1
        if rank.pair is None:
            return
        encodings, _ = self._encodings.pop(rank.pair, (0, 0))
        self._encodings[rank.pair] = (encodings + 1, rank.observations)
        self._class_encodings[_unordered(rank.pair.classes)] += 1
        if len(self._encodings) > REMEMBERED_PAIRS:
            del self._encodings[next(iter(self._encodings))]

    def clear(self) -> None:
        """Start with a full budget, after a jump in time."""
        self._credit = self._most_credit
        self._newest_ns = None


def _newest_first(clip: QueuedClip) -> Order:
    """Newest frame, then nearest pair."""
    return (clip.stamp_ns, -clip.geo_cost, -clip.rows[0], -clip.rows[1])


def _unordered(classes: tuple[int, int]) -> tuple[int, int]:
    low, high = sorted(classes)
    return low, high


# --- The clips that wait for the world model: a bounded number, ranked by a policy.

# Memory for the pixels of clips that wait longer than their frames are buffered, in bytes: 60 clips
# of 16 frames of 210 x 210 pixels.
MAX_CUT_BYTES = 128 * 2**20


class ClipQueue:
    """At most `size` clips, one per pair of nodes, in the order of the policy.

    Args:
        size: clips that may wait.
        policy: ranks the clips.
        on_drop: called with the reason of every lost clip: those of the policy, ``superseded`` (a
            newer clip of its pair waits), ``queue_full`` (clips of higher rank filled the queue),
            ``stale`` (its frames left the buffer).
    """

    def __init__(self, size: int, policy: ClipPolicy, on_drop: Callable[[str], None]) -> None:
        if size < 1:
            raise ValueError(f"clip queue of size {size}: expected at least 1")
        self.size = size
        self._policy = policy
        self._on_drop = on_drop
        self._clips: list[QueuedClip] = []

    def __len__(self) -> int:
        return len(self._clips)

    def put(self, clips: Iterable[QueuedClip]) -> None:
        """Add clips, then drop those that the policy refuses or that exceed the size."""
        self._clips.extend(clips)
        self._sift()

    def take(self) -> QueuedClip | None:
        """Remove the first clip that may be encoded now; None if there is none."""
        for rank, clip in self._sift():
            if not rank.ready:
                continue
            if not self._policy.allowance(1):
                return None
            self._policy.spend(rank)
            self._clips = [other for other in self._clips if other is not clip]
            return clip
        return None

    def ready(self) -> int:
        """The number of clips that may be encoded now."""
        return self._policy.allowance(sum(rank.ready for rank, _ in self._sift()))

    def cut(
        self,
        leaving_ns: int,
        frames: FrameBuffer,
        clip_length: int,
        choose: Callable[[QueuedClip], QueuedClip] = lambda clip: clip,
    ) -> None:
        """Cut clips of known pairs before the frame with this stamp leaves the buffer.

        The only clip of a pair that waits for confirmation or for the budget is so kept. Clips
        whose pair is not known yet become stale: newer ones will follow. `choose` gives a clip its
        frames and regions.
        """
        bytes_left = MAX_CUT_BYTES
        kept: list[QueuedClip] = []
        for rank, clip in self._sift():
            if clip.pixels is None and clip.frame_stamps_ns[0] <= leaving_ns:
                clip = clip if rank.pair is None else choose(clip)
                images = frames.images(clip.frame_stamps_ns)
                if rank.pair is None or images is None:
                    self._on_drop("stale")
                    continue
                clip = replace(clip, pixels=crop_clip(images, clip.regions_xyxy, clip_length))
            if clip.pixels is not None:
                bytes_left -= clip.pixels.nbytes
                if bytes_left < 0:
                    self._on_drop("stale")
                    continue
            kept.append(clip)
        self._clips = kept

    def clear(self) -> int:
        """Drop all clips and return their number."""
        count = len(self._clips)
        self._clips.clear()
        return count

    def _sift(self) -> list[tuple[Rank, QueuedClip]]:
        """Drop clips that need not wait; return the others with their ranks, in encoding order."""
        ranked: list[tuple[Rank, QueuedClip]] = []
        newest: dict[PairKey, int] = {}
        # Newest first: the first clip of a pair is the one to keep.
        clips = sorted(self._clips, key=lambda clip: -clip.stamp_ns)
        for clip, rank in zip(clips, self._policy.judge(clips)):
            if isinstance(rank, str):
                self._on_drop(rank)
            elif rank.pair is not None and newest.setdefault(rank.pair, id(clip)) != id(clip):
                self._on_drop("superseded")
            else:
                ranked.append((rank, clip))
        ranked.sort(key=lambda entry: entry[0].order, reverse=True)
        for _ in ranked[self.size :]:
            self._on_drop("queue_full")
        del ranked[self.size :]
        self._clips = [clip for _, clip in ranked]
        return ranked
