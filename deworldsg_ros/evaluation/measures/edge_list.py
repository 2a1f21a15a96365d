"""A CSV file of the edges of one scan beside the annotation, worst first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from deworldsg_ros.evaluation.measures.edge_measures import JudgedEdge
from deworldsg_ros.files import write_csv

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
