"""Results as tables on the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from deworldsg_ros.evaluation.measures import Measures
from deworldsg_ros.evaluation.protocol import Count, ProtocolResult


def percent(fraction: float) -> str:
    """A fraction in percent with one decimal; a dash where it is undefined."""
    return "–" if math.isnan(fraction) else f"{100 * fraction:.1f}"


def print_protocol(console: Console, result: ProtocolResult, title: str) -> None:
    """The five numbers, the tables by class, and the notes."""
    table = Table(title=title)
    for heading in ("recall at 1, %", "items", "right", "recall", "mean over classes"):
        table.add_column(heading, justify="left" if heading.startswith("recall at") else "right")
    rows = (
        ("objects", result.objects, percent(result.object_mean_recall)),
        ("predicates", result.predicates, percent(result.predicate_mean_recall)),
        ("relationships", result.relationships, ""),
    )
    for name, count, mean in rows:
        table.add_row(name, str(count.total), str(count.hits), percent(count.recall), mean)
    console.print(table)
    _print_classes(console, "objects by class", result.object_classes)
    _print_classes(console, "predicates", result.predicate_classes)
    for note in dict.fromkeys(result.notes):
        console.print(f"[yellow]note:[/] {note}", highlight=False, soft_wrap=True)


def print_measures(console: Console, measures: Mapping[str, Measures]) -> None:
    """What recall leaves out, a line a scan (or method)."""
    table = Table(title="beside recall")
    columns = (
        ("objects", "objects", 0),
        ("nodes", "nodes", 0),
        ("found", "found", 0),
        ("duplicates", "duplicates", 0),
        ("wrong class", "wrong_class", 0),
        ("stray", "stray", 0),
        ("precision, %", "node_precision", 100),
        ("F1, %", "f1", 100),
        ("centroid, cm", "centroid_error_main_median_m", 100),
        ("extent, cm", "extent_error_median_m", 100),
        ("edge precision, %", "edge_precision", 100),
        ("edge ECE, %", "edge_calibration_error", 100),
    )
    table.add_column("")
    for heading, _, _ in columns:
        table.add_column(heading, justify="right")
    for name, item in measures.items():
        numbers = item.numbers()
        cells = [
            percent(numbers[key] * factor / 100) if factor else f"{numbers[key]:.0f}"
            for _, key, factor in columns
        ]
        table.add_row(name, *cells)
    console.print(table)


def _print_classes(console: Console, title: str, counts: Mapping[str, Count]) -> None:
    table = Table(title=title)
    table.add_column("class")
    for heading in ("items", "right", "recall, %"):
        table.add_column(heading, justify="right")
    for name, count in counts.items():
        table.add_row(name, str(count.total), str(count.hits), percent(count.recall))
    console.print(table)
