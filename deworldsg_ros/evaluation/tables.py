"""Tables that compare methods: jobs, their execution, and their results."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import traceback
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from deworldsg_ros import __version__
from deworldsg_ros.base.files import together, write_atomically
from deworldsg_ros.base.timing import STAGES
from deworldsg_ros.base.words import visible_lines
from deworldsg_ros.checkpoints.catalogue import checkpoints_of
from deworldsg_ros.checkpoints.hub import fingerprint_of
from deworldsg_ros.evaluation import graph_measures as measures
from deworldsg_ros.evaluation import reports
from deworldsg_ros.evaluation import scoring as protocol
from deworldsg_ros.evaluation.graph_measures import Measures
from deworldsg_ros.evaluation.reports import Evaluation
from deworldsg_ros.evaluation.rows import RUNTIME_DEVICE, RUNTIME_MS, Row, printed_rows
from deworldsg_ros.evaluation.runner import ScanOutcome, ScanTask, evaluate_scan
from deworldsg_ros.evaluation.scoring import ProtocolResult
from deworldsg_ros.graph.graph_files import GRAPH_FILE
from deworldsg_ros.scene.errors import DeWorldSGError, EvaluationError
from deworldsg_ros.scene.frame_graph import Vocabulary

# --- Jobs: one scan of one row each, run or reused from an earlier run of the same task.

OUTCOME_FILE = "outcome.json"
ERROR_FILE = "error.txt"


@dataclass(frozen=True)
class Job:
    """One scan of a row; `fresh` ignores an earlier result."""

    row: str
    task: ScanTask
    fresh: bool = False


@dataclass(frozen=True)
class JobResult:
    """The outcome of a job, or the reason of its failure."""

    row: str
    scan: str
    outcome: ScanOutcome | None
    failure: str = ""
    reused: bool = False


@dataclass(frozen=True)
class _Saved:
    """Content of the file of a finished job."""

    fingerprint: str
    outcome: ScanOutcome


def jobs_of(rows: Sequence[Row], tasks: Sequence[ScanTask], *, fresh: bool) -> list[Job]:
    """Every scan of every row; results of a row are below ``out/ROW``."""
    return [
        Job(
            row.name,
            replace(
                task,
                out=task.out / row.name,
                method=row.method,
                config=row.config,
                poses=row.poses,
                front_end=row.front_end,
            ),
            fresh,
        )
        for task in tasks
        for row in rows
    ]


def run_job(job: Job) -> JobResult:
    """Run a job, or reuse its saved result. Errors become failures; interruptions are raised.

    The outcome is saved beside the graph with the fingerprint of the task. The traceback of an
    unexpected error is written to ``error.txt`` there.
    """
    task = job.task
    folder = task.out / task.scan
    try:
        # Before the run: weights that are replaced during it did not make its result.
        inputs = fingerprint(task)
        saved = None if job.fresh else read_saved(folder, inputs)
        if saved is not None:
            return JobResult(job.row, task.scan, saved, reused=True)
        outcome = evaluate_scan(task)
        _save(folder, _Saved(inputs, outcome))
    except DeWorldSGError as error:
        return JobResult(job.row, task.scan, None, str(error))
    except Exception as error:  # a failed scan must not stop the others
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / ERROR_FILE, traceback.format_exc())
        failure = f"{type(error).__name__}: {error} (traceback in {folder / ERROR_FILE})"
        return JobResult(job.row, task.scan, None, failure)
    return JobResult(job.row, task.scan, outcome)


def fingerprint(task: ScanTask) -> str:
    """Hash of all inputs of a task: options and the content of checkpoints.

    The content of the data set, code of this version and plug-ins are not in it.
    """
    portable = replace(task, root=task.root.resolve(), out=Path())
    models = [fingerprint_of(name) for name in checkpoints_of(task.config)]
    inputs = {"version": __version__, "task": portable, "models": models}
    return hashlib.sha256(msgspec.json.encode(inputs, enc_hook=_as_text)).hexdigest()


def read_saved(folder: Path, expected: str) -> ScanOutcome | None:
    """The saved outcome in the folder of a scan; None if it is damaged or of another task."""
    try:
        content = (folder / OUTCOME_FILE).read_bytes()
        saved = msgspec.json.decode(content, type=_Saved, dec_hook=_from_text)
    except (OSError, msgspec.MsgspecError):
        return None
    usable = saved.fingerprint == expected and (folder / GRAPH_FILE).exists()
    return saved.outcome if usable else None


def _save(folder: Path, saved: _Saved) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / OUTCOME_FILE, msgspec.json.encode(saved, enc_hook=_as_text))


def _as_text(value: Any) -> str:
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be saved as JSON")


def _from_text(kind: type, value: Any) -> Any:
    if issubclass(kind, Path):
        return Path(value)
    raise TypeError(f"{kind.__name__} cannot be read from JSON")


# --- Execution of jobs: in this process, in parallel on the cores, or on a cluster.

# Thread limits of libraries that otherwise use all cores each; read at their first import.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DIED = "its process died (out of memory?)"


def run_jobs(jobs: Sequence[Job], *, workers: int = 0, scheduler: str = "") -> Iterator[JobResult]:
    """Run jobs; yields results in the order in which they finish.

    Args:
        jobs: jobs to run.
        workers: number of processes; 1 = this process, 0 = one per core.
        scheduler: address of a dask scheduler whose workers share the file system; empty = none.

    Raises:
        EvaluationError: the scheduler cannot be used.
    """
    if scheduler:
        yield from _over_cluster(jobs, scheduler)
        return
    workers = min(workers or len(os.sched_getaffinity(0)), len(jobs))
    if workers <= 1:
        for job in jobs:
            yield run_job(job)
        return
    yield from _over_cores(jobs, workers)


def _over_cores(jobs: Sequence[Job], workers: int) -> Iterator[JobResult]:
    """A process that dies breaks its pool. Unfinished jobs then run again, each in its own pool."""
    unfinished = []
    pool = _pool(workers)
    try:
        futures = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(futures):
            try:
                yield future.result()
            except BrokenProcessPool:
                unfinished.append(futures[future])
    finally:
        pool.shutdown(cancel_futures=True)
    for job in unfinished:
        with _pool(1) as alone:
            try:
                yield alone.submit(run_job, job).result()
            except BrokenProcessPool:
                yield JobResult(job.row, job.task.scan, None, DIED)


def _pool(workers: int) -> ProcessPoolExecutor:
    # Spawn: a forked copy of a process with threads may hang.
    context = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=one_thread)
        # Start all processes now, while the environment has the thread limits.
        for future in [pool.submit(os.getpid) for _ in range(workers)]:
            future.result()
        return pool
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def one_thread() -> None:
    """Limit OpenCV to one thread: the other processes use the other cores."""
    import cv2

    cv2.setNumThreads(1)


def _over_cluster(jobs: Sequence[Job], address: str) -> Iterator[JobResult]:
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError as error:
        raise EvaluationError(
            f"--scheduler needs dask.distributed: pip install distributed ({error})"
        ) from error
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise EvaluationError(
            f"--scheduler {address}: {error}; expected the address of a running dask scheduler, "
            "e.g. tcp://host:8786"
        ) from error
    with client:
        futures = {client.submit(run_job, job, pure=False): job for job in jobs}
        for future in completed(futures):
            job = futures[future]
            raised = future.exception()
            if raised is None:
                yield future.result()
            else:
                failure = f"{type(raised).__name__}: {raised}"
                yield JobResult(job.row, job.task.scan, None, failure)


# --- Results of the rows of a table, with the rows of the paper; as values and files.

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
        {"frames": frames, "scans": [reports.outcome_values(outcome) for outcome in outcomes]},
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
            reports.write_rows(staged / CSV_FILE, lines, "method")
            write_atomically(staged / LATEX_FILE, reports.latex_rows(lines))
    except OSError as error:
        raise EvaluationError(f"--out {out}: cannot be written ({error.strerror})") from error
    return [out / CSV_FILE, out / LATEX_FILE]


# --- Terminal tables that compare methods.

# Heading, number, factor, decimals.
RECALL_COLUMNS = (
    ("Rel %", "relationship_recall", 100, 1),
    ("Obj %", "object_recall", 100, 1),
    ("Pred %", "predicate_recall", 100, 1),
    ("of det.", "predicate_recall_of_detected", 100, 1),
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
        line = Text.assemble(("failed:", "red"), f" {visible_lines(text)}")
        console.print(line, highlight=False, soft_wrap=True)


def _number(value: float, decimals: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{decimals}f}"


def _ms(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
