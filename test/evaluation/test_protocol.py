"""The protocol: the official program's numbers, and its rules one by one on data made here."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.evaluation import one_hot, segment, write_dataset, write_json

from deworldsg_ros.evaluation.predictions import ScanPrediction, read_predictions
from deworldsg_ros.evaluation.scoring import (
    NO_RANK,
    ProtocolOptions,
    evaluate_predictions,
    match,
    rank,
    triple_rank,
)
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.errors import RecordingError

LAYOUT_NAMES = {"replica": "replica", "scannet": "3rscan"}
CASES = ("case_00", "case_01", "case_03", "case_05")


def options_of(arguments):
    values = dict(zip(arguments, [*arguments[1:], ""]))
    return ProtocolOptions(
        split=values.get("--split", "test"),
        skip_no_rel_objects="--skip_no_rel_objects" in values,
        overlap_threshold_m=float(values.get("--eval_overlap_threshold", "0.1")),
    )


@pytest.mark.parametrize("file_name", ["predictions.json", "predictions.pkl"])
@pytest.mark.parametrize("case", CASES)
def test_official_numbers(shared_dir, case, file_name):
    folder = shared_dir / "data" / "eval_cases" / case
    expected = json.loads((folder / "expected.json").read_text())
    annotations = Annotations(folder, LAYOUT_NAMES[expected["label_categories"]])
    predictions = read_predictions(folder / file_name)
    assert len(expected["runs"]) >= 2
    for run in expected["runs"].values():
        result = evaluate_predictions(annotations, predictions, options_of(run["arguments"]))
        numbers = result.numbers()
        for name in ("object", "predicate", "relationship"):
            assert numbers[f"{name}_recall"] == run[f"{name}_recall@1"]
        for name in ("object", "predicate"):
            mean = pytest.approx(run[f"{name}_mrecall@1"], abs=1e-12)
            assert numbers[f"{name}_mean_recall"] == mean
        for counts, key in (
            (result.object_classes, "object_per_class"),
            (result.predicate_classes, "predicate_per_class"),
        ):
            assert counts == {name: (item["hits"], item["gt"]) for name, item in run[key].items()}
        assert len(result.scans) == len(run["scans"])
        for scan, official in zip(result.scans, run["scans"]):
            assert scan.object_ids == official["gt_object_ids"]
            for name in ("scan", "object_ranks", "predicate_ranks", "relationship_ranks"):
                assert getattr(scan, name) == official[name], name
            matched = [scan.matching.prediction_of.get(number, -1) for number in scan.object_ids]
            assert matched == official["matched_prediction"]
            supports = [
                None if item is None else [item.object_id, item.points]
                for item in scan.matching.supports
            ]
            assert supports == official["prediction_supports"]
        # The paper's definition of the predicate recall, from the official matches and ranks.
        ranks = []
        for scan, official in zip(result.scans, run["scans"]):
            matched = dict(zip(official["gt_object_ids"], official["matched_prediction"]))
            for (subject, object_, _), ranked in zip(scan.relations, official["predicate_ranks"]):
                if -1 not in (matched.get(subject, -1), matched.get(object_, -1)):
                    ranks.append(ranked)
        assert result.predicates_of_detected == (ranks.count(0), len(ranks))
        assert 0 < len(ranks) < result.predicates.total


def test_rank_is_that_of_a_flipped_stable_sort():
    """Of equals the last comes first, NaN before every number."""
    generator = np.random.default_rng(3)
    for _ in range(50):
        scores = generator.choice([0.0, -0.0, 0.25, 1.0, np.nan, np.inf], 12)
        order = np.argsort(scores, kind="stable")[::-1]
        assert [rank(scores, index) for index in order] == list(range(12))
    assert rank(np.array([]), 0) == rank(np.array([1.0]), 5) == NO_RANK


def test_triple_rank_takes_every_cell_of_the_table():
    generator = np.random.default_rng(4)
    subject, object_, predicate = (generator.choice([0.0, 0.1, 0.3, 0.7], n) for n in (4, 4, 3))
    triples = list(np.ndindex(4, 4, 3))
    table = [(subject[a] * object_[b]) * predicate[k] for a, b, k in triples]
    for position, index in enumerate(np.argsort(table, kind="stable")[::-1]):
        assert triple_rank(subject, object_, predicate, triples[index]) == position
    # Zero vectors make the last triple the top.
    zeros = np.zeros(3)
    assert triple_rank(zeros, zeros, zeros, (2, 2, 2)) == 0
    assert triple_rank(np.ones(3), np.ones(3), zeros, (0, 0, 0)) == 26


@pytest.mark.parametrize(
    ("offset", "inside"),
    [((0.0, 0.0, 0.1), False), ((0.0, 0.08, 0.06), True), ((0.0, 0.0, 0.1 - 1e-9), True)],
)
def test_a_point_votes_when_strictly_nearer_than_the_threshold(offset, inside):
    matching = match([7], np.zeros((1, 3)), np.array([7]), [np.array([offset])])
    assert (matching.supports[0] is not None) is inside
    # Points that are not finite do not vote, but count.
    points = np.array([offset, [np.nan] * 3, [np.nan] * 3])
    matching = match([7], np.zeros((1, 3)), np.array([7]), [points])
    assert (matching.supports, matching.skipped_points) == ((None,), 2)


@given(seed=st.integers(0, 2**32 - 1))
def test_matching_equals_a_search_over_all_pairs(seed):
    generator = np.random.default_rng(seed)
    surface_points = generator.uniform(0, 0.5, (40, 3))
    ids = generator.integers(0, 5, 40)
    wanted_ids = [1, 2, 4]
    segments = [generator.uniform(0, 0.5, (n, 3)) for n in generator.integers(0, 12, 6)]
    supports = []
    for points in segments:
        votes = dict.fromkeys(wanted_ids, 0)
        for point in points:
            # Points of other ids are removed before the search.
            squared = ((surface_points - point) ** 2).sum(axis=1)
            squared[~np.isin(ids, wanted_ids)] = np.inf
            if squared.min() < 0.1 * 0.1:
                votes[ids[squared.argmin()]] += 1
        first, second = sorted(votes.values())[:-3:-1]
        void = not first or first / len(points) < 0.5
        if void or (second / len(points)) / (first / len(points)) > 0.75:
            supports.append(None)
        else:
            supports.append((max(votes, key=votes.get), first))
    matching = match(wanted_ids, surface_points, ids, segments)
    assert [s and (s.object_id, s.points) for s in matching.supports] == supports
    # Most points win, and the first of equals.
    for number in wanted_ids:
        rows = [row for row, support in enumerate(supports) if support and support[0] == number]
        best = max(rows, key=lambda row: supports[row][1], default=None)
        assert matching.prediction_of.get(number) == best


def graph(objects, edges):
    """Nodes (object id, class) and edges (subject, object, predicate) between indices."""
    predicates = np.array([one_hot(edge[2]) for edge in edges]).reshape(-1, 3)
    points = tuple(segment(number) for number, _ in objects)
    classes = np.array([one_hot(index) for _, index in objects]).reshape(-1, 3)
    pairs = np.array([edge[:2] for edge in edges], np.int64).reshape(-1, 2)
    return ScanPrediction(points, classes, pairs, predicates)


def data_set(root, layout="replica", split_scans=None, **scans):
    """Annotations of scans, each a list of objects and a list of relations."""
    return Annotations(write_dataset(root, scans, layout=layout, split_scans=split_scans), layout)


# An annotated chair 1 and table 2, and two relations between them.
OBJECTS = [("chair", 1), ("table", 2)]
ROOM = (OBJECTS, [(1, 2, "near"), (2, 1, "near")])
NODES = [(1, 1), (2, 2)]


@pytest.mark.parametrize(
    ("nodes", "edges", "hits"),
    [
        ([], [], (0, 0, 0)),
        (NODES, [(0, 1, 0), (1, 0, 0)], (2, 2, 2)),
        # Only one direction is predicted.
        (NODES, [(0, 1, 0)], (2, 1, 1)),
        # Wrong classes do not matter to predicates.
        ([(1, 0), (2, 2)], [(0, 1, 0)], (1, 1, 0)),
        # Of a pair predicted twice the first entry counts.
        (NODES, [(0, 1, 1), (0, 1, 0)], (2, 0, 0)),
        # The edge is at a duplicate that was not taken.
        ([*NODES, (1, 1)], [(2, 1, 0)], (2, 0, 0)),
        # An edge to a node that does not exist.
        (NODES, [(0, 7, 0)], (2, 0, 0)),
    ],
)
@pytest.mark.parametrize("layout", ["replica", "3rscan"])
def test_items(tmp_path, layout, nodes, edges, hits):
    prediction = graph(nodes, edges)
    annotations = data_set(tmp_path, layout, a=ROOM)
    result = evaluate_predictions(annotations, {"a": prediction, "other": prediction})
    assert (result.objects, result.predicates, result.relationships) == tuple(
        (hit, 2) for hit in hits
    )


def test_every_relation_line_is_an_item_and_a_self_relation_needs_a_loop(tmp_path):
    lines = [(1, 2, "near"), (1, 2, "near"), (1, 2, "on"), (1, 1, "on")]
    annotations = data_set(tmp_path, a=(OBJECTS, lines))
    result = evaluate_predictions(annotations, {"a": graph(NODES, [(0, 1, 0), (0, 0, 1)])})
    assert result.predicates == (3, 4)
    assert result.predicate_classes == {"near": (2, 2), "on": (1, 2)}


def test_items_are_pooled_and_absent_predictions_count(tmp_path):
    annotations = data_set(tmp_path, a=ROOM, b=([("chair", 1), ("book", 4), ("book", 5)], []))
    result = evaluate_predictions(annotations, {"a": graph(NODES, [])})
    assert result.objects == (2, 5)
    assert result.object_mean_recall == pytest.approx((0 + 0.5 + 1) / 3)
    assert any("b has no prediction" in note for note in result.notes)
    # A scan that is listed twice is evaluated twice.
    twice = data_set(tmp_path / "twice", split_scans=["a", " a ", ""], a=ROOM)
    assert evaluate_predictions(twice, {}).objects == (0, 4)


def test_skipped_objects_follow_the_last_relation_entry(tmp_path):
    annotations = data_set(tmp_path, a=([*OBJECTS, ("book", 3)], []))
    entries = [[[1, 2, 0, "near"], [3, 2, 0, "on"]], [[1, 2, 0, "on"]]]
    listed = [{"scan": "a", "relationships": entry} for entry in entries]
    write_json(tmp_path / "ReplicaSSG/relationships.json", {"scans": listed})
    annotations = Annotations(tmp_path, "replica")
    assert evaluate_predictions(annotations, {}).objects == (0, 3)
    skipping = evaluate_predictions(annotations, {}, ProtocolOptions(skip_no_rel_objects=True))
    assert skipping.objects == (0, 2)
    # The relations of all entries count in both, also one whose end was skipped.
    assert skipping.predicates == (0, 3)
    assert annotations.scan("a").related_ids == {1, 2}


def test_labels_ids_and_entries(tmp_path):
    data_set(tmp_path, a=ROOM)
    last = {"wall": "8", "never heard": "7", "table": "2", "chair": "30"}
    listed = [
        {"scan": "a", "objects": [{"label": label, "id": id_} for label, id_ in entry.items()]}
        for entry in ({"book": "9"}, last)
    ]
    write_json(tmp_path / "ReplicaSSG/objects.json", {"scans": listed})
    annotations = Annotations(tmp_path, "replica")
    # The last entry stands; an object without a point in the PLY stays in the denominator.
    assert annotations.scan("a").objects == {2: 2, 30: 1}
    assert evaluate_predictions(annotations, {}).objects == (0, 2)


def test_input_on_which_the_official_program_stops(tmp_path):
    one = ([("chair", 1)], [(1, 6, "near"), (1, 1, "never heard")])
    annotations = data_set(tmp_path, none=([("wall", 1)], []), one=one)
    prediction = graph([(1, 1)], [(0, 0, 0)])
    result = evaluate_predictions(annotations, {"none": prediction, "one": prediction})
    assert (result.objects, result.predicates) == ((1, 1), (0, 2))
    assert sum("never" in note for note in result.notes) == 2
    empty = data_set(tmp_path / "e", a=([("chair", 1)], []))
    assert math.isnan(evaluate_predictions(empty, {}).predicates.recall)


def test_a_missing_file_is_reported_with_its_source(tmp_path):
    with pytest.raises(RecordingError, match=r"replica_to_visual_genome\.json is missing.*Replica"):
        Annotations(tmp_path, "replica")
    annotations = data_set(tmp_path, a=ROOM)
    (tmp_path / "data/a/labels.instances.annotated.v2.ply").unlink()
    with pytest.raises(RecordingError, match=r"annotated\.v2\.ply is missing"):
        evaluate_predictions(annotations, {})
