"""The official protocol: matching by nearest points, and its recalls."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from deworldsg_ros.evaluation.predictions import ScanPrediction
from deworldsg_ros.recordings.folders.annotations import Annotations, ScanAnnotation, ScanPoints
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.frame_graph import Vocabulary

# --- Matching of predictions to annotated objects by the official vote of nearest points.

# The limits of the official program (FROSS, Merging/evaluate.py): distance to the nearest annotated
# point, fraction of votes of the best object, and ratio of the second best to the best.
OVERLAP_THRESHOLD_M = 0.1
MIN_VOTE_FRACTION = 0.5
MAX_SECOND_TO_BEST = 0.75


@dataclass(frozen=True)
class Support:
    """The object that a prediction supports, and its number of votes."""

    object_id: int
    points: int


@dataclass(frozen=True)
class Matching:
    """Result of the vote.

    Attributes:
        supports: the object that each prediction supports; None = void prediction.
        prediction_of: row of the prediction by id of the object, for each object that is found.
        skipped_points: number of points with NaN or infinity, which have no vote.
    """

    supports: tuple[Support | None, ...]
    prediction_of: dict[int, int]
    skipped_points: int


def match(
    object_ids: Sequence[int],
    points_world: Float64,
    point_objects: Int64,
    segments: Sequence[NDArray[np.floating[Any]]],
    threshold_m: float = OVERLAP_THRESHOLD_M,
) -> Matching:
    """Match predictions to objects (docs/dev/evaluation/protocol.md, "Matching").

    Args:
        object_ids: ids of the annotated objects; annotated points of other ids are ignored.
        points_world: (n, 3) float64, metres, annotated surface points.
        point_objects: (n,) int64, object id of each annotated point.
        segments: points (n_i, 3) of each prediction, metres.
        threshold_m: a point votes for the object of its nearest annotated point if the distance is
            strictly less.
    """
    ids = np.array(sorted(set(object_ids)), np.int64)
    kept = np.isin(point_objects, ids)
    usable = kept & np.isfinite(points_world).all(axis=1)
    skipped = int((kept & ~usable).sum())
    surface = np.ascontiguousarray(points_world[usable])
    rows = np.searchsorted(ids, point_objects[usable])
    tree = cKDTree(surface) if len(surface) else None

    supports: list[Support | None] = []
    for segment in segments:
        points = np.asarray(segment, np.float64).reshape(-1, 3)
        finite = points[np.isfinite(points).all(axis=1)]
        skipped += len(points) - len(finite)
        votes = np.zeros(len(ids), np.int64)
        if tree is not None and len(finite):
            votes = _votes(tree, surface, rows, finite, len(ids), threshold_m)
        best = _supported(votes, len(points))
        supports.append(None if best is None else Support(int(ids[best]), int(votes[best])))
    return Matching(tuple(supports), _best_predictions(supports), skipped)


def _votes(
    tree: Any,
    surface: Float64,
    rows: Int64,
    points: Float64,
    object_count: int,
    threshold_m: float,
) -> Int64:
    _, nearest = tree.query(points)
    delta = points - surface[nearest]
    # The distances of the tree went through a square root, whose rounding can change a vote.
    squared = delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1] + delta[:, 2] * delta[:, 2]
    inside = squared < threshold_m * threshold_m
    return np.bincount(rows[nearest[inside]], minlength=object_count).astype(np.int64)


def _supported(votes: Int64, point_count: int) -> int | None:
    """Index of the object that the votes support; None = void prediction."""
    if point_count == 0 or not votes.any():
        return None
    best = int(votes.argmax())
    others = np.delete(votes, best)
    # A ratio of rounded fractions, as in the official program: 9/22 over 12/22 exceeds 0.75.
    fraction = int(votes[best]) / point_count
    second = (int(others.max()) if len(others) else 0) / point_count
    if fraction < MIN_VOTE_FRACTION or second / fraction > MAX_SECOND_TO_BEST:
        return None
    return best


def _best_predictions(supports: Sequence[Support | None]) -> dict[int, int]:
    """Row of the prediction with most votes for each object; of equal ones the first."""
    taken: dict[int, int] = {}
    for row, support in enumerate(supports):
        if support is None:
            continue
        current = taken.get(support.object_id)
        rival = supports[current] if current is not None else None
        if rival is None or support.points > rival.points:
            taken[support.object_id] = row
    return taken


# --- Ranks of scores in the official order: the last of equal scores first, NaN above all
# numbers.

# Rank of an item without a match or an edge, as in the official program.
NO_RANK = 99999


def rank(scores: NDArray[Any], index: int) -> int:
    """Number of scores (n,) that rank before the one at `index`; 0 = the top.

    An index outside the scores has the rank `NO_RANK`, or n if that is larger.
    """
    if not 0 <= index < len(scores):
        return max(NO_RANK, len(scores))
    value = scores[index]
    later = scores[index + 1 :]
    if scores.dtype.kind != "f":
        return int((scores > value).sum() + (later == value).sum())
    if np.isnan(value):
        return int(np.isnan(later).sum())
    # NaN compares as not less or equal.
    return int((~(scores <= value)).sum() + (later == value).sum())


def triple_rank(
    subject_scores: NDArray[Any],
    object_scores: NDArray[Any],
    predicate_scores: NDArray[Any],
    triple: tuple[int, int, int],
) -> int:
    """Rank of (subject class, object class, predicate) among all triples.

    The score of a triple is (subject * object) * predicate, multiplied in this order and in the
    number type of the arrays. Ties follow the row-major order of triples, the predicate fastest.
    """
    sizes = (len(subject_scores), len(object_scores), len(predicate_scores))
    if not all(0 <= index < size for index, size in zip(triple, sizes)):
        return max(NO_RANK, sizes[0] * sizes[1] * sizes[2])
    # Predictions may overflow or contain NaN: the ranking defines both.
    with np.errstate(all="ignore"):
        ends = subject_scores[:, None] * object_scores[None, :]
        table = ends[:, :, None] * predicate_scores[None, None, :]
    index = (triple[0] * sizes[1] + triple[1]) * sizes[2] + triple[2]
    return rank(table.ravel(), index)


# --- The official protocol: recall of objects, predicates and relationships.
#
# The rules are those of the program behind the published numbers (FROSS, ``Merging/evaluate.py``).
# docs/dev/evaluation/protocol.md states them.


@dataclass(frozen=True)
class ProtocolOptions:
    """Options of the official program.

    Attributes:
        split: train, validation (val) or test.
        skip_no_rel_objects: count only objects that occur in the relations of the scan.
        overlap_threshold_m: maximum distance from a predicted point to its annotated point.
        aligned_ply: use the aligned point cloud (3RScan layout).
    """

    split: str = "test"
    skip_no_rel_objects: bool = False
    overlap_threshold_m: float = OVERLAP_THRESHOLD_M
    aligned_ply: bool = False


@dataclass(frozen=True)
class ScanResult:
    """Ranks of the annotated items of one scan, in the order of the annotation.

    Attributes:
        scan: id of the scan.
        object_ids, object_classes: annotated objects that count.
        relations: annotated (subject, object, predicate).
        matching: predictions matched to objects.
        object_ranks, predicate_ranks, relationship_ranks: rank of the annotated class, predicate
            and triple; 0 = right.
        notes: input on which the official program would stop, and how it was handled.
    """

    scan: str
    object_ids: list[int]
    object_classes: list[int]
    relations: list[tuple[int, int, int]]
    matching: Matching
    object_ranks: list[int]
    predicate_ranks: list[int]
    relationship_ranks: list[int]
    notes: list[str] = field(default_factory=list)


class Count(NamedTuple):
    """Number of right items and of all items."""

    hits: int
    total: int

    @property
    def recall(self) -> float:
        """Fraction of right items; NaN without items."""
        return self.hits / self.total if self.total else math.nan


@dataclass(frozen=True)
class ProtocolResult:
    """Scores over several scans.

    Attributes:
        objects, predicates, relationships: counts over all scans.
        predicates_of_detected: the predicates whose objects both have a matched node: "among
            detected object pairs", the definition of the paper.
        object_classes, predicate_classes: counts by annotated class or predicate, in the order of
            the vocabulary; without those that have no item.
        scans: results of the scans, in the order of the split.
    """

    objects: Count
    predicates: Count
    relationships: Count
    predicates_of_detected: Count
    object_classes: dict[str, Count]
    predicate_classes: dict[str, Count]
    scans: list[ScanResult]

    @property
    def object_mean_recall(self) -> float:
        """Mean recall over classes with items; NaN without any."""
        return _mean(self.object_classes.values())

    @property
    def predicate_mean_recall(self) -> float:
        """Mean recall over predicates with items; NaN without any."""
        return _mean(self.predicate_classes.values())

    @property
    def notes(self) -> list[str]:
        """Notes of all scans."""
        return [note for scan in self.scans for note in scan.notes]

    def numbers(self) -> dict[str, float]:
        """The five scores, and the predicate recall as the paper defines it, as fractions."""
        return {
            "object_recall": self.objects.recall,
            "predicate_recall": self.predicates.recall,
            "predicate_recall_of_detected": self.predicates_of_detected.recall,
            "relationship_recall": self.relationships.recall,
            "object_mean_recall": self.object_mean_recall,
            "predicate_mean_recall": self.predicate_mean_recall,
        }


def evaluate_predictions(
    annotations: Annotations,
    predictions: Mapping[str, ScanPrediction],
    options: ProtocolOptions | None = None,
    scans: Sequence[str] | None = None,
) -> ProtocolResult:
    """Score predictions by scan against the annotations of `scans`; None = of the split.

    Raises:
        RecordingError: a file of the data set is missing or cannot be read.
    """
    options = options or ProtocolOptions()
    vocabulary = annotations.vocabulary
    results = []
    for scan in scans or annotations.scans(options.split):
        prediction = predictions.get(scan)
        notes = (
            []
            if prediction is not None
            else [f"{scan} has no prediction: all its items count as wrong"]
        )
        if prediction is None:
            prediction = ScanPrediction.empty(len(vocabulary.classes), len(vocabulary.predicates))
        points = annotations.points(scan, aligned=options.aligned_ply)
        result = score_scan(annotations.scan(scan), points, prediction, options)
        results.append(replace(result, notes=[*notes, *result.notes]))
    return pool(results, vocabulary)


def score_scan(
    annotation: ScanAnnotation,
    points: ScanPoints,
    prediction: ScanPrediction,
    options: ProtocolOptions,
) -> ScanResult:
    """Match the predictions of one scan to its objects, and rank its items."""
    objects = annotation.objects
    if options.skip_no_rel_objects:
        related = annotation.related_ids or frozenset()
        objects = {number: index for number, index in objects.items() if number in related}
    matching = match(
        list(objects),
        points.points_world,
        points.object_ids,
        prediction.points_world,
        options.overlap_threshold_m,
    )
    object_ranks = []
    for number, index in objects.items():
        row = matching.prediction_of.get(number)
        ranked = NO_RANK if row is None else rank(prediction.class_scores[row], index)
        object_ranks.append(ranked)
    predicate_ranks, relationship_ranks = _rank_relations(
        annotation.relations, objects, matching, prediction
    )
    notes = [*annotation.notes, *prediction.notes]
    if matching.skipped_points:
        notes.append(
            f"{annotation.scan}: {matching.skipped_points} points are not finite: they have no vote"
        )
    return ScanResult(
        annotation.scan,
        list(objects),
        list(objects.values()),
        annotation.relations,
        matching,
        object_ranks,
        predicate_ranks,
        relationship_ranks,
        notes,
    )


def _rank_relations(
    relations: Sequence[tuple[int, int, int]],
    objects: Mapping[int, int],
    matching: Matching,
    prediction: ScanPrediction,
) -> tuple[list[int], list[int]]:
    # If a pair is predicted twice, the first entry counts.
    edge_rows: dict[tuple[int, int], int] = {}
    for row, (subject, object_) in enumerate(prediction.edges.tolist()):
        edge_rows.setdefault((subject, object_), row)
    predicate_ranks, relationship_ranks = [], []
    for subject_id, object_id, predicate in relations:
        subject = matching.prediction_of.get(subject_id)
        object_ = matching.prediction_of.get(object_id)
        found = subject is not None and object_ is not None
        edge = edge_rows.get((subject, object_)) if found else None  # type: ignore[arg-type]
        if edge is None or subject is None or object_ is None:
            predicate_ranks.append(NO_RANK)
            relationship_ranks.append(NO_RANK)
            continue
        scores = prediction.edge_scores[edge]
        predicate_ranks.append(rank(scores, predicate))
        relationship_ranks.append(
            triple_rank(
                prediction.class_scores[subject],
                prediction.class_scores[object_],
                scores,
                (objects[subject_id], objects[object_id], predicate),
            )
        )
    return predicate_ranks, relationship_ranks


def pool(scans: Sequence[ScanResult], vocabulary: Vocabulary) -> ProtocolResult:
    """Scores over the items of all scans."""
    objects = [
        (index, ranked == 0)
        for scan in scans
        for index, ranked in zip(scan.object_classes, scan.object_ranks)
    ]
    predicates = [
        (line[2], ranked == 0)
        for scan in scans
        for line, ranked in zip(scan.relations, scan.predicate_ranks)
    ]
    relationships = [ranked == 0 for scan in scans for ranked in scan.relationship_ranks]
    of_detected = [
        ranked == 0
        for scan in scans
        for line, ranked in zip(scan.relations, scan.predicate_ranks)
        if scan.matching.prediction_of.keys() >= set(line[:2])
    ]
    return ProtocolResult(
        _count(right for _, right in objects),
        _count(right for _, right in predicates),
        _count(relationships),
        _count(of_detected),
        _by_class(objects, vocabulary.classes),
        _by_class(predicates, vocabulary.predicates),
        list(scans),
    )


def _count(rights: Iterable[bool]) -> Count:
    listed = list(rights)
    return Count(sum(listed), len(listed))


def _by_class(items: Sequence[tuple[int, bool]], names: Sequence[str]) -> dict[str, Count]:
    hits, totals = [0] * len(names), [0] * len(names)
    for index, right in items:
        if index >= 0:
            hits[index] += right
            totals[index] += 1
    return {name: Count(hit, total) for name, hit, total in zip(names, hits, totals) if total}


def _mean(counts: Iterable[Count]) -> float:
    recalls = [count.recall for count in counts]
    return sum(recalls) / len(recalls) if recalls else math.nan
