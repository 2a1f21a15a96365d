"""The directed edges of the global graph: a sparse map, and the neighbours of each node."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import chain
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from deworldsg_ros.scene.arrays import Float64, Int64

Pair = tuple[int, int]
Ids = TypeVar("Ids", int, Int64)


def key(first: Ids, second: Ids) -> Ids:
    """One number for a pair of ids, the smaller first."""
    return first << 31 | second


def ends_of(pair_key: int) -> Pair:
    """The two ids of a `key`."""
    return pair_key >> 31, pair_key & 0x7FFFFFFF


class EdgeEvidence(NamedTuple):
    """Evidence of one directed pair of nodes (R predicates); a value, never changed in place.

    Attributes:
        visual_logits: (R,) float64, the sum of the visual relation logits (Eq. 9). Zeros if there
            were none, which is the uniform distribution.
        frames: number of frames with visual evidence; 0 = a geometric neighbour only.
        last_seen_ns: time of the newest evidence of either kind.
        neighbour_frames: number of frames in which the pair was a geometric neighbour (Eq. 8).
        revision: graph revision at which this last changed.
    """

    visual_logits: Float64
    frames: int
    last_seen_ns: int
    neighbour_frames: int
    revision: int


class EdgeMap:
    """Directed pairs (subject id, object id) with their evidence."""

    def __init__(self, predicate_count: int) -> None:
        # All pairs without visual evidence share one row of zeros.
        self._no_logits = np.zeros(predicate_count)
        self._no_logits.flags.writeable = False
        self._evidence: dict[Pair, EdgeEvidence] = {}
        self._partners: dict[int, dict[int, None]] = {}
        self._changed: set[Pair] = set()

    @property
    def evidence(self) -> Mapping[Pair, EdgeEvidence]:
        """The map itself, read only.

        Pairs with `frames == 0` are geometric neighbours without visual evidence.
        """
        return MappingProxyType(self._evidence)

    def partners(self, node_id: int) -> Collection[int]:
        """Ids of the nodes that share a pair with a node; do not change it."""
        return self._partners.get(node_id, {}).keys()

    def take_changed(self) -> set[Pair]:
        """Pairs that changed since the last call; some may have been dropped."""
        changed, self._changed = self._changed, set()
        return changed

    def add_visual(self, pair: Pair, logits: Float64, stamp_ns: int, revision: int) -> None:
        """Sum a frame's relation logits (R,) into a pair (Eq. 9).

        Raises:
            ValueError: if the logits have another shape.
        """
        if logits.shape != self._no_logits.shape:
            raise ValueError(
                f"relation logits have shape {logits.shape}: expected {self._no_logits.shape}"
            )
        known = self._evidence.get(pair)
        if known is None:
            self.add(pair, EdgeEvidence(logits, 1, stamp_ns, 0, revision))
            return
        self._changed.add(pair)
        summed, frames, last_ns, neighbour_frames, _ = known
        last_ns = max(last_ns, stamp_ns)
        self._evidence[pair] = EdgeEvidence(
            summed + logits, frames + 1, last_ns, neighbour_frames, revision
        )

    def add_neighbours(self, pairs: Sequence[Pair], stamp_ns: int, revision: int) -> None:
        """Count a frame in which pairs were geometric neighbours (Eq. 8).

        Args:
            pairs: subject and object of each.
            stamp_ns: of the frame.
            revision: of the graph before the first pair; each pair adds one.
        """
        evidence = self._evidence
        self._changed.update(pairs)
        for pair in pairs:
            revision += 1
            known = evidence.get(pair)
            if known is None:
                self.add(pair, EdgeEvidence(self._no_logits, 0, stamp_ns, 1, revision))
                continue
            summed, frames, last_ns, neighbour_frames, _ = known
            evidence[pair] = EdgeEvidence(
                summed, frames, max(last_ns, stamp_ns), neighbour_frames + 1, revision
            )

    def add(self, pair: Pair, more: EdgeEvidence) -> None:
        """Add evidence to a pair: logits and frames are summed."""
        known = self._evidence.get(pair)
        if known is None:
            known = EdgeEvidence(self._no_logits, 0, more.last_seen_ns, 0, more.revision)
            self._partners.setdefault(pair[0], {})[pair[1]] = None
            self._partners.setdefault(pair[1], {})[pair[0]] = None
        self._changed.add(pair)
        self._evidence[pair] = EdgeEvidence(
            known.visual_logits + more.visual_logits if more.frames else known.visual_logits,
            known.frames + more.frames,
            max(known.last_seen_ns, more.last_seen_ns),
            known.neighbour_frames + more.neighbour_frames,
            more.revision,
        )

    def restore(self, evidence: Mapping[Pair, EdgeEvidence]) -> None:
        """Fill an empty map with the `evidence` of another one."""
        self._evidence, self._changed = dict(evidence), set(evidence)
        # Grouped by node; the partners of each stay in the order of the pairs.
        ends = np.fromiter(chain.from_iterable(evidence), np.int64, 2 * len(evidence))
        others = ends.reshape(-1, 2)[:, ::-1].ravel()
        order = ends.argsort(kind="stable")
        node_ids, starts = np.unique(ends[order], return_index=True)
        flat = others[order].tolist()
        ends_of = [*starts[1:].tolist(), None]
        for node_id, start, stop in zip(node_ids.tolist(), starts.tolist(), ends_of):
            self._partners[node_id] = dict.fromkeys(flat[start:stop])

    def repoint(self, old_id: int, new_id: int, revision: int) -> None:
        """Move all edges of one node to another, summing evidence; O(degree of `old_id`).

        An edge between the two would become one from a node to itself and is dropped.
        """
        for (subject, object_), evidence in self._pop_all(old_id):
            pair = (
                new_id if subject == old_id else subject,
                new_id if object_ == old_id else object_,
            )
            if pair[0] != pair[1]:
                self.add(pair, evidence._replace(revision=revision))

    def copy(self, old_id: int, new_id: int, without: Collection[int], revision: int) -> None:
        """Give a node the edges of another one, except those to some nodes."""
        for partner in list(self._partners.get(old_id, {})):
            for pair, new in (
                ((old_id, partner), (new_id, partner)),
                ((partner, old_id), (partner, new_id)),
            ):
                if partner not in without and pair in self._evidence:
                    self.add(new, self._evidence[pair]._replace(revision=revision))

    def drop(self, node_id: int) -> None:
        """Drop all edges of a node."""
        self._pop_all(node_id)

    def _pop_all(self, node_id: int) -> list[tuple[Pair, EdgeEvidence]]:
        popped = []
        for partner in self._partners.pop(node_id, {}):
            del self._partners[partner][node_id]
            for pair in ((node_id, partner), (partner, node_id)):
                evidence = self._evidence.pop(pair, None)
                if evidence is not None:
                    popped.append((pair, evidence))
                    self._changed.add(pair)
        return popped
