"""`deworldsg evaluate`: scene graphs measured against annotations, and tables of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from deworldsg_ros.base.words import visible, visible_lines
from deworldsg_ros.cli.configuration import EXIT_NOTHING_DONE, effective_config
from deworldsg_ros.cli.evaluate_options import (
    DataOptions,
    DetectionOptions,
    LossOptions,
    RunOptions,
    ScoringOptions,
    TableOptions,
)
from deworldsg_ros.cli.terminal import find_shared, frame_progress
from deworldsg_ros.config import Config, load_config
from deworldsg_ros.evaluation import tables
from deworldsg_ros.evaluation.front_ends import (
    PERTURBATION,
    POSE_KINDS,
    FrontEndChoice,
    PoseSource,
    parse_faults,
)
from deworldsg_ros.evaluation.losses import (
    LOSSES_FILE,
    STAGES,
    Loss,
    count_stages,
    trace_scan,
)
from deworldsg_ros.evaluation.recorded_room import open_annotations
from deworldsg_ros.evaluation.reports import (
    Evaluation,
    evaluate_prediction_file,
    evaluate_saved_graphs,
    evaluation_of_runs,
    evaluation_values,
    outcome_values,
    print_evaluation,
    write_folder,
    write_json,
)
from deworldsg_ros.evaluation.rows import (
    Configurations,
    Row,
    paper_file,
    table_rows,
)
from deworldsg_ros.evaluation.runner import ScanOutcome, ScanTask, evaluate_scan
from deworldsg_ros.evaluation.scoring import ProtocolOptions
from deworldsg_ros.evaluation.tables import Job, JobResult, jobs_of, run_jobs
from deworldsg_ros.poses.trajectory import parse_noise
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError, EvaluationError

# --- `deworldsg evaluate score`: predictions or saved graphs against annotations.


def score_files(
    data: DataOptions,
    scoring: ScoringOptions,
    predictions: Path | None,
    graphs: Path | None,
    out: Path | None,
    json_file: Path | None,
) -> None:
    """Score one of predictions and graphs; raises DeWorldSGError."""
    console = Console(markup=False)
    annotations = open_annotations(data.dataset, data.layout)
    options = protocol_options(data, scoring)
    values = header(data, scoring)
    if predictions is not None and graphs is None:
        evaluation = evaluate_prediction_file(annotations, predictions, options, data.scans)
        values["predictions"] = predictions.name
    elif graphs is not None and predictions is None:
        evaluation = evaluate_saved_graphs(annotations, graphs, options, data.scans)
    else:
        seen = "both of" if graphs else "none of"
        raise EvaluationError(
            f"evaluate score has {seen} --predictions FILE and --graphs DIR: give one of them"
        )
    report(evaluation, out, console)
    finish(values | evaluation_values(evaluation), json_file, console)


def protocol_options(data: DataOptions, scoring: ScoringOptions) -> ProtocolOptions:
    """Options of the protocol from those of the command line."""
    return ProtocolOptions(
        data.split, scoring.skip_no_rel_objects, scoring.overlap_threshold, scoring.aligned_ply
    )


def header(data: DataOptions, scoring: ScoringOptions) -> dict[str, Any]:
    """First values of every JSON file: data set and options of the protocol."""
    return {
        "dataset": data.dataset.resolve().name,
        "layout": data.layout,
        "split": data.split,
        "skip_no_rel_objects": scoring.skip_no_rel_objects,
        "overlap_threshold_m": scoring.overlap_threshold,
    }


def report(evaluation: Evaluation, out: Path | None, console: Console) -> None:
    """Print an evaluation and write its files; raises EvaluationError."""
    print_evaluation(console, evaluation)
    if out is not None:
        print_files(write_folder(out, evaluation), console)


def print_files(written: list[Path], console: Console) -> None:
    """Print which files of a folder were written."""
    names = ", ".join(path.name for path in written)
    console.print(f"in {written[0].parent}: {names}", highlight=False, soft_wrap=True)


def finish(values: dict[str, Any], json_file: Path | None, console: Console) -> None:
    """Write the values to the JSON file, if one was given; raises EvaluationError."""
    if json_file is not None:
        write_json(json_file, values)
        console.print(f"numbers in {json_file}", highlight=False, soft_wrap=True)


# --- `deworldsg evaluate run`: the pipeline on every scan, and its graphs against annotations.


def run_scans(
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    scoring: ScoringOptions,
    out: Path,
    json_file: Path | None,
) -> None:
    """Run and score the scans; a scan that fails is reported and the others go on.

    Raises:
        DeWorldSGError: the options or the data set cannot be used.
        typer.Exit: every scan failed.
    """
    console = Console(markup=False)
    poses = pose_sources(running)
    if len(poses) > 1:
        raise EvaluationError(
            f"evaluate run has {len(poses)} --poses: give one; the pose table takes several"
        )
    annotations = open_annotations(data.dataset, data.layout)
    config = effective_config(running.config, running.settings)
    tasks = [
        replace(task, config=config, poses=poses[0])
        for task in scan_tasks(annotations, data, detections, running, scoring, out)
    ]
    outcomes, failures = _run_all(tasks, console)
    _print_failures(failures, console)
    if not outcomes:
        raise typer.Exit(EXIT_NOTHING_DONE)
    front_end = tasks[0].front_end.describe()
    evaluation = evaluation_of_runs(annotations, outcomes, front_end)
    report(evaluation, out, console)
    values = {
        **header(data, scoring),
        "front_end": front_end,
        **evaluation_values(evaluation),
        "scans": [outcome_values(outcome) for outcome in outcomes],
        "failed": failures,
    }
    finish(values, json_file, console)


def _print_failures(failures: Mapping[str, str], console: Console) -> None:
    for scan, reason in failures.items():
        line = Text.assemble(("failed:", "red"), " " + visible_lines(f"{scan}: {reason}"))
        console.print(line, highlight=False, soft_wrap=True)


def front_end_choice(detections: DetectionOptions) -> FrontEndChoice:
    """The front end of the command line; raises DeWorldSGError."""
    return FrontEndChoice(
        detections.front_end,  # type: ignore[arg-type]
        detections.flip,
        detections.miss,
        detections.jitter_px,
        detections.seed,
        parse_faults(detections.faults),
    )


def pose_sources(running: RunOptions, default: Sequence[str] = ()) -> list[PoseSource]:
    """The pose sources of the command line, in its order.

    Without --poses they are ``perturbed`` if there is --pose-noise, else `default`, else
    ``ground-truth``.

    Raises:
        DeWorldSGError: a source or noise that does not exist, or noise of unperturbed poses.
    """
    noise = parse_noise(running.pose_noise) if running.pose_noise else PERTURBATION
    otherwise = default or (("perturbed",) if running.pose_noise else ("ground-truth",))
    kinds = list(dict.fromkeys(running.poses or otherwise))
    if running.pose_noise and "perturbed" not in kinds:
        raise EvaluationError(
            f"--pose-noise with --poses {' '.join(kinds)}: only --poses perturbed has noise"
        )
    return [PoseSource(kind, noise) for kind in kinds]  # type: ignore[arg-type]


def scan_tasks(
    annotations: Annotations | None,
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    scoring: ScoringOptions,
    out: Path,
) -> list[ScanTask]:
    """One task per scan, with the default configuration and ground-truth poses.

    Without annotations, `data` lists the scans.

    Raises:
        DeWorldSGError: the options cannot be used, or there is no scan.
    """
    front_end = front_end_choice(detections)
    scans = data.scans or (annotations.scans(data.split) if annotations else [])
    if not scans:
        raise EvaluationError(
            f"--split {data.split} of {data.dataset} has no scan: give another split, or --scan"
        )
    return [
        ScanTask(
            root=data.dataset,
            layout=data.layout,
            scan=scan,
            out=out,
            config=Config(),
            front_end=front_end,
            options=protocol_options(data, scoring),
            dataset=DatasetOptions(depth_source=running.depth_source),
            every=running.every,
            max_frames=running.max_frames,
            checkpoints=running.checkpoints,
        )
        for scan in scans
    ]


def _run_all(
    tasks: Sequence[ScanTask], console: Console
) -> tuple[list[ScanOutcome], dict[str, str]]:
    """Outcomes, and the reasons of failures by scan."""
    outcomes: list[ScanOutcome] = []
    failures: dict[str, str] = {}
    for number, task in enumerate(tasks, start=1):
        with console.status(f"scan {number} of {len(tasks)}: {task.scan} …"):
            try:
                outcomes.append(evaluate_scan(task))
            except DeWorldSGError as error:
                failures[task.scan] = str(error)
    return outcomes, failures


# --- `deworldsg evaluate losses`: the stage that lost each annotated object.


def list_losses(
    data: LossOptions,
    detections: DetectionOptions,
    running: RunOptions,
    out: Path,
    json_file: Path | None,
) -> None:
    """Run the scans, print the stage of each lost object, and write the pictures.

    Raises:
        DeWorldSGError: the options or the data set cannot be used; a scan that fails is reported.
        typer.Exit: every scan failed.
    """
    console = Console(markup=False)
    poses = pose_sources(running)
    if len(poses) > 1:
        raise EvaluationError(f"evaluate losses has {len(poses)} --poses: give one")
    if (data.boxes is None) != bool(data.layout):
        seen = "both" if data.layout else "none"
        raise EvaluationError(
            f"evaluate losses has {seen} of --layout and --boxes: --layout LAYOUT names the layout "
            "of a data set, --boxes FILE the objects of any other recording"
        )
    config = effective_config(running.config, running.settings)
    tasks = [
        replace(task, config=config, poses=poses[0])
        for task in _loss_tasks(data, detections, running, out)
    ]
    found: dict[str, list[Loss]] = {}
    failures: dict[str, str] = {}
    for number, task in enumerate(tasks, start=1):
        with console.status(f"scan {number} of {len(tasks)}: {task.scan} …"):
            try:
                found[task.scan] = trace_scan(task, data.boxes)
            except DeWorldSGError as error:
                failures[task.scan] = str(error)
    _print_failures(failures, console)
    if not found:
        raise typer.Exit(EXIT_NOTHING_DONE)
    for scan, losses in found.items():
        _print_losses(scan, losses, console)
    _print_stages(found, console)
    console.print(
        f"pictures and {LOSSES_FILE} in {', '.join(str(out / scan) for scan in found)}",
        highlight=False,
        soft_wrap=True,
    )
    values = {
        "dataset": data.dataset.resolve().name,
        "front_end": tasks[0].front_end.describe(),
        "scans": {
            scan: {
                "stages": count_stages(losses),
                "objects": [loss.to_dict() for loss in losses],
            }
            for scan, losses in found.items()
        },
        "failed": failures,
    }
    finish(values, json_file, console)


def _loss_tasks(
    data: LossOptions, detections: DetectionOptions, running: RunOptions, out: Path
) -> list[ScanTask]:
    scoring = ScoringOptions()
    if data.boxes is None:
        annotations = open_annotations(data.dataset, data.layout)
        return scan_tasks(annotations, data, detections, running, scoring, out)
    if detections.front_end != "backend":
        raise EvaluationError(
            f"--boxes with --front-end {detections.front_end}: a recording without a data set has "
            "no annotated detections; expected backend"
        )
    if data.scans:
        raise EvaluationError(
            f"--boxes with --scan {data.scans[0]}: the file has the objects of one recording"
        )
    named = replace(data, scans=[data.dataset.resolve().stem])
    return scan_tasks(None, named, detections, running, scoring, out)


def _print_losses(scan: str, losses: Sequence[Loss], console: Console) -> None:
    console.print(Text(visible(f"lost objects of {scan}:"), style="bold"))
    for loss in losses:
        if loss.stage == "found":
            continue
        note = "" if loss.has_class else "; the detector has no such class"
        picture = f" ({loss.picture})" if loss.picture else ""
        why = visible(f": {loss.detail}{note}{picture}")
        line = Text.assemble(f"  {visible(loss.item.title)}: ", (loss.stage, "yellow"), why)
        console.print(line, highlight=False, soft_wrap=True)


def _print_stages(found: Mapping[str, Sequence[Loss]], console: Console) -> None:
    table = Table(title="objects by stage", box=box.SIMPLE)
    table.add_column("stage")
    for scan in found:
        table.add_column(Text(visible(scan)), justify="right", overflow="fold")
    table.add_column("")
    counts = {scan: count_stages(losses) for scan, losses in found.items()}
    for stage in (*STAGES, "duplicates"):
        numbers = (str(counts[scan][stage]) for scan in found)
        table.add_row(stage, *numbers, STAGES.get(stage, "further nodes of found objects"))
    console.print(table)


# --- `deworldsg evaluate table`: methods or configurations compared.

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
) -> None:
    """Run the rows of a table over the scans, print and write it.

    Raises:
        DeWorldSGError: the options or the data set cannot be used; a scan that fails is reported.
        typer.Exit: every scan failed.
    """
    console = Console(markup=False)
    files = _named_files(kind, comparing.predictions or [])
    annotations = open_annotations(data.dataset, data.layout)
    poses = pose_sources(running, POSE_KINDS if kind == "pose" else ())
    if len(poses) > 1 and kind != "pose":
        raise EvaluationError(
            f"evaluate table {kind} takes one --poses, found {len(poses)}; the pose table takes "
            "several"
        )
    tasks = scan_tasks(annotations, data, detections, running, scoring, out)
    front_end = tasks[0].front_end
    paper = paper_file(annotations.layout.name)
    configurations = Configurations(
        partial(_configure, kind, running),
        paper,
        load_config(_config_path(paper, None)),
        running.config.stem if running.config else "default",
    )
    rows = table_rows(kind, poses, front_end, configurations)
    _check_prefixes(rows, running.settings or [])
    done = _run_jobs(jobs_of(rows, tasks, fresh=comparing.fresh), kind, comparing, console)
    lines = _printed(kind, annotations.layout.name, data, tasks, rows, [name for name, _ in files])
    dataset = annotations.root.resolve().name
    for row in rows:
        own = sorted((item for item in done if item.row == row.name), key=lambda item: item.scan)
        lines.append(tables.run_row(row.name, row.title, dataset, own, annotations.vocabulary))
    for name, path in files:
        evaluation = evaluate_prediction_file(annotations, path, tasks[0].options, data.scans)
        lines.append(tables.predicted_row(name, evaluation))
    if not (lines and lines[0].printed) and kind in PRINTED:
        console.print(NOT_PRINTED, highlight=False, soft_wrap=True)
    title = f"{kind}: {dataset}" + (f", {front_end.describe()} detections" if rows else "")
    if kind == "runtime":
        tables.print_runtime(console, lines, title)
    else:
        tables.print_table(console, lines, title, timed=kind == "switches")
    print_files(tables.write_table(out, lines), console)
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
) -> list[tables.RowResult]:
    """The paper's rows of the methods in the table, if it covers a whole test split."""
    if data.scans or data.split != "test" or any(task.max_frames for task in tasks):
        return []
    titles = {row.printed for row in rows if row.printed}.union(predicted)
    return tables.paper_rows(kind, layout, {task.scan for task in tasks}, titles)


def _configure(
    kind: str, running: RunOptions, file: str, settings: Sequence[str], row: str
) -> Config:
    """Configuration of a row: a file, the row's own settings, those of the command line."""
    # The scans share the cores, one thread each; the runtime table runs one scan at a time.
    threads = [] if kind == "runtime" else ["perception.threads=1"]
    given = _settings_of(row, running.settings or [])
    return effective_config(_config_path(file, running.config), [*threads, *settings, *given])


def _run_jobs(
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
