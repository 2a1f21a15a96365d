"""Published models: name, purpose, source and licence. Needs no torch and no network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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
    """

    name: str
    repository: str
    purpose: str
    licence: str


def _published(owner: str, purpose: str, licence: str, *names: str) -> list[Published]:
    return [Published(name, f"{owner}/{name}", purpose, licence) for name in names]


DETECTOR, SEGMENTER = "perception.detector: rtdetr", "perception.segmenter"
WORLD_MODEL = "relations.world_model"
CATALOGUE = {
    model.name: model
    for model in (
        *_published("PekingU", DETECTOR, "apache-2.0", "rtdetr_r18vd", "rtdetr_r50vd"),
        *_published("PekingU", DETECTOR, "apache-2.0", "rtdetr_v2_r50vd"),
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
