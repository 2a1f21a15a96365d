"""Edges of a graph compared with annotated relations, predicate by predicate.

docs/dev/evaluation/protocol.md defines every measure.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from deworldsg_ros.evaluation.measures.calibration import (
    Calibrated,
    calibration_error,
    total_log_loss,
)
from deworldsg_ros.evaluation.measures.reference import ReferenceScene

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
    """Each edge beside the annotation; `ends` has the ends by node id."""
    truth = _predicates_by_pair(reference)
    judged = []
    for edge in edges:
        subject, object_ = (
            ends.get(node, EdgeEnd(node, "", 0, None)) for node in (edge.subject, edge.object)
        )
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
