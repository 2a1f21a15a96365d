"""One scan of one row: run, or taken from an earlier run of the very same task."""

from __future__ import annotations

import hashlib
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from deworldsg_ros import __version__
from deworldsg_ros.evaluation.runner import GRAPH_FILE, ScanOutcome, ScanTask, evaluate_scan
from deworldsg_ros.evaluation.tables.rows import Row
from deworldsg_ros.files import write_atomically
from deworldsg_ros.scene.errors import DeWorldSGError

OUTCOME_FILE = "outcome.json"
ERROR_FILE = "error.txt"


@dataclass(frozen=True)
class Job:
    """A scan of a row; `fresh` = do not look for an earlier result."""

    row: str
    task: ScanTask
    fresh: bool = False


@dataclass(frozen=True)
class JobResult:
    """What became of a job: an outcome, or why there is none."""

    row: str
    scan: str
    outcome: ScanOutcome | None
    failure: str = ""
    reused: bool = False


@dataclass(frozen=True)
class _Kept:
    """The file of a finished job."""

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
    """Run a job, or reuse its result; never raises but for an interruption.

    The result is kept beside the graph with the task's fingerprint. What an unexpected error tells
    goes to ``error.txt`` there.
    """
    task = job.task
    folder = task.out / task.scan
    kept = None if job.fresh else read_kept(folder, fingerprint(task))
    if kept is not None:
        return JobResult(job.row, task.scan, kept, reused=True)
    try:
        outcome = evaluate_scan(task)
        _keep(folder, _Kept(fingerprint(task), outcome))
    except DeWorldSGError as error:
        return JobResult(job.row, task.scan, None, str(error))
    except Exception as error:  # one scan must not take the others with it
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ERROR_FILE).write_text(traceback.format_exc(), encoding="utf-8")
        failure = f"{type(error).__name__}: {error} (all of it in {folder / ERROR_FILE})"
        return JobResult(job.row, task.scan, None, failure)
    return JobResult(job.row, task.scan, outcome)


def fingerprint(task: ScanTask) -> str:
    """Of everything that a result depends on but the content of the data set."""
    place = replace(task, root=task.root.resolve(), out=Path())
    content = msgspec.json.encode({"version": __version__, "task": place}, enc_hook=_as_text)
    return hashlib.sha256(content).hexdigest()


def read_kept(folder: Path, wanted: str) -> ScanOutcome | None:
    """The outcome that is kept in a scan's folder; None where it is of another task, or damaged."""
    try:
        content = (folder / OUTCOME_FILE).read_bytes()
        kept = msgspec.json.decode(content, type=_Kept, dec_hook=_from_text)
    except (OSError, msgspec.MsgspecError):
        return None
    usable = kept.fingerprint == wanted and (folder / GRAPH_FILE).exists()
    return kept.outcome if usable else None


def _keep(folder: Path, kept: _Kept) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / OUTCOME_FILE, msgspec.json.encode(kept, enc_hook=_as_text))


def _as_text(value: Any) -> str:
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be kept as JSON")


def _from_text(kind: type, value: Any) -> Any:
    if issubclass(kind, Path):
        return Path(value)
    raise TypeError(f"{kind.__name__} cannot be read from JSON")
