"""`deworldsg evaluate`: predictions, or what the pipeline makes of a data set, in numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.console import Console


def evaluate(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="root folder, with data/ and the annotations")
    ],
    layout: Annotated[str, typer.Option("--layout", help="replica or 3rscan")],
    predictions: Annotated[
        Optional[Path],
        typer.Option("--predictions", help="predictions of a method, .json or official .pkl"),
    ] = None,
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
    json_file: Annotated[
        Optional[Path], typer.Option("--json", help="write every number by name to this file")
    ] = None,
) -> None:
    """Measure scene graphs against annotations with the official protocol."""
    from deworldsg_ros.datasets.annotations import Annotations
    from deworldsg_ros.evaluation import report, tables
    from deworldsg_ros.evaluation.errors import EvaluationError
    from deworldsg_ros.evaluation.predictions import read_predictions
    from deworldsg_ros.evaluation.protocol import ProtocolOptions, evaluate_predictions

    console = Console()
    options = ProtocolOptions(split, skip_no_rel_objects, overlap_threshold, aligned_ply)
    annotations = Annotations(dataset, layout)
    if predictions is None:
        raise EvaluationError("nothing to evaluate: give --predictions FILE")
    result = evaluate_predictions(annotations, read_predictions(predictions), options)
    title = f"{predictions.name} on {dataset.resolve().name}, {split}"
    tables.print_protocol(console, result, title)
    values: dict[str, Any] = {
        "dataset": dataset.resolve().name,
        "layout": layout,
        "split": split,
        "skip_no_rel_objects": skip_no_rel_objects,
        "overlap_threshold_m": overlap_threshold,
        **report.protocol_values(result),
    }
    if json_file is not None:
        report.write_json(json_file, values)
        console.print(f"numbers in {json_file}", highlight=False, soft_wrap=True)
