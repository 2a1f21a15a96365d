"""V-JEPA 2, the paper's world model: its frozen encoder and a trained probe.

A clip's feature is the mean of all tokens of the encoder's last layer. The predictor is not used.
All published sizes work: ViT-L, ViT-H and ViT-g at 256 pixels, ViT-g at 384 pixels.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from transformers import VJEPA2Model

from deworldsg_ros.checkpoints.probe_card import BackboneIdentity
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.probing.backbone import (
    FrozenBackbone,
    fingerprint,
    load_checkpoint,
    to_device,
)
from deworldsg_ros.relations.probing.preprocessing import ClipGeometry
from deworldsg_ros.scene.errors import ConfigurationError


def load_backbone(
    config: RelationsConfig, *, device: str = "auto", download: bool = False
) -> FrozenBackbone:
    """The encoder of the configured checkpoint.

    Args:
        config: section ``relations``.
        device: auto, cpu or cuda.
        download: whether a hub id may be downloaded.

    Raises:
        ConfigurationError: the checkpoint cannot be used as configured.
    """
    model: Any = load_checkpoint(config, VJEPA2Model, unused=("predictor.",), download=download)
    settings = model.config
    if config.clip_length % settings.tubelet_size:
        raise ConfigurationError(
            f"relations.clip_length is {config.clip_length}: V-JEPA 2 expects a multiple of its "
            f"tubelet size {settings.tubelet_size}"
        )
    model.predictor = torch.nn.Identity()
    identity = BackboneIdentity(
        "vjepa2",
        settings.hidden_size,
        settings.crop_size,
        config.clip_length,
        fingerprint(model),
        fit="stretch",
    )

    def features(network: Any, videos: torch.Tensor) -> torch.Tensor:
        hidden: torch.Tensor = network(videos, skip_predictor=True).last_hidden_state
        # Half precision is too coarse for the mean of thousands of tokens.
        return hidden.mean(dim=1, dtype=torch.float32)

    placed, where, dtype = to_device(model, device, identity, features)
    geometry = clip_geometry(settings.crop_size)
    return FrozenBackbone(identity, geometry, where, dtype, partial(features, placed))


def clip_geometry(image_size: int) -> ClipGeometry:
    """Interpolation of the published processor and of the paper's released code."""
    return ClipGeometry(image_size, "bilinear")
