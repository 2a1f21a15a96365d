"""The checkpoints that a configuration needs, and how to get the missing ones. Needs no torch."""

from __future__ import annotations

from pathlib import Path

from deworldsg_ros.checkpoints.catalogue import CATALOGUE, MODELS_FOLDER, NOT_ON_THE_HUB
from deworldsg_ros.config import PerceptionConfig, RelationsConfig
from deworldsg_ros.scene.errors import ConfigurationError

# How to get the checkpoint of a backend: title, name for `deworldsg models get`.
DETECTORS = {"rtdetr": ("RT-DETR", "rtdetr_r50vd")}
SEGMENTERS = {
    "sam2": ("SAM 2", "sam2.1-hiera-tiny"),
    "sam3": ("SAM 3", "sam3"),
    "sam": ("SAM", "sam-vit-base"),
}
WORLD_MODELS = {
    "vjepa2": ("V-JEPA 2", "vjepa2-vitg-fpc64-384"),
    "dinov2": ("DINOv2", "dinov2-small"),
}


def is_hub_id(name: str) -> bool:
    """Whether the name of a checkpoint has the form of a hub id, ``owner/model``."""
    return not name.startswith(("/", "~", ".")) and name.count("/") == 1


def is_folder(name: str) -> bool:
    """Whether a checkpoint is an existing folder; an empty name is none."""
    return bool(name) and Path(name).expanduser().is_dir()


def require_checkpoints(
    perception: PerceptionConfig | None = None, relations: RelationsConfig | None = None
) -> None:
    """Refuse sections whose checkpoints are not there, with one line for each network.

    A hub id passes: only its loading shows whether it is in the local cache.

    Raises:
        ConfigurationError: names every missing folder, and how to get its content.
    """
    lines = [] if perception is None else missing_perception(perception)
    lines += [] if relations is None else missing_world_model(relations)
    if lines:
        raise ConfigurationError(
            "checkpoints of the configuration are missing (see docs/dev/models.md):\n"
            + "\n".join(lines)
        )


def missing_perception(config: PerceptionConfig) -> list[str]:
    """One line for each network of perception whose checkpoint is missing."""
    lines = []
    if config.detector in DETECTORS and _is_missing(config.detector_path):
        title, name = DETECTORS[config.detector]
        if config.relation_head == "egtr":
            (_, title, advice), _ = NOT_ON_THE_HUB
        else:
            advice = _get(config.detector_path, name)
        lines.append(_line(title, "perception.detector_path", config.detector_path, advice))
    if config.segmenter in SEGMENTERS and _is_missing(config.segmenter_path):
        title, name = SEGMENTERS[config.segmenter]
        advice = _get(config.segmenter_path, name)
        lines.append(_line(title, "perception.segmenter_path", config.segmenter_path, advice))
    return lines


def missing_world_model(config: RelationsConfig) -> list[str]:
    """One line for a world model of clips whose checkpoint or probe is missing."""
    if config.world_model not in WORLD_MODELS:
        return []
    title, name = WORLD_MODELS[config.world_model]
    parts = []
    if _is_missing(config.world_model_path):
        advice = _get(config.world_model_path, name)
        parts.append(_line(title, "relations.world_model_path", config.world_model_path, advice))
    if not is_folder(config.probe_path):
        _, (_, _, advice) = NOT_ON_THE_HUB
        probe = f"probe of {title}"
        parts.append(_line(probe, "relations.probe_path", config.probe_path, advice))
    return ["; ".join(parts)] if parts else []


def _is_missing(name: str) -> bool:
    return not is_folder(name) and not is_hub_id(name)


def _get(name: str, default: str) -> str:
    """The command that gets a model into the folder of this name."""
    folder = Path(name)
    model = folder.name if folder.name in CATALOGUE else default
    into = "" if folder.parent == MODELS_FOLDER or not name else f" --into {folder.parent}"
    return f"run `deworldsg models get {model}{into}`"


def _line(title: str, parameter: str, name: str, advice: str) -> str:
    return f"{title} ({parameter} '{name}'): {advice.format(folder=name or 'FOLDER')}"
