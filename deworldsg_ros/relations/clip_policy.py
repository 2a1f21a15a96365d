"""Which waiting clips the world model encodes, in which order, and how many per second.

The prior enters an edge only if the edge's visual distribution is uncertain, and it is kept per
class pair. A clip is therefore encoded only if

- its pair of nodes is uncertain;
- the frame gives both objects the classes that the graph gives them, because the prediction would
  otherwise update the prior of another class pair;
- its pair was not encoded yet, or was observed twice as often since: n observations of a pair cost
  log2 n clips.

The policy has no clock. Time is the stamps of the frames.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.clips import QueuedClip
from deworldsg_ros.relations.graph_view import GraphView

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
