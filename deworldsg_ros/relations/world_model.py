"""The interface of world models, and their choice by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import Vocabulary

# Libraries of the optional world models; the extra `models` of this package installs them.
MODEL_LIBRARIES = ("torch", "transformers", "safetensors")


@dataclass(frozen=True)
class PairContext:
    """One direction of a pair in a clip.

    Attributes:
        subject_box_xyxy, object_box_xyxy: (4,) float64 pixels of the crop, in the clip's last
            frame.
        subject_class, object_class: indices into the vocabulary's classes.
        subject_name, object_name: names of these classes.
    """

    subject_box_xyxy: Float64
    object_box_xyxy: Float64
    subject_class: int
    object_class: int
    subject_name: str
    object_name: str


@dataclass(frozen=True)
class ClipRequest:
    """One clip, and the ordered pairs to predict from it.

    Attributes:
        clip: (T, h, w, 3) uint8 RGB, oldest frame first.
        pairs: directions to predict, usually both of one pair; the clip is encoded once.
        vocabulary: its predicates are the columns of the prediction.
    """

    clip: UInt8
    pairs: tuple[PairContext, ...]
    vocabulary: Vocabulary


class WorldModel(Protocol):
    """A frozen video model with its probe: maps a clip to predicate distributions.

    A world model whose attribute `window` is ``valid_interval`` gets clips of the frames since both
    objects were seen without a break.
    """

    @property
    def name(self) -> str:
        """The `source` of its published evidence."""
        ...

    @property
    def clip_length(self) -> int:
        """T, frames of its clips."""
        ...

    def predict(self, request: ClipRequest) -> Float64:
        """Predicate distributions of the pairs of a request.

        Clips differ in height and width. The world model resizes them.

        Returns:
            (pairs, R), rows >= 0 that sum to one.
        """
        ...


def require_predicates(model: WorldModel | None, predicates: tuple[str, ...]) -> None:
    """Refuse a world model whose predicates differ from the graph's, before the first frame.

    A world model with fixed predicates has a method `require_predicates`.

    Raises:
        ConfigurationError: the predicates differ.
    """
    check = getattr(model, "require_predicates", None)
    if check is not None:
        check(predicates)


def _no_clips(config: RelationsConfig, device: str) -> None:
    """No model of clips: edges have visual evidence, and with ``physics`` that of surfaces."""
    del config, device


def _fake(config: RelationsConfig, device: str) -> WorldModel:
    from deworldsg_ros.relations.world_models.fake import FakeWorldModel

    del device
    return FakeWorldModel(config.clip_length)


def _vjepa2(config: RelationsConfig, device: str) -> WorldModel:
    from deworldsg_ros.relations.probing.probed_world_model import build_probed
    from deworldsg_ros.relations.world_models.vjepa2 import load_backbone

    return build_probed(config, load_backbone, device)


def _dinov2(config: RelationsConfig, device: str) -> WorldModel:
    from deworldsg_ros.relations.probing.probed_world_model import build_probed
    from deworldsg_ros.relations.world_models.dinov2 import load_backbone

    return build_probed(config, load_backbone, device)


# By the name in the configuration. `physics` judges the fused geometry of pairs in the graph: it
# needs no images.
WORLD_MODELS: dict[str, Callable[[RelationsConfig, str], WorldModel | None]] = {
    "dinov2": _dinov2,
    "fake": _fake,
    "none": _no_clips,
    "physics": _no_clips,
    "vjepa2": _vjepa2,
}


def build_world_model(config: RelationsConfig, device: str = "auto") -> WorldModel | None:
    """The configured world model, on a device (auto, cpu or cuda).

    None if the configured one reads no clips. The libraries of a network are imported only here.

    Raises:
        ConfigurationError: unknown name, missing library, or a checkpoint or probe that cannot be
            used.
    """
    if config.world_model not in WORLD_MODELS:
        raise ConfigurationError(
            f"relations.world_model is '{config.world_model}': "
            f"expected one of {', '.join(WORLD_MODELS)}"
        )
    try:
        return WORLD_MODELS[config.world_model](config, device)
    except ImportError as error:
        if (error.name or "").split(".")[0] not in MODEL_LIBRARIES:
            raise
        raise ConfigurationError(
            f"world model '{config.world_model}' needs {' and '.join(MODEL_LIBRARIES)}: "
            f"pip install torch transformers safetensors ({error})"
        ) from error
