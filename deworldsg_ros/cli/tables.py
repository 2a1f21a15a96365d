"""`deworldsg evaluate --table`: a table of methods, from one command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.installation import find_shared
from deworldsg_ros.cli.progress import frame_progress
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.measures import graph_measures as measures
from deworldsg_ros.evaluation.pose_sources import KINDS, WORSE, PoseChoice
from deworldsg_ros.evaluation.protocol.predictions import read_predictions
from deworldsg_ros.evaluation.protocol.scoring import ProtocolOptions, evaluate_predictions
from deworldsg_ros.evaluation.runner import ScanTask
from deworldsg_ros.evaluation.tables import results, text
from deworldsg_ros.evaluation.tables.jobs import Job, JobResult
from deworldsg_ros.evaluation.tables.mapping import run_jobs
from deworldsg_ros.evaluation.tables.rows import Row, table_rows
from deworldsg_ros.poses.perturbation import parse_noise
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.errors import ConfigurationError

EXIT_NOTHING_DONE = 1


def evaluate_table(
    annotations: Annotations,
    table: str,
    tasks: Sequence[ScanTask],
    *,
    config_path: Path | None,
    settings: Sequence[str],
    predictions: Sequence[str],
    poses: Sequence[PoseChoice],
    workers: int,
    scheduler: str,
    fresh: bool,
    console: Console,
) -> dict[str, Any]:
    """Run a table's rows over the scans, print and write it; returns its values for JSON.

    Args:
        annotations: of the data set.
        table: which one.
        tasks: a scan each, whose method, configuration and poses the rows replace.
        config_path: in place of the default configuration.
        settings: ``section.field=value``, or ``ROW:section.field=value`` of one row.
        predictions: ``NAME=FILE`` of further rows.
        poses: of the rows.
        workers: processes, see `run_jobs`.
        scheduler: of a cluster.
        fresh: run again what was finished before.
        console: to print on.

    Raises:
        DeWorldSGError: where the table cannot be begun; a scan that fails is reported.
    """
    read = [_named_predictions(item) for item in predictions]
    alone = table == "runtime"

    def configure(file: str, own: Sequence[str], row: str) -> Config:
        # Each process has one core; where time is measured, the machine is left to one process.
        given = [*([] if alone else ["perception.threads=1"]), *own, *_settings_of(row, settings)]
        return effective_config(_config_path(file, config_path), given)

    rows = table_rows(table, poses, tasks[0].front_end, configure)
    _check_prefixes(rows, settings)
    jobs = [
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
    done = _run(jobs, 1 if alone and not workers else workers, scheduler, console)
    dataset = annotations.root.resolve().name
    lines = results.paper_rows(table, annotations.layout.name)
    for row in rows:
        own = sorted((item for item in done if item.row == row.name), key=lambda item: item.scan)
        lines.append(results.run_row(row.name, row.title, dataset, own, annotations.vocabulary))
    for name, path in read:
        lines.append(_predicted(annotations, name, path, tasks[0].options, dataset))
    title = f"{table}: {dataset}, {tasks[0].front_end.describe()} detections"
    if alone:
        text.print_runtime(console, lines, title)
    else:
        text.print_table(console, lines, title, timed=table == "switches")
    written = results.write_table(tasks[0].out, lines)
    names = ", ".join(path.name for path in written)
    console.print(f"in {tasks[0].out}: {names}", highlight=False, soft_wrap=True)
    if jobs and not any(item.outcome for item in done):
        raise typer.Exit(EXIT_NOTHING_DONE)
    return {"table": table, "rows": [line.values() for line in lines]}


def pose_choices(table: str | None, names: Sequence[str], noise: str) -> list[PoseChoice]:
    """The poses asked for; without a name ``worse`` where there is noise, else the true ones.

    Of the pose table all kinds where none is asked for.

    Raises:
        DeWorldSGError: for a kind or noise that does not exist, noise without ``worse``, or
            several poses but for the pose table.
    """
    worse = parse_noise(noise) if noise else WORSE
    default = KINDS if table == "pose" else ("worse",) if noise else KINDS[:1]
    chosen: Sequence[Any] = list(dict.fromkeys(names)) or default
    if len(chosen) > 1 and table != "pose":
        which = f"--table {table}" if table else "a run"
        raise EvaluationError(f"{which} takes one --poses; the pose table takes several")
    if noise and "worse" not in chosen:
        raise EvaluationError(f"--pose-noise with --poses {' '.join(chosen)}: wanted worse")
    return [PoseChoice(kind, worse) for kind in chosen]


def _run(jobs: Sequence[Job], workers: int, scheduler: str, console: Console) -> list[JobResult]:
    done = []
    with frame_progress(console) as progress:
        bar = progress.add_task("scans", total=len(jobs), note="")
        for item in run_jobs(jobs, workers=workers, scheduler=scheduler):
            done.append(item)
            failed = sum(known.outcome is None for known in done)
            reused = sum(known.reused for known in done)
            note = f"{reused} from before, {failed} failed" if reused or failed else ""
            progress.update(bar, advance=1, note=note)
    return done


def _predicted(
    annotations: Annotations, name: str, path: Path, options: ProtocolOptions, dataset: str
) -> results.TableRow:
    predictions = read_predictions(path)
    result = evaluate_predictions(annotations, predictions, options)
    measured = []
    for scan in annotations.scans(options.split):
        if scan in predictions:
            points = annotations.points(scan, aligned=options.aligned_ply)
            reference = measures.read_reference(annotations, scan, points)
            measured.append(
                measures.measure_prediction(predictions[scan], annotations.vocabulary, reference)
            )
    return results.predicted_row(name, dataset, result, measures.pool(measured))


def _named_predictions(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if not equals or not name or not path:
        raise EvaluationError(f"--predictions {text}: wanted NAME=FILE with --table")
    if not Path(path).is_file():
        raise EvaluationError(f"--predictions {text}: there is no file {path}")
    return name, Path(path)


def _config_path(file: str, default: Path | None) -> Path:
    if file == "default" and default is not None:
        return default
    path = find_shared(f"config/{file}.yaml")
    if path is None:
        raise ConfigurationError(f"config/{file}.yaml is not installed: the table needs it")
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
