"""Frozen backbones on torch: clips in, features out."""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
)
from deworldsg_ros.checkpoints.probe_card import BackboneIdentity
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.probing.preprocessing import ClipGeometry, normalise, resize_and_crop
from deworldsg_ros.scene.arrays import Float32, UInt8
from deworldsg_ros.scene.errors import ConfigurationError

# Values of each tensor that its fingerprint is made of.
FINGERPRINT_SAMPLES = 64
REMEDY = (
    "lower relations.batch_size or relations.image_size, choose a smaller checkpoint, or free the "
    "device"
)


@dataclass(frozen=True)
class FrozenBackbone:
    """A pretrained network that is only read.

    Attributes:
        identity: what a probe is bound to.
        geometry: how frames are resized.
        device: where it runs.
        dtype: of its activations.
        features: (B, T, 3, S, S) normalised to (B, d), the network itself.
        quantised: whether its linear layers are in 8-bit integers.
    """

    identity: BackboneIdentity
    geometry: ClipGeometry
    device: torch.device
    dtype: torch.dtype
    features: Callable[[torch.Tensor], torch.Tensor]
    quantised: bool = False

    @property
    def description(self) -> str:
        """Everything that a feature depends on besides the clip, but for the device."""
        number = "int8" if self.quantised else str(self.dtype).removeprefix("torch.")
        return f"{self.identity}; {self.geometry}; {number}"

    def encode(self, clips: Sequence[UInt8]) -> Float32:
        """Features of clips, all of them in one batch.

        Args:
            clips: each (T, h, w, 3) uint8 RGB; sizes may differ.

        Returns:
            (n, d) float32.

        Raises:
            ConfigurationError: where the device has too little memory for the batch.
            ValueError: for a clip of another length.
        """
        wanted = self.identity.clip_length
        for clip in clips:
            if len(clip) != wanted:
                raise ValueError(f"clip of {len(clip)} frames: wanted {wanted}")
        if not clips:
            return np.zeros((0, self.identity.feature_dim), np.float32)
        on_cuda = self.device.type == "cuda"
        with enough_memory(f"encoding {len(clips)} clips", REMEDY), torch.inference_mode():
            images = torch.stack([resize_and_crop(clip, self.geometry) for clip in clips])
            if on_cuda:
                images = images.pin_memory().to(self.device, non_blocking=True)
            features = self.features(normalise(images, self.dtype))
            return np.asarray(features.to("cpu", torch.float32).numpy(), np.float32)


def load_checkpoint(
    config: RelationsConfig,
    family: str,
    model_class: Any,
    changes: Mapping[str, int] = MappingProxyType({}),
    unused: Sequence[str] = (),
) -> torch.nn.Module:
    """A pretrained model of `transformers`, whole and frozen, on the CPU in float32.

    Args:
        config: section ``relations``.
        family: model type that the checkpoint must have.
        model_class: class that it is loaded into.
        changes: fields of its configuration to set.
        unused: prefixes of parameters that need not be there.

    Raises:
        ConfigurationError: where there is no checkpoint, or it is another model's, or not whole.
    """
    source = CheckpointSource.find(
        "relations.model_path", config.model_path, local_files_only=config.local_files_only
    )
    settings = source.config([family])
    settings.update(dict(changes))
    model: torch.nn.Module = source.load(model_class, settings, unused)
    return model


def place(
    config: RelationsConfig, model: torch.nn.Module
) -> tuple[torch.nn.Module, torch.device, torch.dtype]:
    """The model on its device, in its precision, quantised where that is configured.

    Raises:
        ConfigurationError: no CUDA, no memory, or quantisation that is not to be had.
    """
    device = choose_device("relations.device", config.device)
    dtype = choose_dtype(device)
    if config.quantise:
        return quantise(model, device), device, dtype
    with enough_memory(f"moving the backbone to {device}", REMEDY):
        return model.to(device, dtype), device, dtype


def quantise(model: torch.nn.Module, device: torch.device) -> torch.nn.Module:
    """Linear layers in 8-bit integers, activations quantised as they come."""
    if device.type != "cpu":
        raise ConfigurationError(
            "relations.quantise is for the CPU: set relations.device to 'cpu', or quantise to false"
        )
    try:
        quantization: Any = importlib.import_module("torch.ao.quantization")
    except ImportError as error:
        raise ConfigurationError(
            f"torch {torch.__version__} has no dynamic quantisation: set relations.quantise to "
            "false, or install torch 2.13 or older"
        ) from error
    quantised: torch.nn.Module = quantization.quantize_dynamic(
        model, {torch.nn.Linear}, dtype=torch.qint8
    )
    return quantised


def fingerprint(model: torch.nn.Module) -> str:
    """16 hexadecimal digits that depend on names, shapes and a sample of all parameters."""
    digest = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        flat = value.detach().flatten()
        step = max(1, flat.numel() // FINGERPRINT_SAMPLES)
        sample = flat[::step][:FINGERPRINT_SAMPLES].to("cpu", torch.float32).numpy()
        digest.update(f"{name} {tuple(value.shape)}".encode())
        digest.update(sample.astype("<f4").tobytes())
    return digest.hexdigest()[:16]
