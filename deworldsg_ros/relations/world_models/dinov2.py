"""DINOv2, the paper's ablation (d): the clips and the probe of V-JEPA 2, single frames.

A frame's feature is its class token after the last normalisation. A clip's feature is the mean of
its frames' features.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from transformers import Dinov2Model

from deworldsg_ros.checkpoints.probe_card import BackboneIdentity
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.probing.backbone import (
    FrozenBackbone,
    fingerprint,
    load_checkpoint,
    to_device,
)
from deworldsg_ros.relations.probing.preprocessing import ClipGeometry

# Edge of the square input, pixels: that of the published processor, 16 patches of 14 pixels. The
# checkpoints' own 518 pixels are the size of their last training.
IMAGE_SIZE_PX = 224


def load_backbone(
    config: RelationsConfig,
    *,
    device: str = "auto",
    download: bool = False,
    image_size: int = IMAGE_SIZE_PX,
) -> FrozenBackbone:
    """The configured checkpoint.

    Args:
        config: section ``relations``.
        device: auto, cpu or cuda.
        download: whether a hub id may be downloaded.
        image_size: edge of the square input, pixels, a multiple of the patch size.

    Raises:
        ConfigurationError: the checkpoint cannot be used as configured.
    """
    # The mask token is only for training.
    model: Any = load_checkpoint(
        config, Dinov2Model, unused=("embeddings.mask_token",), download=download
    )
    identity = BackboneIdentity(
        "dinov2",
        model.config.hidden_size,
        image_size,
        config.clip_length,
        fingerprint(model),
        fit="stretch",
    )

    def features(network: Any, videos: torch.Tensor) -> torch.Tensor:
        clips, frames = videos.shape[:2]
        tokens: torch.Tensor = network(videos.flatten(0, 1)).last_hidden_state
        return tokens[:, 0].to(torch.float32).reshape(clips, frames, -1).mean(dim=1)

    placed, where, dtype = to_device(model, device, identity, features)
    geometry = clip_geometry(image_size)
    return FrozenBackbone(identity, geometry, where, dtype, partial(features, placed))


def clip_geometry(image_size: int) -> ClipGeometry:
    """Interpolation of the published processor."""
    return ClipGeometry(image_size, "bicubic")
