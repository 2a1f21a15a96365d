"""All files of an evaluation in one folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.measures.graph_measures import Measures
from deworldsg_ros.evaluation.protocol.scoring import ProtocolResult, pool
from deworldsg_ros.evaluation.reports import files, plots
from deworldsg_ros.evaluation.runner import Checkpoint
from deworldsg_ros.recordings.folders.annotations import Annotations

CSV_FILE, CLASSES_FILE, LATEX_FILE = "results.csv", "classes.csv", "results.tex"
OBJECTS_PLOT, PREDICATES_PLOT = "objects_by_class.png", "predicates.png"
CONFUSION_PLOT, TIME_PLOT = "confusion.png", "recall_over_time.png"


def write_results(
    out: Path,
    annotations: Annotations,
    result: ProtocolResult,
    measures: Mapping[str, Measures],
    pooled: Measures,
    method: str,
    over_time: Mapping[str, Sequence[Checkpoint]] | None = None,
) -> list[Path]:
    """Write CSV, LaTeX and plots; returns what was written.

    Args:
        out: folder; made if need be.
        annotations: of the data set.
        result: the protocol's numbers.
        measures: of each scan, where they are known.
        pooled: of all scans.
        method: name of the row.
        over_time: checkpoints of each scan, where there are some.

    Raises:
        EvaluationError: where the folder cannot be written.
    """
    rows = {
        scan.scan: pool([scan], annotations.vocabulary).numbers()
        | (measures[scan.scan].numbers() if scan.scan in measures else {})
        for scan in result.scans
    }
    rows["all"] = result.numbers() | pooled.numbers()
    timed = {scan: points for scan, points in (over_time or {}).items() if points}
    names = [CSV_FILE, CLASSES_FILE, LATEX_FILE, OBJECTS_PLOT, PREDICATES_PLOT, CONFUSION_PLOT]
    try:
        out.mkdir(parents=True, exist_ok=True)
        files.write_rows(out / CSV_FILE, rows, "scan")
        files.write_classes(out / CLASSES_FILE, result)
        latex = files.latex_rows({method: result.numbers()})
        (out / LATEX_FILE).write_text(latex, encoding="utf-8")
        plots.plot_classes(out / OBJECTS_PLOT, result.object_classes, f"objects: {method}")
        plots.plot_classes(out / PREDICATES_PLOT, result.predicate_classes, f"predicates: {method}")
        plots.plot_confusion(out / CONFUSION_PLOT, pooled.confusion, f"classes of nodes: {method}")
        if timed:
            plots.plot_over_time(out / TIME_PLOT, timed, f"recall over time: {method}")
            names.append(TIME_PLOT)
    except OSError as error:
        raise EvaluationError(f"--out {out}: cannot be written ({error.strerror})") from error
    return [out / name for name in names]
