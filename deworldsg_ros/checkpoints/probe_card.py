"""What a probe was trained for; it refuses to be used for anything else.

A probe is a folder: `config.json` (a `ProbeCard`), `model.safetensors`, and, where it was trained
here, `metrics.json` and `confusion.png`.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.errors import ConfigurationError

CARD_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"

# Both boxes of a pair, corners as shares of the crop.
BOX_INPUTS = 8


class BackboneIdentity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A frozen backbone and how clips are given to it.

    Attributes:
        family: name of the world model, e.g. ``vjepa2``.
        feature_dim: d, length of a clip's feature.
        image_size: edge of the square that a frame is made into, pixels.
        clip_length: T, frames of a clip.
        fingerprint: of the weights; empty where the origin of a probe does not tell.
    """

    family: str
    feature_dim: Annotated[int, msgspec.Meta(ge=1)]
    image_size: Annotated[int, msgspec.Meta(ge=1)]
    clip_length: Annotated[int, msgspec.Meta(ge=1)]
    fingerprint: str = ""

    def __str__(self) -> str:
        weights = f", weights {self.fingerprint}" if self.fingerprint else ""
        return (
            f"{self.family} with {self.feature_dim} features of {self.clip_length} frames at "
            f"{self.image_size} px{weights}"
        )


class ProbeCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a probe is and what it was trained for.

    Attributes:
        backbone: whose features it reads.
        predicates: R names, in the order of its outputs.
        layout: ``two_layer`` is the paper's, Linear-ReLU-Linear; ``batch_norm`` that of the
            published probe, with batch normalisation before both and dropout before the last.
        inputs: ``clip`` is the paper's: the clip's feature alone, and so one answer for both
            directions of a pair; ``clip_and_boxes`` adds the subject's and the object's box.
        hidden_dim: width of the layer between.
        training: how it was trained, plain values.
        schema, version: of this file.
    """

    backbone: BackboneIdentity
    predicates: tuple[str, ...]
    layout: Literal["two_layer", "batch_norm"] = "two_layer"
    inputs: Literal["clip", "clip_and_boxes"] = "clip"
    hidden_dim: Annotated[int, msgspec.Meta(ge=1)] = 512
    training: dict[str, Any] = {}
    schema: Literal["deworldsg/probe"] = "deworldsg/probe"
    version: Literal[1] = 1

    @property
    def input_dim(self) -> int:
        """Numbers that the probe reads of one pair."""
        return self.backbone.feature_dim + (BOX_INPUTS if self.inputs == "clip_and_boxes" else 0)

    def require_backbone(self, backbone: BackboneIdentity) -> None:
        """Raise ConfigurationError unless the probe was trained on this backbone."""
        wanted = self.backbone
        if not wanted.fingerprint or not backbone.fingerprint:
            wanted = msgspec.structs.replace(wanted, fingerprint=backbone.fingerprint)
        if wanted != backbone:
            raise ConfigurationError(
                f"the probe was trained on {self.backbone}, and the backbone is {backbone}: "
                "choose the checkpoint and the image size that it was trained on, or train a "
                "probe for this one with `deworldsg train-probe`"
            )

    def require_predicates(self, predicates: tuple[str, ...]) -> None:
        """Raise ConfigurationError unless the probe answers over just these predicates."""
        if self.predicates == predicates:
            return
        missing = [name for name in predicates if name not in self.predicates]
        extra = [name for name in self.predicates if name not in predicates]
        parts = [f"lacks {_some(missing)}"] * bool(missing) + [f"has {_some(extra)}"] * bool(extra)
        raise ConfigurationError(
            f"the probe was trained for {len(self.predicates)} predicates and the graph has "
            f"{len(predicates)}: it {' and '.join(parts) or 'has them in another order'}; choose "
            "the predicate set that it was trained for, or train one for this set"
        )


def read_card(folder: Path) -> ProbeCard:
    """Read `config.json` of a probe's folder.

    Raises:
        ConfigurationError: where it is missing, or is no probe's.
    """
    path = folder / CARD_FILE
    if not path.is_file():
        raise ConfigurationError(
            f"probe '{folder}' has no {CARD_FILE}: wanted a folder made by `deworldsg train-probe` "
            "or `deworldsg import-probe`"
        )
    try:
        card = msgspec.json.decode(path.read_bytes(), type=ProbeCard)
    except (OSError, msgspec.MsgspecError) as error:
        raise ConfigurationError(f"probe {path}: {error}") from error
    if not card.predicates or len(set(card.predicates)) != len(card.predicates):
        raise ConfigurationError(f"probe {path}: wanted predicates, each named once")
    return card


def write_card(folder: Path, card: ProbeCard) -> None:
    """Write `config.json` of a probe's folder."""
    path = folder / CARD_FILE
    path.write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=2) + b"\n")


def relative_box_pair(
    subject_box_xyxy: Float64, object_box_xyxy: Float64, width: int, height: int
) -> Float32:
    """(8,) float32: corners of both boxes as shares of a crop's width and height."""
    both = np.concatenate([subject_box_xyxy, object_box_xyxy])
    shares: Float32 = np.clip(both / np.array([width, height] * 4), 0, 1).astype(np.float32)
    return shares


def _some(names: list[str], most: int = 5) -> str:
    told = ", ".join(f"'{name}'" for name in names[:most])
    return told if len(names) <= most else f"{told} and {len(names) - most} more"
