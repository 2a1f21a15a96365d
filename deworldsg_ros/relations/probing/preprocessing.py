"""Preprocessing of clips: stretch a crop to the square input, normalise as for ImageNet.

The backbones' published processors use the middle of an image only. In a crop around two objects,
the objects are at the sides: on the shipped recording the middle loses 56 % of their area, and in
three of ten clips one object altogether (`bench/clip_fit.py`). The released code of the paper
stretches, too. Pixels are copied to the device as uint8, a quarter of the bytes of float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from deworldsg_ros.checkpoints.card import IMAGENET_MEAN, IMAGENET_STD
from deworldsg_ros.scene.arrays import UInt8


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
