"""`deworldsg evaluate`: predictions, or what the pipeline makes of a data set, in numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer
from rich.console import Console
from rich.markup import escape

if TYPE_CHECKING:
    from deworldsg_ros.evaluation.protocol.scoring import ProtocolOptions
    from deworldsg_ros.evaluation.runner import ScanOutcome, ScanTask
    from deworldsg_ros.recordings.folders.annotations import Annotations

EXIT_NOTHING_DONE = 1
DEFAULT_OUT = Path("evaluation_out")


def evaluate(
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET",
            help="root folder, with data/ and the annotations; or a recording with ground truth",
        ),
    ],
    layout: Annotated[str, typer.Option("--layout", help="replica, 3rscan, or recording")],
    predictions: Annotated[
        Optional[list[str]],
        typer.Option(
            "--predictions",
            metavar="[NAME=]FILE",
            help="predictions of a method, .json or official .pkl; with --table a row each",
        ),
    ] = None,
    table: Annotated[
        Optional[str],
        typer.Option(
            "--table",
            help="the method against others: main, hard, pose, ablation, switches or runtime",
        ),
    ] = None,
    graphs: Annotated[
        Optional[Path],
        typer.Option("--graphs", help="folder with SCAN/scene_graph.json, made before"),
    ] = None,
    front_end: Annotated[
        Optional[str],
        typer.Option(
            "--front-end",
            help="run the pipeline on detections from: backend, recorded or ground-truth",
        ),
    ] = None,
    flip: Annotated[
        float, typer.Option("--flip", help="share of labels that are wrong; recorded: 0 or 0.1")
    ] = 0.0,
    miss: Annotated[
        float, typer.Option("--miss", help="recorded, ground-truth: share of detections missing")
    ] = 0.0,
    jitter: Annotated[
        float,
        typer.Option("--jitter", help="recorded, ground-truth: deviation of box edges, pixels"),
    ] = 0.0,
    faults: Annotated[
        str,
        typer.Option(
            "--faults",
            metavar="NAME=NUMBER,…",
            help="recorded, ground-truth: faults that persist over frames, e.g. label=0.1,false=1",
        ),
    ] = "",
    seed: Annotated[int, typer.Option("--seed", min=0, help="seed of all faults")] = 0,
    config: Annotated[
        Optional[Path],
        typer.Option("--config", help="ROS parameter file; the defaults without one"),
    ] = None,
    settings: Annotated[
        Optional[list[str]],
        typer.Option(
            "--set", metavar="SECTION.FIELD=VALUE", help="one value of it; may be repeated"
        ),
    ] = None,
    out: Annotated[
        Optional[Path],
        typer.Option("--out", help="folder of each scan's graph, and of tables and plots"),
    ] = None,
    scans: Annotated[
        Optional[list[str]],
        typer.Option("--scan", help="this scan rather than the whole split; may be repeated"),
    ] = None,
    depth_source: Annotated[
        str, typer.Option("--depth-source", help="3rscan: rendered or sensor; auto = rendered")
    ] = "auto",
    every: Annotated[int, typer.Option("--every", min=1, help="take every so manieth frame")] = 1,
    max_frames: Annotated[
        int, typer.Option("--max-frames", min=0, help="stop after so many frames; 0 = take all")
    ] = 0,
    checkpoints: Annotated[
        int,
        typer.Option("--checkpoints", min=0, help="how often to measure on the way, for a plot"),
    ] = 8,
    split: Annotated[str, typer.Option("--split", help="train, validation or test")] = "test",
    skip_no_rel_objects: Annotated[
        bool, typer.Option("--skip-no-rel-objects", help="only objects that occur in relations")
    ] = False,
    overlap_threshold: Annotated[
        float,
        typer.Option("--overlap-threshold", min=0, help="reach of a predicted point, metres"),
    ] = 0.1,
    aligned_ply: Annotated[
        bool, typer.Option("--aligned-ply", help="3rscan: take the aligned point cloud")
    ] = False,
    poses: Annotated[
        Optional[list[str]],
        typer.Option(
            "--poses",
            help="ground-truth, slam, odometry or worse; several for the pose table",
        ),
    ] = None,
    pose_noise: Annotated[
        Optional[str],
        typer.Option(
            "--pose-noise", metavar="NAME=NUMBER,…", help="of --poses worse, e.g. jitter_m=0.01"
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="with --table: processes; 0 = one a core")
    ] = 0,
    scheduler: Annotated[
        str, typer.Option("--scheduler", help="with --table: address of a dask scheduler")
    ] = "",
    fresh: Annotated[
        bool, typer.Option("--fresh", help="with --table: run again what was finished before")
    ] = False,
    json_file: Annotated[
        Optional[Path], typer.Option("--json", help="write every number by name to this file")
    ] = None,
) -> None:
    """Measure scene graphs against annotations with the official protocol.

    One of --predictions FILE (of any method), --graphs DIR (of this package, made before), or
    --front-end KIND (run the pipeline first); or --table KIND, which compares methods.
    """
    from deworldsg_ros.cli.configuration import effective_config
    from deworldsg_ros.cli.tables import evaluate_table, pose_choices
    from deworldsg_ros.config import Config
    from deworldsg_ros.evaluation.errors import EvaluationError
    from deworldsg_ros.evaluation.front_ends import FrontEndChoice, parse_faults
    from deworldsg_ros.evaluation.protocol.scoring import ProtocolOptions
    from deworldsg_ros.evaluation.recorded_room import open_annotations
    from deworldsg_ros.evaluation.reports import report
    from deworldsg_ros.evaluation.runner import ScanTask
    from deworldsg_ros.recordings.folders.dataset import DatasetOptions

    given = [bool(predictions), graphs is not None, front_end is not None]
    if table is None and sum(given) != 1:
        raise EvaluationError(
            "give one of --predictions FILE, --graphs DIR and --front-end KIND, or --table KIND"
        )
    if table is None and len(predictions or []) > 1:
        raise EvaluationError("several --predictions are rows of a table: give --table, too")
    if depth_source not in ("auto", "rendered", "sensor"):
        raise EvaluationError(f"--depth-source {depth_source}: wanted auto, rendered or sensor")
    console = Console()
    options = ProtocolOptions(split, skip_no_rel_objects, overlap_threshold, aligned_ply)
    annotations = open_annotations(dataset, layout)
    values: dict[str, Any] = {
        "dataset": dataset.resolve().name,
        "layout": layout,
        "split": split,
        "skip_no_rel_objects": skip_no_rel_objects,
        "overlap_threshold_m": overlap_threshold,
    }
    if predictions and table is None:
        file = Path(predictions[0])
        values["predictions"] = file.name
        values |= _evaluate_predictions(annotations, file, options, out, console)
    elif graphs is not None and table is None:
        values |= _evaluate_graphs(annotations, graphs, options, scans, out, console)
    else:
        choice = FrontEndChoice(
            front_end or "backend",  # type: ignore[arg-type]
            flip,
            miss,
            jitter,
            seed,
            parse_faults(faults),
        )
        values["front_end"] = choice.describe()
        chosen_poses = pose_choices(table, poses or [], pose_noise or "")
        tasks = [
            ScanTask(
                root=dataset,
                layout=layout,
                scan=scan,
                out=out or DEFAULT_OUT,
                config=Config() if table else effective_config(config, settings),
                front_end=choice,
                options=options,
                dataset=DatasetOptions(depth_source=depth_source),  # type: ignore[arg-type]
                every=every,
                max_frames=max_frames,
                checkpoints=checkpoints,
                poses=chosen_poses[0],
            )
            for scan in scans or annotations.scans(split)
        ]
        if table is None:
            values |= _evaluate_runs(annotations, tasks, console)
        else:
            values |= evaluate_table(
                annotations,
                table,
                tasks,
                config_path=config,
                settings=settings or [],
                predictions=predictions or [],
                poses=chosen_poses,
                workers=workers,
                scheduler=scheduler,
                fresh=fresh,
                console=console,
            )
    if json_file is not None:
        report.write_json(json_file, values)
        console.print(f"numbers in {json_file}", highlight=False, soft_wrap=True)


def _evaluate_predictions(
    annotations: Annotations,
    path: Path,
    options: ProtocolOptions,
    out: Path | None,
    console: Console,
) -> dict[str, Any]:
    from deworldsg_ros.evaluation.measures import graph_measures as measures
    from deworldsg_ros.evaluation.protocol.predictions import read_predictions
    from deworldsg_ros.evaluation.protocol.scoring import evaluate_predictions
    from deworldsg_ros.evaluation.reports import report, results
    from deworldsg_ros.evaluation.reports import terminal as tables

    predictions = read_predictions(path)
    result = evaluate_predictions(annotations, predictions, options)
    tables.print_protocol(
        console, result, f"{path.name} on {annotations.root.resolve().name}, {options.split}"
    )
    measured = {}
    for scan in dict.fromkeys(item.scan for item in result.scans):
        if scan in predictions:
            points = annotations.points(scan, aligned=options.aligned_ply)
            reference = measures.read_reference(annotations, scan, points)
            measured[scan] = measures.measure_prediction(
                predictions[scan], annotations.vocabulary, reference
            )
    pooled = measures.pool(measured.values())
    tables.print_measures(console, {**measured, "all": pooled})
    if out is not None:
        written = results.write_results(out, annotations, result, measured, pooled, path.name)
        _print_files(written, console)
    return {**report.protocol_values(result), "measures": pooled.numbers()}


def _evaluate_graphs(
    annotations: Annotations,
    folder: Path,
    options: ProtocolOptions,
    scans: list[str] | None,
    out: Path | None,
    console: Console,
) -> dict[str, Any]:
    from deworldsg_ros.evaluation.measures import graph_measures as measures
    from deworldsg_ros.evaluation.protocol import scoring as protocol
    from deworldsg_ros.evaluation.reports import report, results
    from deworldsg_ros.evaluation.reports import terminal as tables
    from deworldsg_ros.evaluation.runner import GRAPH_FILE, evaluate_graph, read_graph

    chosen = scans or annotations.scans(options.split)
    evaluated = {
        scan: evaluate_graph(annotations, scan, read_graph(folder / scan / GRAPH_FILE), options)
        for scan in dict.fromkeys(chosen)
    }
    result = protocol.pool([evaluated[scan][0] for scan in chosen], annotations.vocabulary)
    measured = {scan: item[1] for scan, item in evaluated.items()}
    pooled = measures.pool(measured.values())
    name = folder.resolve().name
    tables.print_protocol(console, result, f"graphs of {name}")
    tables.print_measures(console, {**measured, "all": pooled})
    if out is not None:
        written = results.write_results(out, annotations, result, measured, pooled, name)
        _print_files(written, console)
    return {**report.protocol_values(result), "measures": pooled.numbers()}


def _evaluate_runs(
    annotations: Annotations, tasks: list[ScanTask], console: Console
) -> dict[str, Any]:
    from deworldsg_ros.evaluation.measures import graph_measures as measures
    from deworldsg_ros.evaluation.protocol import scoring as protocol
    from deworldsg_ros.evaluation.reports import report, results
    from deworldsg_ros.evaluation.reports import terminal as tables
    from deworldsg_ros.evaluation.runner import evaluate_scan
    from deworldsg_ros.scene.errors import DeWorldSGError

    outcomes: list[ScanOutcome] = []
    failures: dict[str, str] = {}
    for number, task in enumerate(tasks, start=1):
        with console.status(f"scan {number} of {len(tasks)}: {task.scan} …"):
            try:
                outcomes.append(evaluate_scan(task))
            except DeWorldSGError as error:
                failures[task.scan] = str(error)
    for scan, reason in failures.items():
        console.print(f"[red]failed:[/] {scan}: {escape(reason)}", highlight=False, soft_wrap=True)
    if not outcomes:
        raise typer.Exit(EXIT_NOTHING_DONE)
    result = protocol.pool([outcome.result for outcome in outcomes], annotations.vocabulary)
    name = tasks[0].front_end.describe()
    tables.print_protocol(console, result, f"{name} on {annotations.root.resolve().name}")
    pooled = measures.pool(outcome.measures for outcome in outcomes)
    measured = {outcome.scan: outcome.measures for outcome in outcomes}
    tables.print_measures(console, {**measured, "all": pooled})
    over_time = {outcome.scan: outcome.over_time for outcome in outcomes}
    written = results.write_results(
        tasks[0].out, annotations, result, measured, pooled, name, over_time
    )
    _print_files(written, console)
    return {
        **report.protocol_values(result),
        "measures": pooled.numbers(),
        "scans": [report.outcome_values(outcome) for outcome in outcomes],
        "failed": failures,
    }


def _print_files(written: list[Path], console: Console) -> None:
    names = ", ".join(path.name for path in written)
    console.print(f"in {written[0].parent}: {names}", highlight=False, soft_wrap=True)
