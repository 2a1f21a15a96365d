"""World models by their name in the configuration.

The libraries of a network are imported only if the configuration names it.
"""

from __future__ import annotations

from collections.abc import Callable

from deworldsg_ros.base.plugins import PluginError, load_plugin
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.world_model import WorldModel
from deworldsg_ros.scene.errors import ConfigurationError

# Libraries of the optional world models; the extra `models` of this package installs them.
MODEL_LIBRARIES = ("torch", "transformers", "safetensors")


def _no_clips(config: RelationsConfig, device: str) -> None:
    """No model of clips: edges have visual evidence, and with ``physics`` that of surfaces."""
    del config, device


def _fake(config: RelationsConfig, device: str) -> WorldModel:
    from deworldsg_ros.relations.world_model import FakeWorldModel

    del device
    return FakeWorldModel(config.clip_length)


def _vjepa2(config: RelationsConfig, device: str) -> WorldModel:
    from deworldsg_ros.relations.clip_models import build_probed, load_vjepa2

    return build_probed(config, load_vjepa2, device)


def _dinov2(config: RelationsConfig, device: str) -> WorldModel:
    from deworldsg_ros.relations.clip_models import build_probed, load_dinov2

    return build_probed(config, load_dinov2, device)


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
    name = config.world_model
    if name not in WORLD_MODELS:
        try:
            make = load_plugin("relations.world_model", name, WORLD_MODELS)
        except PluginError as error:
            raise ConfigurationError(str(error)) from error
        made: WorldModel | None = make(config, device)
        return made
    try:
        return WORLD_MODELS[name](config, device)
    except ImportError as error:
        if (error.name or "").split(".")[0] not in MODEL_LIBRARIES:
            raise
        raise ConfigurationError(
            f"world model '{config.world_model}' needs {' and '.join(MODEL_LIBRARIES)}: "
            f"pip install torch transformers safetensors ({error})"
        ) from error
