"""What a table says: each row's numbers, those of the paper, as values, text and files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from deworldsg_ros.scene.frame_graph import Vocabulary

CSV_FILE, LATEX_FILE = "table.csv", "table.tex"


@dataclass(frozen=True)
class TableRow:
    """One line of a table.

    Attributes:
        name, title: of the row.
        dataset: that its numbers are of.
        printed: whether they are the paper's and not ours.
        numbers: by name, fractions and metres.
        times_ms: mean milliseconds a frame of each stage.
        device: that the times were taken on.
        scans: number of scans behind it.
        failures: why a scan is not, by scan.
        details: what else goes into the JSON.
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
        """For JSON."""
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
) -> TableRow:
    """A row that was run: its scans pooled."""
    outcomes = [result.outcome for result in results if result.outcome is not None]
    failures = {result.scan: result.failure for result in results if result.outcome is None}
    if not outcomes:
        return TableRow(name, title, dataset, False, {}, failures=failures)
    pooled = protocol.pool([outcome.result for outcome in outcomes], vocabulary)
    together = measures.pool(outcome.measures for outcome in outcomes)
    frames = sum(outcome.frames for outcome in outcomes)
    stages = dict.fromkeys(stage for outcome in outcomes for stage in outcome.total_ms)
    times_ms = {
        stage: sum(outcome.total_ms.get(stage, 0.0) for outcome in outcomes) / frames
        for stage in stages
    }
    return TableRow(
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


def predicted_row(title: str, evaluation: Evaluation) -> TableRow:
    """The row of a method of which only the predictions are known."""
    result = evaluation.result
    numbers = all_numbers(result, evaluation.pooled)
    return TableRow(title, title, evaluation.dataset, False, numbers, scans=len(result.scans))


def paper_rows(table: str, layout: str) -> list[TableRow]:
    """The paper's rows of a table."""
    if table == "runtime":
        title = "DeWorldSG as printed"
        times = dict(RUNTIME_MS)
        return [TableRow("printed", title, "ReplicaSSG", True, {}, times, RUNTIME_DEVICE)]
    return [
        TableRow(f"printed {row.title}", row.title, row.dataset, True, row.numbers())
        for row in printed_rows(table, layout)
    ]


def all_numbers(result: ProtocolResult, together: Measures) -> dict[str, float]:
    """The protocol's five, the measures beside them, and nodes an object."""
    numbers = {**result.numbers(), **together.numbers()}
    numbers["nodes_per_object"] = (
        together.nodes / together.objects if together.objects else math.nan
    )
    return numbers


def total_ms(times_ms: Mapping[str, float]) -> float:
    """Of a whole frame; perception's parts are not counted beside it."""
    if "total" in times_ms:
        return times_ms["total"]
    stages = ("perception", "lifting", "merging", "relations")
    return sum(times_ms.get(stage, 0.0) for stage in stages)


def write_table(out: Path, rows: Sequence[TableRow]) -> list[Path]:
    """CSV with every number and LaTeX rows; raises EvaluationError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        lines = {
            row.title + (" (printed)" if row.printed else ""): {
                **row.numbers,
                **{f"{stage}_ms": value for stage, value in row.times_ms.items()},
            }
            for row in rows
        }
        csv_latex.write_rows(out / CSV_FILE, lines, "method")
        (out / LATEX_FILE).write_text(csv_latex.latex_rows(lines), encoding="utf-8")
    except OSError as error:
        raise EvaluationError(f"--out {out}: cannot be written ({error.strerror})") from error
    return [out / CSV_FILE, out / LATEX_FILE]
