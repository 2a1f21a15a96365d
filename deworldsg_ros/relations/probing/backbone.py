"""Frozen torch backbones that turn clips into features."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
)
from deworldsg_ros.checkpoints.precision import in_best_precision, noise_pattern, require_finite
from deworldsg_ros.checkpoints.probe_card import BackboneIdentity
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.probing.preprocessing import ClipGeometry, normalise, stretch
from deworldsg_ros.scene.arrays import Float32, UInt8

# Values per tensor that enter its fingerprint. All values of a ViT-g would take seconds to hash.
FINGERPRINT_SAMPLES = 64
REMEDY = "choose a smaller checkpoint, encode fewer clips at once, or free memory of the device"


@dataclass(frozen=True)
class FrozenBackbone:
    """A pretrained network without training.

    Attributes:
        identity: family, sizes and weights; a probe is bound to it.
        geometry: how frames are resized.
        device: device of the network.
        dtype: data type of its activations.
        features: the network itself, (B, T, 3, S, S) normalised images to (B, d).
    """

    identity: BackboneIdentity
    geometry: ClipGeometry
    device: torch.device
    dtype: torch.dtype
    features: Callable[[torch.Tensor], torch.Tensor]

    @property
    def description(self) -> str:
        """Everything besides the clip and the device that changes a feature."""
        return f"{self.identity}; {self.geometry}; {str(self.dtype).removeprefix('torch.')}"

    def encode(self, clips: Sequence[UInt8]) -> Float32:
        """Features of clips, encoded in one batch.

        Args:
            clips: each (T, h, w, 3) uint8 RGB; sizes may differ.

        Returns:
            (n, d) float32.

        Raises:
            ConfigurationError: the device has too little memory for the batch.
            RefusedInput: ``nan_features``.
            ValueError: a clip has another length than T.
        """
        expected = self.identity.clip_length
        for clip in clips:
            if len(clip) != expected:
                raise ValueError(f"clip of {len(clip)} frames: expected {expected}")
        if not clips:
            return np.zeros((0, self.identity.feature_dim), np.float32)
        with enough_memory(f"encoding {len(clips)} clip(s)", REMEDY), torch.inference_mode():
            images = torch.stack([stretch(clip, self.geometry) for clip in clips])
            if self.device.type == "cuda":
                images = images.pin_memory().to(self.device, non_blocking=True)
            features = self.features(normalise(images, self.dtype))
            require_finite(features, "nan_features", f"a feature of {self.identity.family}")
            return np.asarray(features.to("cpu", torch.float32).numpy(), np.float32)


def load_checkpoint(
    config: RelationsConfig,
    model_class: Any,
    unused: Sequence[str] = (),
    *,
    download: bool = False,
) -> torch.nn.Module:
    """A pretrained model of `transformers`, complete and frozen, on the CPU in float32.

    Args:
        config: section ``relations``; `world_model` is the model type of the checkpoint.
        model_class: class of `transformers` to load it into.
        unused: prefixes of parameters that the checkpoint may lack.
        download: whether a hub id may be downloaded; otherwise it is taken from the local cache.

    Raises:
        ConfigurationError: no checkpoint, a checkpoint of another model, or an incomplete one.
    """
    source = CheckpointSource.find(
        "relations.world_model_path", config.world_model_path, local_files_only=not download
    )
    model: torch.nn.Module = source.load(model_class, source.config([config.world_model]), unused)
    return model


def to_device(
    model: torch.nn.Module,
    choice: str,
    identity: BackboneIdentity,
    features: Callable[[Any, torch.Tensor], torch.Tensor],
) -> tuple[torch.nn.Module, torch.device, torch.dtype]:
    """Move a model to a device (auto, cpu or cuda), in a precision that is exact enough there.

    Args:
        model: in float32.
        choice: the device.
        identity: sizes of a clip.
        features: of normalised clips, by a model.

    Raises:
        ConfigurationError: no CUDA device, or too little memory.
    """
    device = choose_device("perception.device", choice)
    shape = (1, identity.clip_length, 3, identity.image_size, identity.image_size)

    # A decorator of torch has no type where torch is not installed.
    def of_test_clip(model: Any, dtype: torch.dtype) -> torch.Tensor:
        with torch.inference_mode():
            return features(model, normalise(noise_pattern(*shape).to(device), dtype))

    with enough_memory(f"moving the backbone to {device}", REMEDY):
        placed, dtype = in_best_precision(
            model, device, choose_dtype(device), of_test_clip, f"the backbone {identity.family}"
        )
    return placed, device, dtype


def fingerprint(model: torch.nn.Module) -> str:
    """16 hexadecimal digits of a hash of all parameters: names, shapes and sampled values."""
    digest = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        flat = value.detach().flatten()
        step = max(1, flat.numel() // FINGERPRINT_SAMPLES)
        sample = flat[::step][:FINGERPRINT_SAMPLES].to("cpu", torch.float32).numpy()
        digest.update(f"{name} {tuple(value.shape)}".encode())
        digest.update(sample.astype("<f4").tobytes())
    return digest.hexdigest()[:16]
