"""`deworldsg evaluate score`: predictions or saved graphs against annotations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from deworldsg_ros.cli.evaluate.options import DataOptions, ScoringOptions
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.protocol.scoring import ProtocolOptions
from deworldsg_ros.evaluation.recorded_room import open_annotations
from deworldsg_ros.evaluation.reports.evaluation import (
    Evaluation,
    evaluate_prediction_file,
    evaluate_saved_graphs,
)
from deworldsg_ros.evaluation.reports.folder import write_folder
from deworldsg_ros.evaluation.reports.json_values import evaluation_values, write_json
from deworldsg_ros.evaluation.reports.terminal import print_evaluation


def score_files(
    data: DataOptions,
    scoring: ScoringOptions,
    predictions: Path | None,
    graphs: Path | None,
    out: Path | None,
    json_file: Path | None,
    console: Console,
) -> None:
    """Score one of predictions and graphs; raises DeWorldSGError."""
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
