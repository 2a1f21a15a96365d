"""The checkpoints that a configuration needs, and how to get the missing ones. Needs no torch."""

from __future__ import annotations

from pathlib import Path

from deworldsg_ros.config import PerceptionConfig, RelationsConfig
from deworldsg_ros.scene.errors import ConfigurationError

FROSS = (
    "download 3RScan20.zip or VG.zip (links in FROSS's README), unpack it, and run `deworldsg "
    "models import-fross WEIGHTS/version_0 {folder}`"
)
PROBE = (
    "run `deworldsg import-probe vjepa_probe_mlp.pt {folder} --predicates SET` for the published "
    "probe, or train one with `deworldsg train-probe`"
)
# How to get the checkpoint of a backend into a folder.
DETECTORS = {
    "rtdetr": ("RT-DETR", "run `hf download PekingU/rtdetr_r50vd --local-dir {folder}`"),
}
SEGMENTERS = {
    "sam2": ("SAM 2", "run `hf download facebook/sam2.1-hiera-tiny --local-dir {folder}`"),
    "sam": ("SAM", "run `hf download facebook/sam-vit-base --local-dir {folder}`"),
}
WORLD_MODELS = {
    "vjepa2": ("V-JEPA 2", "run `hf download facebook/vjepa2-vitg-fpc64-384 --local-dir {folder}`"),
    "dinov2": ("DINOv2", "run `hf download facebook/dinov2-small --local-dir {folder}`"),
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
            "checkpoints of the configuration are missing (see docs/models.md):\n"
            + "\n".join(lines)
        )


def missing_perception(config: PerceptionConfig) -> list[str]:
    """One line for each network of perception whose checkpoint is missing."""
    lines = []
    if config.detector in DETECTORS and _is_missing(config.detector_path):
        title, advice = DETECTORS[config.detector]
        if config.relation_head == "egtr":
            title, advice = f"{title} and EGTR", FROSS
        lines.append(_line(title, "perception.detector_path", config.detector_path, advice))
    if config.segmenter in SEGMENTERS and _is_missing(config.segmenter_path):
        title, advice = SEGMENTERS[config.segmenter]
        lines.append(_line(title, "perception.segmenter_path", config.segmenter_path, advice))
    return lines


def missing_world_model(config: RelationsConfig) -> list[str]:
    """One line for a world model of clips whose checkpoint or probe is missing."""
    if config.world_model not in WORLD_MODELS:
        return []
    title, advice = WORLD_MODELS[config.world_model]
    parts = []
    if _is_missing(config.world_model_path):
        name = "relations.world_model_path"
        parts.append(_line(title, name, config.world_model_path, advice))
    if not is_folder(config.probe_path):
        parts.append(_line(f"probe of {title}", "relations.probe_path", config.probe_path, PROBE))
    return ["; ".join(parts)] if parts else []


def _is_missing(name: str) -> bool:
    return not is_folder(name) and not is_hub_id(name)


def _line(title: str, parameter: str, name: str, advice: str) -> str:
    return f"{title} ({parameter} '{name}'): {advice.format(folder=name or 'FOLDER')}"
