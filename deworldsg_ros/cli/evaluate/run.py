"""`deworldsg evaluate run`: the pipeline on every scan, and its graphs against annotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import typer
from rich.console import Console
from rich.text import Text

from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.evaluate.options import (
    DataOptions,
    DetectionOptions,
    RunOptions,
    ScoringOptions,
)
from deworldsg_ros.cli.evaluate.score import finish, header, protocol_options, report
from deworldsg_ros.cli.exit_codes import EXIT_NOTHING_DONE
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends import FrontEndChoice, parse_faults
from deworldsg_ros.evaluation.pose_sources import PERTURBATION, PoseSource
from deworldsg_ros.evaluation.recorded_room import open_annotations
from deworldsg_ros.evaluation.reports.evaluation import evaluation_of_runs
from deworldsg_ros.evaluation.reports.json_values import evaluation_values, outcome_values
from deworldsg_ros.evaluation.runner import ScanOutcome, ScanTask, evaluate_scan
from deworldsg_ros.poses.perturbation import parse_noise
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.scene.errors import DeWorldSGError
from deworldsg_ros.words import visible


def run_scans(
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    scoring: ScoringOptions,
    out: Path,
    json_file: Path | None,
    console: Console,
) -> None:
    """Run and score the scans; a scan that fails is reported and the others go on.

    Raises:
        DeWorldSGError: the options or the data set cannot be used.
        typer.Exit: every scan failed.
    """
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
    outcomes, failures = _run(tasks, console)
    for scan, reason in failures.items():
        line = Text.assemble(("failed:", "red"), " " + visible(f"{scan}: {reason}"))
        console.print(line, highlight=False, soft_wrap=True)
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
    annotations: Annotations,
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    scoring: ScoringOptions,
    out: Path,
) -> list[ScanTask]:
    """One task per scan, with the default configuration and ground-truth poses.

    Raises:
        DeWorldSGError: the options cannot be used, or there is no scan.
    """
    front_end = front_end_choice(detections)
    scans = data.scans or annotations.scans(data.split)
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


def _run(tasks: Sequence[ScanTask], console: Console) -> tuple[list[ScanOutcome], dict[str, str]]:
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
