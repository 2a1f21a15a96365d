"""SAM 2 and SAM 2.1 on torch: the paper's segmenter."""

from __future__ import annotations

from typing import Any

import torch
from transformers import Sam2Config, Sam2Model

from deworldsg_ros.checkpoints.card import IMAGENET_MEAN, IMAGENET_STD
from deworldsg_ros.checkpoints.loading import CheckpointSource
from deworldsg_ros.perception.networks.box_prompts import BoxPromptedSegmenter
from deworldsg_ros.perception.networks.image_tensors import Preprocessing, resize
from deworldsg_ros.scene.arrays import UInt8

# transformers below 5 ties the two and saves the second one only.
SHARED_EMBEDDING = {
    "prompt_encoder.shared_embedding.positional_embedding": (
        "shared_image_embedding.positional_embedding"
    )
}


class Sam2Segmenter(BoxPromptedSegmenter):
    """Boxes to masks. The image is stretched to the square input."""

    wide_range = True

    def _load(self, source: CheckpointSource) -> tuple[Any, int]:
        # The published checkpoints are of the video model; only its image part is used.
        found = source.config(("sam2", "sam2_video"))
        config: Any = Sam2Config(
            vision_config=found.vision_config.to_dict(),
            prompt_encoder_config=fields(found.prompt_encoder_config),
            mask_decoder_config=fields(found.mask_decoder_config),
        )
        model = source.load(Sam2Model, config, copies=SHARED_EMBEDDING)
        return model, int(config.prompt_encoder_config.image_size)

    def _input(self, rgb: UInt8) -> torch.Tensor:
        preprocess = Preprocessing(self.image_size, self.image_size, IMAGENET_MEAN, IMAGENET_STD)
        return preprocess(rgb, self.device, self.dtype)

    def _scale(self, height: int, width: int) -> tuple[float, float]:
        return self.image_size / width, self.image_size / height

    def _at_image_size(self, logits: torch.Tensor, height: int, width: int) -> torch.Tensor:
        return resize(logits, (height, width))


def fields(part: Any) -> dict[str, Any]:
    """A part of the video model's configuration without its type name, for the image model."""
    fields: dict[str, Any] = part.to_dict()
    fields.pop("model_type", None)
    return fields
