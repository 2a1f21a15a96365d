"""Which rows a table has: a method with a configuration and poses each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.pose_sources import PoseChoice
from deworldsg_ros.evaluation.runner import PIPELINE

Kind = Literal["main", "pose", "ablation", "runtime"]
TABLES: tuple[Kind, ...] = ("main", "pose", "ablation", "runtime")
POSE_WORDS = {
    "ground-truth": "true poses",
    "slam": "SLAM's poses",
    "odometry": "odometry",
    "worse": "poses made worse",
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
        poses: where they come from.
    """

    name: str
    title: str
    method: str
    config: Config
    poses: PoseChoice = PoseChoice()


# name, title, method, configuration file
METHODS = (
    ("fross", "FROSS", "fross", "paper"),
    ("kim", "Kim et al.", "kim", "paper"),
    ("paper", "DeWorldSG, paper.yaml", PIPELINE, "paper"),
    ("robust", "DeWorldSG, robust.yaml", PIPELINE, "robust"),
)
# name, title, settings on config/paper.yaml
ABLATION = (
    ("a", "(a) box lifting", ("lifting.regions=boxes", "lifting.refine=false")),
    ("b", "(b) + masks", ("lifting.refine=false",)),
    ("c", "(c) + depth refinement", ()),
    ("d", "(d) + DINOv2", ("relations.world_model=dinov2",)),
    ("e", "(e) + V-JEPA 2", ("relations.world_model=vjepa2",)),
)


def table_rows(table: str, poses: Sequence[PoseChoice], configure: Configure) -> list[Row]:
    """The rows of a table.

    Args:
        table: one of `TABLES`.
        poses: of the pose table: one row a method and choice; of the others the first.
        configure: makes the configuration of a row from the name of a shipped file, settings, and
            the row's name.

    Raises:
        EvaluationError: for a table that does not exist.
        ConfigurationError: for a setting that does not fit.
    """
    if table not in TABLES:
        raise EvaluationError(f"--table {table}: wanted {', '.join(TABLES)}")
    if table == "ablation":
        return [
            Row(name, title, PIPELINE, configure("paper", settings, name), poses[0])
            for name, title, settings in ABLATION
        ]
    if table == "pose":
        return [
            Row(
                f"{name}-{choice.kind}",
                f"{title}, {POSE_WORDS[choice.kind]}",
                method,
                configure(file, (), name),
                choice,
            )
            for choice in poses
            for name, title, method, file in METHODS
            if name != "kim"
        ]
    return [
        Row(name, title, method, configure(file, (), name), poses[0])
        for name, title, method, file in METHODS
    ]
