"""The files of an evaluation in one folder: CSV, LaTeX and plots."""

from __future__ import annotations

from pathlib import Path

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.measures.calibration import Calibrated
from deworldsg_ros.evaluation.measures.edge_measures import COMPLETE_PREDICATES, beliefs_of
from deworldsg_ros.evaluation.measures.graph_measures import Measures
from deworldsg_ros.evaluation.protocol.scoring import pool
from deworldsg_ros.evaluation.reports import csv_latex, plots
from deworldsg_ros.evaluation.reports.evaluation import Evaluation
from deworldsg_ros.files import together, write_atomically

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
    csv_latex.write_rows(out / CSV_FILE, rows, "scan")
    csv_latex.write_classes(out / CLASSES_FILE, result)
    csv_latex.write_rows(out / EDGE_SCORES_FILE, edge_rows, "predicate")
    latex = csv_latex.latex_rows({evaluation.method: result.numbers()})
    write_atomically(out / LATEX_FILE, latex)


def _plot(out: Path, evaluation: Evaluation) -> None:
    result, pooled, method = evaluation.result, evaluation.pooled, evaluation.method
    plots.plot_classes(out / OBJECTS_PLOT, result.object_classes, f"objects: {method}")
    plots.plot_classes(out / PREDICATES_PLOT, result.predicate_classes, f"predicates: {method}")
    plots.plot_confusion(out / CONFUSION_PLOT, pooled.confusion, f"classes of nodes: {method}")
    plots.plot_reliability(out / RELIABILITY_PLOT, _edge_beliefs(pooled), f"edges: {method}")
    over_time = {scan: points for scan, points in evaluation.over_time.items() if points}
    if over_time:
        plots.plot_over_time(out / TIME_PLOT, over_time, f"recall over time: {method}")


def _edge_beliefs(measures: Measures) -> dict[str, list[Calibrated]]:
    """Beliefs of the edges with a complete predicate, and of all."""
    complete = [edge for edge in measures.edges if edge.predicate in COMPLETE_PREDICATES]
    return {
        "complete predicates": beliefs_of(complete),
        "all predicates": beliefs_of(measures.edges),
    }
