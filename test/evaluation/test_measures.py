"""Measures beside recall, on graphs whose faults are known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from support.evaluation import write_dataset
from support.sequences import write_ground_truth

from deworldsg_ros.evaluation.edge_measures import ReferenceScene, read_reference
from deworldsg_ros.evaluation.graph_measures import (
    Measures,
    NodeView,
    measure_prediction,
    measure_views,
    pool,
)
from deworldsg_ros.evaluation.predictions import ScanPrediction
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.errors import RecordingError

SCENE = ReferenceScene(
    ids=[10, 20],
    labels=["chair", "table"],
    boxes_min=np.array([[0.0, 0, 0], [2.0, 0, 0]]),
    boxes_max=np.array([[1.0, 1, 1], [3.0, 1, 1]]),
    centroids=np.array([[0.5, 0.5, 0.5], [2.5, 0.5, 0.5]]),
    relations=frozenset({(10, 20, "near"), (20, 10, "under"), (20, 99, "on")}),
    exact=True,
)


def node(number: int, label: str, x: float, weight: float = 1.0) -> NodeView:
    cube = np.array([[x + dx, 0.5 + dy, 0.5 + dz] for dx in (-0.5, 0.5) for dy in (-0.5, 0.5)
                     for dz in (-0.5, 0.5)])  # fmt: skip
    return NodeView(number, label, 0.8, np.array([x, 0.5, 0.5]), cube, weight)


def test_an_empty_graph() -> None:
    numbers = measure_views([], [], SCENE).numbers()
    assert numbers["node_recall"] == 0
    assert math.isnan(numbers["node_precision"])
    assert math.isnan(numbers["edge_calibration_error"])


def test_nodes() -> None:
    nodes = [
        node(1, "chair", 0.5),
        node(2, "chair", 0.9, weight=3.0),  # a duplicate, and the main one
        node(3, "chair", 1.04),  # in the margin
        node(4, "book", 2.5),  # wrong class
        node(5, "chair", 1.06),  # nowhere
        node(6, "table", 0.5),  # a table inside the chair
    ]
    measured = measure_views(nodes, [], SCENE)
    assert (measured.found, measured.matched, measured.duplicates) == (1, 3, 2)
    assert (measured.wrong_class, measured.stray) == (2, 1)
    numbers = measured.numbers()
    assert numbers["node_precision"] == 0.5
    assert numbers["node_recall"] == 0.5
    assert numbers["duplicates_per_object"] == 2
    assert numbers["f1"] == pytest.approx(2 / (6 + 2))
    assert measured.best_errors_m == [0.0]
    assert measured.main_errors_m == pytest.approx([0.4])
    assert measured.extent_errors_m == pytest.approx([0.0])
    assert measured.box_ious == pytest.approx([0.6 / 1.4])
    assert sorted(measured.confusion)[0] == ("chair", "chair")
    assert ("chair", "table") in measured.confusion
    assert ("table", "book") in measured.confusion


def test_pooling_adds() -> None:
    one = measure_views([node(1, "chair", 0.5)], [], SCENE)
    both = pool([one, one])
    assert (both.objects, both.nodes, both.found, both.best_errors_m) == (4, 2, 2, [0.0, 0.0])
    assert pool([]) == Measures()


def test_a_prediction_is_measured_by_its_points() -> None:
    class_names = ("chair", "table")
    prediction = ScanPrediction(
        (node(1, "", 0.5).points_m, np.zeros((0, 3)), np.full((2, 3), np.nan)),
        np.array([[0.9, 0.1], [1.0, 0.0], [1.0, 0.0]]),
        np.array([[0, 1]]),
        np.array([[0.5, 0.5]]),
    )
    from deworldsg_ros.scene.frame_graph import Vocabulary

    measured = measure_prediction(prediction, Vocabulary(class_names, ("near", "on")), SCENE)
    assert (measured.found, measured.matched, measured.stray) == (1, 1, 2)
    # On a tie the last predicate counts.
    assert [(edge.predicate, edge.probability) for edge in measured.edges] == [("on", 0.5)]
    assert not measured.edges[0].matched


def test_reference_from_surface_points(tmp_path: Path) -> None:
    content = ([("chair", 1), ("wall", 2), ("table", 3)], [(1, 3, "near")])
    annotations = Annotations(write_dataset(tmp_path, {"a": content}), "replica")
    scene = read_reference(annotations, "a", annotations.points("a"))
    assert (scene.ids, scene.labels, scene.exact) == ([1, 3], ["chair", "table"], False)
    np.testing.assert_allclose(scene.boxes_max[0], [1, 0.95, 0], atol=1e-6)
    np.testing.assert_allclose(scene.centroids[1], [3, 0.475, 0], atol=1e-6)
    assert scene.relations == {(1, 3, "near")}


def test_reference_from_ground_truth(tmp_path: Path) -> None:
    annotations = Annotations(write_dataset(tmp_path, {"a": ([("chair", 1)], [])}), "replica")
    write_ground_truth(tmp_path / "data" / "a")
    scene = read_reference(annotations, "a", annotations.points("a"))
    assert (scene.ids, scene.exact) == ([1, 2, 3], True)
    assert (1, 2, "near") in scene.relations
    (tmp_path / "data/a/gt.json").write_text('{"objects": [{}]}')
    with pytest.raises(RecordingError, match=r"gt\.json"):
        read_reference(annotations, "a", annotations.points("a"))
