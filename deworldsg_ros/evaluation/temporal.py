"""Stability of the graph over time, as a client of /scene_graph/updates sees it.

* An *id switch*: an object of the ground truth is associated with another node than before, and
  no update reports that the two nodes were merged.
* A *label flip*: a node has another label than in the previous update.
* An *edge flip*: two related nodes have another predicate or direction than before, also after a
  time without an edge.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.pipeline import FrameResult
from deworldsg_ros.recordings.folders.sequence import read_instances
from deworldsg_ros.scene.arrays import UInt16
from deworldsg_ros.wire import messages as wire

# A detection shows an object of the ground truth if at least half of its pixels do.
MIN_PIXEL_FRACTION = 0.5


@dataclass(frozen=True)
class TemporalQuality:
    """Counts over a stream of updates.

    Attributes:
        duration_s: time from the first to the last stamp.
        updates: number of updates.
        associations: detections with a known object of the ground truth.
        id_switches: see the module; None without ground truth.
        label_flips, edge_flips: see the module.
        merges: nodes that were merged into others.
        removals: nodes that were removed without a merge.
    """

    duration_s: float
    updates: int
    associations: int
    id_switches: int | None
    label_flips: int
    edge_flips: int
    merges: int
    removals: int

    def per_minute(self, count: int | None) -> float | None:
        """A count per minute; None if the count is unknown or the stream has no duration."""
        return None if count is None or self.duration_s <= 0 else 60.0 * count / self.duration_s

    def numbers(self) -> dict[str, Any]:
        """Every number by name, for JSON."""
        return {
            "duration_s": self.duration_s,
            "updates": self.updates,
            "associations": self.associations,
            "id_switches": self.id_switches,
            "label_flips": self.label_flips,
            "edge_flips": self.edge_flips,
            "merges": self.merges,
            "removals": self.removals,
            "id_switches_per_minute": self.per_minute(self.id_switches),
            "label_flips_per_minute": self.per_minute(self.label_flips),
            "edge_flips_per_minute": self.per_minute(self.edge_flips),
        }


Triples = frozenset[tuple[int, int, str]]


def measure_stream(
    updates: Iterable[wire.SceneGraphUpdateMessage],
    true_ids: Mapping[int, Sequence[int]] | None = None,
) -> TemporalQuality:
    """Count switches and flips.

    Args:
        updates: updates in order of time.
        true_ids: by stamp of a frame in nanoseconds, the ids of the true objects of the rows of
            its local graph; 0 = none.

    Raises:
        ValueError: a frame has different numbers of rows and associations.
    """
    stream = _Stream(true_ids or {})
    for update in updates:
        stream.apply(update)
    return stream.quality(with_truth=true_ids is not None)


class _Stream:
    def __init__(self, true_ids: Mapping[int, Sequence[int]]) -> None:
        self._true_ids = true_ids
        self._labels: dict[int, str] = {}
        self._edges: dict[tuple[int, int], str] = {}
        # The last relations of each pair, kept after its edges are removed.
        self._related: dict[tuple[int, int], Triples] = {}
        self._successors: dict[int, int] = {}
        self._node_of: dict[int, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._updates = self._associations = self._switches = 0
        self._label_flips = self._edge_flips = self._merges = self._removals = 0

    def apply(self, update: wire.SceneGraphUpdateMessage) -> None:
        """Count the changes of the next update."""
        self._updates += 1
        self._last_ns = wire.ns_from_stamp(update.stamp)
        if self._first_ns is None:
            stamps = [item.stamp for item in update.associations] or [update.stamp]
            self._first_ns = wire.ns_from_stamp(stamps[0])
        self._remove(update.removed_nodes)
        self._associate(update.associations)
        for node in update.nodes:
            self._label_flips += self._labels.get(node.id, node.label) != node.label
            self._labels[node.id] = node.label
        self._relate(update)

    def quality(self, *, with_truth: bool) -> TemporalQuality:
        """The counts so far."""
        return TemporalQuality(
            duration_s=(self._last_ns - (self._first_ns or self._last_ns)) / 1e9,
            updates=self._updates,
            associations=self._associations,
            id_switches=self._switches if with_truth else None,
            label_flips=self._label_flips,
            edge_flips=self._edge_flips,
            merges=self._merges,
            removals=self._removals,
        )

    def _remove(self, removed: Sequence[wire.RemovedNode]) -> None:
        for node in removed:
            was_shown = self._labels.pop(node.id, None) is not None
            if node.merged_into is not None:
                self._successors[node.id] = node.merged_into
                self._merges += was_shown
            else:
                self._removals += was_shown

    def _associate(self, associations: Sequence[wire.Association]) -> None:
        for item in associations:
            objects = self._true_ids.get(wire.ns_from_stamp(item.stamp))
            if objects is None:
                continue
            if len(objects) != len(item.nodes):
                raise ValueError(
                    f"frame of {item.stamp.sec}.{item.stamp.nanosec:09d} s has {len(objects)} "
                    f"true objects and {len(item.nodes)} associations: expected equal numbers"
                )
            for object_id, node_id in zip(objects, item.nodes):
                if object_id and node_id:
                    node_id = self._resolve(node_id)
                    before = self._resolve(self._node_of.get(object_id, node_id))
                    self._associations += 1
                    self._switches += before != node_id
                    self._node_of[object_id] = node_id

    def _resolve(self, node_id: int) -> int:
        while node_id in self._successors:
            node_id = self._successors[node_id]
        return node_id

    def _relate(self, update: wire.SceneGraphUpdateMessage) -> None:
        touched = set()
        for removed in update.removed_edges:
            self._edges.pop((removed.subject, removed.object), None)
            touched.add(_pair(removed.subject, removed.object))
        for edge in update.edges:
            self._edges[edge.subject, edge.object] = edge.predicate
            touched.add(_pair(edge.subject, edge.object))
        for a, b in touched:
            now = frozenset(
                (*ends, self._edges[ends]) for ends in ((a, b), (b, a)) if ends in self._edges
            )
            if now:
                self._edge_flips += self._related.get((a, b), now) != now
                self._related[a, b] = now


def _pair(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)


def true_objects(instance_ids: Sequence[int], instances: UInt16, truth: UInt16) -> list[int]:
    """The true object that most pixels of each detection show; 0 = none.

    Args:
        instance_ids: values of the detections in the instance image.
        instances: (H, W) uint16, instance image of the detections.
        truth: (H, W) uint16, instance image of the ground truth; 0 = no object.
    """
    objects = []
    for instance in instance_ids:
        shown = truth[instances == instance]
        values, counts = np.unique(shown, return_counts=True)
        best = int(np.argmax(counts)) if len(counts) else -1
        is_clear = best >= 0 and counts[best] >= MIN_PIXEL_FRACTION * len(shown)
        objects.append(int(values[best]) if is_clear else 0)
    return objects


class UpdateLog:
    """Records the updates of a run, at the rate at which the graph node publishes them.

    Args:
        rate_hz: updates per second of recorded time.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = 1e9 / rate_hz
        self._due_ns: float | None = None
        self._updates: list[wire.SceneGraphUpdateMessage] = []
        self._true_ids: dict[int, list[int]] = {}
        self._builder: GraphBuilder | None = None

    def note(self, builder: GraphBuilder, source: object, result: FrameResult) -> None:
        """Record a frame. Instance images of the source are the ground truth, if it has any."""
        self._builder = builder
        stamp_ns = result.local.stamp_ns
        truth = read_instances(source, stamp_ns)
        if truth is not None:
            self._true_ids[stamp_ns] = true_objects(
                result.local.instance_ids.tolist(), result.perceived.instances, truth
            )
        if self._due_ns is None or stamp_ns >= self._due_ns:
            self._take()
            self._due_ns = stamp_ns + self._period_ns

    def quality(self) -> TemporalQuality:
        """Stability over all recorded frames."""
        self._take()
        return measure_stream(self._updates, self._true_ids or None)

    def _take(self) -> None:
        update = None if self._builder is None else self._builder.update()
        if update is not None:
            self._updates.append(update)
