"""Images as input of a network: resized, scaled, normalised."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from deworldsg_ros.checkpoints.loading import CheckpointSource
from deworldsg_ros.scene.arrays import UInt8
from deworldsg_ros.scene.errors import ConfigurationError


@dataclass(frozen=True)
class Preprocessing:
    """Size and normalisation of a network's input.

    Attributes:
        height, width: of the input, pixels.
        mean, std: per channel, RGB, of values in [0, 1].
    """

    height: int
    width: int
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @staticmethod
    def of_checkpoint(source: CheckpointSource, default: Preprocessing) -> Preprocessing:
        """Read preprocessor_config.json of a checkpoint; `default` fills in missing values.

        Raises:
            ConfigurationError: the file cannot be read, or has values of another kind.
        """
        path = source.file("preprocessor_config.json") or source.file("processor_config.json")
        if path is None:
            return default
        try:
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            content = content.get("image_processor", content)
            size = content.get("size", {})
            if isinstance(size, int):
                size = {"height": size, "width": size}
            height = int(size.get("height", default.height))
            width = int(size.get("width", default.width))
            if not content.get("do_normalize", False):
                return Preprocessing(height, width)
            red, green, blue = (float(value) for value in content.get("image_mean", default.mean))
            mean = red, green, blue
            red, green, blue = (float(value) for value in content.get("image_std", default.std))
            return Preprocessing(height, width, mean, (red, green, blue))
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise ConfigurationError(
                f"{path}: {error}; expected size.height, size.width, do_normalize, image_mean and "
                "image_std: download the checkpoint again"
            ) from error

    def __call__(self, rgb: UInt8, device: torch.device, dtype: torch.dtype) -> torch.Tensor:
        """(H, W, 3) uint8 as (1, 3, height, width), normalised."""
        pixels = to_device(rgb, device).permute(2, 0, 1)[None].float()
        if pixels.shape[-2:] != (self.height, self.width):
            pixels = resize(pixels, (self.height, self.width), antialias=True)
        mean, std = (
            torch.tensor(values, device=device).view(1, 3, 1, 1) for values in (self.mean, self.std)
        )
        return ((pixels / 255 - mean) / std).to(dtype)


def to_device(array: NDArray[Any], device: torch.device) -> torch.Tensor:
    """A copy on the device. Pinned memory makes the copy to a GPU asynchronous."""
    # The copy on the CPU is writable. Images of messages are not, and torch warns of such arrays.
    tensor = torch.from_numpy(np.array(array, order="C"))
    if device.type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor


def resize(pixels: torch.Tensor, size: tuple[int, int], *, antialias: bool = False) -> torch.Tensor:
    """Bilinear resampling of (B, C, h, w) to (B, C, *size)."""
    return torch.nn.functional.interpolate(
        pixels, size=size, mode="bilinear", align_corners=False, antialias=antialias
    )
