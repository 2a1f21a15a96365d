"""Results of the rows of a table, with the rows of the paper; as values and files."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.measures import graph_measures as measures
from deworldsg_ros.evaluation.measures.graph_measures import Measures
from deworldsg_ros.evaluation.protocol import scoring as protocol
from deworldsg_ros.evaluation.protocol.scoring import ProtocolResult
from deworldsg_ros.evaluation.reports import csv_latex, json_values
from deworldsg_ros.evaluation.reports.evaluation import Evaluation
from deworldsg_ros.evaluation.tables.jobs import JobResult
from deworldsg_ros.evaluation.tables.paper_numbers import (
    RUNTIME_DEVICE,
    RUNTIME_MS,
    printed_rows,
)
from deworldsg_ros.files import together, write_atomically
from deworldsg_ros.scene.frame_graph import Vocabulary

CSV_FILE, LATEX_FILE = "table.csv", "table.tex"


@dataclass(frozen=True)
class RowResult:
    """Result of one row of a table.

    Attributes:
        name, title: name and title of the row.
        dataset: name of the data set.
        printed: True if the numbers are printed in the paper.
        numbers: numbers by name, fractions and metres.
        times_ms: mean milliseconds per frame of each stage.
        device: device of the measured times.
        scans: number of scans.
        failures: reason of the failure, by scan.
        details: more values for JSON.
    """

    name: str
    title: str
    dataset: str
    printed: bool
    numbers: dict[str, float]
    times_ms: dict[str, float] = field(default_factory=dict)
    device: str = ""
    scans: int = 0
    failures: dict[str, str] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)

    def values(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "name": self.name,
            "title": self.title,
            "dataset": self.dataset,
            "printed": self.printed,
            **self.numbers,
            "times_ms": self.times_ms,
            "device": self.device,
            "scan_count": self.scans,
            "failed": self.failures,
            **self.details,
        }


def run_row(
    name: str, title: str, dataset: str, results: Sequence[JobResult], vocabulary: Vocabulary
) -> RowResult:
    """The result of a row over all its scans."""
    outcomes = [result.outcome for result in results if result.outcome is not None]
    failures = {result.scan: result.failure for result in results if result.outcome is None}
    if not outcomes:
        return RowResult(name, title, dataset, False, {}, failures=failures)
    pooled = protocol.pool([outcome.result for outcome in outcomes], vocabulary)
    together = measures.pool(outcome.measures for outcome in outcomes)
    frames = sum(outcome.frames for outcome in outcomes)
    stages = dict.fromkeys(stage for outcome in outcomes for stage in outcome.total_ms)
    times_ms = {
        stage: sum(outcome.total_ms.get(stage, 0.0) for outcome in outcomes) / frames
        for stage in stages
    }
    return RowResult(
        name,
        title,
        dataset,
        False,
        all_numbers(pooled, together),
        times_ms,
        "; ".join(dict.fromkeys(outcome.device for outcome in outcomes)),
        len(outcomes),
        failures,
        {"frames": frames, "scans": [json_values.outcome_values(outcome) for outcome in outcomes]},
    )


def predicted_row(title: str, evaluation: Evaluation) -> RowResult:
    """The row of a method that is known by its predictions only."""
    result = evaluation.result
    numbers = all_numbers(result, evaluation.pooled)
    return RowResult(title, title, evaluation.dataset, False, numbers, scans=len(result.scans))


def paper_rows(
    table: str, layout: str, scans: Collection[str], titles: Collection[str]
) -> list[RowResult]:
    """The paper's rows of a table, of the methods that the table ran or got predictions of.

    Args:
        table: name of the table.
        layout: layout of the data set.
        scans: the evaluated scans.
        titles: titles of these rows.
    """
    if table == "runtime":
        title = "DeWorldSG as printed"
        times = dict(RUNTIME_MS)
        row = RowResult("printed", title, "ReplicaSSG", True, {}, times, RUNTIME_DEVICE)
        return [row] if "DeWorldSG" in titles else []
    return [
        RowResult(f"printed {row.title}", row.title, row.dataset, True, row.numbers())
        for row in printed_rows(table, layout, scans)
        if row.title in titles
    ]


def all_numbers(result: ProtocolResult, together: Measures) -> dict[str, float]:
    """The five official scores, the measures, and the number of nodes per object."""
    numbers = {**result.numbers(), **together.numbers()}
    numbers["nodes_per_object"] = (
        together.nodes / together.objects if together.objects else math.nan
    )
    return numbers


def total_ms(times_ms: Mapping[str, float]) -> float:
    """Milliseconds of a whole frame: the sum of the stages, without the parts of perception."""
    if "total" in times_ms:
        return times_ms["total"]
    stages = ("perception", "lifting", "merging", "relations")
    return sum(times_ms.get(stage, 0.0) for stage in stages)


def write_table(out: Path, rows: Sequence[RowResult]) -> list[Path]:
    """Write a CSV file with every number and a file of LaTeX rows; raises EvaluationError."""
    try:
        lines = {
            row.title + (" (printed)" if row.printed else ""): {
                **row.numbers,
                **{f"{stage}_ms": value for stage, value in row.times_ms.items()},
            }
            for row in rows
        }
        with together(out, (CSV_FILE, LATEX_FILE)) as staged:
            csv_latex.write_rows(staged / CSV_FILE, lines, "method")
            write_atomically(staged / LATEX_FILE, csv_latex.latex_rows(lines))
    except OSError as error:
        raise EvaluationError(f"--out {out}: cannot be written ({error.strerror})") from error
    return [out / CSV_FILE, out / LATEX_FILE]
