"""Edges of a graph compared with annotated relations, and probabilities with their outcomes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deworldsg_ros.base.files import write_csv
from deworldsg_ros.recordings.folders.annotations import Annotations, ScanPoints
from deworldsg_ros.recordings.folders.sequence import GROUND_TRUTH_NAME
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RecordingError

# --- Predicted probabilities compared with how often the predictions are right.

BINS = 10
# Probabilities are clipped this far from 0 and 1: one certain error must not decide the log loss.
LOG_LOSS_MARGIN = 1e-3


class Calibrated(NamedTuple):
    """A predicted probability and whether the prediction is right."""

    probability: float
    right: bool


class ReliabilityBin(NamedTuple):
    """The predictions of one interval of probabilities: number, mean probability, part right."""

    size: int
    probability: float
    right: float


def reliability(beliefs: Sequence[Calibrated]) -> list[ReliabilityBin]:
    """The bins [0, 0.1), [0.1, 0.2), …, [0.9, 1] that have predictions, in this order."""
    probabilities = np.array([item.probability for item in beliefs], np.float64)
    right = np.array([item.right for item in beliefs], np.float64)
    index = np.clip((probabilities * BINS).astype(int), 0, BINS - 1)
    rows = [np.flatnonzero(index == number) for number in range(BINS)]
    return [
        ReliabilityBin(len(row), float(probabilities[row].mean()), float(right[row].mean()))
        for row in rows
        if len(row)
    ]


def calibration_error(beliefs: Sequence[Calibrated]) -> float:
    """Expected calibration error, Σ n · |part right - mean probability| / Σ n over the bins.

    NaN without beliefs.
    """
    if not beliefs:
        return math.nan
    gaps = [bin_.size * abs(bin_.right - bin_.probability) for bin_ in reliability(beliefs)]
    return sum(gaps) / len(beliefs)


def total_log_loss(beliefs: Sequence[Calibrated]) -> float:
    """Sum of -ln(probability of what is true), nats.

    Probabilities are clipped to [`LOG_LOSS_MARGIN`, 1 - `LOG_LOSS_MARGIN`].
    """
    stated = np.array([item.probability for item in beliefs], np.float64)
    of_truth = np.where([item.right for item in beliefs], stated, 1.0 - stated)
    return float(-np.log(np.clip(of_truth, LOG_LOSS_MARGIN, 1.0 - LOG_LOSS_MARGIN)).sum())


# --- Annotated positions of the objects of a scan, for the measures beside the protocol.


@dataclass(frozen=True)
class ReferenceScene:
    """The n objects of a scan that can be detected, and their relations.

    Attributes:
        ids: ids of the annotation.
        labels: class names.
        boxes_min, boxes_max: (n, 3) float64, metres, world: axis-aligned boxes.
        centroids: (n, 3) float64, metres, world: centroid of the visible surface, or of the whole
            surface if the visible part is unknown.
        relations: (subject id, object id, predicate name) of every true relation.
        exact: True if boxes and centroids come from the ground truth of a rendered room, False if
            they come from annotated surface points.
        unclear: (id, id) of the pairs about which two people may disagree, in both orders. Their
            edges and relations are neither right nor wrong.
    """

    ids: list[int]
    labels: list[str]
    boxes_min: Float64
    boxes_max: Float64
    centroids: Float64
    relations: frozenset[tuple[int, int, str]]
    exact: bool
    unclear: frozenset[tuple[int, int]] = frozenset()

    def __len__(self) -> int:
        return len(self.ids)


def read_reference(annotations: Annotations, scan: str, points: ScanPoints) -> ReferenceScene:
    """The reference of a scan: from its gt.json, or else from the annotated surface points.

    An object without surface points is left out.

    Raises:
        RecordingError: a field of gt.json is missing or invalid.
    """
    content = annotations.ground_truth(scan)
    if content is None:
        return _from_points(annotations, scan, points)
    try:
        objects = [item for item in content["objects"] if item["vg"] and item["detectable"]]
        boxes = np.array([item["aabb"] for item in objects], np.float64).reshape(-1, 2, 3)
        centroids = np.array([item["visible_centroid"] for item in objects], np.float64)
        return ReferenceScene(
            [int(item["id"]) for item in objects],
            [str(item["vg"]) for item in objects],
            boxes[:, 0],
            boxes[:, 1],
            centroids.reshape(-1, 3),
            frozenset((int(s), int(o), str(name)) for s, o, _, name in content["relationships"]),
            exact=True,
            unclear=frozenset(
                pair for a, b in content.get("unclear", ()) for pair in ((int(a), int(b)), (b, a))
            ),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"{annotations.scan_folder(scan) / GROUND_TRUTH_NAME}: {type(error).__name__}: {error}"
        ) from error


def _from_points(annotations: Annotations, scan: str, points: ScanPoints) -> ReferenceScene:
    annotation = annotations.scan(scan)
    vocabulary = annotations.vocabulary
    finite = np.isfinite(points.points_world).all(axis=1)
    surfaces = {
        number: points.points_world[finite & (points.object_ids == number)]
        for number in annotation.objects
    }
    surfaces = {number: surface for number, surface in surfaces.items() if len(surface)}
    return ReferenceScene(
        list(surfaces),
        [vocabulary.classes[annotation.objects[number]] for number in surfaces],
        np.array([surface.min(axis=0) for surface in surfaces.values()]).reshape(-1, 3),
        np.array([surface.max(axis=0) for surface in surfaces.values()]).reshape(-1, 3),
        np.array([surface.mean(axis=0) for surface in surfaces.values()]).reshape(-1, 3),
        frozenset(
            (subject, object_, vocabulary.predicates[predicate])
            for subject, object_, predicate in annotation.relations
            if predicate >= 0
        ),
        exact=False,
    )


# --- Edges of a graph compared with annotated relations, predicate by predicate.
#
# docs/dev/evaluation/protocol.md defines every measure.

# Ground truth lists every instance of these predicates: an edge without annotation is wrong.
COMPLETE_PREDICATES = ("on", "in", "attached to", "above", "under", "against")
# A graph says an edge from this probability on, and is sure of it from the second on.
SAID, SURE = 0.5, 0.99
# Names of the scores over the complete predicates and over all.
COMPLETE, ALL = "complete", "all"


class EdgeView(NamedTuple):
    """An edge in the form for the measures: node ids, best predicate and its probability."""

    subject: int
    object: int
    predicate: str
    probability: float
    observations: int = 0


class EdgeEnd(NamedTuple):
    """One end of an edge.

    Attributes:
        node: id of the node; None if the graph has none for the object.
        label: class of the node, or of the object if there is no node.
        observations: of the node.
        object: id of the annotated object that the node is matched to; None if there is none.
    """

    node: int | None
    label: str
    observations: int
    object: int | None


class JudgedEdge(NamedTuple):
    """An edge, or an annotated relation, beside the annotation.

    Attributes:
        subject, object: the ends.
        predicate: of the edge or relation.
        probability: of the edge; of a relation, the highest of the edges that state it, else 0.
        observations: of the edge.
        truth: predicates that are annotated from subject to object.
        reverse_truth: predicates that are annotated from object to subject.
    """

    subject: EdgeEnd
    predicate: str
    object: EdgeEnd
    probability: float
    observations: int
    truth: tuple[str, ...]
    reverse_truth: tuple[str, ...]

    @property
    def matched(self) -> bool:
        """Whether the edge links nodes of two objects."""
        ends = self.subject.object, self.object.object
        return None not in ends and ends[0] != ends[1]

    @property
    def right(self) -> bool:
        """Whether the annotation has this relation."""
        return self.predicate in self.truth

    @property
    def said(self) -> bool:
        """Whether the graph states the relation as more likely than not."""
        return self.probability >= SAID


@dataclass(frozen=True)
class EdgeScores:
    """Scores of the edges of one predicate or of several.

    Attributes:
        relations: annotated relations between objects that can be detected.
        found: of those, the ones that an edge says.
        said: edges between nodes of two objects with a probability of at least `SAID`.
        right: of those, the ones that are annotated.
        unmatched: edges with a probability of at least `SAID` that do not link nodes of two
            objects.
        sure: said edges with a probability of at least `SURE`.
        sure_wrong: of those, the ones that are not annotated.
        calibration_error: over all edges between nodes of two objects; NaN without any.
        log_loss: nats per relation, over these edges and the relations that no edge states, which
            have a probability of 0; NaN without relations. A graph cannot lower it by leaving out
            an edge that holds.
    """

    relations: int
    found: int
    said: int
    right: int
    unmatched: int
    sure: int
    sure_wrong: int
    calibration_error: float
    log_loss: float

    @property
    def precision(self) -> float:
        """Right part of the said edges; NaN without any."""
        return self.right / self.said if self.said else math.nan

    @property
    def recall(self) -> float:
        """Found part of the relations; NaN without any."""
        return self.found / self.relations if self.relations else math.nan

    def numbers(self) -> dict[str, float]:
        """Every number by name."""
        return {
            "relations": self.relations,
            "relations_found": self.found,
            "edges_said": self.said,
            "edges_right": self.right,
            "edges_unmatched": self.unmatched,
            "edges_sure": self.sure,
            "edges_sure_wrong": self.sure_wrong,
            "edge_precision": self.precision,
            "edge_recall": self.recall,
            "edge_calibration_error": self.calibration_error,
            "edge_log_loss": self.log_loss,
        }


def judge_edges(
    edges: Iterable[EdgeView], ends: Mapping[int, EdgeEnd], reference: ReferenceScene
) -> list[JudgedEdge]:
    """Each edge of a clear pair beside the annotation; `ends` has the ends by node id."""
    truth = _predicates_by_pair(reference)
    judged = []
    for edge in edges:
        subject, object_ = (
            ends.get(node, EdgeEnd(node, "", 0, None)) for node in (edge.subject, edge.object)
        )
        if (subject.object, object_.object) in reference.unclear:
            continue
        judged.append(
            JudgedEdge(
                subject,
                edge.predicate,
                object_,
                edge.probability,
                edge.observations,
                truth.get((subject.object, object_.object), ()),
                truth.get((object_.object, subject.object), ()),
            )
        )
    return judged


def judge_relations(
    judged: Iterable[JudgedEdge], ends: Mapping[int, EdgeEnd], reference: ReferenceScene
) -> list[JudgedEdge]:
    """Each relation between objects that can be detected, with the edge that states it best.

    Relations of unclear pairs are left out.

    Args:
        judged: the edges of the graph.
        ends: by object id, the end at the main node of the object; others have no node.
        reference: of the scan.
    """
    best: dict[tuple[int | None, str, int | None], JudgedEdge] = {}
    for edge in judged:
        key = edge.subject.object, edge.predicate, edge.object.object
        if edge.right and (key not in best or best[key].probability < edge.probability):
            best[key] = edge
    labels = dict(zip(reference.ids, reference.labels))
    truth = _predicates_by_pair(reference)
    relations = []
    for subject, object_, predicate in sorted(reference.relations):
        if subject not in labels or object_ not in labels:
            continue
        if (subject, object_) in reference.unclear:
            continue
        stated = best.get((subject, predicate, object_))
        relations.append(
            stated
            or JudgedEdge(
                ends.get(subject, EdgeEnd(None, labels[subject], 0, subject)),
                predicate,
                ends.get(object_, EdgeEnd(None, labels[object_], 0, object_)),
                0.0,
                0,
                truth[subject, object_],
                truth.get((object_, subject), ()),
            )
        )
    return relations


def score_edges(
    edges: Sequence[JudgedEdge],
    relations: Sequence[JudgedEdge],
    predicates: Collection[str] | None = None,
) -> EdgeScores:
    """Scores of the edges and relations with one of `predicates`; None = of all."""
    edges = [edge for edge in edges if predicates is None or edge.predicate in predicates]
    wanted = [item for item in relations if predicates is None or item.predicate in predicates]
    said = [edge for edge in edges if edge.matched and edge.said]
    sure = [edge for edge in said if edge.probability >= SURE]
    beliefs = beliefs_of(edges)
    unstated = [Calibrated(0.0, right=True) for item in wanted if item.probability == 0.0]
    loss = total_log_loss(beliefs + unstated)
    return EdgeScores(
        relations=len(wanted),
        found=sum(item.said for item in wanted),
        said=len(said),
        right=sum(edge.right for edge in said),
        unmatched=sum(edge.said and not edge.matched for edge in edges),
        sure=len(sure),
        sure_wrong=sum(not edge.right for edge in sure),
        calibration_error=calibration_error(beliefs),
        log_loss=loss / len(wanted) if wanted else math.nan,
    )


def scores_by_predicate(
    edges: Sequence[JudgedEdge], relations: Sequence[JudgedEdge]
) -> dict[str, EdgeScores]:
    """Scores of each predicate that occurs, then of the complete predicates and of all."""
    present = {item.predicate for item in (*edges, *relations)}
    names = [name for name in COMPLETE_PREDICATES if name in present]
    names += sorted(present - set(names))
    scores = {name: score_edges(edges, relations, (name,)) for name in names}
    scores[COMPLETE] = score_edges(edges, relations, COMPLETE_PREDICATES)
    scores[ALL] = score_edges(edges, relations)
    return scores


def beliefs_of(edges: Iterable[JudgedEdge]) -> list[Calibrated]:
    """Probability of each edge between nodes of two objects, and whether it is right."""
    return [Calibrated(edge.probability, edge.right) for edge in edges if edge.matched]


def _predicates_by_pair(
    reference: ReferenceScene,
) -> dict[tuple[int | None, int | None], tuple[str, ...]]:
    pairs: dict[tuple[int | None, int | None], tuple[str, ...]] = {}
    for subject, object_, predicate in sorted(reference.relations):
        pairs[subject, object_] = (*pairs.get((subject, object_), ()), predicate)
    return pairs


# --- A CSV file of the edges of one scan beside the annotation, worst first.

EDGES_FILE = "edges.csv"
HEADER = (
    "verdict",
    "subject",
    "subject_class",
    "predicate",
    "object",
    "object_class",
    "probability",
    "truth",
    "reverse_truth",
    "edge_observations",
    "subject_observations",
    "object_observations",
    "subject_annotated",
    "object_annotated",
)
# In this order in the file.
VERDICTS = ("wrong", "missed", "unmatched", "right", "not said")


def write_edge_list(
    path: Path, edges: Sequence[JudgedEdge], relations: Sequence[JudgedEdge]
) -> None:
    """Write one line per edge, and one per annotated relation that no edge says.

    ``wrong`` edges come first, the most probable one on top, then ``missed`` relations. An edge
    that states a missed relation with a low probability is that relation's line.
    """
    missed = [item for item in relations if not item.said]
    lines = [(verdict(edge), edge) for edge in edges if edge not in missed]
    lines += [("missed", item) for item in missed]
    lines.sort(key=lambda line: (VERDICTS.index(line[0]), -line[1].probability))
    write_csv(path, [HEADER, *([name, *_cells(edge)] for name, edge in lines)])


def verdict(edge: JudgedEdge) -> str:
    """``right`` or ``wrong``; ``not said`` if improbable; ``unmatched`` if not of two objects."""
    if not edge.said:
        return "not said"
    if not edge.matched:
        return "unmatched"
    return "right" if edge.right else "wrong"


def _cells(edge: JudgedEdge) -> list[object]:
    subject, object_ = edge.subject, edge.object
    return [
        _id(subject.node),
        subject.label,
        edge.predicate,
        _id(object_.node),
        object_.label,
        f"{edge.probability:.4f}",
        "; ".join(edge.truth),
        "; ".join(edge.reverse_truth),
        edge.observations,
        *(end.observations for end in (subject, object_)),
        *(_id(end.object) for end in (subject, object_)),
    ]


def _id(number: int | None) -> object:
    return "" if number is None else number
