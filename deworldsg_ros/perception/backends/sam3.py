"""SAM 3 on torch: the segmenter of the paper's released code. transformers has it since 5.0."""

from __future__ import annotations

from typing import Any

import torch
from transformers import Sam3TrackerConfig, Sam3TrackerModel

from deworldsg_ros.checkpoints.loading import CheckpointSource
from deworldsg_ros.perception.backends.sam2 import SHARED_EMBEDDING, Sam2Segmenter, fields
from deworldsg_ros.perception.networks.image_tensors import Preprocessing
from deworldsg_ros.scene.arrays import UInt8

# The published processor maps [0, 1] to [-1, 1].
MEAN_STD = (0.5, 0.5, 0.5)

# The published checkpoint shares the vision encoder between detector and tracker. transformers 5.23
# has these rules, and does not apply the last one.
PUBLISHED_NAMES = {
    r"^detector_model\.vision_encoder\.backbone\.": "vision_encoder.backbone.",
    r"^tracker_neck\.": "vision_encoder.neck.",
    r"^tracker_model\.(.+)": r"\1",
}


class Sam3Segmenter(Sam2Segmenter):
    """Boxes to masks, with the part of SAM 3 that takes boxes of objects as prompts (its tracker).

    The part that finds all objects of a text or an example is not used.
    """

    def _load(self, source: CheckpointSource) -> tuple[Any, int]:
        found = source.config(("sam3_tracker", "sam3_tracker_video", "sam3_video"))
        if found.model_type == "sam3_video":  # the published checkpoint: detector and tracker
            vision, found = found.detector_config.vision_config, found.tracker_config
        else:
            vision = found.vision_config
        config: Any = Sam3TrackerConfig(
            vision_config=vision.to_dict(),
            prompt_encoder_config=fields(found.prompt_encoder_config),
            mask_decoder_config=fields(found.mask_decoder_config),
        )
        model = source.load(
            Sam3TrackerModel, config, copies=SHARED_EMBEDDING, renamed=PUBLISHED_NAMES
        )
        return model, int(config.prompt_encoder_config.image_size)

    def _input(self, rgb: UInt8) -> torch.Tensor:
        preprocess = Preprocessing(self.image_size, self.image_size, MEAN_STD, MEAN_STD)
        return preprocess(rgb, self.device, self.dtype)
