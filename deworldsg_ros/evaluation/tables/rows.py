"""The rows of each table: method, configuration, detections and poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends import Faults, FrontEndChoice
from deworldsg_ros.evaluation.pose_sources import PoseSource
from deworldsg_ros.evaluation.runner import PIPELINE
from deworldsg_ros.poses.perturbation import PoseNoise

Kind = Literal["main", "hard", "pose", "ablation", "switches", "runtime"]
TABLES: tuple[Kind, ...] = ("main", "hard", "pose", "ablation", "switches", "runtime")
POSE_TITLES = {
    "ground-truth": "ground-truth poses",
    "slam": "SLAM poses",
    "odometry": "odometry",
    "perturbed": "perturbed poses",
}
# (configuration file, settings of the row, name of the row) -> configuration of the row.
Configure = Callable[[str, Sequence[str], str], Config]


@dataclass(frozen=True)
class Row:
    """One method of a table.

    Attributes:
        name: folder of its results; prefix in ``--set NAME:section.field=value``.
        title: name in the printed table.
        method: the pipeline or a baseline.
        config: configuration of the pipeline; a baseline uses some of it.
        front_end: source of detections.
        poses: source of poses.
    """

    name: str
    title: str
    method: str
    config: Config
    front_end: FrontEndChoice
    poses: PoseSource = PoseSource()


@dataclass(frozen=True)
class Condition:
    """Faults that make the input of a row harder.

    Attributes:
        name, title: suffixes of the row's; an empty title adds none.
        faults, poses, flip: replace those of the command line; None keeps them.
    """

    name: str
    title: str = ""
    faults: Faults | None = None
    poses: PoseSource | None = None
    flip: float | None = None

    def apply(self, front_end: FrontEndChoice) -> FrontEndChoice:
        """The front end with the faults of this condition."""
        faults = front_end.faults if self.faults is None else self.faults
        flip = front_end.flip if self.flip is None else self.flip
        return replace(front_end, faults=faults, flip=flip)


# name, title, method, configuration file
METHODS = (
    ("fross", "FROSS", "fross", "paper"),
    ("kim", "Kim et al.", "kim", "paper"),
    ("paper", "DeWorldSG, paper.yaml", PIPELINE, "paper"),
    ("default", "DeWorldSG, default", PIPELINE, "default"),
)
# name, title, settings on config/paper.yaml
ABLATION = (
    ("a", "(a) box lifting", ("lifting.pixels=box",)),
    ("b", "(b) + masks", ("lifting.pixels=mask",)),
    ("c", "(c) + depth refinement", ()),
    ("d", "(d) + DINOv2", ("relations.world_model=dinov2",)),
    ("e", "(e) + V-JEPA 2", ("relations.world_model=vjepa2",)),
)


# Hand shake, or a tracker without smoothing.
SHAKING = PoseSource("perturbed", PoseNoise(jitter_m=0.02, jitter_deg=1.0))
LABELS = Condition("label", "persistent wrong labels", Faults(label=0.1))
FALSE = Condition("false", "false detections", Faults(false=1.0))
JITTER = Condition("jitter", "pose jitter 2 cm, 1°", poses=SHAKING)
HARD = (
    Condition("plain"),
    LABELS,
    FALSE,
    Condition("bleed", "bleeding masks", Faults(bleed=0.3)),
    Condition("merge", "merged masks", Faults(merge=0.1)),
    Condition("cut", "cut masks", Faults(cut=0.3)),
    JITTER,
    Condition(
        "all",
        "all faults and jitter",
        Faults(label=0.1, false=1.0, bleed=0.3, merge=0.1, cut=0.3),
        SHAKING,
    ),
)
# name, title, settings on top of the default configuration
SWITCHES = (
    ("default", "default", ()),
    ("paper", "association of the paper", ("merging.association=paper",)),
    ("align", "pose alignment", ("merging.align_poses=true",)),
    ("confirmed", "nodes confirmed at once", ("merging.confirm_observations=1",)),
    ("mask", "all mask pixels", ("lifting.pixels=mask",)),
    ("belief", "edge belief of the paper", ("relations.edge_belief=paper",)),
)
SWITCH_CONDITIONS = (
    Condition("flip0", "no flipped labels", flip=0.0),
    Condition("flip10", "10 % flipped labels", flip=0.1),
    LABELS,
    FALSE,
    JITTER,
)


def table_rows(
    table: str, poses: Sequence[PoseSource], front_end: FrontEndChoice, configure: Configure
) -> list[Row]:
    """The rows of a table.

    Args:
        table: one of `TABLES`.
        poses: the pose table has rows for each; the other tables use the first.
        front_end: source of detections, before the faults of a condition.
        configure: returns the configuration of a row.

    Raises:
        EvaluationError: an unknown table.
        ConfigurationError: an invalid setting.
    """
    if table not in TABLES:
        raise EvaluationError(f"table {table}: expected {', '.join(TABLES)}")
    if table == "ablation":
        return [
            Row(name, title, PIPELINE, configure("paper", settings, name), front_end, poses[0])
            for name, title, settings in ABLATION
        ]
    if table == "pose":
        return [
            Row(
                f"{name}-{choice.kind}",
                f"{title}, {POSE_TITLES[choice.kind]}",
                method,
                configure(file, (), name),
                front_end,
                choice,
            )
            for choice in poses
            for name, title, method, file in METHODS
            if name != "kim"
        ]
    if table == "switches":
        rows = [
            Row(name, title, PIPELINE, configure("default", settings, name), front_end, poses[0])
            for name, title, settings in SWITCHES
        ]
        return [_harder(row, condition) for condition in SWITCH_CONDITIONS for row in rows]
    rows = [
        Row(name, title, method, configure(file, (), name), front_end, poses[0])
        for name, title, method, file in METHODS
    ]
    if table == "hard":
        return [_harder(row, condition) for condition in HARD for row in rows if row.name != "kim"]
    return rows


def _harder(row: Row, condition: Condition) -> Row:
    return replace(
        row,
        name=f"{row.name}-{condition.name}",
        title=f"{row.title}, {condition.title}" if condition.title else row.title,
        front_end=condition.apply(row.front_end),
        poses=condition.poses or row.poses,
    )
