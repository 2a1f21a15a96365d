"""Edges beside annotated relations, on graphs whose numbers are counted by hand."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from deworldsg_ros.evaluation.edge_measures import (
    Calibrated,
    EdgeView,
    ReferenceScene,
    ReliabilityBin,
    calibration_error,
    reliability,
    total_log_loss,
    write_edge_list,
)
from deworldsg_ros.evaluation.graph_measures import Measures, NodeView, measure_views, pool
from deworldsg_ros.evaluation.reports import plot_reliability

# Objects 10, 20, 30, 40 stand at x = 0, 2, 4, 6 m. Object 99 cannot be detected.
NAMES = ("cup", "table", "lamp", "chair")
LOW = np.array([[2.0 * index, 0.0, 0.0] for index in range(4)])
SCENE = ReferenceScene(
    ids=[10, 20, 30, 40],
    labels=list(NAMES),
    boxes_min=LOW,
    boxes_max=LOW + 1.0,
    centroids=LOW + 0.5,
    relations=frozenset(
        {
            (10, 20, "on"),
            (30, 20, "on"),
            (20, 10, "under"),
            (20, 40, "near"),
            (40, 20, "near"),
            (99, 20, "on"),
        }
    ),
    exact=True,
)


def node(number: int, object_index: int, observations: int = 5) -> NodeView:
    mean = LOW[object_index] + 0.5
    label = NAMES[object_index]
    return NodeView(number, label, 0.8, mean, mean[None], float(observations), observations)


# Two nodes of the cup, one of table and lamp, none of the chair; node 5 is in no box.
NODES = [
    node(1, 0),
    node(2, 1, observations=9),
    node(3, 0, observations=2),
    node(4, 2),
    NodeView(5, "book", 0.9, np.array([50.0, 0, 0]), np.zeros((0, 3)), 1.0, 1),
]
EDGES = [
    EdgeView(1, 2, "on", 0.95, 40),
    EdgeView(3, 2, "on", 0.65),  # of the second cup: right, and finds nothing new
    EdgeView(4, 2, "on", 0.45),  # right, but not said
    EdgeView(4, 1, "on", 0.995),  # a lamp on a cup: wrong, and sure
    EdgeView(2, 1, "near", 0.75),  # the annotation has "under"
    EdgeView(1, 3, "on", 0.9),  # two nodes of one object
    EdgeView(5, 2, "on", 0.8),  # a node without an object
    EdgeView(5, 2, "near", 0.3),  # the same, not said
    EdgeView(5, 7, "in", 0.6),  # a node that does not exist
]


def test_scores_by_predicate_are_those_counted_by_hand() -> None:
    measured = measure_views(NODES, EDGES, SCENE)
    scores = measured.edge_scores()
    assert list(scores) == ["on", "in", "under", "near", "complete", "all"]
    on = scores["on"]
    # Said between two objects: 0.95, 0.65 and 0.995. (99, on, 20) does not count.
    assert (on.relations, on.found, on.said, on.right) == (2, 1, 3, 2)
    assert (on.sure, on.sure_wrong, on.unmatched) == (1, 1, 2)
    assert on.precision == pytest.approx(2 / 3)
    assert on.recall == 0.5
    # One bin for 0.95 and 0.995 (half is right), one for 0.65, one for 0.45.
    gaps = [2 * abs(0.5 - (0.95 + 0.995) / 2), 1 - 0.65, 1 - 0.45]
    assert on.calibration_error == pytest.approx(sum(gaps) / 4)
    of_truth = (0.95, 0.65, 0.45, 0.005)
    assert on.log_loss == pytest.approx(-sum(map(math.log, of_truth)) / 2)
    under = scores["under"]
    assert (under.relations, under.found, under.said, under.recall) == (1, 0, 0, 0.0)
    assert math.isnan(under.precision)
    assert math.isnan(under.calibration_error)
    # No edge states the one relation: a probability of 0, limited to 0.001.
    assert under.log_loss == pytest.approx(-math.log(1e-3))
    near = scores["near"]
    assert (near.relations, near.found, near.said, near.right, near.unmatched) == (2, 0, 1, 0, 0)


def test_complete_predicates_are_pooled_apart_from_all() -> None:
    scores = measure_views(NODES, EDGES, SCENE).edge_scores()
    complete, all_ = scores["complete"], scores["all"]
    assert (complete.relations, complete.found, complete.said, complete.right) == (3, 1, 3, 2)
    assert complete.unmatched == 3
    assert (all_.relations, all_.found, all_.said, all_.right) == (5, 1, 4, 2)
    numbers = measure_views(NODES, EDGES, SCENE).numbers()
    assert numbers["edges"] == 9
    assert numbers["edge_precision"] == 0.5
    assert numbers["edge_recall"] == 0.2
    assert numbers["complete_edge_precision"] == pytest.approx(2 / 3)
    assert numbers["complete_edge_recall"] == pytest.approx(1 / 3)
    assert numbers["edges_unmatched"] == 3


def test_no_edges_and_no_relations() -> None:
    for measured in (measure_views([], [], SCENE), Measures()):
        scores = measured.edge_scores()["all"]
        assert (scores.said, scores.found, scores.unmatched) == (0, 0, 0)
        assert math.isnan(scores.precision)
        assert math.isnan(scores.calibration_error)
    assert math.isnan(scores.recall)
    assert math.isnan(scores.log_loss)


@pytest.mark.parametrize(("probability", "said"), [(0.5, 1), (0.4999, 0)])
def test_an_edge_is_said_from_one_half_on(probability: float, said: int) -> None:
    edges = [EdgeView(1, 2, "on", probability)]
    scores = measure_views(NODES, edges, SCENE).edge_scores()["on"]
    assert (scores.said, scores.right, scores.found) == (said, said, said)


def test_pooled_scans_count_equal_ids_apart() -> None:
    one = measure_views(NODES, EDGES, SCENE)
    twice = pool([one, one]).edge_scores()
    for name, scores in one.edge_scores().items():
        assert twice[name].relations == 2 * scores.relations
        assert twice[name].found == 2 * scores.found
        assert twice[name].sure_wrong == 2 * scores.sure_wrong
        assert twice[name].calibration_error == pytest.approx(scores.calibration_error, nan_ok=True)


def test_the_edge_list_has_the_worst_edges_first(tmp_path: Path) -> None:
    measured = measure_views(NODES, EDGES, SCENE)
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
    assert (rows[3]["subject"], rows[3]["object"]) == ("2", "1")
    assert (rows[4]["subject_observations"], rows[4]["object"]) == ("9", "")
    assert rows[4]["object_annotated"] == "40"
    right = rows[9]
    assert (right["subject"], right["subject_annotated"], right["edge_observations"]) == (
        "1",
        "10",
        "40",
    )


def test_reliability_bins() -> None:
    assert reliability([]) == []
    beliefs = [Calibrated(0.0, False), Calibrated(1.0, True), Calibrated(0.94, False)]
    assert reliability(beliefs) == [ReliabilityBin(1, 0, 0), ReliabilityBin(2, 0.97, 0.5)]


def test_calibration_error() -> None:
    assert math.isnan(calibration_error([]))
    assert calibration_error([Calibrated(1.0, True), Calibrated(0.0, False)]) == 0
    # Within a bin, over and under add up to the bin's gap.
    bin_ = [Calibrated(0.75, True)] * 3 + [Calibrated(0.75, False)]
    assert calibration_error(bin_) == pytest.approx(0)
    assert calibration_error([Calibrated(0.9, False)]) == pytest.approx(0.9)


def test_total_log_loss() -> None:
    assert total_log_loss([]) == 0
    beliefs = [Calibrated(0.8, True), Calibrated(0.8, False)]
    assert total_log_loss(beliefs) == pytest.approx(-math.log(0.8) - math.log(0.2))
    assert total_log_loss([Calibrated(1.0, False)]) == pytest.approx(-math.log(1e-3))


def test_leaving_out_an_edge_that_holds_does_not_lower_the_log_loss() -> None:
    stated = [EdgeView(1, 2, "on", 0.6), EdgeView(4, 2, "on", 0.3)]
    full = measure_views(NODES, stated, SCENE).edge_scores()["on"].log_loss
    assert measure_views(NODES, stated[:1], SCENE).edge_scores()["on"].log_loss > full
    assert measure_views(NODES, [], SCENE).edge_scores()["on"].log_loss > full
    # Leaving out an edge that does not hold lowers it.
    wrong = [*stated, EdgeView(4, 1, "on", 0.3)]
    assert measure_views(NODES, wrong, SCENE).edge_scores()["on"].log_loss > full


def test_the_reliability_plot_is_drawn_with_and_without_edges(tmp_path: Path) -> None:
    beliefs = {"complete": [Calibrated(0.9, True), Calibrated(0.3, False)], "all": []}
    for name, content in (("a.png", beliefs), ("b.png", {})):
        plot_reliability(tmp_path / name, content, "edges")
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
