"""Cards of checkpoints: how outputs of a detector and of a probe are read; a probe's training."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import msgspec
import numpy as np

from deworldsg_ros.base.files import parse_json, read_regular, write_atomically
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import PREDICATE_SETS

# --- The card of a detector's checkpoint, `deworldsg.json`: how its outputs are read.

DETECTOR_CARD = "deworldsg.json"
# Twenty thousand class names have 400 kB; a training record is smaller.
MAX_CARD_BYTES = 16_000_000
# Mean and standard deviation of ImageNet, RGB, of values in [0, 1].
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Least detection score by kind of score. The paper's 0.7 is for softmax scores; the sigmoid scores
# of RT-DETR are lower.
DEFAULT_SCORE_THRESHOLD = {"softmax": 0.7, "sigmoid": 0.5}

Positive = Annotated[float, msgspec.Meta(gt=0)]


class CheckpointCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a checkpoint is read. Without a card it is read as a public RT-DETR.

    Attributes:
        class_scores: ``softmax`` over the classes (the paper), or independent ``sigmoid``s.
        temperature: of the softmax of the class distribution; below 1 sharpens.
        score_threshold: least score of an object; None = 0.7 for softmax, 0.5 for sigmoid.
        decoder_layers: number of decoder layers to run; 0 = all.
        classes: names of the classes; empty = the `id2label` of config.json.
        predicates: names of the relation head's predicates; empty = no relation head.
        frequency_bias: whether the relation head adds its class-pair statistics.
    """

    class_scores: Literal["softmax", "sigmoid"] = "sigmoid"
    temperature: Positive = 1.0
    score_threshold: Union[Annotated[float, msgspec.Meta(ge=0, le=1)], None] = None
    decoder_layers: Annotated[int, msgspec.Meta(ge=0)] = 0
    classes: tuple[str, ...] = ()
    predicates: tuple[str, ...] = ()
    frequency_bias: bool = False


def read_detector_card(path: Union[Path, None]) -> CheckpointCard:
    """The card in a file; None gives the default card. Raises ConfigurationError."""
    if path is None:
        return CheckpointCard()
    try:
        return parse_json(read_regular(path, MAX_CARD_BYTES), CheckpointCard)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"checkpoint card {path}: {error}") from error


def write_detector_card(path: Path, card: CheckpointCard) -> None:
    """Write a card as indented JSON."""
    write_atomically(path, msgspec.json.format(msgspec.json.encode(card), indent=2) + b"\n")


# --- The card of an exported detector, `model.json` beside `model.onnx`.

ONNX_CARD = "model.json"
Side = Annotated[int, msgspec.Meta(ge=1, le=4096)]
Column = Annotated[int, msgspec.Meta(ge=0, lt=65536)]


class OnnxCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Inputs and outputs of a detector that `deworldsg models export` wrote.

    Attributes:
        classes: names.
        columns: output of each class.
        height, width: of the input, pixels.
        mean, std: per channel, RGB, of values in [0, 1].
        class_scores: ``softmax`` or ``sigmoid``, as `CheckpointCard`.
        no_object: whether the last output is "no object".
        temperature: of the softmax of the class distribution.
        score_threshold: least score of an object.
        schema, version: of the file format.
    """

    classes: tuple[str, ...]
    columns: tuple[Column, ...]
    height: Side
    width: Side
    mean: tuple[float, float, float]
    std: tuple[Positive, Positive, Positive]
    class_scores: Literal["softmax", "sigmoid"]
    no_object: bool
    temperature: Positive
    score_threshold: Annotated[float, msgspec.Meta(ge=0, le=1)]
    schema: Literal["deworldsg/onnx_detector"] = "deworldsg/onnx_detector"
    version: Literal[1] = 1


def read_onnx_card(path: Path) -> OnnxCard:
    """The card of an exported detector; raises ConfigurationError."""
    try:
        card = parse_json(read_regular(path, MAX_CARD_BYTES), OnnxCard)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"exported detector {path}: {error}") from error
    if not card.classes or len(card.classes) != len(card.columns):
        raise ConfigurationError(
            f"exported detector {path}: {len(card.classes)} classes and {len(card.columns)} "
            "columns; expected one column for each class"
        )
    return card


def graph_predicates(config: PerceptionConfig) -> Union[tuple[str, ...], None]:
    """The predicates of the graph, for nodes that do not run perception.

    Returns:
        None if the predicates are those of a checkpoint that is not a local folder.

    Raises:
        ConfigurationError: the checkpoint's card cannot be read, or names no predicates.
    """
    if config.predicate_set != "checkpoint":
        return PREDICATE_SETS[config.predicate_set]
    folder = Path(config.detector_path).expanduser()
    path = folder / DETECTOR_CARD
    if not path.is_file():
        return None
    predicates = read_detector_card(path).predicates
    if not predicates:
        raise ConfigurationError(
            f"perception.predicate_set is 'checkpoint' and {path} names no predicates: it is the "
            "card of a detector without a relation head"
        )
    return predicates


# --- The card of a probe: the backbone and the predicates for which it was trained.
#
# A probe is a folder with `config.json` (a `ProbeCard`) and `model.safetensors`. `deworldsg
# train-probe` also writes `metrics.json` and `confusion.png`.

PROBE_CARD = "config.json"
WEIGHTS_FILE = "model.safetensors"

# The frames of a clip, and the region of them, see `ProbeCard`.
Window = Literal["last_frames", "valid_interval"]
Crop = Literal["last_frame", "clip_union", "each_frame"]

# Inputs for the two boxes of a pair: four corner coordinates each, as fractions of the crop.
BOX_INPUTS = 8


class BackboneIdentity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A frozen backbone and the size of its clips.

    Attributes:
        family: name of the world model, e.g. ``vjepa2``.
        feature_dim: d, length of a clip's feature.
        image_size: edge of the square input, pixels.
        clip_length: T, frames of a clip.
        fingerprint: hash of the weights; empty = not known.
        fit: how a crop becomes the square input: ``stretch`` = the whole crop; ``centre`` = its
            middle only, as for probes that version 0.2 trained.
    """

    family: str
    feature_dim: Annotated[int, msgspec.Meta(ge=1)]
    image_size: Annotated[int, msgspec.Meta(ge=1)]
    clip_length: Annotated[int, msgspec.Meta(ge=1)]
    fingerprint: str = ""
    # Cards without this field are those of version 0.2.
    fit: Literal["stretch", "centre"] = "centre"

    def __str__(self) -> str:
        weights = f", weights {self.fingerprint}" if self.fingerprint else ""
        return (
            f"{self.family} with {self.feature_dim} features of {self.clip_length} frames at "
            f"{self.image_size} px ({self.fit}){weights}"
        )


class ProbeCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Architecture and training of a probe.

    Attributes:
        backbone: the backbone of its input features.
        predicates: R names, in the order of its outputs.
        layout: ``two_layer`` is the paper's, Linear-ReLU-Linear. ``batch_norm`` is the published
            probe's, with batch normalisation before both linear layers and dropout before the
            last.
        inputs: ``clip`` is the paper's: only the clip's feature, so that both directions of a pair
            get the same prediction. ``clip_and_boxes`` adds the boxes of subject and object.
        hidden_dim: width of the hidden layer.
        window: frames of its clips: ``last_frames`` = the last T frames; ``valid_interval`` = those
            of them since both objects were seen without a break.
        crop: region of its clips: ``last_frame`` is the paper's, the union box of the last frame in
            all frames; ``clip_union`` = the union of the boxes of all frames; ``each_frame`` = in
            each frame its own union box, resized to that of the last.
        training: record of the training, plain values.
        schema, version: of the file format.
    """

    backbone: BackboneIdentity
    predicates: tuple[str, ...]
    layout: Literal["two_layer", "batch_norm"] = "two_layer"
    inputs: Literal["clip", "clip_and_boxes"] = "clip"
    hidden_dim: Annotated[int, msgspec.Meta(ge=1)] = 512
    window: Window = "last_frames"
    crop: Crop = "last_frame"
    training: dict[str, Any] = {}
    schema: Literal["deworldsg/probe"] = "deworldsg/probe"
    version: Literal[1] = 1

    @property
    def input_dim(self) -> int:
        """Number of inputs per pair."""
        return self.backbone.feature_dim + (BOX_INPUTS if self.inputs == "clip_and_boxes" else 0)

    @property
    def seen_groups(self) -> frozenset[str]:
        """Scans and rooms that decided the weights, in the training or by stopping it."""
        records = [self.training.get(f"{unit}_by_part", {}) for unit in ("groups", "scans")]
        parts = [record.get(part, ()) for record in records for part in ("train", "validation")]
        return frozenset(str(name) for part in parts for name in part)

    def require_backbone(self, backbone: BackboneIdentity) -> None:
        """Raise ConfigurationError unless the probe was trained on this backbone.

        A probe that does not know the weights of its backbone accepts all weights.
        """
        expected = self.backbone
        if expected.fit != backbone.fit:
            raise ConfigurationError(
                f"the probe was trained with crops brought to the square by '{expected.fit}', and "
                f"this version uses '{backbone.fit}': train the probe again with "
                "`deworldsg train-probe`"
            )
        if not expected.fingerprint or not backbone.fingerprint:
            expected = msgspec.structs.replace(expected, fingerprint=backbone.fingerprint)
        if expected != backbone:
            raise ConfigurationError(
                f"the probe was trained on {self.backbone}, and the backbone is {backbone}: "
                "choose the backbone of the probe, or train a probe for this backbone with "
                "`deworldsg train-probe`"
            )

    def require_predicates(self, predicates: tuple[str, ...]) -> None:
        """Raise ConfigurationError unless the probe has exactly these predicates, in this order."""
        if self.predicates == predicates:
            return
        missing = [name for name in predicates if name not in self.predicates]
        extra = [name for name in self.predicates if name not in predicates]
        parts = [f"lacks {_some(missing)}"] * bool(missing) + [f"has {_some(extra)}"] * bool(extra)
        raise ConfigurationError(
            f"the probe was trained for {len(self.predicates)} predicates and the graph has "
            f"{len(predicates)}: it {' and '.join(parts) or 'has them in another order'}; choose "
            "the predicate set of the probe, or train a probe for this set"
        )


def read_probe_card(folder: Path) -> ProbeCard:
    """Read `config.json` of a probe's folder.

    Raises:
        ConfigurationError: the file is missing, or is not a probe's.
    """
    path = folder / PROBE_CARD
    if not path.is_file():
        raise ConfigurationError(
            f"probe '{folder}' has no {PROBE_CARD}: expected a folder from `deworldsg train-probe` "
            "or `deworldsg import-probe`"
        )
    try:
        card = parse_json(read_regular(path, MAX_CARD_BYTES), ProbeCard)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"probe {path}: {error}") from error
    try:
        card.seen_groups  # noqa: B018  the record of the training has any values
    except (AttributeError, TypeError) as error:
        raise ConfigurationError(
            f"probe {path}: training.groups_by_part or scans_by_part is no record of names by part "
            f"({error})"
        ) from error
    if not card.predicates or len(set(card.predicates)) != len(card.predicates):
        raise ConfigurationError(f"probe {path}: expected predicates, each name once")
    return card


def write_probe_card(folder: Path, card: ProbeCard) -> None:
    """Write `config.json` of a probe's folder."""
    path = folder / PROBE_CARD
    write_atomically(path, msgspec.json.format(msgspec.json.encode(card), indent=2) + b"\n")


def relative_box_pair(
    subject_box_xyxy: Float64, object_box_xyxy: Float64, width: int, height: int
) -> Float32:
    """(8,) float32: corners of both boxes as fractions of a crop's width and height.

    Args:
        subject_box_xyxy: (4,) float64 pixels of the crop.
        object_box_xyxy: likewise.
        width: of the crop, pixels.
        height: of the crop, pixels.
    """
    both = np.concatenate([subject_box_xyxy, object_box_xyxy])
    fractions: Float32 = np.clip(both / np.array([width, height] * 4), 0, 1).astype(np.float32)
    return fractions


def _some(names: list[str]) -> str:
    listed = ", ".join(f"'{name}'" for name in names[:5])
    return listed if len(names) <= 5 else f"{listed} and {len(names) - 5} more"


# --- Options of a training; here without torch, so that the command line can check them first.


@dataclass(frozen=True)
class FitOptions:
    """Options of the fit.

    Attributes:
        epochs: maximum number of passes over the training clips; without validation clips their
            number.
        patience: passes without a lower validation loss after which the fit stops.
        batch_size: clips per step.
        learning_rate, weight_decay: of AdamW.
        seed: of the initial weights and the order of the clips.
        class_weights: of the predicates in the loss. ``none`` is the paper's: the probe learns
            their distribution. ``inverse_frequency`` favours rare ones.
    """

    epochs: int = 200
    patience: int = 20
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-2
    seed: int = 0
    class_weights: Literal["none", "inverse_frequency"] = "none"


@dataclass(frozen=True)
class TrainingOptions:
    """Options of a training.

    Attributes:
        layout, inputs: of the probe, see `ProbeCard`.
        window, crop: frames of the clips of a data set and region of them, see `ProbeCard`.
        held_out_fraction: fraction of the groups that is kept for the final scores. 0 trains on
            all groups: none is held out, and none stops the fit.
        held_out_groups: keep these groups instead.
        batch_size: clips encoded at once.
        fit: options of the fit.
    """

    layout: Literal["two_layer", "batch_norm"] = "two_layer"
    inputs: Literal["clip", "clip_and_boxes"] = "clip"
    window: Window = "last_frames"
    crop: Crop = "last_frame"
    held_out_fraction: float = 0.2
    held_out_groups: tuple[str, ...] = ()
    batch_size: int = 1
    fit: FitOptions = field(default_factory=FitOptions)


@dataclass(frozen=True)
class ClipOrigin:
    """Where clips come from, for the record.

    Attributes:
        source: its name.
        data_split: of a data set; empty = a folder of clips.
    """

    source: str = ""
    data_split: str = ""
