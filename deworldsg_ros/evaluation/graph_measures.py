"""Measures beside recall: precision, duplicates, position, extent, edges, calibration."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from deworldsg_ros.evaluation.edge_measures import (
    ALL,
    COMPLETE,
    Calibrated,
    EdgeEnd,
    EdgeScores,
    EdgeView,
    JudgedEdge,
    ReferenceScene,
    calibration_error,
    judge_edges,
    judge_relations,
    read_reference,
    scores_by_predicate,
)
from deworldsg_ros.evaluation.predictions import ScanPrediction
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.wire import messages as wire

# --- Measures beside recall: precision, duplicates, position, extent, edges, calibration.
#
# docs/dev/evaluation/protocol.md defines every measure. `Measures` stores counts, so that several
# scans can be pooled.

__all__ = ["Measures", "ReferenceScene", "measure", "measure_prediction", "pool", "read_reference"]

# A node is in the box of an object if its mean is; the box is this much larger on every side,
# because the mean of a visible surface may lie on the box.
BOX_MARGIN_M = 0.05
# The extent of a node lies between these quantiles of its surface points: single outliers in depth
# do not count.
EXTENT_QUANTILES = (0.02, 0.98)


class NodeView(NamedTuple):
    """A node in the form for the measures; the main node of an object has the largest `weight`."""

    id: int
    label: str
    probability: float
    mean_m: Float64
    points_m: Float64
    weight: float
    observations: int = 0
    is_named: bool = True


@dataclass(frozen=True)
class Measures:
    """Counts and samples of one scan or of several.

    Attributes:
        objects: annotated objects that can be detected.
        nodes: of the graph.
        found: objects with at least one node.
        matched: nodes whose mean is in the box of an object of their class.
        wrong_class: nodes whose mean is only in boxes of objects of other classes.
        stray: nodes whose mean is in no box.
        named, named_matched: nodes that have a name, and those of them that are matched.
        edges: of the graph, beside the annotation.
        relations: annotated relations between objects that can be detected, each with the edge that
            states it best.
        best_errors_m, main_errors_m: distance of node mean and visible centroid, metres, of the
            nearest and of the main node of each object found.
        extent_errors_m: absolute difference of extents, mean over the axes, of main nodes.
        box_ious: intersection over union of boxes, of main nodes.
        node_beliefs: probability of the best class of nodes in a box, and whether it is right.
        confusion: (annotated class, predicted class) of nodes in a box.
    """

    objects: int = 0
    nodes: int = 0
    found: int = 0
    matched: int = 0
    wrong_class: int = 0
    stray: int = 0
    named: int = 0
    named_matched: int = 0
    edges: list[JudgedEdge] = field(default_factory=list)
    relations: list[JudgedEdge] = field(default_factory=list)
    best_errors_m: list[float] = field(default_factory=list)
    main_errors_m: list[float] = field(default_factory=list)
    extent_errors_m: list[float] = field(default_factory=list)
    box_ious: list[float] = field(default_factory=list)
    node_beliefs: list[Calibrated] = field(default_factory=list)
    confusion: list[tuple[str, str]] = field(default_factory=list)

    @property
    def duplicates(self) -> int:
        """Matched nodes beyond the first of each object."""
        return self.matched - self.found

    def edge_scores(self) -> dict[str, EdgeScores]:
        """Scores of the edges by predicate, then ``complete`` and ``all``."""
        return scores_by_predicate(self.edges, self.relations)

    def numbers(self) -> dict[str, float]:
        """Every measure by name; fractions, metres; NaN where undefined."""
        node_precision = _ratio(self.matched, self.nodes)
        edge_scores = self.edge_scores()
        return {
            "objects": self.objects,
            "nodes": self.nodes,
            "found": self.found,
            "duplicates": self.duplicates,
            "wrong_class": self.wrong_class,
            "stray": self.stray,
            "node_recall": _ratio(self.found, self.objects),
            "node_precision": node_precision,
            "named": self.named,
            "named_precision": _ratio(self.named_matched, self.named),
            "duplicates_per_object": _ratio(self.duplicates, self.found),
            "f1": _ratio(2 * self.found, self.nodes + self.objects),
            "centroid_error_best_median_m": _quantile(self.best_errors_m, 0.5),
            "centroid_error_best_mean_m": _mean(self.best_errors_m),
            "centroid_error_best_p90_m": _quantile(self.best_errors_m, 0.9),
            "centroid_error_main_median_m": _quantile(self.main_errors_m, 0.5),
            "centroid_error_main_mean_m": _mean(self.main_errors_m),
            "extent_error_median_m": _quantile(self.extent_errors_m, 0.5),
            "extent_error_mean_m": _mean(self.extent_errors_m),
            "box_iou_mean": _mean(self.box_ious),
            "edges": len(self.edges),
            **edge_scores[ALL].numbers(),
            **{f"complete_{k}": v for k, v in edge_scores[COMPLETE].numbers().items()},
            "node_calibration_error": calibration_error(self.node_beliefs),
        }


def measure(graph: wire.SceneGraphMessage, reference: ReferenceScene) -> Measures:
    """Measures of a scene graph against the objects of its scan."""
    nodes = [
        NodeView(
            node.id,
            node.label,
            node.classes[0].probability,
            np.array(node.mean_m),
            points,
            # Between nodes with equal numbers of observations, the points decide.
            node.observations + 1e-6 * len(points),
            node.observations,
            node.named,
        )
        for node, points in zip(graph.nodes, map(surface_points, graph.nodes))
    ]
    edges = [
        EdgeView(edge.subject, edge.object, edge.predicate, edge.probability, edge.observations)
        for edge in graph.edges
    ]
    return measure_views(nodes, edges, reference)


def measure_prediction(
    prediction: ScanPrediction, vocabulary: Vocabulary, reference: ReferenceScene
) -> Measures:
    """Measures of a prediction against the objects of its scan.

    The position of a node is the median of its points, because predictions often have outliers. Its
    weight is the number of its points. A node without a finite point counts as stray.
    """
    nodes = []
    for index, points in enumerate(prediction.points_world):
        surface = np.asarray(points, np.float64)
        surface = surface[np.isfinite(surface).all(axis=1)]
        mean = np.median(surface, axis=0) if len(surface) else np.full(3, np.nan)
        label, probability = _top(prediction.class_scores[index], vocabulary.classes)
        nodes.append(NodeView(index, label, probability, mean, surface, len(surface)))
    edges = []
    for (subject, object_), scores in zip(prediction.edges.tolist(), prediction.edge_scores):
        edges.append(EdgeView(subject, object_, *_top(scores, vocabulary.predicates)))
    return measure_views(nodes, edges, reference)


def measure_views(
    nodes: Sequence[NodeView], edges: Sequence[EdgeView], reference: ReferenceScene
) -> Measures:
    """Measures of nodes and edges against the objects of a scan."""
    assignment = _assign(nodes, reference)
    judged, relations = _judge(nodes, edges, assignment, reference)
    return Measures(
        objects=len(reference),
        nodes=len(nodes),
        found=len(assignment.nodes_of),
        matched=assignment.counts["matched"],
        wrong_class=assignment.counts["wrong_class"],
        stray=assignment.counts["stray"],
        named=sum(node.is_named for node in nodes),
        named_matched=assignment.counts["named_matched"],
        edges=judged,
        relations=relations,
        **_geometric_errors(assignment.nodes_of, reference),
        node_beliefs=assignment.beliefs,
        confusion=assignment.confusion,
    )


@dataclass
class _Assignment:
    """Nodes assigned to objects.

    Attributes:
        nodes_of: nodes of the right class by row of their object.
        object_of: id of the object by id of its node.
        counts: nodes that are matched, of a wrong class, or stray.
        beliefs: probability of the best class of each node in a box, and whether it is right.
        confusion: (annotated class, predicted class) of each node in a box.
    """

    nodes_of: dict[int, list[NodeView]] = field(default_factory=dict)
    object_of: dict[int, int] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    beliefs: list[Calibrated] = field(default_factory=list)
    confusion: list[tuple[str, str]] = field(default_factory=list)


def _assign(nodes: Sequence[NodeView], reference: ReferenceScene) -> _Assignment:
    """Assign each node to the nearest object whose box it is in, of its own class if possible."""
    result = _Assignment()
    for node in nodes:
        inside = _objects_around(node.mean_m, reference)
        own = [row for row in inside if reference.labels[row] == node.label]
        result.counts["matched" if own else "wrong_class" if inside else "stray"] += 1
        if not inside:
            continue
        result.beliefs.append(Calibrated(node.probability, bool(own)))
        row = _nearest(node.mean_m, own or inside, reference)
        result.confusion.append((reference.labels[row], node.label))
        if own:
            result.counts["named_matched"] += node.is_named
            result.nodes_of.setdefault(row, []).append(node)
            result.object_of[node.id] = reference.ids[row]
    return result


def _geometric_errors(
    nodes_of: Mapping[int, Sequence[NodeView]], reference: ReferenceScene
) -> dict[str, Any]:
    """Errors of position and extent, and box overlaps, by name of the measure."""
    best_errors, main_errors, extent_errors, ious = [], [], [], []
    for row, matched in sorted(nodes_of.items()):
        errors = [float(np.linalg.norm(n.mean_m - reference.centroids[row])) for n in matched]
        main = _main(matched)
        best_errors.append(min(errors))
        main_errors.append(float(np.linalg.norm(main.mean_m - reference.centroids[row])))
        if len(main.points_m):
            low, high = np.quantile(main.points_m, EXTENT_QUANTILES, axis=0)
            box = reference.boxes_min[row], reference.boxes_max[row]
            extent_errors.append(float(np.abs((high - low) - (box[1] - box[0])).mean()))
            ious.append(_box_iou((low, high), box))
    return {
        "best_errors_m": best_errors,
        "main_errors_m": main_errors,
        "extent_errors_m": extent_errors,
        "box_ious": ious,
    }


def _judge(
    nodes: Sequence[NodeView],
    edges: Sequence[EdgeView],
    assignment: _Assignment,
    reference: ReferenceScene,
) -> tuple[list[JudgedEdge], list[JudgedEdge]]:
    """The edges and the annotated relations, each beside the other."""
    object_of = assignment.object_of
    ends = {n.id: EdgeEnd(n.id, n.label, n.observations, object_of.get(n.id)) for n in nodes}
    main_ends = {
        reference.ids[row]: ends[_main(matched).id] for row, matched in assignment.nodes_of.items()
    }
    judged = judge_edges(edges, ends, reference)
    return judged, judge_relations(judged, main_ends, reference)


def pool(measures: Iterable[Measures]) -> Measures:
    """Measures over all scans: sums of counts, concatenated samples."""
    totals = Measures()
    for item in measures:
        totals = Measures(
            **{
                part.name: getattr(totals, part.name) + getattr(item, part.name)
                for part in fields(Measures)
            }
        )
    return totals


def _objects_around(mean_m: Float64, reference: ReferenceScene) -> list[int]:
    inside = (
        (mean_m >= reference.boxes_min - BOX_MARGIN_M)
        & (mean_m <= reference.boxes_max + BOX_MARGIN_M)
    ).all(axis=1)
    rows: list[int] = np.flatnonzero(inside).tolist()
    return rows


def _nearest(mean_m: Float64, rows: Sequence[int], reference: ReferenceScene) -> int:
    return min(rows, key=lambda row: float(np.linalg.norm(mean_m - reference.centroids[row])))


def _main(nodes: Sequence[NodeView]) -> NodeView:
    return max(nodes, key=lambda node: node.weight)


def _box_iou(a: tuple[Float64, Float64], b: tuple[Float64, Float64]) -> float:
    sides = np.clip(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0, None)
    common = float(np.prod(sides))
    union = float(np.prod(a[1] - a[0])) + float(np.prod(b[1] - b[0])) - common
    return common / union if union > 0 else 0.0


def _top(scores: Float64, names: Sequence[str]) -> tuple[str, float]:
    """The label of the highest score (of equal ones the last), and its fraction of the sum."""
    if not len(scores):
        return "", 0.0
    index = len(scores) - 1 - int(np.argmax(scores[::-1]))
    value, total = float(scores[index]), float(np.nansum(scores))
    fraction = value / total if total > 0 and 0 <= value <= total else 0.0
    return (names[index] if index < len(names) else ""), fraction


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _quantile(values: Sequence[float], fraction: float) -> float:
    return float(np.quantile(values, fraction)) if values else math.nan
