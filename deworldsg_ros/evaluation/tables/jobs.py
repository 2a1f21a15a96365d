"""Jobs: one scan of one row each, run or reused from an earlier run of the same task."""

from __future__ import annotations

import hashlib
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from deworldsg_ros import __version__
from deworldsg_ros.evaluation.runner import ScanOutcome, ScanTask, evaluate_scan
from deworldsg_ros.evaluation.tables.rows import Row
from deworldsg_ros.files import write_atomically
from deworldsg_ros.scene.errors import DeWorldSGError
from deworldsg_ros.scene.graph_file import GRAPH_FILE

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
    saved = None if job.fresh else read_saved(folder, fingerprint(task))
    if saved is not None:
        return JobResult(job.row, task.scan, saved, reused=True)
    try:
        outcome = evaluate_scan(task)
        _save(folder, _Saved(fingerprint(task), outcome))
    except DeWorldSGError as error:
        return JobResult(job.row, task.scan, None, str(error))
    except Exception as error:  # a failed scan must not stop the others
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / ERROR_FILE, traceback.format_exc())
        failure = f"{type(error).__name__}: {error} (traceback in {folder / ERROR_FILE})"
        return JobResult(job.row, task.scan, None, failure)
    return JobResult(job.row, task.scan, outcome)


def fingerprint(task: ScanTask) -> str:
    """Hash of all inputs of a task except the content of the data set."""
    portable = replace(task, root=task.root.resolve(), out=Path())
    content = msgspec.json.encode({"version": __version__, "task": portable}, enc_hook=_as_text)
    return hashlib.sha256(content).hexdigest()


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
