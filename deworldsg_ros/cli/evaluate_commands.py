"""`deworldsg evaluate score | run | table`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer
from rich.console import Console

from deworldsg_ros.cli.evaluate_options import (
    DataOptions,
    DetectionOptions,
    JsonFile,
    OutFolder,
    RunOptions,
    ScoringOptions,
    TableOptions,
    with_option_groups,
)


@with_option_groups
def score(
    data: DataOptions,
    scoring: ScoringOptions,
    predictions: Annotated[
        Optional[Path],
        typer.Option("--predictions", help="predictions of any method, .json or official .pkl"),
    ] = None,
    graphs: Annotated[
        Optional[Path],
        typer.Option("--graphs", help="folder with SCAN/scene_graph.json of an earlier run"),
    ] = None,
    out: Annotated[
        Optional[Path], typer.Option("--out", help="folder for tables and plots")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Score predictions or scene graphs against annotations with the official protocol."""
    from deworldsg_ros.cli.evaluate import score_files

    score_files(data, scoring, predictions, graphs, out, json_file, Console(markup=False))


@with_option_groups
def run(
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    scoring: ScoringOptions,
    out: OutFolder,
    json_file: JsonFile = None,
) -> None:
    """Run the pipeline on every scan of a data set and score its graphs."""
    from deworldsg_ros.cli.evaluate import run_scans

    run_scans(data, detections, running, scoring, out, json_file, Console(markup=False))


@with_option_groups
def table(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="TABLE", help="main, predictions, hard, pose, ablation, switches or runtime"
        ),
    ],
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    comparing: TableOptions,
    scoring: ScoringOptions,
    out: OutFolder,
    json_file: JsonFile = None,
) -> None:
    """Compare methods or configurations in a table, with the numbers of the paper."""
    from deworldsg_ros.cli.evaluate import make_table

    make_table(
        kind, data, detections, running, comparing, scoring, out, json_file, Console(markup=False)
    )
