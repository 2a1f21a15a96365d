"""DINOv2, the paper's ablation (d): the same clips and probe, frames looked at one by one.

A frame's feature is its class token after the last normalisation; a clip's is their mean.
"""

from __future__ import annotations

from typing import Any

import torch
from transformers import Dinov2Model

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

FAMILY = "dinov2"

# Of the published processor; the checkpoints' own 518 pixels are those of their last training.
IMAGE_SIZE = 224


def load_backbone(config: RelationsConfig) -> FrozenBackbone:
    """The configured checkpoint.

    Raises:
        ConfigurationError: in one sentence, where it cannot be used as configured.
    """
    image_size = config.image_size or IMAGE_SIZE
    # The mask token is for training.
    model: Any = load_checkpoint(config, FAMILY, Dinov2Model, unused=("embeddings.mask_token",))
    settings = model.config
    if image_size % settings.patch_size:
        raise ConfigurationError(
            f"relations.image_size is {image_size}: DINOv2 wants a multiple of its patch size "
            f"{settings.patch_size}"
        )
    identity = BackboneIdentity(
        FAMILY, settings.hidden_size, image_size, config.clip_length, fingerprint(model)
    )
    placed, device, dtype = place(config, model)

    def features(videos: torch.Tensor) -> torch.Tensor:
        clips, frames = videos.shape[:2]
        tokens: torch.Tensor = placed(videos.flatten(0, 1)).last_hidden_state
        return tokens[:, 0].to(torch.float32).reshape(clips, frames, -1).mean(dim=1)

    return FrozenBackbone(
        identity, clip_geometry(image_size), device, dtype, features, config.quantise
    )


def clip_geometry(image_size: int) -> ClipGeometry:
    """Resizing of the published processor: 256 for 224."""
    return ClipGeometry(image_size * 256 // 224, image_size, "bicubic")


def build(config: RelationsConfig) -> ProbedWorldModel:
    """The backbone with its probe; raises ConfigurationError where one does not fit."""
    return build_probed(config, load_backbone)
