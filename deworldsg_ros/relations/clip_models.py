"""World models on torch: a frozen backbone (V-JEPA 2, DINOv2) and a trained probe."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from transformers import Dinov2Model, VJEPA2Model

from deworldsg_ros.checkpoints.cards import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    BackboneIdentity,
    relative_box_pair,
)
from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
    in_best_precision,
    noise_pattern,
    require_finite,
)
from deworldsg_ros.checkpoints.probe_network import Probe, load_probe
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.world_model import ClipRequest
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8
from deworldsg_ros.scene.errors import ConfigurationError

# --- Preprocessing of clips: stretch a crop to the square input, normalise as for ImageNet.
#
# The backbones' published processors use the middle of an image only. In a crop around two objects,
# the objects are at the sides: on the shipped recording the middle loses 58 % of their area, and in
# a third of the clips one object altogether (`bench/clip_fit.py`). The released code of the paper
# stretches, too. Pixels are copied to the device as uint8, a quarter of the bytes of float32.


@dataclass(frozen=True)
class ClipGeometry:
    """How an image is resized.

    Attributes:
        edge: edge of the square input, pixels.
        interpolation: ``bilinear`` or ``bicubic``, both with antialiasing.
    """

    edge: int
    interpolation: str

    def __str__(self) -> str:
        return f"{self.interpolation} {self.edge}, stretched"


def stretch(clip: UInt8, geometry: ClipGeometry) -> torch.Tensor:
    """(T, h, w, 3) uint8 to (T, 3, edge, edge) uint8: the whole crop, without its aspect ratio."""
    images = torch.from_numpy(np.ascontiguousarray(clip)).permute(0, 3, 1, 2)
    return torch.nn.functional.interpolate(
        images,
        size=(geometry.edge, geometry.edge),
        mode=geometry.interpolation,
        antialias=True,
        align_corners=False,
    )


def normalise(images: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """(…, 3, h, w) uint8 minus ImageNet's mean, over its deviation; same device."""
    shape = (3, 1, 1)
    mean = torch.tensor(IMAGENET_MEAN, device=images.device).reshape(shape)
    std = torch.tensor(IMAGENET_STD, device=images.device).reshape(shape)
    return ((images.to(torch.float32) / 255 - mean) / std).to(dtype)


# --- Frozen torch backbones that turn clips into features.

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


# --- V-JEPA 2, the paper's world model: its frozen encoder and a trained probe.
#
# A clip's feature is the mean of all tokens of the encoder's last layer. The predictor is not used.
# All published sizes work: ViT-L, ViT-H and ViT-g at 256 pixels, ViT-g at 384 pixels.


def load_vjepa2(
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
    geometry = vjepa2_geometry(settings.crop_size)
    return FrozenBackbone(identity, geometry, where, dtype, partial(features, placed))


def vjepa2_geometry(image_size: int) -> ClipGeometry:
    """Interpolation of the published processor and of the paper's released code."""
    return ClipGeometry(image_size, "bilinear")


# --- DINOv2, the paper's ablation (d): the clips and the probe of V-JEPA 2, single frames.
#
# A frame's feature is its class token after the last normalisation. A clip's feature is the mean of
# its frames' features.

# Edge of the square input, pixels: that of the published processor, 16 patches of 14 pixels. The
# checkpoints' own 518 pixels are the size of their last training.
IMAGE_SIZE_PX = 224


def load_dinov2(
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
    geometry = dinov2_geometry(image_size)
    return FrozenBackbone(identity, geometry, where, dtype, partial(features, placed))


def dinov2_geometry(image_size: int) -> ClipGeometry:
    """Interpolation of the published processor."""
    return ClipGeometry(image_size, "bicubic")


# --- A world model made of a frozen backbone and a trained probe.

logger = logging.getLogger(__name__)


class ProbedWorldModel:
    """Maps clips to the probe's predicate distributions.

    Attributes:
        name: family of the backbone.
        clip_length: T, frames of a clip.
        predicates: names of the probe's outputs.
        window, crop: frames of a clip and region of them, see `ProbeCard`.

    Raises:
        ConfigurationError: the probe was trained on another backbone.
    """

    def __init__(self, backbone: FrozenBackbone, probe: Probe) -> None:
        probe.card.require_backbone(backbone.identity)
        self.name = backbone.identity.family
        self.clip_length = backbone.identity.clip_length
        self.predicates = probe.card.predicates
        self.window, self.crop = probe.card.window, probe.card.crop
        self._backbone = backbone
        self._probe = probe

    def require_predicates(self, predicates: tuple[str, ...]) -> None:
        """Raise ConfigurationError unless the probe has exactly these predicates, in this order."""
        self._probe.card.require_predicates(predicates)

    def predict(self, request: ClipRequest) -> Float64:
        """(pairs, R) float64, rows sum to one.

        Raises:
            ConfigurationError: the vocabulary has other predicates than the probe, or the device
                has too little memory.
        """
        self.require_predicates(request.vocabulary.predicates)
        boxes = relative_boxes(request)
        features = np.repeat(self._backbone.encode([request.clip]), len(boxes), axis=0)
        return self._probe.predict(features, boxes)


def relative_boxes(request: ClipRequest) -> Float32:
    """(pairs, 8) float32: corners of subject and object as fractions of the crop's size."""
    height, width = request.clip.shape[1:3]
    rows = [
        relative_box_pair(pair.subject_box_xyxy, pair.object_box_xyxy, width, height)
        for pair in request.pairs
    ]
    return np.array(rows, np.float32).reshape(len(rows), 8)


def build_probed(
    config: RelationsConfig, load_backbone: Callable[..., FrozenBackbone], device: str
) -> ProbedWorldModel:
    """The configured backbone and probe.

    Raises:
        ConfigurationError: one of them is missing, or they do not fit each other.
    """
    if not config.probe_path:
        raise ConfigurationError(
            f"relations.probe_path is empty: world model '{config.world_model}' needs the folder "
            "of a probe; train one with `deworldsg train-probe`"
        )
    # The probe is small: an error in it is reported before the long load of the backbone.
    probe = load_probe(Path(config.probe_path).expanduser())
    if probe.card.backbone.family != config.world_model:
        raise ConfigurationError(
            f"relations.probe_path '{config.probe_path}' was trained on {probe.card.backbone}: "
            f"relations.world_model '{config.world_model}' needs another probe"
        )
    model = ProbedWorldModel(load_backbone(config, device=device), probe)
    if not probe.card.backbone.fingerprint:
        logger.warning(
            "probe %s does not know the weights of its backbone, so '%s' is not compared with "
            "them: with other weights its predictions mean nothing (docs/dev/models.md, The "
            "published probe)",
            config.probe_path,
            config.world_model_path,
        )
    choice = probe.card.inputs, probe.card.crop
    if config.edge_belief != "robust" and choice != ("clip", "last_frame"):
        logger.warning(
            "probe %s gets '%s' of '%s'. The paper's probe gets the clip only, in the region of "
            "its last frame: these are not the paper's results. For those, use a probe trained "
            "with --inputs clip --crop last_frame",
            config.probe_path,
            *choice,
        )
    return model
