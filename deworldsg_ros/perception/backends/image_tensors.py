"""Images as input of a network: resized, scaled, normalised."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from deworldsg_ros.checkpoints.loading import CheckpointSource
from deworldsg_ros.scene.arrays import UInt8
from deworldsg_ros.scene.errors import ConfigurationError

# Largest long side of DETR's input, where its file has none.
DETR_LONGEST_PX = 1333
# Side of a network's input: the largest published one has 1536.
MAX_INPUT_PX = 4096


@dataclass(frozen=True)
class Preprocessing:
    """Size and normalisation of a network's input.

    Attributes:
        height, width: of the input, pixels; with `edges`, its largest short and long side.
        mean, std: per channel, RGB, of values in [0, 1].
        fit: how an image becomes the input: ``stretch``; ``edges`` = it keeps its aspect ratio and
            gets one of the two sides; ``square`` = black below or beside it, then stretched.
    """

    height: int
    width: int
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    fit: Literal["stretch", "edges", "square"] = "stretch"

    @staticmethod
    def of_checkpoint(source: CheckpointSource, default: Preprocessing | None) -> Preprocessing:
        """Read preprocessor_config.json of a checkpoint; `default` fills in missing values.

        Raises:
            ConfigurationError: the file cannot be read, has values of another kind, or is missing
                without a default.
        """
        path = source.file("preprocessor_config.json") or source.file("processor_config.json")
        if path is None:
            if default is None:
                raise ConfigurationError(
                    f"{source.parameter} '{source.name}' has no preprocessor_config.json: download "
                    "the checkpoint again"
                )
            return default
        default = default or Preprocessing(0, 0)
        try:
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            found = _read(content.get("image_processor", content), default)
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise ConfigurationError(
                f"{path}: {error}; expected size.height, size.width, do_normalize, image_mean and "
                "image_std: download the checkpoint again"
            ) from error
        if not all(1 <= side <= MAX_INPUT_PX for side in (found.height, found.width)):
            raise ConfigurationError(
                f"{path}: the input has {found.height} x {found.width} pixels, expected sides of 1 "
                f"to {MAX_INPUT_PX}"
            )
        return found

    def size_of(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the input for an image."""
        if self.fit != "edges":
            return self.height, self.width
        # As transformers rounds: the short side to the nearest pixel, the long side down.
        short, long = min(height, width), max(height, width)
        side = float(self.height)
        if long / short * side > self.width:
            side = self.width * short / long
        other = max(1, int(side * long / short))
        return (max(1, round(side)), other) if height <= width else (other, max(1, round(side)))

    def __call__(self, rgb: UInt8, device: torch.device, dtype: torch.dtype) -> torch.Tensor:
        """(H, W, 3) uint8 as (1, 3, height, width), normalised."""
        pixels = to_device(rgb, device).permute(2, 0, 1)[None].float()
        height, width = rgb.shape[:2]
        if self.fit == "square":
            side = max(height, width)
            pixels = torch.nn.functional.pad(pixels, (0, side - width, 0, side - height))
        size = self.size_of(height, width)
        if pixels.shape[-2:] != size:
            pixels = resize(pixels, size, antialias=True)
        mean, std = (
            torch.tensor(values, device=device).view(1, 3, 1, 1) for values in (self.mean, self.std)
        )
        return ((pixels / 255 - mean) / std).to(dtype)


def _read(content: dict[str, Any], default: Preprocessing) -> Preprocessing:
    size = content.get("size", {})
    if isinstance(size, int):  # of DETR, as older versions of transformers saved it
        size = {"shortest_edge": size, "longest_edge": content.get("max_size", DETR_LONGEST_PX)}
    height = int(size.get("height", size.get("shortest_edge", default.height)))
    width = int(size.get("width", size.get("longest_edge", default.width)))
    edges = "shortest_edge" in size
    fit: Any = "edges" if edges else "square" if _is_owl(content) else default.fit
    if not content.get("do_normalize", False):
        return Preprocessing(height, width, fit=fit)
    # Some processors normalise values in [0, 255].
    unit = 1.0 if content.get("do_rescale", True) else 255.0
    red, green, blue = (float(value) / unit for value in content.get("image_mean", default.mean))
    mean = red, green, blue
    red, green, blue = (float(value) / unit for value in content.get("image_std", default.std))
    return Preprocessing(height, width, mean, (red, green, blue), fit)


def _is_owl(content: dict[str, Any]) -> bool:
    """Whether the processor is that of OWLv2, the one that pads an image to a square."""
    return str(content.get("image_processor_type", "")).startswith("Owlv2")


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
