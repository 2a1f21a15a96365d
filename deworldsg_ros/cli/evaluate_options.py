"""Options of `deworldsg evaluate`, in groups that its commands share."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Optional, get_type_hints

import typer


@dataclass(frozen=True)
class DataOptions:
    """The annotated data."""

    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET",
            help="root folder with data/ and the annotations, or a recording with ground truth",
        ),
    ]
    layout: Annotated[str, typer.Option("--layout", help="replica, 3rscan or recording")]
    split: Annotated[str, typer.Option("--split", help="train, validation or test")] = "test"
    scans: Annotated[
        Optional[list[str]],
        typer.Option("--scan", help="evaluate this scan only, not the split; may be repeated"),
    ] = None


@dataclass(frozen=True)
class LossOptions(DataOptions):
    """Annotated data, or a recording and boxes."""

    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET",
            help="root folder with data/ and the annotations, a recording with ground truth, or, "
            "with --boxes, any recording",
        ),
    ]
    layout: Annotated[
        str, typer.Option("--layout", help="replica, 3rscan or recording; not with --boxes")
    ] = ""
    boxes: Annotated[
        Optional[Path],
        typer.Option("--boxes", metavar="FILE", help="JSON file of objects: names and boxes"),
    ] = None


@dataclass(frozen=True)
class ScoringOptions:
    """Options of the official protocol."""

    skip_no_rel_objects: Annotated[
        bool, typer.Option("--skip-no-rel-objects", help="count only objects that have relations")
    ] = False
    overlap_threshold: Annotated[
        float,
        typer.Option(
            "--overlap-threshold",
            min=0,
            help="maximum distance from a predicted point to its annotated point, metres",
        ),
    ] = 0.1
    aligned_ply: Annotated[
        bool, typer.Option("--aligned-ply", help="3rscan: use the aligned point cloud")
    ] = False


@dataclass(frozen=True)
class DetectionOptions:
    """The source of detections, and the faults injected into them."""

    front_end: Annotated[
        str,
        typer.Option(
            "--front-end",
            help="source of detections: backend, boxes (true boxes, own masks and relations), "
            "recorded or ground-truth",
        ),
    ] = "backend"
    flip: Annotated[
        float,
        typer.Option("--flip", help="fraction of labels that are wrong; recorded: 0 or 0.1"),
    ] = 0.0
    miss: Annotated[
        float,
        typer.Option("--miss", help="not backend: fraction of detections to drop"),
    ] = 0.0
    jitter_px: Annotated[
        Optional[float],
        typer.Option(
            "--jitter",
            help="not backend: standard deviation of each box edge, pixels; default: 2 of boxes, "
            "else 0",
        ),
    ] = None
    faults: Annotated[
        str,
        typer.Option(
            "--faults",
            metavar="NAME=NUMBER,…",
            help="not backend: faults that persist over frames, e.g. label=0.1,false=1",
        ),
    ] = ""
    seed: Annotated[int, typer.Option("--seed", min=0, help="random seed of all faults")] = 0


@dataclass(frozen=True)
class RunOptions:
    """How the pipeline runs over each scan."""

    config: Annotated[
        Optional[Path],
        typer.Option("--config", help="ROS parameter file; default: the built-in defaults"),
    ] = None
    settings: Annotated[
        Optional[list[str]],
        typer.Option(
            "--set", metavar="SECTION.FIELD=VALUE", help="set one parameter; may be repeated"
        ),
    ] = None
    poses: Annotated[
        Optional[list[str]],
        typer.Option(
            "--poses",
            help="ground-truth, slam, odometry or perturbed; the pose table takes several",
        ),
    ] = None
    pose_noise: Annotated[
        str,
        typer.Option(
            "--pose-noise",
            metavar="NAME=NUMBER,…",
            help="noise of --poses perturbed, e.g. jitter_m=0.01",
        ),
    ] = ""
    depth_source: Annotated[
        str, typer.Option("--depth-source", help="3rscan: rendered or sensor; auto = rendered")
    ] = "auto"
    every: Annotated[int, typer.Option("--every", min=1, help="process every N-th frame")] = 1
    max_frames: Annotated[
        int, typer.Option("--max-frames", min=0, help="stop after this many frames; 0 = no limit")
    ] = 0
    checkpoints: Annotated[
        int,
        typer.Option(
            "--checkpoints", min=0, help="number of measurements during a scan, for the plot"
        ),
    ] = 8


@dataclass(frozen=True)
class TableOptions:
    """Options of tables only."""

    predictions: Annotated[
        Optional[list[str]],
        typer.Option(
            "--predictions",
            metavar="NAME=FILE",
            help="add a row with the predictions of a method; may be repeated",
        ),
    ] = None
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="number of processes; 0 = one per core")
    ] = 0
    scheduler: Annotated[str, typer.Option("--scheduler", help="address of a dask scheduler")] = ""
    fresh: Annotated[
        bool, typer.Option("--fresh", help="ignore the results of earlier runs in the folder")
    ] = False


OutFolder = Annotated[
    Path, typer.Option("--out", help="folder for graphs, tables and plots; created if missing")
]
JsonFile = Annotated[
    Optional[Path], typer.Option("--json", help="write every number by name to this file")
]


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """The command as typer reads it: the fields of a dataclass parameter become options."""
    hints = get_type_hints(command, include_extras=True)
    del hints["return"]
    groups: dict[str, Any] = {n: kind for n, kind in hints.items() if is_dataclass(kind)}
    parameters = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name in groups:
            parameters += _parameters(groups[parameter.name])
        else:
            parameters.append(_parameter(parameter.name, parameter.default, hints[parameter.name]))

    @functools.wraps(command)
    def run(**values: Any) -> None:
        built = {
            name: kind(**{field.name: values.pop(field.name) for field in fields(kind)})
            for name, kind in groups.items()
        }
        command(**built, **values)

    # typer reads these two.
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _parameters(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        _parameter(
            field.name,
            inspect.Parameter.empty if field.default is MISSING else field.default,
            hints[field.name],
        )
        for field in fields(group)
    ]


def _parameter(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=default, annotation=annotation)
