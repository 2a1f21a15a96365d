"""Preprocessing of clips: resize the short edge, crop the centre, normalise as for ImageNet.

The steps are those of the backbones' published processors. Pixels are copied to the device as
uint8, a quarter of the bytes of float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from deworldsg_ros.checkpoints.card import IMAGENET_MEAN, IMAGENET_STD
from deworldsg_ros.scene.arrays import UInt8

# Longer images are shortened to this ratio before resizing. Only the central square is used, and
# the resizing of the rest would be wasted.
MAX_ASPECT_RATIO = 4


@dataclass(frozen=True)
class ClipGeometry:
    """How an image is resized; sizes in pixels.

    Attributes:
        short_edge: length of the short edge after resizing.
        crop: edge of the central square that is cropped then.
        interpolation: ``bilinear`` or ``bicubic``, both with antialiasing.
    """

    short_edge: int
    crop: int
    interpolation: str

    def __str__(self) -> str:
        return f"{self.interpolation} {self.short_edge}, middle {self.crop}"


def resize_and_crop(clip: UInt8, geometry: ClipGeometry) -> torch.Tensor:
    """(T, h, w, 3) uint8 to (T, 3, crop, crop) uint8."""
    height, width = clip.shape[1:3]
    limit = MAX_ASPECT_RATIO * min(height, width)
    # Equal parts are removed on both sides: the centre stays the centre.
    top, left = max(0, (height - limit + 1) // 2), max(0, (width - limit + 1) // 2)
    middle = clip[:, top : height - top, left : width - left]
    height, width = middle.shape[1:3]
    short = min(height, width)
    resized_height, resized_width = (
        geometry.short_edge * edge // short for edge in (height, width)
    )
    images = torch.from_numpy(np.ascontiguousarray(middle)).permute(0, 3, 1, 2)
    images = torch.nn.functional.interpolate(
        images,
        size=(resized_height, resized_width),
        mode=geometry.interpolation,
        antialias=True,
        align_corners=False,
    )
    top = round((resized_height - geometry.crop) / 2)
    left = round((resized_width - geometry.crop) / 2)
    return images[:, :, top : top + geometry.crop, left : left + geometry.crop].contiguous()


def normalise(images: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """(…, 3, h, w) uint8 minus ImageNet's mean, over its deviation; same device."""
    shape = (3, 1, 1)
    mean = torch.tensor(IMAGENET_MEAN, device=images.device).reshape(shape)
    std = torch.tensor(IMAGENET_STD, device=images.device).reshape(shape)
    return ((images.to(torch.float32) / 255 - mean) / std).to(dtype)
