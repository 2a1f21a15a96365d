"""The rows of each table: method, configuration, detections and poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from deworldsg_ros.checkpoints.required import missing_perception, missing_world_model
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends import Faults, FrontEndChoice
from deworldsg_ros.evaluation.pose_sources import PoseSource
from deworldsg_ros.evaluation.runner import PIPELINE
from deworldsg_ros.evaluation.tables.same_method import networks, runs_the_paper
from deworldsg_ros.poses.perturbation import PoseNoise

Kind = Literal["main", "predictions", "hard", "pose", "ablation", "switches", "runtime"]
TABLES: tuple[Kind, ...] = (
    *("main", "predictions", "hard", "pose", "ablation", "switches", "runtime"),
)
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
        title: name in the table: the rules, and what they ran on.
        method: the pipeline or a baseline.
        config: configuration of the pipeline; a baseline uses some of it.
        front_end: source of detections.
        poses: source of poses.
        printed: title of the row of the paper with the same method; empty = none.
    """

    name: str
    title: str
    method: str
    config: Config
    front_end: FrontEndChoice
    poses: PoseSource = PoseSource()
    printed: str = ""


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


# name, title, method, configuration file, row of the paper. The file `rules` is config/paper.yaml
# if its checkpoints are there and detections are not given, else config/paper_rules.yaml. The
# title of the last row is the name of its configuration.
METHODS = (
    ("fross", "FROSS (own code)", "fross", "rules", "FROSS"),
    ("kim", "Kim et al. (own code)", "kim", "rules", "Kim et al."),
    ("paper", "the paper's rules", PIPELINE, "rules", "DeWorldSG"),
    ("default", "", PIPELINE, "default", "DeWorldSG"),
)
# name, title, settings on the file `rules`, row of the paper. Row (a) has none: the paper lifts one
# depth value of a box, and this one lifts every pixel.
ABLATION = (
    ("a", "(a) box lifting", ("lifting.pixels=box", "relations.world_model=none"), ""),
    ("b", "(b) + masks", ("lifting.pixels=mask", "relations.world_model=none"), "(b) + masks"),
    ("c", "(c) + depth refinement", ("relations.world_model=none",), "(c) + depth refinement"),
    ("d", "(d) + DINOv2", ("relations.world_model=dinov2",), "(d) + DINOv2"),
    ("e", "(e) + V-JEPA 2", ("relations.world_model=vjepa2",), "(e) + V-JEPA 2"),
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
    ("hidden", "all nodes published", ("output.min_existence=0",)),
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


@dataclass(frozen=True)
class Configurations:
    """The configurations of the rows.

    Attributes:
        configure: returns the configuration of a row.
        paper: content of config/paper.yaml, unchanged by the command line.
        name: name of the configuration of the row `default`.
    """

    configure: Configure
    paper: Config
    name: str = "default"

    def rules(self, front_end: FrontEndChoice, table: str) -> str:
        """The file with the paper's rules: with its networks, if they can run."""
        config = self.configure("paper", (), "paper")
        missing = missing_perception(config.perception)
        if table != "ablation":  # its first rows need no world model
            missing += missing_world_model(config.relations)
        return "paper_rules" if missing or front_end.kind != "backend" else "paper"


def table_rows(
    table: str, poses: Sequence[PoseSource], front_end: FrontEndChoice, files: Configurations
) -> list[Row]:
    """The rows of a table.

    Args:
        table: one of `TABLES`.
        poses: the pose table has rows for each; the other tables use the first.
        front_end: source of detections, before the faults of a condition.
        files: the configurations.

    Raises:
        EvaluationError: an unknown table.
        ConfigurationError: an invalid setting.
    """
    if table not in TABLES:
        raise EvaluationError(f"table {table}: expected {', '.join(TABLES)}")
    if table == "predictions":  # its rows are the prediction files
        return []
    if table == "ablation":
        return _ablation(poses[0], front_end, files)
    if table == "switches":
        rows = []
        for name, title, settings in SWITCHES:
            config = files.configure("default", settings, name)
            rows.append(Row(name, title, PIPELINE, config, front_end, poses[0]))
        return [_harder(row, condition) for condition in SWITCH_CONDITIONS for row in rows]
    rows = _methods(table, poses[0], front_end, files)
    if table == "hard":
        return [_harder(row, condition) for condition in HARD for row in rows if row.name != "kim"]
    if table == "pose":
        return [_posed(row, choice) for choice in poses for row in rows if row.name != "kim"]
    return rows


def _methods(
    table: str, poses: PoseSource, front_end: FrontEndChoice, files: Configurations
) -> list[Row]:
    rules = files.rules(front_end, table)
    rows = []
    for name, title, method, file, printed in METHODS:
        if name == "paper":
            name = rules
        config = files.configure(rules if file == "rules" else file, (), name)
        same = runs_the_paper(method, config, front_end, files.paper)
        if same and method == PIPELINE:
            title = "DeWorldSG" if file == "rules" else f"DeWorldSG, {files.name}"
        title = f"{title or files.name}: {networks(method, config, front_end)}"
        rows.append(Row(name, title, method, config, front_end, poses, printed if same else ""))
    return rows


def _ablation(poses: PoseSource, front_end: FrontEndChoice, files: Configurations) -> list[Row]:
    rules = files.rules(front_end, "ablation")
    rows = []
    for name, title, settings, printed in ABLATION:
        config = files.configure(rules, settings, name)
        same = runs_the_paper(PIPELINE, config, front_end, files.paper, *settings)
        title = f"{title}: {networks(PIPELINE, config, front_end)}"
        rows.append(Row(name, title, PIPELINE, config, front_end, poses, printed if same else ""))
    return rows


def _posed(row: Row, choice: PoseSource) -> Row:
    """The row with poses of a kind; the paper has true poses and those of a SLAM system."""
    suffix = {"ground-truth": "", "slam": ", estimated poses"}.get(choice.kind)
    return replace(
        row,
        name=f"{row.name}-{choice.kind}",
        title=f"{row.title}, {POSE_TITLES[choice.kind]}",
        poses=choice,
        printed="" if suffix is None or not row.printed else row.printed + suffix,
    )


def _harder(row: Row, condition: Condition) -> Row:
    return replace(
        row,
        name=f"{row.name}-{condition.name}",
        title=f"{row.title}, {condition.title}" if condition.title else row.title,
        front_end=condition.apply(row.front_end),
        poses=condition.poses or row.poses,
        printed="",
    )
