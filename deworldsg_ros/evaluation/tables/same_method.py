"""Titles of the rows of a table, and the rows of the paper that they may be compared with.

A number of the paper is printed only beside a row of the same method: the same networks and the
same rules.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from deworldsg_ros.checkpoints.probe_card import CARD_FILE, read_card
from deworldsg_ros.checkpoints.required import WORLD_MODELS
from deworldsg_ros.config import Config, RelationsConfig, to_mapping
from deworldsg_ros.evaluation.front_ends import FrontEndChoice
from deworldsg_ros.evaluation.runner import PIPELINE

# Names of backends and world models, as the literature writes them.
NAMES = {
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
    """What a row runs on, e.g. ``RT-DETR, SAM 2, EGTR, V-JEPA 2``."""
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
        paper: content of config/paper.yaml.
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
    if config.world_model not in WORLD_MODELS or not (folder / CARD_FILE).is_file():
        return True
    return read_card(folder).inputs == "clip"


def _method(mapping: dict[str, Any], stage: str) -> dict[str, Any]:
    ignored = ELSEWHERE.get(stage, ())
    return {name: value for name, value in mapping[stage].items() if name not in ignored}
