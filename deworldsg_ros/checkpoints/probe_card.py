"""The card of a probe: the backbone and the predicates for which it was trained.

A probe is a folder with `config.json` (a `ProbeCard`) and `model.safetensors`. `deworldsg
train-probe` also writes `metrics.json` and `confusion.png`.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from deworldsg_ros.checkpoints.card import MAX_CARD_BYTES
from deworldsg_ros.files import read_regular, write_atomically
from deworldsg_ros.parsing import parse_json
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.errors import ConfigurationError

CARD_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"

# The frames of a clip, see `ProbeCard`.
Window = Literal["last_frames", "valid_interval"]

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
        training: record of the training, plain values.
        schema, version: of the file format.
    """

    backbone: BackboneIdentity
    predicates: tuple[str, ...]
    layout: Literal["two_layer", "batch_norm"] = "two_layer"
    inputs: Literal["clip", "clip_and_boxes"] = "clip"
    hidden_dim: Annotated[int, msgspec.Meta(ge=1)] = 512
    window: Window = "last_frames"
    training: dict[str, Any] = {}
    schema: Literal["deworldsg/probe"] = "deworldsg/probe"
    version: Literal[1] = 1

    @property
    def input_dim(self) -> int:
        """Number of inputs per pair."""
        return self.backbone.feature_dim + (BOX_INPUTS if self.inputs == "clip_and_boxes" else 0)

    @property
    def seen_groups(self) -> frozenset[str]:
        """Scans or rooms that decided the weights, in the training or by stopping it."""
        groups = self.training.get("groups_by_part", {})
        parts = [groups.get(part, ()) for part in ("train", "validation")]
        return frozenset(str(group) for part in parts for group in part)

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


def read_card(folder: Path) -> ProbeCard:
    """Read `config.json` of a probe's folder.

    Raises:
        ConfigurationError: the file is missing, or is not a probe's.
    """
    path = folder / CARD_FILE
    if not path.is_file():
        raise ConfigurationError(
            f"probe '{folder}' has no {CARD_FILE}: expected a folder from `deworldsg train-probe` "
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
            f"probe {path}: training.groups_by_part is no record of scans by part ({error})"
        ) from error
    if not card.predicates or len(set(card.predicates)) != len(card.predicates):
        raise ConfigurationError(f"probe {path}: expected predicates, each name once")
    return card


def write_card(folder: Path, card: ProbeCard) -> None:
    """Write `config.json` of a probe's folder."""
    path = folder / CARD_FILE
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
