"""What a world model is to this stage, and how one is chosen by name.

A world model is a file of its own in `world_models/` with a function
`build(config: RelationsConfig) -> WorldModel | None`; its name is the file's.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations import world_models
from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import Vocabulary

# What the optional world models are made with; the package's own extra installs them.
MODEL_LIBRARIES = ("torch", "transformers", "safetensors")


@dataclass(frozen=True)
class PairContext:
    """One direction of a pair, as it lies in the clip.

    Attributes:
        subject_box_xyxy, object_box_xyxy: (4,) float64 pixels of the crop, in the last frame in
            which both were seen.
        subject_class, object_class: indices into the vocabulary's classes.
        subject_name, object_name: their names.
    """

    subject_box_xyxy: Float64
    object_box_xyxy: Float64
    subject_class: int
    object_class: int
    subject_name: str
    object_name: str


@dataclass(frozen=True)
class ClipRequest:
    """One clip, and the ordered pairs that are asked of it.

    Attributes:
        clip: (T, h, w, 3) uint8 RGB, oldest frame first.
        pairs: the directions asked for, usually both of one pair; the clip is encoded once.
        vocabulary: whose predicates the answer is over.
    """

    clip: UInt8
    pairs: tuple[PairContext, ...]
    vocabulary: Vocabulary


class WorldModel(Protocol):
    """A frozen video model with its probe: clips in, predicate distributions out."""

    @property
    def name(self) -> str:
        """The source that its evidence is published under."""
        ...

    @property
    def clip_length(self) -> int:
        """T, frames that it wants in a clip."""
        ...

    def predict_batch(self, requests: Sequence[ClipRequest]) -> list[Float64]:
        """Predicate distributions of each request's pairs.

        Clips differ in height and width: resizing is the model's own preprocessing.

        Returns:
            for each request (pairs, R), rows >= 0 that sum to one.
        """
        ...


def require_predicates(model: WorldModel | None, predicates: tuple[str, ...]) -> None:
    """Refuse at the start a world model that answers over other predicates than the graph's.

    A world model that is bound to its predicates says so by a method `require_predicates`.

    Raises:
        ConfigurationError: where it does not fit.
    """
    check = getattr(model, "require_predicates", None)
    if check is not None:
        check(predicates)


def world_model_names() -> tuple[str, ...]:
    """Names of the world models that can be chosen."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(world_models.__path__)))


def build_world_model(config: RelationsConfig) -> WorldModel | None:
    """The configured world model; None for ``none``.

    Its module, and with it whatever the model needs, is imported here and not before.

    Raises:
        ConfigurationError: for an unknown name, or a model that cannot be used as configured.
    """
    if config.world_model not in world_model_names():
        raise ConfigurationError(
            f"relations.world_model is '{config.world_model}': "
            f"wanted one of {', '.join(world_model_names())}"
        )
    try:
        module = importlib.import_module(f"{world_models.__name__}.{config.world_model}")
    except ImportError as error:
        if (error.name or "").split(".")[0] not in MODEL_LIBRARIES:
            raise
        raise ConfigurationError(
            f"world model '{config.world_model}' needs {' and '.join(MODEL_LIBRARIES)}: "
            f"pip install 'deworldsg_ros[models]' ({error})"
        ) from error
    model: WorldModel | None = module.build(config)
    return model
