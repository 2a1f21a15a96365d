"""SAM (the first) on torch, by the same protocol as SAM 2."""

from __future__ import annotations

from typing import Any

import torch
from transformers import SamModel

from deworldsg_ros.checkpoints.loading import CheckpointSource
from deworldsg_ros.perception.networks.box_prompts import BoxPromptedSegmenter
from deworldsg_ros.perception.networks.image_tensors import Preprocessing, resize
from deworldsg_ros.scene.arrays import UInt8
from deworldsg_ros.scene.errors import ConfigurationError


class SamSegmenter(BoxPromptedSegmenter):
    """Boxes to masks; the image keeps its shape, at the top left of the square input."""

    def _load(self, source: CheckpointSource, image_size: int) -> tuple[Any, int]:
        config = source.config(("sam",))
        edge = int(config.vision_config.image_size)
        if image_size not in (0, edge):
            raise ConfigurationError(
                f"perception.sam_image_size is {image_size} and SAM was trained for {edge} alone: "
                "set it to 0, or take a SAM 2"
            )
        return source.load(SamModel, config), edge

    def _input(self, rgb: UInt8) -> torch.Tensor:
        height, width = self._used(*rgb.shape[:2])
        pixels = Preprocessing(height, width, self.mean, self.std)(rgb, self.device, self.dtype)
        right, bottom = self.image_size - width, self.image_size - height
        return torch.nn.functional.pad(pixels, (0, right, 0, bottom))

    def _scale(self, height: int, width: int) -> tuple[float, float]:
        used_height, used_width = self._used(height, width)
        return used_width / width, used_height / height

    def _at_image_size(self, logits: torch.Tensor, height: int, width: int) -> torch.Tensor:
        used_height, used_width = self._used(height, width)
        whole = resize(logits, (self.image_size, self.image_size))
        return resize(whole[..., :used_height, :used_width], (height, width))

    def _used(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the input that the image fills."""
        scale = self.image_size / max(height, width)
        return max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))
