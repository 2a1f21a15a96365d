"""Numbers as CSV files for programs and as LaTeX rows for papers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from deworldsg_ros.evaluation.protocol.scoring import Count, ProtocolResult
from deworldsg_ros.files import write_csv

# The columns of the paper's tables.
LATEX_COLUMNS = (
    "relationship_recall",
    "object_recall",
    "predicate_recall",
    "object_mean_recall",
    "predicate_mean_recall",
)
_LATEX_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"}


def write_rows(path: Path, rows: Mapping[str, Mapping[str, float]], heading: str) -> None:
    """Write one CSV line per row, one column per number; undefined numbers stay empty."""
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))
    lines = [
        [name, *(_cell(row.get(column, math.nan)) for column in columns)]
        for name, row in rows.items()
    ]
    write_csv(path, [[heading, *columns], *lines])


def write_classes(path: Path, result: ProtocolResult) -> None:
    """Write a CSV file of the recall of each class and predicate."""
    kinds = {"object": result.object_classes, "predicate": result.predicate_classes}
    lines = [
        [kind, name, count.total, count.hits, _cell(count.recall)]
        for kind, counts in kinds.items()
        for name, count in counts.items()
    ]
    write_csv(path, [["kind", "class", "items", "right", "recall"], *lines])


def latex_rows(methods: Mapping[str, Mapping[str, float]]) -> str:
    """LaTeX rows: method & Rel. & Obj. & Pred. & mObj. & mPred., recalls in percent."""
    lines = []
    for method, numbers in methods.items():
        cells = [_percent(numbers.get(name, math.nan)) for name in LATEX_COLUMNS]
        lines.append(" & ".join([latex_text(method), *cells]) + r" \\")
    return "\n".join(lines) + "\n"


def latex_text(text: str) -> str:
    """Text with the special characters of LaTeX escaped."""
    return "".join(_LATEX_SPECIAL.get(character, character) for character in text)


def class_items(counts: Mapping[str, Count]) -> Sequence[tuple[str, Count]]:
    """Classes, most items first."""
    return sorted(counts.items(), key=lambda item: (-item[1].total, item[0]))


def _cell(value: float) -> str:
    return "" if isinstance(value, float) and math.isnan(value) else repr(value)


def _percent(fraction: float) -> str:
    return "--" if math.isnan(fraction) else f"{100 * fraction:.1f}"
