"""The directed edges of the global graph: a sparse map, and the neighbours of each node."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain
from types import MappingProxyType

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.edges import EdgeArrays, EdgeEvidence, Pair
from deworldsg_ros.scene.saved_edges import SavedEdges


class EdgeMap:
    """Directed pairs (subject id, object id) with their evidence."""

    def __init__(self, predicate_count: int) -> None:
        # All pairs without visual evidence share one row of zeros.
        self._no_logits = np.zeros(predicate_count)
        self._no_logits.flags.writeable = False
        # All but those of a map that did not change since.
        self._evidence: dict[Pair, EdgeEvidence] = {}
        self._partners: dict[int, dict[int, None]] = {}
        self._changed: set[Pair] = set()
        self._saved = SavedEdges(EdgeArrays.of({}, predicate_count))
        # Whether all saved edges count as changed.
        self._restored = False

    @property
    def evidence(self) -> Mapping[Pair, EdgeEvidence]:
        """The map itself, read only.

        Pairs with `frames == 0` are geometric neighbours without visual evidence.
        """
        if not len(self._saved):
            return MappingProxyType(self._evidence)
        return _Newest(self._evidence, self._saved)

    def arrays(self) -> EdgeArrays:
        """The map as arrays, for `restore`."""
        return self._saved.newest(self._evidence)

    def partners(self, node_id: int) -> Collection[int]:
        """Ids of the nodes that share a pair with a node; do not change it."""
        known = self._partners.get(node_id)
        return dict.fromkeys(self._saved.partners(node_id)) if known is None else known.keys()

    def take_changed(self) -> set[Pair]:
        """Pairs that changed since the last call; some may have been dropped."""
        changed, self._changed = self._changed, set()
        if self._restored:
            changed.update(self._saved)
            self._restored = False
        return changed

    def add_visual(self, logits: Mapping[Pair, Float64], stamp_ns: int, revision: int) -> None:
        """Sum a frame's relation logits (R,) into pairs (Eq. 9).

        Args:
            logits: of each subject and object.
            stamp_ns: of the frame.
            revision: of the graph before the first pair; each pair adds one.

        Raises:
            ValueError: if the logits have another shape.
        """
        evidence = self._evidence
        for pair, summand in logits.items():
            if summand.shape != self._no_logits.shape:
                raise ValueError(
                    f"relation logits have shape {summand.shape}: expected {self._no_logits.shape}"
                )
            revision += 1
            known = evidence.get(pair) or self._saved.take(pair)
            if known is None:
                self.add(pair, EdgeEvidence(summand, 1, stamp_ns, 0, revision))
                continue
            self._changed.add(pair)
            summed, frames, last_ns, neighbour_frames, _ = known
            evidence[pair] = EdgeEvidence(
                summed + summand, frames + 1, max(last_ns, stamp_ns), neighbour_frames, revision
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
            known = evidence.get(pair) or self._saved.take(pair)
            if known is None:
                self.add(pair, EdgeEvidence(self._no_logits, 0, stamp_ns, 1, revision))
                continue
            summed, frames, last_ns, neighbour_frames, _ = known
            evidence[pair] = EdgeEvidence(
                summed, frames, max(last_ns, stamp_ns), neighbour_frames + 1, revision
            )

    def add(self, pair: Pair, more: EdgeEvidence) -> None:
        """Add evidence to a pair: logits and frames are summed."""
        known = self._evidence.get(pair) or self._saved.take(pair)
        if known is None:
            known = EdgeEvidence(self._no_logits, 0, more.last_seen_ns, 0, more.revision)
            self._partners_of(pair[0])[pair[1]] = None
            self._partners_of(pair[1])[pair[0]] = None
        self._changed.add(pair)
        self._evidence[pair] = EdgeEvidence(
            known.visual_logits + more.visual_logits if more.frames else known.visual_logits,
            known.frames + more.frames,
            max(known.last_seen_ns, more.last_seen_ns),
            known.neighbour_frames + more.neighbour_frames,
            more.revision,
        )

    def restore(self, arrays: EdgeArrays) -> None:
        """Fill an empty map with the `arrays` of another one."""
        self._saved, self._restored = SavedEdges(arrays), True

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
        for partner in list(self.partners(old_id)):
            for pair, new in (
                ((old_id, partner), (new_id, partner)),
                ((partner, old_id), (partner, new_id)),
            ):
                evidence = self._evidence.get(pair) or self._saved.get(pair)
                if partner not in without and evidence is not None:
                    self.add(new, evidence._replace(revision=revision))

    def drop(self, node_id: int) -> None:
        """Drop all edges of a node."""
        self._pop_all(node_id)

    def _partners_of(self, node_id: int) -> dict[int, None]:
        partners = self._partners.get(node_id)
        if partners is None:
            partners = self._partners[node_id] = dict.fromkeys(self._saved.partners(node_id))
        return partners

    def _pop_all(self, node_id: int) -> list[tuple[Pair, EdgeEvidence]]:
        popped = []
        for partner in self._partners_of(node_id):
            self._partners_of(partner).pop(node_id)
            for pair in ((node_id, partner), (partner, node_id)):
                evidence = self._evidence.pop(pair, None) or self._saved.get(pair)
                if evidence is not None:
                    self._saved.remove(pair)
                    popped.append((pair, evidence))
                    self._changed.add(pair)
        del self._partners[node_id]
        return popped


class _Newest(Mapping[Pair, EdgeEvidence]):
    """Saved edges and newer evidence, in the order in which the pairs came."""

    def __init__(self, newer: Mapping[Pair, EdgeEvidence], saved: SavedEdges) -> None:
        self._newer = newer
        self._saved = saved

    def __len__(self) -> int:
        return len(self._saved) + len(self._newer) - len(self._saved.changed)

    def __iter__(self) -> Iterator[Pair]:
        changed = self._saved.changed
        return chain(self._saved, (pair for pair in self._newer if pair not in changed))

    def __getitem__(self, pair: Pair) -> EdgeEvidence:
        evidence = self._newer.get(pair) or self._saved.get(pair)
        if evidence is None:
            raise KeyError(pair)
        return evidence
