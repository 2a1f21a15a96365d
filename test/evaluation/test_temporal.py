"""Switches and flips, counted on made-up streams of updates."""

from __future__ import annotations

import numpy as np
import pytest

from deworldsg_ros.evaluation.temporal import measure_stream, true_objects
from deworldsg_ros.wire import messages as wire

ZERO = wire.stamp_from_ns(0)


def node(node_id: int, label: str = "cup") -> wire.NodeState:
    belief = [wire.Belief(label, 1.0)]
    return wire.NodeState(node_id, label, belief, [0.0] * 3, [0.0] * 9, 1, ZERO, ZERO)


def edge(subject: int, object_: int, predicate: str = "on") -> wire.EdgeState:
    belief = [wire.Belief(predicate, 1.0)]
    return wire.EdgeState(subject, object_, predicate, 1.0, belief, "visual", 0.0, 1)


def stream(*parts: dict) -> list[wire.SceneGraphUpdateMessage]:  # type: ignore[type-arg]
    """One update a second; `at` gives the associations of its frame."""
    updates = []
    for number, part in enumerate(parts, start=1):
        stamp = wire.stamp_from_ns(number * 10**9)
        nodes = part.pop("at", None)
        updates.append(
            wire.SceneGraphUpdateMessage(
                schema=wire.schema_of(wire.SceneGraphUpdateMessage),
                stamp=stamp,
                frame_id="map",
                sequence=number,
                associations=[] if nodes is None else [wire.Association(stamp, nodes)],
                **{"removed_nodes": [], "removed_edges": [], "nodes": [], "edges": [], **part},
            )
        )
    return updates


def truth(*frames: list[int]) -> dict[int, list[int]]:
    return {number * 10**9: frame for number, frame in enumerate(frames, start=1)}


def test_an_empty_stream_has_nothing_and_no_rates() -> None:
    quality = measure_stream([])
    assert (quality.duration_s, quality.updates, quality.label_flips) == (0.0, 0, 0)
    assert quality.per_minute(3) is None
    assert quality.numbers()["id_switches_per_minute"] is None


def test_a_stable_graph_has_no_switches_and_no_flips() -> None:
    steady = {"nodes": [node(1), node(2, "table")], "edges": [edge(1, 2)]}
    updates = stream(*({**steady, "at": [1, 2]} for _ in range(4)))
    quality = measure_stream(updates, truth(*[[10, 20]] * 4))
    assert quality.duration_s == 3.0
    assert (quality.associations, quality.id_switches) == (8, 0)
    assert (quality.label_flips, quality.edge_flips, quality.merges, quality.removals) == (0,) * 4


def test_without_ground_truth_switches_are_unknown() -> None:
    updates = stream({"at": [1]}, {"at": [2]})
    assert measure_stream(updates).id_switches is None
    assert measure_stream(updates, {}).id_switches == 0


def test_another_node_is_a_switch_each_time() -> None:
    updates = stream(*({"at": [node_id]} for node_id in (1, 2, 2, 1)))
    quality = measure_stream(updates, truth([7], [7], [7], [7]))
    assert quality.id_switches == 2
    assert quality.per_minute(quality.id_switches) == pytest.approx(40.0)


def test_a_merge_is_not_a_switch() -> None:
    merged = [wire.RemovedNode(2, 1)]
    updates = stream({"nodes": [node(1), node(2)], "at": [2]}, {"removed_nodes": merged, "at": [1]})
    quality = measure_stream(updates, truth([7], [7]))
    assert (quality.id_switches, quality.merges, quality.removals) == (0, 1, 0)


def test_a_node_that_is_removed_and_created_again_is_a_switch() -> None:
    updates = stream(
        {"nodes": [node(1)], "at": [1]},
        {"removed_nodes": [wire.RemovedNode(1)]},
        {"nodes": [node(2)], "at": [2]},
    )
    quality = measure_stream(updates, truth([7], [], [7]))
    assert (quality.id_switches, quality.removals) == (1, 1)


def test_detections_without_a_true_object_or_node_are_left_out() -> None:
    updates = stream({"at": [1, 5]}, {"at": [0, 6]}, {"at": [1, 7]})
    quality = measure_stream(updates, truth([7, 0], [7, 0], [7, 0]))
    assert (quality.associations, quality.id_switches) == (2, 0)


def test_unpublished_nodes_do_not_count_as_removed() -> None:
    quality = measure_stream(stream({"removed_nodes": [wire.RemovedNode(9)]}))
    assert quality.removals == 0


def test_labels_that_change_are_flips() -> None:
    labels = ("cup", "cup", "bowl", "cup")
    quality = measure_stream(stream(*({"nodes": [node(1, label)]} for label in labels)))
    assert quality.label_flips == 2


def test_a_node_that_is_published_again_has_no_label_flip() -> None:
    gone = {"removed_nodes": [wire.RemovedNode(1)]}
    quality = measure_stream(stream({"nodes": [node(1)]}, gone, {"nodes": [node(1, "bowl")]}))
    assert (quality.label_flips, quality.removals) == (0, 1)


REMOVED = {"removed_edges": [wire.RemovedEdge(1, 2)]}


@pytest.mark.parametrize(
    ("parts", "flips"),
    [
        ([{"edges": [edge(1, 2)]}, {"edges": [edge(1, 2)]}], 0),
        ([{"edges": [edge(1, 2)]}, {"edges": [edge(1, 2, "near")]}], 1),
        ([{"edges": [edge(1, 2)]}, {**REMOVED, "edges": [edge(2, 1)]}], 1),
        ([{"edges": [edge(1, 2)]}, REMOVED, {"edges": [edge(1, 2)]}], 0),
        ([{"edges": [edge(1, 2)]}, REMOVED, {"edges": [edge(1, 2, "near")]}], 1),
        ([{"edges": [edge(1, 2)]}, {"edges": [edge(1, 3, "near")]}], 0),
        ([REMOVED], 0),
    ],
)
def test_edges_that_change_are_flips(parts: list[dict], flips: int) -> None:  # type: ignore[type-arg]
    quality = measure_stream(stream(*(dict(part) for part in parts)))
    assert quality.edge_flips == flips


def test_different_numbers_of_rows_and_associations_are_an_error() -> None:
    with pytest.raises(ValueError, match="2 true objects and 1 associations"):
        measure_stream(stream({"at": [1]}), truth([7, 8]))


def test_the_true_object_covers_most_pixels_of_the_detection() -> None:
    instances = np.array([[1, 1, 1, 2], [3, 3, 0, 2]], np.uint16)
    shown = np.array([[7, 7, 8, 0], [5, 6, 9, 0]], np.uint16)
    assert true_objects([1, 2, 3, 4], instances, shown) == [7, 0, 5, 0]
    scattered = np.array([[7, 8, 9, 0], [0, 0, 0, 0]], np.uint16)
    assert true_objects([1], instances, scattered) == [0]
    assert true_objects([], instances, shown) == []
