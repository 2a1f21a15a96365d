"""Which rows a table has: a method with a configuration and poses each."""

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
POSE_WORDS = {
    "ground-truth": "true poses",
    "slam": "SLAM's poses",
    "odometry": "odometry",
    "perturbed": "perturbed poses",
}
# Configures a row: shipped file, settings of its own.
Configure = Callable[[str, Sequence[str], str], Config]


@dataclass(frozen=True)
class Row:
    """One method of a table.

    Attributes:
        name: of its folder, and in ``--set NAME:section.field=value``.
        title: for people.
        method: the pipeline, or a baseline.
        config: of the pipeline, or what a baseline uses of it.
        front_end: where its detections come from.
        poses: where they come from.
    """

    name: str
    title: str
    method: str
    config: Config
    front_end: FrontEndChoice
    poses: PoseSource = PoseSource()


@dataclass(frozen=True)
class Condition:
    """What makes the input of a row harder; None = as it was asked for.

    Attributes:
        name, title: of the condition; without a title there is nothing harder.
    """

    name: str
    title: str = ""
    faults: Faults | None = None
    poses: PoseSource | None = None
    flip: float | None = None

    def apply(self, front_end: FrontEndChoice) -> FrontEndChoice:
        """The front end under this condition."""
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


# A hand that trembles, or a tracker that does: 2 cm and 1 degree about each axis.
TREMBLING = PoseSource("perturbed", PoseNoise(jitter_m=0.02, jitter_deg=1.0))
LABELS = Condition("label", "persistent wrong labels", Faults(label=0.1))
FALSE = Condition("false", "false boxes", Faults(false=1.0))
TREMBLES = Condition("jitter", "poses ±2 cm, ±1°", poses=TREMBLING)
HARD = (
    Condition("plain"),
    LABELS,
    FALSE,
    Condition("bleed", "bleeding masks", Faults(bleed=0.3)),
    Condition("merge", "merged masks", Faults(merge=0.1)),
    Condition("cut", "cut masks", Faults(cut=0.3)),
    TREMBLES,
    Condition(
        "all", "all of it", Faults(label=0.1, false=1.0, bleed=0.3, merge=0.1, cut=0.3), TREMBLING
    ),
)
# name, title, settings on the default configuration
SWITCHES = (
    ("default", "default", ()),
    ("paper", "the paper's association", ("merging.association=paper",)),
    ("align", "frames aligned with the graph", ("merging.align_poses=true",)),
    ("confirm", "one observation confirms", ("merging.confirm_observations=1",)),
    ("rough", "no depth refinement", ("lifting.pixels=mask",)),
    ("belief", "the paper's edge belief", ("relations.edge_belief=paper",)),
)
SWITCH_CONDITIONS = (
    Condition("flip0", "no flips", flip=0.0),
    Condition("flip10", "flips 0.1", flip=0.1),
    LABELS,
    FALSE,
    TREMBLES,
)


def table_rows(
    table: str, poses: Sequence[PoseSource], front_end: FrontEndChoice, configure: Configure
) -> list[Row]:
    """The rows of a table.

    Args:
        table: one of `TABLES`.
        poses: of the pose table: one row a method and choice; of the others the first.
        front_end: of all rows, but for what a row makes harder.
        configure: makes the configuration of a row from the name of a shipped file, settings, and
            the row's name.

    Raises:
        EvaluationError: for a table that does not exist.
        ConfigurationError: for a setting that does not fit.
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
                f"{title}, {POSE_WORDS[choice.kind]}",
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
        return [
            _harder(
                Row(
                    name, title, PIPELINE, configure("default", settings, name), front_end, poses[0]
                ),
                condition,
            )
            for condition in SWITCH_CONDITIONS
            for name, title, settings in SWITCHES
        ]
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
