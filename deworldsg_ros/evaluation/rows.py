"""The rows of each table: method, configuration, detections, poses, and the paper's numbers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from deworldsg_ros.checkpoints.cards import PROBE_CARD, read_probe_card
from deworldsg_ros.checkpoints.catalogue import (
    MODELS_FOLDER,
    WORLD_MODELS,
    missing_perception,
    missing_world_model,
)
from deworldsg_ros.config import Config, RelationsConfig, to_mapping
from deworldsg_ros.evaluation.front_ends import Faults, FrontEndChoice, PoseSource
from deworldsg_ros.evaluation.runner import PIPELINE
from deworldsg_ros.poses.trajectory import PoseNoise
from deworldsg_ros.scene.errors import EvaluationError

# --- Titles of the rows of a table, and the rows of the paper that they may be compared with.
#
# A number of the paper is printed only beside a row of the same method: the same networks and the
# same rules.

# Names of backends and world models, as the literature writes them.
NAMES = {
    "pair": "NanoDet and SSDLite",
    "nanodet": "NanoDet",
    "rtdetr": "RT-DETR",
    "rgbd": "RGB-D masks",
    "sam": "SAM",
    "sam2": "SAM 2",
    "sam3": "SAM 3",
    "geometric": "geometric relations",
    "egtr": "EGTR",
    "physics": "embedded world model",
    "vjepa2": "V-JEPA 2",
    "dinov2": "DINOv2",
}
# Options of each stage that do not belong to the method: where checkpoints are, and what runs them.
ELSEWHERE = {
    "perception": ("detector_path", "segmenter_path", "device", "threads", "predicate_set"),
    "relations": ("world_model_path", "probe_path"),
}
STAGES = ("perception", "lifting", "merging", "relations")
# A baseline has its own lifting, merging and relations, and no masks.
DETECTION = ("detector", "relation_head", "score_threshold", "max_relations", "refine_detections")


def networks(method: str, config: Config, front_end: FrontEndChoice) -> str:
    """Models of a row, e.g. ``RT-DETR, SAM 2, EGTR, V-JEPA 2``."""
    perception = config.perception
    used = {
        "backend": [perception.detector, perception.segmenter, perception.relation_head],
        "boxes": ["true boxes", perception.segmenter, perception.relation_head],
        "recorded": ["recorded detections"],
        "ground-truth": ["annotated detections"],
    }[front_end.kind]
    if method != PIPELINE:  # a baseline lifts boxes
        used = [name for name in used if name != perception.segmenter]
    elif config.relations.world_model != "none":
        used.append(config.relations.world_model)
    return ", ".join(NAMES.get(name, name) for name in used)


def runs_the_paper(
    method: str, config: Config, front_end: FrontEndChoice, paper: Config, *settings: str
) -> bool:
    """Whether a row is the method of the paper, or a baseline on the paper's detections.

    Args:
        method: the pipeline, or a baseline.
        config: configuration of the row.
        front_end: source of its detections.
        paper: the paper's configuration for the data set.
        settings: ``section.field=text`` of a step of the ablation, on top of `paper`.
    """
    if front_end.kind != "backend":
        return False
    known, found = to_mapping(paper), to_mapping(config)
    for setting in settings:
        name, _, value = setting.partition("=")
        section, _, field = name.partition(".")
        known[section][field] = value
    if method != PIPELINE:
        return all(known["perception"][name] == found["perception"][name] for name in DETECTION)
    same = all(_method(known, stage) == _method(found, stage) for stage in STAGES)
    return same and _has_the_papers_probe(config.relations)


def _has_the_papers_probe(config: RelationsConfig) -> bool:
    """Whether the probe sees the clip alone; true without a probe, because such a row fails."""
    folder = Path(config.probe_path).expanduser()
    if config.world_model not in WORLD_MODELS or not (folder / PROBE_CARD).is_file():
        return True
    return read_probe_card(folder).inputs == "clip"


def _method(mapping: dict[str, Any], stage: str) -> dict[str, Any]:
    ignored = ELSEWHERE.get(stage, ())
    return {name: value for name, value in mapping[stage].items() if name not in ignored}


# --- Numbers printed in the tables of the paper, percent, for comparison.
#
# Some numbers in the abstract and text of the paper differ: these are from its tables.

COLUMNS = (
    "relationship_recall",
    "object_recall",
    "predicate_recall",
    "object_mean_recall",
    "predicate_mean_recall",
)


@dataclass(frozen=True)
class PrintedRow:
    """A row of a table of the paper.

    Attributes:
        title: title as printed.
        dataset: name of the data set.
        percents: numbers in the order of `COLUMNS`.
    """

    title: str
    dataset: str
    percents: tuple[float, float, float, float, float]

    def numbers(self) -> dict[str, float]:
        """Recalls by name, as fractions."""
        return {
            name: round(value / 100, 6) for name, value in zip(COLUMNS, self.percents, strict=True)
        }


def _rows(
    dataset: str, *rows: tuple[str, tuple[float, float, float, float, float]]
) -> list[PrintedRow]:
    return [PrintedRow(title, dataset, percents) for title, percents in rows]


MAIN_3DSSG = _rows(
    "3DSSG",
    ("IMP", (19.7, 49.5, 20.9, 34.7, 13.8)),
    ("VGfM", (19.6, 50.0, 20.4, 34.8, 11.0)),
    ("3DSSG", (12.9, 37.4, 22.0, 26.2, 14.4)),
    ("SGFN", (22.0, 51.6, 27.5, 37.7, 24.0)),
    ("Kim et al.", (9.1, 59.0, 7.1, 51.0, 8.0)),
    ("MonoSSG", (23.3, 53.8, 28.4, 43.8, 26.6)),
    ("FROSS", (27.9, 62.4, 33.0, 63.8, 18.0)),
    ("DeWorldSG", (50.2, 75.0, 57.3, 70.6, 36.0)),
)
POSE_REPLICA = _rows(
    "ReplicaSSG",
    ("FROSS", (22.3, 26.1, 27.8, 28.8, 20.4)),
    ("DeWorldSG", (38.2, 35.4, 45.3, 38.1, 27.3)),
    ("FROSS, estimated poses", (22.7, 25.8, 27.2, 27.7, 20.1)),
    ("DeWorldSG, estimated poses", (37.4, 33.8, 42.8, 37.6, 26.9)),
)
ABLATION_3DSSG = _rows(
    "3DSSG",
    ("(a) box lifting", (28.5, 63.4, 33.4, 64.3, 20.5)),
    ("(b) + masks", (40.3, 71.7, 46.7, 68.1, 26.3)),
    ("(c) + depth refinement", (47.8, 74.6, 52.9, 70.8, 30.1)),
    ("(d) + DINOv2", (49.5, 74.6, 56.6, 69.5, 33.7)),
    ("(e) + V-JEPA 2", (50.2, 75.0, 57.3, 70.6, 36.0)),
)
# Mean milliseconds per frame on ReplicaSSG, as printed; the parts add up to 108.58, not 108.53.
RUNTIME_DEVICE = "NVIDIA RTX A6000"
RUNTIME_MS = {
    "detection": 4.42,
    "relation_inference": 7.28,
    "masks": 25.26,
    "merging": 2.23,
    "relations": 69.39,
    "total": 108.53,
}


# The test split of ReplicaSSG. Other data sets have its layout, too.
REPLICA_TEST_SCANS = frozenset(
    ("apartment_1", "apartment_2", "office_1", "office_3", "office_4", "room_1", "room_2")
    + ("hotel_0", "frl_apartment_3", "frl_apartment_4", "frl_apartment_5")
)


def printed_rows(table: str, layout: str, scans: Collection[str]) -> list[PrintedRow]:
    """Rows of the paper for a table and data set; none if the paper has none.

    Args:
        table: name of the table.
        layout: layout of the data set.
        scans: the evaluated scans; those of another data set than ReplicaSSG have no printed rows.
    """
    if layout == "replica" and set(scans) == REPLICA_TEST_SCANS:
        rows = {"main": POSE_REPLICA[:2], "predictions": POSE_REPLICA, "pose": POSE_REPLICA}
        return rows.get(table, [])
    if layout == "3rscan":
        rows = {"main": MAIN_3DSSG, "predictions": MAIN_3DSSG, "ablation": ABLATION_3DSSG}
        return rows.get(table, [])
    return []


# --- The rows of each table: method, configuration, detections and poses.

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


# name, title, method, configuration file, row of the paper. The file `rules` is that of
# `paper_file` if its checkpoints are there and detections are not given, else
# config/paper_rules.yaml. The title of the last row is the name of its configuration.
METHODS = (
    ("fross", "FROSS (own code)", "fross", "rules", "FROSS"),
    ("kim", "Kim et al. (own code)", "kim", "rules", "Kim et al."),
    ("paper", "the paper's rules", PIPELINE, "rules", "DeWorldSG"),
    ("default", "", PIPELINE, "default", "DeWorldSG"),
)
# Row (d) has checkpoints of its own: config/paper.yaml has those of row (e).
DINOV2 = (
    "relations.world_model=dinov2",
    f"relations.world_model_path=./{MODELS_FOLDER}/dinov2-giant",
    f"relations.probe_path=./{MODELS_FOLDER}/probe_dinov2_3dssg",
)
# name, title, settings on the file `rules`, row of the paper. Row (a) lifts one depth of a box: the
# paper's "only 2D scene graph lifting", by "a single representative depth value" (Sec. 4.1).
ABLATION = (
    (
        "a",
        "(a) box lifting",
        ("lifting.pixels=box", "relations.world_model=none"),
        "(a) box lifting",
    ),
    ("b", "(b) + masks", ("lifting.pixels=mask", "relations.world_model=none"), "(b) + masks"),
    ("c", "(c) + depth refinement", ("relations.world_model=none",), "(c) + depth refinement"),
    ("d", "(d) + DINOv2", DINOV2, "(d) + DINOv2"),
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


def paper_file(layout: str) -> str:
    """The file with the paper's networks for the names of a layout: of 3DSSG or Visual Genome."""
    return "paper" if layout == "3rscan" else "paper_replica"


@dataclass(frozen=True)
class Configurations:
    """The configurations of the rows.

    Attributes:
        configure: returns the configuration of a row.
        paper_file: the paper's file for the data set, see `paper_file`.
        paper: its content, unchanged by the command line.
        name: name of the configuration of the row `default`.
    """

    configure: Configure
    paper_file: str
    paper: Config
    name: str = "default"

    def rules(self, front_end: FrontEndChoice, table: str) -> str:
        """The file with the paper's rules: with its networks, if they can run."""
        config = self.configure(self.paper_file, (), self.paper_file)
        missing = missing_perception(config.perception)
        if table != "ablation":  # its first rows need no world model
            missing += missing_world_model(config.relations)
        return "paper_rules" if missing or front_end.kind != "backend" else self.paper_file


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
