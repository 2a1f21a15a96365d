"""Terminal tables that compare methods."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from deworldsg_ros.evaluation.tables.row_results import RowResult, total_ms
from deworldsg_ros.timing import STAGES
from deworldsg_ros.words import visible

# Heading, number, factor, decimals.
RECALL_COLUMNS = (
    ("Rel %", "relationship_recall", 100, 1),
    ("Obj %", "object_recall", 100, 1),
    ("Pred %", "predicate_recall", 100, 1),
    ("mObj", "object_mean_recall", 100, 1),
    ("mPred", "predicate_mean_recall", 100, 1),
)
BESIDE_TITLE = "precision and geometry (%; cm = median centroid error of main nodes)"
BESIDE_COLUMNS = (
    ("nodes/obj.", "nodes_per_object", 1, 2),
    ("found", "node_recall", 100, 1),
    ("precise", "node_precision", 100, 1),
    ("dupl.", "duplicates", 1, 0),
    ("cm", "centroid_error_main_median_m", 100, 1),
)


def print_table(
    console: Console, rows: Sequence[RowResult], title: str, *, timed: bool = False
) -> None:
    """Print recalls, with the rows of the paper first, then precision and geometry.

    `timed` adds the mean milliseconds per frame of merging.
    """
    printed = [row for row in rows if row.printed]
    table = _table(title, RECALL_COLUMNS)
    for row in rows:
        name = Text(row.title)
        if row.printed:
            name.append(f" [printed, {row.dataset}]", "dim")
        last = bool(printed) and row is printed[-1]
        table.add_row(name, *_numbers(row, RECALL_COLUMNS), end_section=last)
    console.print(table)
    beside = _table(BESIDE_TITLE, BESIDE_COLUMNS)
    if timed:
        beside.add_column("merging ms", justify="right", no_wrap=True)
    for row in rows:
        if not row.printed:
            times = [_ms(row.times_ms.get("merging"))] if timed else []
            beside.add_row(Text(row.title), *_numbers(row, BESIDE_COLUMNS), *times)
    console.print(beside)
    print_failures(console, rows)


def _table(title: str, columns: Sequence[tuple[str, str, int, int]]) -> Table:
    table = Table(title=title)
    table.add_column("method", overflow="fold")
    for heading, *_ in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _numbers(row: RowResult, columns: Sequence[tuple[str, str, int, int]]) -> list[str]:
    return [_number(row.numbers.get(key, math.nan) * f, d) for _, key, f, d in columns]


def print_runtime(console: Console, rows: Sequence[RowResult], title: str) -> None:
    """Print mean milliseconds per frame of each stage, and the device of each row."""
    table = Table(title=title, caption="mean milliseconds per frame")
    table.add_column("stage")
    timed = [row for row in rows if row.times_ms]
    for row in timed:
        table.add_column(Text(f"{row.title}\n{row.device}"), justify="right", overflow="fold")
    if not all(row.printed or "detection" in row.times_ms for row in timed):
        table.add_row("perception", *(_ms(row.times_ms.get("perception")) for row in timed))
    for stage in STAGES:
        if any(stage in row.times_ms for row in timed):
            table.add_row(stage.replace("_", " "), *(_ms(row.times_ms.get(stage)) for row in timed))
    table.add_row("all", *(_ms(total_ms(row.times_ms)) for row in timed))
    console.print(table)
    print_failures(console, rows)


def print_failures(console: Console, rows: Sequence[RowResult]) -> None:
    """Print each reason of failure once, with its row and scans."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for scan, reason in row.failures.items():
            reasons.setdefault((row.name, reason), []).append(scan)
    for (name, reason), scans in reasons.items():
        text = f"{name}, {', '.join(scans)}: {reason}"
        line = Text.assemble(("failed:", "red"), f" {visible(text)}")
        console.print(line, highlight=False, soft_wrap=True)


def _number(value: float, decimals: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{decimals}f}"


def _ms(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
