"""Switches and flips, counted on made-up streams of updates."""

import numpy as np
import pytest

from deworldsg_ros.evaluation.temporal import measure_stream, true_objects
from deworldsg_ros.wire import messages as wire

ZERO = wire.stamp_from_ns(0)


def node(node_id, label="cup"):
    belief = [wire.Belief(label, 1.0)]
    return wire.NodeState(node_id, label, belief, [0.0] * 3, [0.0] * 9, 1, ZERO, ZERO)


def edge(subject, object_, predicate="on"):
    belief = [wire.Belief(predicate, 1.0)]
    return wire.EdgeState(subject, object_, predicate, 1.0, belief, "visual", 0.0, 1)


def update(number, at=None, removed_nodes=(), removed_edges=(), nodes=(), edges=()):
    """The update of a second; `at` gives the associations of its frame."""
    stamp = wire.stamp_from_ns(number * 10**9)
    return wire.SceneGraphUpdateMessage(
        schema=wire.schema_of(wire.SceneGraphUpdateMessage),
        stamp=stamp,
        frame_id="map",
        sequence=number,
        associations=[] if at is None else [wire.Association(stamp, at)],
        removed_nodes=[wire.RemovedNode(*item) for item in removed_nodes],
        removed_edges=[wire.RemovedEdge(*item) for item in removed_edges],
        nodes=list(nodes),
        edges=list(edges),
    )


def measure(*parts, truth=None):
    """The quality of one update a second; `truth` lists the true objects of each."""
    updates = [update(number, **part) for number, part in enumerate(parts, start=1)]
    if truth is not None:
        truth = {number * 10**9: objects for number, objects in enumerate(truth, start=1)}
    return measure_stream(updates, truth)


BOTH = {"nodes": [node(1), node(2)], "at": [2]}
MERGED, GONE = {"removed_nodes": [(2, 1)], "at": [1]}, {"removed_nodes": [(1,)]}


@pytest.mark.parametrize(
    ("parts", "truth", "associations", "switches"),
    [
        # Without ground truth switches are unknown.
        ([{"at": [1]}, {"at": [2]}], None, 0, None),
        ([{"at": [1]}, {"at": [2]}], [], 0, 0),
        # Another node is a switch each time.
        ([{"at": [1]}, {"at": [2]}, {"at": [2]}, {"at": [1]}], [[7]] * 4, 4, 2),
        # A merge is not a switch, but a node that is removed and created again is one.
        ([BOTH, MERGED], [[7]] * 2, 2, 0),
        ([{"at": [1], "nodes": [node(1)]}, GONE, {"at": [2]}], [[7], [], [7]], 2, 1),
        # Detections without a true object or node are left out.
        ([{"at": [1, 5]}, {"at": [0, 6]}, {"at": [1, 7]}], [[7, 0]] * 3, 2, 0),
    ],
)
def test_switches(parts, truth, associations, switches):
    quality = measure(*parts, truth=truth)
    assert quality.id_switches == switches
    if truth:
        assert quality.associations == associations
    if len(parts) == 4:
        assert quality.per_minute(quality.id_switches) == pytest.approx(40.0)
    # An empty stream has no rates.
    assert measure().numbers()["id_switches_per_minute"] is None


STATED, REMOVED = {"edges": [edge(1, 2)]}, {"removed_edges": [(1, 2)]}
LABELS = [{"nodes": [node(1, label)]} for label in ("cup", "cup", "bowl", "cup")]


@pytest.mark.parametrize(
    ("parts", "counts"),
    [
        # Merges and removals. Unpublished nodes do not count as removed.
        ([BOTH, MERGED], (1, 0, 0, 0)),
        ([GONE], (0, 0, 0, 0)),
        ([{**BOTH, "edges": [edge(1, 2)]}] * 3, (0, 0, 0, 0)),
        # Labels that change are flips, unless the node was published again.
        (LABELS, (0, 0, 2, 0)),
        ([LABELS[0], GONE, LABELS[2]], (0, 1, 0, 0)),
        # Edges that change are flips, too.
        ([STATED, {"edges": [edge(1, 2, "near")]}], (0, 0, 0, 1)),
        ([STATED, {**REMOVED, "edges": [edge(2, 1)]}], (0, 0, 0, 1)),
        ([STATED, REMOVED, STATED], (0, 0, 0, 0)),
        ([STATED, REMOVED, {"edges": [edge(1, 2, "near")]}], (0, 0, 0, 1)),
        ([REMOVED, STATED, {"edges": [edge(1, 3, "near")]}], (0, 0, 0, 0)),
    ],
)
def test_changes(parts, counts):
    quality = measure(*parts)
    flips = quality.label_flips, quality.edge_flips
    assert (quality.merges, quality.removals, *flips) == counts


def test_the_true_object_covers_most_pixels_of_the_detection():
    instances = np.array([[1, 1, 1, 2], [3, 3, 0, 2]], np.uint16)
    shown = np.array([[7, 7, 8, 0], [5, 6, 9, 0]], np.uint16)
    assert true_objects([1, 2, 3, 4], instances, shown) == [7, 0, 5, 0]
    with pytest.raises(ValueError, match="2 true objects and 1 associations"):
        measure({"at": [1]}, truth=[[7, 8]])
