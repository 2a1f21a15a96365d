"""Reports of one evaluation: terminal tables, JSON, CSV, LaTeX and plots."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from rich.text import Text

from deworldsg_ros.base.files import together, write_atomically, write_csv
from deworldsg_ros.base.words import visible
from deworldsg_ros.evaluation import graph_measures
from deworldsg_ros.evaluation.edge_measures import (
    COMPLETE_PREDICATES,
    Calibrated,
    beliefs_of,
    calibration_error,
    reliability,
)
from deworldsg_ros.evaluation.graph_measures import Measures
from deworldsg_ros.evaluation.predictions import read_predictions
from deworldsg_ros.evaluation.runner import Checkpoint, ScanOutcome, evaluate_graph
from deworldsg_ros.evaluation.scoring import (
    Count,
    ProtocolOptions,
    ProtocolResult,
    ScanResult,
    evaluate_predictions,
    pool,
)
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.errors import EvaluationError
from deworldsg_ros.scene.frame_graph import Vocabulary

# --- One method on a data set: scores and measures of predictions, of saved graphs, or of runs.


@dataclass(frozen=True)
class Evaluation:
    """Scores and measures of one method.

    Attributes:
        method: name for tables and plots.
        dataset: name of the data set.
        vocabulary: classes and predicates of the data set.
        result: official scores over all scans.
        measures: further measures by scan; a scan without a prediction is missing.
        over_time: checkpoints by scan; empty unless the pipeline ran.
    """

    method: str
    dataset: str
    vocabulary: Vocabulary
    result: ProtocolResult
    measures: Mapping[str, Measures]
    over_time: Mapping[str, Sequence[Checkpoint]] = field(default_factory=dict)

    @cached_property
    def pooled(self) -> Measures:
        """Measures over all scans together."""
        return graph_measures.pool(self.measures.values())


def evaluate_prediction_file(
    annotations: Annotations,
    path: Path,
    options: ProtocolOptions,
    scans: Sequence[str] | None = None,
) -> Evaluation:
    """Evaluate the predictions of a file.

    Args:
        annotations: of the data set.
        path: predictions, ``.json`` or official ``.pkl``.
        options: of the protocol.
        scans: scans to evaluate; None = the split.

    Raises:
        DeWorldSGError: the predictions or the data set cannot be read.
    """
    predictions = read_predictions(path)
    result = evaluate_predictions(annotations, predictions, options, scans)
    measured = {}
    for scan in dict.fromkeys(item.scan for item in result.scans):
        if scan in predictions:
            points = annotations.points(scan, aligned=options.aligned_ply)
            reference = graph_measures.read_reference(annotations, scan, points)
            measured[scan] = graph_measures.measure_prediction(
                predictions[scan], annotations.vocabulary, reference
            )
    return Evaluation(
        path.name, annotations.root.resolve().name, annotations.vocabulary, result, measured
    )


def evaluate_saved_graphs(
    annotations: Annotations,
    folder: Path,
    options: ProtocolOptions,
    scans: Sequence[str] | None = None,
) -> Evaluation:
    """Evaluate ``folder/SCAN/scene_graph.json`` of each scan; arguments and errors as above."""
    chosen = scans or annotations.scans(options.split)
    evaluated = {
        scan: evaluate_graph(annotations, scan, read_graph(folder / scan), options)
        for scan in dict.fromkeys(chosen)
    }
    return Evaluation(
        folder.resolve().name,
        annotations.root.resolve().name,
        annotations.vocabulary,
        pool([evaluated[scan][0] for scan in chosen], annotations.vocabulary),
        {scan: measures for scan, (_, measures) in evaluated.items()},
    )


def evaluation_of_runs(
    annotations: Annotations, outcomes: Sequence[ScanOutcome], method: str
) -> Evaluation:
    """The evaluation of scans that the pipeline has processed."""
    return Evaluation(
        method,
        annotations.root.resolve().name,
        annotations.vocabulary,
        pool([outcome.result for outcome in outcomes], annotations.vocabulary),
        {outcome.scan: outcome.measures for outcome in outcomes},
        {outcome.scan: outcome.over_time for outcome in outcomes},
    )


# --- Terminal tables of one evaluation.


def percent(fraction: float) -> str:
    """A fraction in percent with one decimal; a dash if it is undefined."""
    return "–" if math.isnan(fraction) else f"{100 * fraction:.1f}"


def print_evaluation(console: Console, evaluation: Evaluation) -> None:
    """Print the official scores and the further measures."""
    print_protocol(console, evaluation.result, f"{evaluation.method} on {evaluation.dataset}")
    print_measures(console, {**evaluation.measures, "all": evaluation.pooled})
    print_edges(console, evaluation.pooled)


def print_protocol(console: Console, result: ProtocolResult, title: str) -> None:
    """Print the official scores, the scores by class, and the notes."""
    table = Table(title=Text(visible(title)))
    for heading in ("recall at 1, %", "items", "right", "recall", "mean over classes"):
        table.add_column(heading, justify="left" if heading.startswith("recall at") else "right")
    rows = (
        ("objects", result.objects, percent(result.object_mean_recall)),
        ("predicates", result.predicates, percent(result.predicate_mean_recall)),
        ("of detected pairs", result.predicates_of_detected, ""),
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


# --- Numbers as CSV files for programs and as LaTeX rows for papers.

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
        [name, *(_csv_cell(row.get(column, math.nan)) for column in columns)]
        for name, row in rows.items()
    ]
    write_csv(path, [[heading, *columns], *lines])


def write_classes(path: Path, result: ProtocolResult) -> None:
    """Write a CSV file of the recall of each class and predicate."""
    kinds = {"object": result.object_classes, "predicate": result.predicate_classes}
    lines = [
        [kind, name, count.total, count.hits, _csv_cell(count.recall)]
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


def _csv_cell(value: float) -> str:
    return "" if isinstance(value, float) and math.isnan(value) else repr(value)


def _percent(fraction: float) -> str:
    return "--" if math.isnan(fraction) else f"{100 * fraction:.1f}"


# --- PNG plots: recall by class, confusion, reliability of edges, recall over time.

DPI = 130
RIGHT, ALL = "#2f6f8f", "#d5dde3"
COLOURS = ("#2f6f8f", "#b8562f", "#5c8a3a")
MAX_CLASSES = 40
# The name of a class may contain $.
_plain_text = rc_context({"text.parse_math": False})


@_plain_text
def plot_classes(path: Path, counts: Mapping[str, Count], title: str) -> None:
    """Bars of items and of right items by class, most items first."""
    items = class_items(counts)[:MAX_CLASSES]
    figure, axes = _figure(10.0, 1.2 + 0.24 * max(len(items), 3))
    indices = np.arange(len(items))
    axes.barh(indices, [count.total for _, count in items], color=ALL, label="annotated")
    axes.barh(indices, [count.hits for _, count in items], color=RIGHT, label="right")
    for index, (_, count) in enumerate(items):
        axes.text(count.total, index, f" {100 * count.recall:.0f} %", va="center", fontsize=8)
    axes.set_yticks(indices, [name for name, _ in items], fontsize=9)
    axes.invert_yaxis()
    axes.margins(x=0.08)
    axes.set_xlabel("items")
    axes.set_title(title)
    if items:
        axes.legend(loc="lower right", frameon=False)
    _save(figure, path)


@_plain_text
def plot_confusion(path: Path, pairs: Sequence[tuple[str, str]], title: str) -> None:
    """Confusion matrix of annotated and predicted classes of nodes; each row sums to one."""
    counts = Counter(pairs)
    rows = [name for name, _ in Counter(pair[0] for pair in pairs).most_common(MAX_CLASSES)]
    others = Counter(pair[1] for pair in pairs if pair[1] not in rows)
    columns = rows + [name for name, _ in others.most_common(max(0, MAX_CLASSES - len(rows)))]
    table = np.array([[counts[row, column] for column in columns] for row in rows], float)
    table = table.reshape(len(rows), len(columns))
    fractions = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    side = 2.5 + 0.24 * max(len(columns), 4)
    figure, axes = _figure(side, 2.0 + 0.24 * max(len(rows), 4))
    if len(rows):
        image = axes.imshow(fractions, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        figure.colorbar(image, ax=axes, fraction=0.035, label="fraction of the nodes of a row")
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set_xlabel("predicted class of the node")
    axes.set_ylabel("annotated class of the object")
    axes.set_title(title)
    _save(figure, path)


@_plain_text
def plot_reliability(path: Path, beliefs: Mapping[str, Sequence[Calibrated]], title: str) -> None:
    """Right part of the edges over their probability, a line per name; on the diagonal if honest.

    The number beside a point is that of the edges in its interval.
    """
    figure, axes = _figure(6.4, 6.0)
    axes.plot([0, 1], [0, 1], color=ALL, linewidth=1)
    # Numbers of the first line are above its points, those of the second below.
    for (name, items), colour, offset in zip(beliefs.items(), COLOURS, ((-4, 6), (4, -10))):
        bins = reliability(items)
        error = f"ECE {100 * calibration_error(items):.1f} %" if items else "no edge"
        axes.plot(
            [item.probability for item in bins],
            [item.right for item in bins],
            color=colour,
            marker="o",
            markersize=4,
            label=f"{name}: {len(items)} edges, {error}",
        )
        for item in bins:
            axes.annotate(
                str(item.size),
                (item.probability, item.right),
                xytext=offset,
                textcoords="offset points",
                fontsize=7,
                color=colour,
            )
    axes.set_xlim(0, 1.04)
    axes.set_ylim(-0.04, 1.04)
    axes.set_xlabel("probability of the edge")
    axes.set_ylabel("part of the edges that is right")
    axes.set_title(title)
    if beliefs:
        axes.legend(loc="upper left", frameon=False)
    _save(figure, path)


@_plain_text
def plot_over_time(path: Path, runs: Mapping[str, Sequence[Checkpoint]], title: str) -> None:
    """Recall of each scan over the time of the recording."""
    figure, axes = _figure(9.0, 5.0)
    kinds = ("object_recall", "predicate_recall", "relationship_recall")
    for run, checkpoints in enumerate(runs.values()):
        times_s = [item.stamp_s for item in checkpoints]
        for kind, colour in zip(kinds, COLOURS):
            axes.plot(
                times_s,
                [100 * getattr(item, kind) for item in checkpoints],
                color=colour,
                alpha=0.9 if len(runs) < 4 else 0.5,
                marker="o",
                markersize=3,
                linestyle=("-", "--", ":", "-.")[run % 4],
                label=kind.split("_")[0] + "s" if run == 0 else None,
            )
    axes.set_ylim(0, 103)
    axes.set_xlabel("time of the recording, s")
    axes.set_ylabel("recall at 1, %")
    axes.set_title(title)
    if runs:
        axes.legend(loc="lower right", frameon=False)
    _save(figure, path)


def _figure(width_in: float, height_in: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _save(figure: Figure, path: Path) -> None:
    # Without date and version: equal results give equal bytes.
    write_atomically(
        path, lambda file: figure.savefig(file, format="png", metadata={"Software": None})
    )


# --- The files of an evaluation in one folder: CSV, LaTeX and plots.

CSV_FILE, CLASSES_FILE, LATEX_FILE = "results.csv", "classes.csv", "results.tex"
EDGE_SCORES_FILE, RELIABILITY_PLOT = "edge_scores.csv", "reliability.png"
OBJECTS_PLOT, PREDICATES_PLOT = "objects_by_class.png", "predicates.png"
CONFUSION_PLOT, TIME_PLOT = "confusion.png", "recall_over_time.png"


def write_folder(out: Path, evaluation: Evaluation) -> list[Path]:
    """Write CSV, LaTeX and plots to the folder `out`; returns the paths.

    Raises:
        EvaluationError: the folder cannot be written.
    """
    names = [CSV_FILE, CLASSES_FILE, EDGE_SCORES_FILE, LATEX_FILE]
    names += [OBJECTS_PLOT, PREDICATES_PLOT, CONFUSION_PLOT, RELIABILITY_PLOT, TIME_PLOT]
    try:
        with together(out, names) as staged:
            _write_numbers(staged, evaluation)
            _plot(staged, evaluation)
    except OSError as error:
        raise EvaluationError(f"--out {out}: cannot be written ({error.strerror})") from error
    return [path for name in names if (path := out / name).exists()]


def _write_numbers(out: Path, evaluation: Evaluation) -> None:
    result, measures, pooled = evaluation.result, evaluation.measures, evaluation.pooled
    rows = {
        scan.scan: pool([scan], evaluation.vocabulary).numbers()
        | (measures[scan.scan].numbers() if scan.scan in measures else {})
        for scan in result.scans
    }
    rows["all"] = result.numbers() | pooled.numbers()
    edge_rows = {name: scores.numbers() for name, scores in pooled.edge_scores().items()}
    write_rows(out / CSV_FILE, rows, "scan")
    write_classes(out / CLASSES_FILE, result)
    write_rows(out / EDGE_SCORES_FILE, edge_rows, "predicate")
    latex = latex_rows({evaluation.method: result.numbers()})
    write_atomically(out / LATEX_FILE, latex)


def _plot(out: Path, evaluation: Evaluation) -> None:
    result, pooled, method = evaluation.result, evaluation.pooled, evaluation.method
    plot_classes(out / OBJECTS_PLOT, result.object_classes, f"objects: {method}")
    plot_classes(out / PREDICATES_PLOT, result.predicate_classes, f"predicates: {method}")
    plot_confusion(out / CONFUSION_PLOT, pooled.confusion, f"classes of nodes: {method}")
    plot_reliability(out / RELIABILITY_PLOT, _edge_beliefs(pooled), f"edges: {method}")
    over_time = {scan: points for scan, points in evaluation.over_time.items() if points}
    if over_time:
        plot_over_time(out / TIME_PLOT, over_time, f"recall over time: {method}")


def _edge_beliefs(measures: Measures) -> dict[str, list[Calibrated]]:
    """Beliefs of the edges with a complete predicate, and of all."""
    complete = [edge for edge in measures.edges if edge.predicate in COMPLETE_PREDICATES]
    return {
        "complete predicates": beliefs_of(complete),
        "all predicates": beliefs_of(measures.edges),
    }


# --- Numbers as plain values for JSON.


def protocol_values(result: ProtocolResult) -> dict[str, Any]:
    """Plain values of the official scores: recalls as fractions, NaN if undefined."""
    return {
        **result.numbers(),
        "counts": {
            "object": _count_values(result.objects),
            "predicate": _count_values(result.predicates),
            "predicate_of_detected": _count_values(result.predicates_of_detected),
            "relationship": _count_values(result.relationships),
        },
        "object_per_class": _class_values(result.object_classes),
        "predicate_per_class": _class_values(result.predicate_classes),
        "scans": [scan_values(scan) for scan in result.scans],
        "notes": result.notes,
    }


def scan_values(scan: ScanResult) -> dict[str, Any]:
    """Plain values of the scores of one scan."""
    return {
        "scan": scan.scan,
        "objects": {
            "hits": sum(ranked == 0 for ranked in scan.object_ranks),
            "total": len(scan.object_ranks),
            "found": len(scan.matching.prediction_of),
        },
        "predicates": _ranks_values(scan.predicate_ranks),
        "relationships": _ranks_values(scan.relationship_ranks),
        "predictions": len(scan.matching.supports),
        "void_predictions": sum(support is None for support in scan.matching.supports),
    }


def outcome_values(outcome: ScanOutcome) -> dict[str, Any]:
    """Plain values of the run of one scan: scores, times, drops, measures, checkpoints."""
    return {
        **scan_values(outcome.result),
        "frames": outcome.frames,
        "nodes": outcome.nodes,
        "edges": outcome.edges,
        "times_ms": outcome.times_ms,
        "drops": outcome.drops,
        "measures": measure_values(outcome.measures),
        "over_time": [asdict(item) for item in outcome.over_time],
    }


def evaluation_values(evaluation: Evaluation) -> dict[str, Any]:
    """Plain values of a whole evaluation."""
    return {**protocol_values(evaluation.result), "measures": measure_values(evaluation.pooled)}


def measure_values(measures: Measures) -> dict[str, Any]:
    """Plain values of the measures beside the protocol."""
    scores = measures.edge_scores()
    by_predicate = {name: item.numbers() for name, item in scores.items()}
    return {**measures.numbers(), "edges_by_predicate": by_predicate}


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write values as JSON, NaN and infinity as null; raises EvaluationError."""
    text = json.dumps(finite_or_none(values), indent=2, ensure_ascii=False, allow_nan=False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text + "\n")
    except OSError as error:
        raise EvaluationError(f"--json {path} cannot be written ({error.strerror})") from error


def finite_or_none(value: Any) -> Any:
    """`value` with NaN and infinity replaced by None, which JSON can represent."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): finite_or_none(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(item) for item in value]
    return value


def _class_values(counts: Mapping[str, Count]) -> dict[str, dict[str, float]]:
    return {
        name: {**_count_values(count), "recall": count.recall} for name, count in counts.items()
    }


def _count_values(count: Count) -> dict[str, int]:
    return {"hits": count.hits, "total": count.total}


def _ranks_values(ranks: list[int]) -> dict[str, int]:
    return {"hits": sum(ranked == 0 for ranked in ranks), "total": len(ranks)}
