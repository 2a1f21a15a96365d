"""Which of the waiting clips are worth the world model's time, in which order, and how many.

The prior enters an edge only where its visual distribution is uncertain, and it is kept by class
pair. So a clip is worth its time where its pair of nodes is uncertain, where the frame calls both
objects what the graph calls them (else it would inform another class pair), and where the pair has
not been looked at yet. A pair is looked at again when it has been seen twice as often as at the
last look: n observations cost log2 n clips.

There is no clock here: time is what the frames' stamps say.
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

# A pair is looked at again when it has been seen so many times as often.
LOOK_AGAIN_FACTOR = 2
# Pairs whose looks are remembered; the one looked at longest ago is forgotten.
REMEMBERED_PAIRS = 65536


class PairKey(NamedTuple):
    """A pair of nodes under the classes that it has today, the smaller id first."""

    nodes: tuple[int, int]
    classes: tuple[int, int]


@dataclass(frozen=True)
class Rank:
    """How a waiting clip stands.

    Attributes:
        order: the greatest is encoded first, the least is dropped first.
        pair: whose clip it is; of two clips of a pair one is enough. None = not known.
        observations: frames in which the pair's less seen node was seen.
        ready: whether it may be encoded now.
    """

    order: Order
    pair: PairKey | None = None
    observations: int = 0
    ready: bool = True


class ClipPolicy:
    """Judges clips by what the graph says of their pairs, within a budget.

    Without a graph every clip is worth its time, newest frame first, then nearest pair.

    Args:
        config: `encode`, `clips_per_s` and `entropy_threshold_nats` are used.
    """

    def __init__(self, config: RelationsConfig) -> None:
        self._graph: GraphView | None = None
        self._generation = 0
        self._selective = config.encode == "uncertain"
        self._entropy_threshold_nats = config.entropy_threshold_nats
        self._clips_per_s = config.clips_per_s
        # A second's worth may be encoded at once, and one clip at any rate.
        self._most_credit = max(1.0, config.clips_per_s)
        self._credit = self._most_credit
        self._newest_ns: int | None = None
        # Looks at each pair, and its observations at the last one; longest ago first.
        self._looks: dict[PairKey, tuple[int, int]] = {}
        self._class_looks: Counter[tuple[int, int]] = Counter()

    def watch(self, graph: GraphView) -> None:
        """Judge by this graph from now on, unless every clip is to be encoded."""
        if self._selective:
            self._graph = graph

    def advance(self, stamp_ns: int) -> None:
        """Time has come to this stamp: the budget grows."""
        if self._newest_ns is not None and stamp_ns > self._newest_ns:
            earned = 1e-9 * (stamp_ns - self._newest_ns) * self._clips_per_s
            self._credit = min(self._most_credit, self._credit + earned)
        self._newest_ns = max(stamp_ns, self._newest_ns or stamp_ns)

    def allowance(self, count: int) -> int:
        """How many of `count` clips the budget allows now."""
        return count if not self._clips_per_s else min(count, math.floor(self._credit + 1e-9))

    def judge(self, clips: Iterable[QueuedClip]) -> Iterator[Rank | str]:
        """How each clip stands, or the reason why it is not worth its time.

        The reasons: ``certain`` (what was seen decides the pair's edges), ``looked_at`` (the pair
        was encoded, and not been seen much more often since), ``other_class`` (the frame calls one
        of the two something else than the graph does), ``node_gone`` (a node is gone, both are
        one, or the graph did not take the frame).
        """
        graph = self._graph
        if graph is None or graph.newest_ns is None:
            yield from (Rank(_newest_first(clip)) for clip in clips)
            return
        if graph.generation != self._generation:
            self._generation = graph.generation
            self._looks.clear()
            self._class_looks.clear()
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
            # The graph's answer is on its way, or has got lost.
            on_its_way = clip.stamp_ns > newest_ns
            return Rank((1, *newest_first), ready=False) if on_its_way else "node_gone"
        if max(clip.rows) >= len(node_ids):
            return "node_gone"
        (a_id, a_class), (b_id, b_class) = sorted(
            (node_ids[row], kind) for row, kind in zip(clip.rows, clip.classes)
        )
        if a_id == 0 or a_id == b_id:
            return "node_gone"
        pair = PairKey((a_id, b_id), (a_class, b_class))
        a, b = graph.node(a_id), graph.node(b_id)
        if a is None or b is None:
            return Rank((0, *newest_first), pair, ready=False)
        names = clip.vocabulary.classes
        if (a.label, b.label) != (names[a_class], names[b_class]):
            return "other_class"
        observations = min(a.observations, b.observations)
        looks, observations_then = self._looks.get(pair, (0, 0))
        if observations < LOOK_AGAIN_FACTOR * observations_then:
            return "looked_at"
        uniform_nats = math.log(len(clip.vocabulary.predicates))
        entropy_nats = min(graph.visual_entropy_nats(a_id, b_id), uniform_nats)
        if entropy_nats <= self._entropy_threshold_nats:
            return "certain"
        # An edge whose class pair has no prior at all gains most.
        unheard_of = not self._class_looks[_unordered(pair.classes)]
        order = (2, unheard_of, -looks, entropy_nats, observations, *newest_first)
        return Rank(order, pair, observations)

    def spend(self, rank: Rank) -> None:
        """Note that a clip is encoded."""
        self._credit -= 1
        if rank.pair is None:
            return
        looks, _ = self._looks.pop(rank.pair, (0, 0))
        self._looks[rank.pair] = (looks + 1, rank.observations)
        self._class_looks[_unordered(rank.pair.classes)] += 1
        if len(self._looks) > REMEMBERED_PAIRS:
            del self._looks[next(iter(self._looks))]

    def clear(self) -> None:
        """Time has jumped: the budget is full."""
        self._credit = self._most_credit
        self._newest_ns = None


def _newest_first(clip: QueuedClip) -> Order:
    """Newest frame, then nearest pair."""
    return (clip.stamp_ns, -clip.geo_cost, -clip.rows[0], -clip.rows[1])


def _unordered(classes: tuple[int, int]) -> tuple[int, int]:
    low, high = sorted(classes)
    return low, high
