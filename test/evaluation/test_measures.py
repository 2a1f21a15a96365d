"""Measures beside recall, on graphs whose faults are counted by hand."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from support.evaluation import write_dataset
from support.sequences import write_ground_truth

from deworldsg_ros.evaluation.edge_measures import (
    EdgeView,
    ReferenceScene,
    read_reference,
    write_edge_list,
)
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
from deworldsg_ros.scene.frame_graph import Vocabulary


def scene(labels, relations):
    """Cubes of 1 m at x = 0, 2, 4 ... m, with the ids 10, 20, 30 ..."""
    low = np.array([[2.0 * index, 0.0, 0.0] for index in range(len(labels))])
    ids = [10 * (index + 1) for index in range(len(labels))]
    return ReferenceScene(ids, labels, low, low + 1, low + 0.5, frozenset(relations), True)


def node(number, label, x, weight=1.0, observations=1):
    corners = [(dx, dy, dz) for dx in (-0.5, 0.5) for dy in (-0.5, 0.5) for dz in (-0.5, 0.5)]
    mean = np.array([x, 0.5, 0.5])
    return NodeView(number, label, 0.8, mean, mean + corners, weight, observations)


ROOM = scene(["chair", "table"], {(10, 20, "near"), (20, 10, "under"), (20, 99, "on")})


def test_nodes():
    nodes = [
        node(1, "chair", 0.5),
        node(2, "chair", 0.9, weight=3.0),  # a duplicate, and the main one
        node(3, "chair", 1.04),  # in the margin
        node(4, "book", 2.5),  # wrong class
        node(5, "chair", 1.06),  # nowhere
        node(6, "table", 0.5),  # a table inside the chair
    ]
    measured = measure_views(nodes, [], ROOM)
    assert (measured.found, measured.matched, measured.duplicates) == (1, 3, 2)
    assert (measured.wrong_class, measured.stray) == (2, 1)
    numbers = measured.numbers()
    assert (numbers["node_precision"], numbers["node_recall"]) == (0.5, 0.5)
    assert numbers["duplicates_per_object"] == 2
    assert numbers["f1"] == pytest.approx(2 / (6 + 2))
    assert measured.best_errors_m == [0.0]
    assert measured.main_errors_m == pytest.approx([0.4])
    assert measured.extent_errors_m == pytest.approx([0.0])
    assert measured.box_ious == pytest.approx([0.6 / 1.4])
    assert sorted(measured.confusion)[0] == ("chair", "chair")
    assert {("chair", "table"), ("table", "book")} <= set(measured.confusion)


def test_pooling_adds_and_nothing_has_no_rates():
    one = measure_views([node(1, "chair", 0.5)], [], ROOM)
    both = pool([one, one])
    assert (both.objects, both.nodes, both.found, both.best_errors_m) == (4, 2, 2, [0.0, 0.0])
    assert pool([]) == Measures()
    empty = measure_views([], [], ROOM)
    assert empty.numbers()["node_recall"] == 0
    assert math.isnan(empty.numbers()["node_precision"])
    for measured in (empty, Measures()):
        edges = measured.edge_scores()["all"]
        assert (edges.said, edges.found, edges.unmatched) == (0, 0, 0)
        assert math.isnan(edges.precision) and math.isnan(edges.calibration_error)
    assert math.isnan(edges.recall) and math.isnan(edges.log_loss)


def test_a_prediction_is_measured_by_its_points():
    prediction = ScanPrediction(
        (node(1, "", 0.5).points_m, np.zeros((0, 3)), np.full((2, 3), np.nan)),
        np.array([[0.9, 0.1], [1.0, 0.0], [1.0, 0.0]]),
        np.array([[0, 1]]),
        np.array([[0.5, 0.5]]),
    )
    vocabulary = Vocabulary(("chair", "table"), ("near", "on"))
    measured = measure_prediction(prediction, vocabulary, ROOM)
    assert (measured.found, measured.matched, measured.stray) == (1, 1, 2)
    # On a tie the last predicate counts.
    (edge,) = measured.edges
    assert (edge.predicate, edge.probability, edge.matched) == ("on", 0.5, False)


def test_reference_from_surface_points_or_ground_truth(tmp_path):
    content = ([("chair", 1), ("wall", 2), ("table", 3)], [(1, 3, "near")])
    annotations = Annotations(write_dataset(tmp_path, {"a": content}), "replica")
    found = read_reference(annotations, "a", annotations.points("a"))
    assert (found.ids, found.labels, found.exact) == ([1, 3], ["chair", "table"], False)
    np.testing.assert_allclose(found.boxes_max[0], [1, 0.95, 0], atol=1e-6)
    np.testing.assert_allclose(found.centroids[1], [3, 0.475, 0], atol=1e-6)
    assert found.relations == {(1, 3, "near")}
    write_ground_truth(tmp_path / "data" / "a")
    found = read_reference(annotations, "a", annotations.points("a"))
    assert (found.ids, found.exact) == ([1, 2, 3], True)
    assert (1, 2, "near") in found.relations
    assert not found.unclear
    path = tmp_path / "data/a/gt.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "unclear": [[1, 2]]}))
    found = read_reference(annotations, "a", annotations.points("a"))
    assert found.unclear == {(1, 2), (2, 1)}
    (tmp_path / "data/a/gt.json").write_text('{"objects": [{}]}')
    with pytest.raises(RecordingError, match=r"gt\.json"):
        read_reference(annotations, "a", annotations.points("a"))


# Object 99 cannot be detected.
HALL = scene(
    ["cup", "table", "lamp", "chair"],
    {
        *((10, 20, "on"), (30, 20, "on"), (99, 20, "on")),
        *((20, 10, "under"), (20, 40, "near"), (40, 20, "near")),
    },
)
# Two nodes of the cup, one of table and lamp, none of the chair; node 5 is in no box.
NODES = [
    node(1, "cup", 0.5, 5, 5),
    node(2, "table", 2.5, 9, 9),
    node(3, "cup", 0.5, 2, 2),
    node(4, "lamp", 4.5, 5, 5),
    node(5, "book", 50.0),
]
EDGES = [
    EdgeView(1, 2, "on", 0.95, 40),
    EdgeView(3, 2, "on", 0.65),  # of the second cup: right, and finds nothing new
    EdgeView(4, 2, "on", 0.45),  # right, but not said: below one half
    EdgeView(4, 1, "on", 0.995),  # a lamp on a cup: wrong, and sure
    EdgeView(2, 1, "near", 0.75),  # the annotation has "under"
    EdgeView(1, 3, "on", 0.9),  # two nodes of one object
    EdgeView(5, 2, "on", 0.8),  # a node without an object
    EdgeView(5, 2, "near", 0.3),  # the same, not said
    EdgeView(5, 7, "in", 0.6),  # a node that does not exist
]


def test_edges():
    measured = measure_views(NODES, EDGES, HALL)
    scores = measured.edge_scores()
    assert list(scores) == ["on", "in", "under", "near", "complete", "all"]
    counts = {
        name: (item.relations, item.found, item.said, item.right, item.unmatched)
        for name, item in scores.items()
    }
    # On, said between two objects: 0.95, 0.65 and 0.995. (99, on, 20) does not count.
    assert counts["on"] == (2, 1, 3, 2, 2)
    assert counts["under"] == (1, 0, 0, 0, 0)
    assert counts["near"] == (2, 0, 1, 0, 0)
    assert counts["complete"] == (3, 1, 3, 2, 3)
    assert counts["all"][:4] == (5, 1, 4, 2)
    on, under = scores["on"], scores["under"]
    assert (on.sure, on.sure_wrong) == (1, 1)
    assert (on.precision, on.recall) == (pytest.approx(2 / 3), 0.5)
    # One bin for 0.95 and 0.995 (half is right), one for 0.65, one for 0.45.
    gaps = [2 * abs(0.5 - (0.95 + 0.995) / 2), 1 - 0.65, 1 - 0.45]
    assert on.calibration_error == pytest.approx(sum(gaps) / 4)
    of_truth = (0.95, 0.65, 0.45, 0.005)
    assert on.log_loss == pytest.approx(-sum(map(math.log, of_truth)) / 2)
    assert under.recall == 0 and math.isnan(under.precision)
    assert math.isnan(under.calibration_error)
    # No edge states the one relation: a probability of 0, limited to 0.001.
    assert under.log_loss == pytest.approx(-math.log(1e-3))
    numbers = measured.numbers()
    assert (numbers["edges"], numbers["edges_unmatched"]) == (9, 3)
    assert (numbers["edge_precision"], numbers["edge_recall"]) == (0.5, 0.2)
    assert numbers["complete_edge_precision"] == pytest.approx(2 / 3)
    assert numbers["complete_edge_recall"] == pytest.approx(1 / 3)
    # Pooled scans count equal ids apart.
    for name, twice in pool([measured, measured]).edge_scores().items():
        one = scores[name]
        assert twice.relations == 2 * one.relations and twice.found == 2 * one.found
        assert twice.sure_wrong == 2 * one.sure_wrong
        assert twice.calibration_error == pytest.approx(one.calibration_error, nan_ok=True)


def test_edges_of_unclear_pairs_are_neither_right_nor_wrong():
    unclear = replace(HALL, unclear=frozenset({(10, 20), (20, 10)}))
    on = measure_views(NODES, EDGES, unclear).edge_scores()["on"]
    # Without the two edges and the relation of cup and table; those of no object count as before.
    assert (on.relations, on.found, on.said, on.right, on.unmatched) == (1, 0, 1, 0, 2)


def test_the_edge_list_has_the_worst_edges_first(tmp_path):
    measured = measure_views(NODES, EDGES, HALL)
    write_edge_list(tmp_path / "edges.csv", measured.edges, measured.relations)
    with (tmp_path / "edges.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    words = ("verdict", "subject_class", "predicate", "object_class", "probability")
    assert [tuple(row[word] for word in words) for row in rows] == [
        ("wrong", "lamp", "on", "cup", "0.9950"),
        ("wrong", "table", "near", "cup", "0.7500"),
        ("missed", "lamp", "on", "table", "0.4500"),
        ("missed", "table", "under", "cup", "0.0000"),
        ("missed", "table", "near", "chair", "0.0000"),
        ("missed", "chair", "near", "table", "0.0000"),
        ("unmatched", "cup", "on", "cup", "0.9000"),
        ("unmatched", "book", "on", "table", "0.8000"),
        ("unmatched", "book", "in", "", "0.6000"),
        ("right", "cup", "on", "table", "0.9500"),
        ("right", "cup", "on", "table", "0.6500"),
        ("not said", "book", "near", "table", "0.3000"),
    ]
    assert (rows[1]["truth"], rows[1]["reverse_truth"]) == ("under", "on")
    # A missed relation names the main nodes; the graph has none of the chair.
    assert (rows[3]["subject"], rows[3]["object"], rows[4]["object"]) == ("2", "1", "")
