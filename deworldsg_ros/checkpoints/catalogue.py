"""Published models, and those that a configuration needs. Needs no torch and no network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from deworldsg_ros.config import PerceptionConfig, RelationsConfig
from deworldsg_ros.scene.errors import ConfigurationError

# --- Published models: name, purpose, source and licence. Needs no torch and no network.

# Folder of the models, below the working directory; config/paper.yaml has its paths there.
MODELS_FOLDER = Path("models")


@dataclass(frozen=True)
class Published:
    """A model on the Hugging Face hub.

    Attributes:
        name: of the folder, and for `deworldsg models get`.
        repository: id on the hub.
        purpose: options that use it.
            licence: as its hub page states; `models get` shows the one of the download.
        note: classes and accuracy, as its authors publish them; empty = none.
    """

    name: str
    repository: str
    purpose: str
    licence: str
    note: str = ""


def _published(owner: str, purpose: str, licence: str, *names: str) -> list[Published]:
    return [Published(name, f"{owner}/{name}", purpose, licence) for name in names]


def _dfine(size: str, ap: float) -> list[Published]:
    """D-FINE of a size, for the 80 classes of COCO and the 365 of Objects365."""
    found = [
        Published(f"dfine-{size}-coco", f"ustc-community/dfine-{size}-coco", DETECTOR, "apache-2.0",
                  f"80 classes, AP {ap} on COCO"),
        Published(f"dfine-{size}-obj365", f"ustc-community/dfine-{size}-obj365", DETECTOR,
                  "apache-2.0", "365 classes"),
    ]  # fmt: skip
    return found[: 1 if size == "nano" else 2]


DETECTOR, SEGMENTER = "perception.detector: transformers", "perception.segmenter"
WORLD_MODEL = "relations.world_model"
CATALOGUE = {
    model.name: model
    for model in (
        *_published("PekingU", DETECTOR, "apache-2.0", "rtdetr_r18vd", "rtdetr_r50vd"),
        *_published("PekingU", DETECTOR, "apache-2.0", "rtdetr_v2_r50vd"),
        *_dfine("nano", 42.8),
        *_dfine("small", 48.5),
        *_dfine("medium", 52.3),
        *_dfine("large", 54.0),
        *_dfine("xlarge", 55.8),
        *_published(
            *("facebook", f"{SEGMENTER}: sam2", "apache-2.0"),
            *(f"sam2.1-hiera-{size}" for size in ("tiny", "small", "base-plus", "large")),
        ),
        *_published("facebook", f"{SEGMENTER}: sam", "apache-2.0", "sam-vit-base", "sam-vit-large"),
        *_published("facebook", f"{SEGMENTER}: sam3", "SAM licence; accept it there", "sam3"),
        *_published(
            *("facebook", f"{WORLD_MODEL}: vjepa2", "mit"),
            *("vjepa2-vitl-fpc64-256", "vjepa2-vitg-fpc64-256", "vjepa2-vitg-fpc64-384"),
        ),
        *_published(
            *("facebook", f"{WORLD_MODEL}: dinov2", "apache-2.0"),
            *("dinov2-small", "dinov2-base", "dinov2-large"),
        ),
    )
}
# Names that stand for several models. The embedded models are part of the package.
GROUPS: dict[str, tuple[str, ...]] = {
    "paper": ("sam2.1-hiera-tiny", "vjepa2-vitg-fpc64-384"),
    "embedded": (),
    # Names 365 things of households, and runs on a CPU.
    "detector": ("dfine-small-obj365",),
}
# What the paper needs and the hub does not have: folder, content, how to get it.
NOT_ON_THE_HUB = (
    (
        "fross_3dssg",
        "RT-DETR and EGTR of FROSS",
        "download 3RScan20.zip (link in FROSS's README), unpack it, and run `deworldsg models "
        "import-fross WEIGHTS/version_0 {folder}`",
    ),
    (
        "probe_3dssg",
        "probe of V-JEPA 2",
        "run `deworldsg import-probe vjepa_probe_mlp.pt {folder} --predicates 3dssg` for the "
        "published probe, or `deworldsg train-probe` for one of your own",
    ),
)


def is_complete(folder: Path) -> bool:
    """Whether a folder has a configuration and weights, and no part of a download."""
    weights = list(folder.glob("*.safetensors")) if folder.is_dir() else []
    return bool(weights) and (folder / "config.json").is_file()


# --- The checkpoints that a configuration needs, and how to get the missing ones. Needs no torch.

# How to get the checkpoint of a backend: title, name for `deworldsg models get`.
DETECTORS = {
    "transformers": ("detector", "dfine-small-obj365"),
    "rtdetr": ("RT-DETR", "rtdetr_r50vd"),
}
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
