"""SAM (version 1) on torch."""

from __future__ import annotations

from typing import Any

import torch
from transformers import SamModel

from deworldsg_ros.checkpoints.card import IMAGENET_MEAN, IMAGENET_STD
from deworldsg_ros.checkpoints.loading import CheckpointSource
from deworldsg_ros.perception.networks.box_prompts import BoxPromptedSegmenter
from deworldsg_ros.perception.networks.image_tensors import Preprocessing, resize
from deworldsg_ros.scene.arrays import UInt8


class SamSegmenter(BoxPromptedSegmenter):
    """Boxes to masks. The image keeps its aspect ratio, at the top left of the square input."""

    def _load(self, source: CheckpointSource) -> tuple[Any, int]:
        config = source.config(("sam",))
        return source.load(SamModel, config), int(config.vision_config.image_size)

    def _input(self, rgb: UInt8) -> torch.Tensor:
        height, width = self._used(*rgb.shape[:2])
        preprocess = Preprocessing(height, width, IMAGENET_MEAN, IMAGENET_STD)
        right, bottom = self.image_size - width, self.image_size - height
        pixels = preprocess(rgb, self.device, self.dtype)
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
