"""Published models, and those that a configuration needs. Needs no torch and no network."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import msgspec

from deworldsg_ros.base.files import parse_json, read_regular
from deworldsg_ros.checkpoints.cards import WEIGHTS_FILE
from deworldsg_ros.config import Config, PerceptionConfig, RelationsConfig
from deworldsg_ros.scene.errors import ConfigurationError

# --- Published models: name, purpose, source and licence. Needs no torch and no network.

# Folder of the models, below the working directory; config/paper.yaml has its paths there.
MODELS_FOLDER = Path("models")
# Folders of the embedded models.
_PACKAGE = Path(__file__).parents[1]
EMBEDDED = (_PACKAGE / "perception" / "weights", _PACKAGE / "relations" / "weights")


@dataclass(frozen=True)
class Published:
    """A model on the Hugging Face hub.

    Attributes:
        name: of the folder, and for `deworldsg models get`.
        repository: id on the hub.
        purpose: options that use it.
        licence: as its hub page states; `models get` shows the one of the download.
        note: classes and accuracy, as its authors publish them; empty = none.
        parameters_m: millions of parameters, as published or counted; 0 = not known here.
        revision: commit that is fetched; empty = not pinned, that of the first download is.
        sha256: of model.safetensors; empty = not known, that of the first download counts.
    """

    name: str
    repository: str
    purpose: str
    licence: str
    note: str = ""
    parameters_m: float = 0
    revision: str = ""
    sha256: str = ""

    def described(self) -> str:
        """Note, size in float32, licence and pins, in words."""
        parts = [self.note]
        if self.parameters_m:
            size = megabytes(4 * self.parameters_m)
            parts.append(f"{self.parameters_m:g} million parameters, about {size}")
        parts.append(f"licence {self.licence}")
        if self.revision:
            parts.append(f"commit {self.revision[:12]}{' and SHA-256' if self.sha256 else ''}")
        return "; ".join(filter(None, parts))


def megabytes(size_mb: float) -> str:
    """A size in words, to three digits."""
    return f"{size_mb / 1e3:.2f} GB" if size_mb >= 999.5 else f"{size_mb:.3g} MB"


def _published(owner: str, purpose: str, licence: str, sizes: dict[str, float]) -> list[Published]:
    """Models of one owner: millions of parameters by name."""
    return [
        Published(name, f"{owner}/{name}", purpose, licence, parameters_m=size)
        for name, size in sizes.items()
    ]


def _detector(
    repository: str, note: str, parameters_m: float, purpose: str = "", **pins: str
) -> Published:
    name, licence = repository.partition("/")[2], "apache-2.0"
    return Published(name, repository, purpose or DETECTOR, licence, note, parameters_m, **pins)


def _dfine(size: str, parameters_m: float, coco: float, after_objects365: float) -> list[Published]:
    """D-FINE of a size: for COCO, for Objects365, and for COCO after Objects365."""
    of = f"ustc-community/dfine-{size}"
    last = f"{of}-obj2coco{'-e25' if size == 'large' else ''}"
    return [
        _detector(f"{of}-coco", f"80 classes, AP {coco} on COCO", parameters_m),
        _detector(f"{of}-obj365", "365 classes", parameters_m),
        _detector(last, f"80 classes, AP {after_objects365} on COCO", parameters_m),
    ]


DETECTOR, SEGMENTER = "perception.detector: transformers", "perception.segmenter"
TEXT_DETECTOR = "perception.detector: open_vocabulary"
WORLD_MODEL = "relations.world_model"
# Millions of parameters, counted in the architectures of transformers at the published sizes; those
# of SAM 2 have the memory of videos, those of V-JEPA 2 the predictor.
SAM2_SIZES: dict[str, float] = {
    "sam2.1-hiera-tiny": 39,
    "sam2.1-hiera-small": 46.1,
    "sam2.1-hiera-base-plus": 80.9,
    "sam2.1-hiera-large": 224.4,
}
SAM_SIZES = {"sam-vit-base": 93.7, "sam-vit-large": 312.3, "sam-vit-huge": 641.1}
VJEPA2_SIZES: dict[str, float] = {
    "vjepa2-vitl-fpc64-256": 326,
    "vjepa2-vith-fpc64-256": 654,
    "vjepa2-vitg-fpc64-256": 1034.6,
    "vjepa2-vitg-fpc64-384": 1034.6,
}
DINOV2_SIZES: dict[str, float] = {
    "dinov2-small": 22.1,
    "dinov2-base": 86.6,
    "dinov2-large": 304.4,
    "dinov2-giant": 1136.5,
}
SIGLIP2_SIZES = {"siglip2-base-patch16-224": 375.2}
# Other numbers are of the README of D-FINE, RT-DETR and RF-DETR, and of Grounding DINO's paper.
# Pins are those on which public code of several others agrees: nothing was fetched for this list.
CATALOGUE = {
    model.name: model
    for model in (
        _detector(
            "ustc-community/dfine-nano-coco",
            "80 classes, AP 42.8 on COCO",
            4,
            revision="066438d3d8f0da137a37b38fdf3368fd4afceced",
            sha256="19e06bdc873da819920a8d373b879721a5b9759d822f8213220bb09abbdab58b",
        ),
        *_dfine("small", 10, 48.5, 50.7),
        *_dfine("medium", 19, 52.3, 55.1),
        *_dfine("large", 31, 54.0, 57.3),
        *_dfine("xlarge", 62, 55.8, 59.3),
        _detector("PekingU/rtdetr_r18vd", "80 classes, AP 46.5 on COCO", 20),
        _detector("PekingU/rtdetr_r50vd", "80 classes, AP 53.1 on COCO", 42),
        _detector("PekingU/rtdetr_v2_r50vd", "80 classes, AP 53.4 on COCO", 42),
        _detector("Roboflow/rf-detr-nano", "80 classes, AP 48.4 on COCO", 30.5),
        _detector("Roboflow/rf-detr-small", "80 classes, AP 53.0 on COCO", 32.1),
        _detector("Roboflow/rf-detr-medium", "80 classes, AP 54.7 on COCO", 33.7),
        _detector("Roboflow/rf-detr-large", "80 classes, AP 56.5 on COCO", 33.9),
        _detector(
            "IDEA-Research/grounding-dino-tiny",
            "free text, AP 48.4 on COCO without its training",
            172,
            TEXT_DETECTOR,
            revision="a2bb814dd30d776dcf7e30523b00659f4f141c71",
            sha256="1a2412ef99bd74bcd3c2a246fa1e48581f8889a1300c9051974741314fc042f3",
        ),
        _detector(
            "google/owlv2-base-patch16-ensemble",
            "free text",
            155,
            TEXT_DETECTOR,
            revision="cfd3195ba4ea9592eec887ded089f4c08eff231d",
        ),
        _detector("omlab/omdet-turbo-swin-tiny-hf", "free text; needs timm", 0, TEXT_DETECTOR),
        *_published("facebook", f"{SEGMENTER}: sam2", "apache-2.0", SAM2_SIZES),
        *_published("facebook", f"{SEGMENTER}: sam", "apache-2.0", SAM_SIZES),
        *_published(
            *("facebook", f"{SEGMENTER}: sam3, or {TEXT_DETECTOR}"),
            *("SAM licence; accept it there", {"sam3": 0.0}),
        ),
        *_published("facebook", f"{WORLD_MODEL}: vjepa2", "mit", VJEPA2_SIZES),
        *_published("facebook", f"{WORLD_MODEL}: dinov2", "apache-2.0", DINOV2_SIZES),
        *_published("google", "perception.embedder", "apache-2.0", SIGLIP2_SIZES),
    )
}
# Names that stand for several models. The embedded models are part of the package.
GROUPS: dict[str, tuple[str, ...]] = {
    # DINOv2 is for row (d) of the ablation, in the size of that V-JEPA 2.
    "paper": ("sam2.1-hiera-tiny", "vjepa2-vitg-fpc64-384", "dinov2-giant"),
    "embedded": (),
    # Names 365 things of households, and runs on a CPU.
    "detector": ("dfine-small-obj365",),
    # Apache licence, no further package, and a published accuracy.
    "open-vocabulary": ("grounding-dino-tiny",),
}
TRAIN_DINOV2_PROBE = (
    "run `deworldsg train-probe CLIPS --world-model dinov2 --model MODEL --out {folder}`"
)
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
    ("probe_dinov2_3dssg", "probe of DINOv2 for row (d) of the ablation", TRAIN_DINOV2_PROBE),
)


# The file that names the shards of weights that are not in one file.
INDEX_FILE = "model.safetensors.index.json"
# A config.json of Objects365 has 30 kB, an index of 40 thousand parameters 4 MB.
MAX_CONFIG_BYTES = 8_000_000


def is_complete(folder: Path) -> bool:
    """Whether a folder has a configuration and all of its weights, in one file or in shards."""
    names = {WEIGHTS_FILE}
    if not (folder / WEIGHTS_FILE).is_file():
        try:
            index = parse_json(read_regular(folder / INDEX_FILE, MAX_CONFIG_BYTES), _Index)
        except (OSError, ValueError):
            return False
        names = set(index.weight_map.values())
    return bool(names) and all((folder / name).is_file() for name in ("config.json", *names))


class _Index(msgspec.Struct):
    """The index of weights in shards: the file of each parameter."""

    weight_map: dict[str, str]


# --- The checkpoints that a configuration needs, and how to get the missing ones. Needs no torch.

# An exported detector, in a folder with a description.
ONNX_FILE = "model.onnx"
# How to get the checkpoint of a backend: title, name for `deworldsg models get`.
DETECTORS = {
    "transformers": ("detector", "dfine-small-obj365"),
    "rtdetr": ("RT-DETR", "rtdetr_r50vd"),
    "open_vocabulary": ("detector of free text", "grounding-dino-tiny"),
    "onnx": ("exported detector", "dfine-small-obj365"),
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


# Model types of checkpoints that find what words name.
TEXT_TYPES = ("owlv2", "grounding-dino", "mm-grounding-dino", "omdet-turbo", "sam3", "sam3_video")


def detector_of(folder: Path) -> str:
    """The name of the backend that runs the detector of a folder.

    A folder without a readable configuration, or an id of the hub, counts as a transformers one:
    its loader tells the fault.
    """
    if (folder / ONNX_FILE).is_file():
        return "onnx"
    try:
        content = json.loads(read_regular(folder / "config.json", MAX_CONFIG_BYTES))
        is_text = content["model_type"] in TEXT_TYPES
    except (OSError, ValueError, KeyError, TypeError):
        is_text = False
    return "open_vocabulary" if is_text else "transformers"


def unused_detector(config: PerceptionConfig, into: Path = MODELS_FOLDER) -> tuple[str, str]:
    """Folder of a stronger detector and the options that use it; empty if there is none.

    Args:
        config: of a run; a detector is unused if this names the embedded one.
        into: folder of the models.
    """
    if config.detector != PerceptionConfig().detector or not into.is_dir():
        return "", ""
    for folder in sorted(into.iterdir()):
        backend = detector_of(folder)
        known = folder.name in CATALOGUE and CATALOGUE[folder.name].purpose == DETECTOR
        if backend == "onnx" or (known and is_complete(folder)):
            return str(folder), (
                f"--set perception.detector={backend} --set perception.detector_path={folder}"
            )
    return "", ""


def checkpoints_of(config: Config) -> list[str]:
    """Folders and hub ids of all checkpoints of a configuration, first those in the package."""
    perception, relations = config.perception, config.relations
    names = (
        *(perception.detector_path, perception.segmenter_path, perception.embedder),
        *(relations.world_model_path, relations.probe_path),
    )
    return [*map(str, EMBEDDED), *filter(None, names)]


# Files that torch wrote. Only `import-fross` and `import-probe` read some.
ORIGINAL = (".pt", ".pth", ".ckpt")


def is_hub_id(name: str) -> bool:
    """Whether the name of a checkpoint has the form of a hub id, ``owner/model``."""
    is_path = name.startswith(("/", "~", ".")) or name.endswith(ORIGINAL)
    return not is_path and name.count("/") == 1


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
        if config.detector == "onnx":
            advice = "run `deworldsg models export NAME {folder}`"
        elif config.relation_head == "egtr":
            (_, title, advice), *_ = NOT_ON_THE_HUB
        else:
            advice = _get(config.detector_path, name)
        lines.append(_line(title, "perception.detector_path", config.detector_path, advice))
    if config.segmenter in SEGMENTERS and _is_missing(config.segmenter_path):
        title, name = SEGMENTERS[config.segmenter]
        advice = _get(config.segmenter_path, name)
        lines.append(_line(title, "perception.segmenter_path", config.segmenter_path, advice))
    if config.embedder and _is_missing(config.embedder):
        advice = _get(config.embedder, "siglip2-base-patch16-224")
        lines.append(_line("SigLIP or CLIP", "perception.embedder", config.embedder, advice))
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
        advice = NOT_ON_THE_HUB[1][2]
        if config.world_model == "dinov2":
            advice = TRAIN_DINOV2_PROBE
        probe = f"probe of {title}"
        parts.append(_line(probe, "relations.probe_path", config.probe_path, advice))
    return ["; ".join(parts)] if parts else []


def _is_missing(name: str) -> bool:
    return _is_original(name) or (not is_folder(name) and not is_hub_id(name))


def _is_original(name: str) -> bool:
    """Whether a checkpoint is a file of its authors' own layout, or a folder with nothing else."""
    path = Path(name).expanduser()
    if not is_folder(name):
        return name.endswith(ORIGINAL) and path.is_file()
    files = [file.name for file in path.glob("*")]
    return "config.json" not in files and any(file.endswith(ORIGINAL) for file in files)


def _get(name: str, default: str) -> str:
    """The command that gets a model into the folder of this name."""
    folder = Path(name)
    same = folder.stem.replace("_", "-") if name.endswith(ORIGINAL) else folder.name
    model = same if same in CATALOGUE else default
    into = "" if folder.parent == MODELS_FOLDER or not name else f" --into {folder.parent}"
    run = f"run `deworldsg models get {model}{into}`"
    if not _is_original(name):
        return run
    return (
        f"this is its authors' own layout, which is not read; {run}, which brings the layout of "
        f"transformers, and set the option to {folder.parent / model}"
    )


def _line(title: str, parameter: str, name: str, advice: str) -> str:
    return f"{title} ({parameter} '{name}'): {advice.format(folder=name or 'FOLDER')}"
