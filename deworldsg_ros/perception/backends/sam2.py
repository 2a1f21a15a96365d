"""SAM 2 and SAM 2.1 on torch: the paper's segmenter."""

from __future__ import annotations

from typing import Any

import torch
from transformers import Sam2Config, Sam2Model

from deworldsg_ros.checkpoints.loading import CheckpointSource
from deworldsg_ros.perception.networks.box_prompts import BoxPromptedSegmenter
from deworldsg_ros.perception.networks.image_tensors import Preprocessing, resize
from deworldsg_ros.scene.arrays import UInt8
from deworldsg_ros.scene.errors import ConfigurationError

# The published checkpoints are those of the video model; its image part is used.
ARCHITECTURES = ("sam2", "sam2_video")
# Three feature maps of strides 4, 8, 16, and a last stage of the backbone of stride 32.
STRIDES = (4, 8, 16)
LEAST_STRIDE = 32


class Sam2Segmenter(BoxPromptedSegmenter):
    """Boxes to masks; the image is stretched to a square of `perception.sam_image_size`.

    512 is five times faster than the published 1024, and coarser: masks are found on a quarter of
    the edge.
    """

    def _load(self, source: CheckpointSource, image_size: int) -> tuple[Any, int]:
        found = source.config(ARCHITECTURES)
        config: Any = Sam2Config(
            vision_config=found.vision_config.to_dict(),
            prompt_encoder_config=_fields(found.prompt_encoder_config),
            mask_decoder_config=_fields(found.mask_decoder_config),
        )
        trained = _edge(config.prompt_encoder_config.image_size)
        edge = image_size or trained
        if edge % LEAST_STRIDE or edge < LEAST_STRIDE:
            raise ConfigurationError(
                f"perception.sam_image_size is {edge}: wanted a multiple of {LEAST_STRIDE}"
            )
        config.prompt_encoder_config.image_size = edge
        config.vision_config.backbone_config.image_size = [edge, edge]
        config.vision_config.backbone_feature_sizes = [
            [edge // stride, edge // stride] for stride in STRIDES
        ]
        return source.load(Sam2Model, config), edge

    def _input(self, rgb: UInt8) -> torch.Tensor:
        preprocess = Preprocessing(self.image_size, self.image_size, self.mean, self.std)
        return preprocess(rgb, self.device, self.dtype)

    def _scale(self, height: int, width: int) -> tuple[float, float]:
        return self.image_size / width, self.image_size / height

    def _at_image_size(self, logits: torch.Tensor, height: int, width: int) -> torch.Tensor:
        return resize(logits, (height, width))


def _fields(part: Any) -> dict[str, Any]:
    """A part of the video model's configuration without its name, for the image model's."""
    fields: dict[str, Any] = part.to_dict()
    fields.pop("model_type", None)
    return fields


def _edge(size: Any) -> int:
    return int(size if isinstance(size, int) else size[0])
