"""`deworldsg evaluate table`: methods or configurations compared."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import typer
from rich.console import Console

from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.evaluate.options import (
    DataOptions,
    DetectionOptions,
    RunOptions,
    ScoringOptions,
    TableOptions,
)
from deworldsg_ros.cli.evaluate.run import pose_sources, scan_tasks
from deworldsg_ros.cli.evaluate.score import finish, header, print_files
from deworldsg_ros.cli.exit_codes import EXIT_NOTHING_DONE
from deworldsg_ros.cli.installation import find_shared
from deworldsg_ros.cli.progress import frame_progress
from deworldsg_ros.config import Config, load_config
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.pose_sources import KINDS
from deworldsg_ros.evaluation.recorded_room import open_annotations
from deworldsg_ros.evaluation.reports.evaluation import evaluate_prediction_file
from deworldsg_ros.evaluation.runner import ScanTask
from deworldsg_ros.evaluation.tables import row_results, terminal
from deworldsg_ros.evaluation.tables.jobs import Job, JobResult, jobs_of
from deworldsg_ros.evaluation.tables.parallel import run_jobs
from deworldsg_ros.evaluation.tables.rows import Configurations, Row, table_rows
from deworldsg_ros.scene.errors import ConfigurationError

# Tables that the paper prints, too.
PRINTED = ("main", "predictions", "pose", "ablation", "runtime")
NOT_PRINTED = (
    "Numbers of the paper appear only beside a row of the same method, on its whole test split. "
    "This table has none. docs/dev/models.md says how to get the paper's networks."
)


def make_table(
    kind: str,
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    comparing: TableOptions,
    scoring: ScoringOptions,
    out: Path,
    json_file: Path | None,
    console: Console,
) -> None:
    """Run the rows of a table over the scans, print and write it.

    Raises:
        DeWorldSGError: the options or the data set cannot be used; a scan that fails is reported.
        typer.Exit: every scan failed.
    """
    files = _named_files(kind, comparing.predictions or [])
    annotations = open_annotations(data.dataset, data.layout)
    poses = pose_sources(running, KINDS if kind == "pose" else ())
    if len(poses) > 1 and kind != "pose":
        raise EvaluationError(
            f"evaluate table {kind} takes one --poses, found {len(poses)}; the pose table takes "
            "several"
        )
    tasks = scan_tasks(annotations, data, detections, running, scoring, out)
    front_end = tasks[0].front_end
    configurations = Configurations(
        partial(_configure, kind, running),
        load_config(_config_path("paper", None)),
        running.config.stem if running.config else "default",
    )
    rows = table_rows(kind, poses, front_end, configurations)
    _check_prefixes(rows, running.settings or [])
    done = _run(jobs_of(rows, tasks, fresh=comparing.fresh), kind, comparing, console)
    lines = _printed(kind, annotations.layout.name, data, tasks, rows, [name for name, _ in files])
    dataset = annotations.root.resolve().name
    for row in rows:
        own = sorted((item for item in done if item.row == row.name), key=lambda item: item.scan)
        lines.append(row_results.run_row(row.name, row.title, dataset, own, annotations.vocabulary))
    for name, path in files:
        evaluation = evaluate_prediction_file(annotations, path, tasks[0].options, data.scans)
        lines.append(row_results.predicted_row(name, evaluation))
    if not (lines and lines[0].printed) and kind in PRINTED:
        console.print(NOT_PRINTED, highlight=False, soft_wrap=True)
    title = f"{kind}: {dataset}" + (f", {front_end.describe()} detections" if rows else "")
    if kind == "runtime":
        terminal.print_runtime(console, lines, title)
    else:
        terminal.print_table(console, lines, title, timed=kind == "switches")
    print_files(row_results.write_table(out, lines), console)
    if not any(item.outcome for item in done) and not files:
        raise typer.Exit(EXIT_NOTHING_DONE)
    values = {
        **header(data, scoring),
        "front_end": front_end.describe(),
        "table": kind,
        "rows": [line.values() for line in lines],
    }
    finish(values, json_file, console)


def _printed(
    kind: str,
    layout: str,
    data: DataOptions,
    tasks: Sequence[ScanTask],
    rows: Sequence[Row],
    predicted: Sequence[str],
) -> list[row_results.RowResult]:
    """The paper's rows of the methods in the table, if it covers a whole test split."""
    if data.scans or data.split != "test" or any(task.max_frames for task in tasks):
        return []
    titles = {row.printed for row in rows if row.printed}.union(predicted)
    return row_results.paper_rows(kind, layout, {task.scan for task in tasks}, titles)


def _configure(
    kind: str, running: RunOptions, file: str, settings: Sequence[str], row: str
) -> Config:
    """Configuration of a row: a file, the row's own settings, those of the command line."""
    # The scans share the cores, one thread each; the runtime table runs one scan at a time.
    threads = [] if kind == "runtime" else ["perception.threads=1"]
    given = _settings_of(row, running.settings or [])
    return effective_config(_config_path(file, running.config), [*threads, *settings, *given])


def _run(
    jobs: Sequence[Job], kind: str, comparing: TableOptions, console: Console
) -> list[JobResult]:
    # Times are measured with the machine to one process, unless the user asks for more.
    workers = comparing.workers or (1 if kind == "runtime" else 0)
    done = []
    with frame_progress(console) as progress:
        bar = progress.add_task("scans", total=len(jobs), note="")
        for item in run_jobs(jobs, workers=workers, scheduler=comparing.scheduler):
            done.append(item)
            failed = sum(known.outcome is None for known in done)
            reused = sum(known.reused for known in done)
            note = f"{reused} from before, {failed} failed" if reused or failed else ""
            progress.update(bar, advance=1, note=note)
    return done


def _named_files(kind: str, texts: Sequence[str]) -> list[tuple[str, Path]]:
    if kind == "predictions" and not texts:
        raise EvaluationError("evaluate table predictions needs --predictions NAME=FILE")
    return [_named_predictions(text) for text in texts]


def _named_predictions(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if not equals or not name or not path:
        raise EvaluationError(f"--predictions {text}: expected NAME=FILE")
    if not Path(path).is_file():
        raise EvaluationError(f"--predictions {text}: {path} is not a file")
    return name, Path(path)


def _config_path(file: str, default: Path | None) -> Path:
    if file == "default" and default is not None:
        return default
    path = find_shared(f"config/{file}.yaml")
    if path is None:
        raise ConfigurationError(
            f"config/{file}.yaml is missing: expected it in the installed package; install it again"
        )
    return path


def _prefix(setting: str) -> tuple[str, str]:
    """Row and setting of ``ROW:section.field=value``; no row where there is none."""
    name, _, value = setting.partition("=")
    row, colon, field = name.partition(":")
    return (row, f"{field}={value}") if colon else ("", setting)


def _settings_of(row: str, settings: Sequence[str]) -> list[str]:
    known = [_prefix(setting) for setting in settings]
    return [setting for name, setting in known if name in ("", row)]


def _check_prefixes(rows: Sequence[Row], settings: Sequence[str]) -> None:
    names = {row.name.partition("-")[0] for row in rows}
    for setting in settings:
        name, _ = _prefix(setting)
        if name and name not in names:
            raise EvaluationError(
                f"--set {setting}: the table has no row {name}; its rows are "
                f"{', '.join(sorted(names))}"
            )
