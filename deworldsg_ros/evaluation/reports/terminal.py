"""Terminal tables of one evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rich.console import Console
from rich.table import Table
from rich.text import Text

from deworldsg_ros.evaluation.measures.graph_measures import Measures
from deworldsg_ros.evaluation.protocol.scoring import Count, ProtocolResult
from deworldsg_ros.evaluation.reports.evaluation import Evaluation
from deworldsg_ros.words import visible


def percent(fraction: float) -> str:
    """A fraction in percent with one decimal; a dash if it is undefined."""
    return "–" if math.isnan(fraction) else f"{100 * fraction:.1f}"


def print_evaluation(console: Console, evaluation: Evaluation) -> None:
    """Print the official scores and the further measures."""
    print_protocol(console, evaluation.result, f"{evaluation.method} on {evaluation.dataset}")
    print_measures(console, {**evaluation.measures, "all": evaluation.pooled})
    print_edges(console, evaluation.pooled)


def print_protocol(console: Console, result: ProtocolResult, title: str) -> None:
    """Print the five scores, the scores by class, and the notes."""
    table = Table(title=Text(visible(title)))
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
        line = Text.assemble(("note:", "yellow"), f" {visible(note)}")
        console.print(line, highlight=False, soft_wrap=True)


# Printed measures: heading, name, factor (0 = a count).
MEASURE_ROWS = (
    ("objects", "objects", 0),
    ("nodes", "nodes", 0),
    ("objects found", "found", 0),
    ("duplicates", "duplicates", 0),
    ("nodes of a wrong class", "wrong_class", 0),
    ("stray nodes", "stray", 0),
    ("node precision, %", "node_precision", 100),
    ("F1, %", "f1", 100),
    ("centroid error, cm (median)", "centroid_error_main_median_m", 100),
    ("extent error, cm (median)", "extent_error_median_m", 100),
    ("edges", "edges", 0),
    ("edges without two objects", "edges_unmatched", 0),
    ("edge precision, complete predicates, %", "complete_edge_precision", 100),
    ("edge recall, complete predicates, %", "complete_edge_recall", 100),
    ("edge calibration error, the same, %", "complete_edge_calibration_error", 100),
)
# Printed scores of edges: heading, name, factor (0 = a count).
EDGE_COLUMNS = (
    ("relations", "relations", 0),
    ("said", "edges_said", 0),
    ("right", "edges_right", 0),
    ("prec.", "edge_precision", 100),
    ("recall", "edge_recall", 100),
    ("ECE", "edge_calibration_error", 100),
)
# A terminal has space for this many scans; the files contain all.
MAX_COLUMNS = 4


def print_measures(console: Console, measures: Mapping[str, Measures]) -> None:
    """Print the measures, one column per scan; with many scans only the last column, all scans."""
    shown = dict(list(measures.items())[-1:]) if len(measures) > MAX_COLUMNS else measures
    table = Table(title="precision, geometry, edges")
    table.add_column("")
    for name in shown:
        table.add_column(Text(visible(name)), justify="right", overflow="fold")
    numbers = [item.numbers() for item in shown.values()]
    for heading, key, factor in MEASURE_ROWS:
        table.add_row(heading, *(_cell(item[key], factor) for item in numbers))
    console.print(table)


def print_edges(console: Console, measures: Measures) -> None:
    """Print the scores of the edges by predicate, of the complete predicates, and of all."""
    table = Table(title="edges by predicate (precision, recall, calibration error in %)")
    table.add_column("predicate", no_wrap=True)
    for heading, _, _ in EDGE_COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("wrong ≥99%", justify="right", no_wrap=True)
    scores = measures.edge_scores()
    for name, item in scores.items():
        numbers = item.numbers()
        cells = [_cell(numbers[key], factor) for _, key, factor in EDGE_COLUMNS]
        # A line separates the predicates from the sums.
        last = list(scores).index(name) == len(scores) - 3
        table.add_row(
            Text(visible(name)), *cells, f"{item.sure_wrong}/{item.sure}", end_section=last
        )
    console.print(table)


def _cell(value: float, factor: float) -> str:
    return percent(value * factor / 100) if factor else f"{value:.0f}"


def _print_classes(console: Console, title: str, counts: Mapping[str, Count]) -> None:
    table = Table(title=title)
    table.add_column("class")
    for heading in ("items", "right", "recall, %"):
        table.add_column(heading, justify="right")
    for name, count in counts.items():
        table.add_row(Text(visible(name)), str(count.total), str(count.hits), percent(count.recall))
    console.print(table)
