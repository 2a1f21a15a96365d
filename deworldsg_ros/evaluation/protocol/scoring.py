"""The official protocol: recall of objects, predicates and relationships.

The rules are those of the program behind the published numbers (FROSS, ``Merging/evaluate.py``).
docs/dev/evaluation/protocol.md states them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from deworldsg_ros.evaluation.protocol.matching import OVERLAP_THRESHOLD_M, Matching, match
from deworldsg_ros.evaluation.protocol.predictions import ScanPrediction
from deworldsg_ros.evaluation.protocol.ranking import NO_RANK, rank, triple_rank
from deworldsg_ros.recordings.folders.annotations import Annotations, ScanAnnotation, ScanPoints
from deworldsg_ros.scene.frame_graph import Vocabulary


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
        object_classes, predicate_classes: counts by annotated class or predicate, in the order of
            the vocabulary; without those that have no item.
        scans: results of the scans, in the order of the split.
    """

    objects: Count
    predicates: Count
    relationships: Count
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
        """The five scores by name, as fractions."""
        return {
            "object_recall": self.objects.recall,
            "predicate_recall": self.predicates.recall,
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
    return ProtocolResult(
        _count(right for _, right in objects),
        _count(right for _, right in predicates),
        _count(relationships),
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
