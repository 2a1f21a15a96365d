"""V-JEPA 2, the paper's world model: its encoder, frozen, with a trained probe.

All tokens of the encoder's last layer are averaged; the predictor is not used. Any published
size: ViT-L, ViT-H, ViT-g at 256, ViT-g at 384 pixels.
"""

from __future__ import annotations

from typing import Any

import torch
from transformers import VJEPA2Model

from deworldsg_ros.checkpoints.probe_card import BackboneIdentity
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.probing.backbone import (
    FrozenBackbone,
    fingerprint,
    load_checkpoint,
    place,
)
from deworldsg_ros.relations.probing.preprocessing import ClipGeometry
from deworldsg_ros.relations.probing.probed_world_model import ProbedWorldModel, build_probed
from deworldsg_ros.scene.errors import ConfigurationError

FAMILY = "vjepa2"


def load_backbone(config: RelationsConfig) -> FrozenBackbone:
    """The configured checkpoint's encoder.

    Raises:
        ConfigurationError: in one sentence, where it cannot be used as configured.
    """
    # The rotary positions follow the configured size of the image: it is set, not the checkpoint's.
    changes = {"crop_size": config.image_size} if config.image_size else {}
    model: Any = load_checkpoint(config, FAMILY, VJEPA2Model, changes, unused=("predictor.",))
    settings = model.config
    _check(settings, config)
    model.predictor = torch.nn.Identity()
    identity = BackboneIdentity(
        FAMILY, settings.hidden_size, settings.crop_size, config.clip_length, fingerprint(model)
    )
    placed, device, dtype = place(config, model)

    def features(videos: torch.Tensor) -> torch.Tensor:
        hidden: torch.Tensor = placed(videos, skip_predictor=True).last_hidden_state
        # The average of thousands of tokens wants more than half precision.
        return hidden.mean(dim=1, dtype=torch.float32)

    return FrozenBackbone(
        identity, clip_geometry(settings.crop_size), device, dtype, features, config.quantise
    )


def clip_geometry(image_size: int) -> ClipGeometry:
    """Resizing of the published processor: 292 for 256, 438 for 384."""
    return ClipGeometry(image_size * 256 // 224, image_size, "bilinear")


def build(config: RelationsConfig) -> ProbedWorldModel:
    """The backbone with its probe; raises ConfigurationError where one does not fit."""
    return build_probed(config, load_backbone)


def _check(settings: Any, config: RelationsConfig) -> None:
    if settings.crop_size % settings.patch_size:
        raise ConfigurationError(
            f"relations.image_size is {settings.crop_size}: V-JEPA 2 wants a multiple of its "
            f"patch size {settings.patch_size}"
        )
    if config.clip_length % settings.tubelet_size:
        raise ConfigurationError(
            f"relations.clip_length is {config.clip_length}: V-JEPA 2 wants a multiple of its "
            f"tubelet size {settings.tubelet_size}"
        )
