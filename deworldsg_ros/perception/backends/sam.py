"""SAM, SAM 2.1 (the paper's segmenter) and SAM 3 on torch: boxes become masks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from transformers import Sam2Config, Sam2Model, Sam3TrackerConfig, Sam3TrackerModel, SamModel

from deworldsg_ros.checkpoints.cards import IMAGENET_MEAN, IMAGENET_STD
from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
    in_best_precision,
    noise_pattern,
    require_finite,
)
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.backends.image_tensors import Preprocessing, resize
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, UInt8
from deworldsg_ros.scene.camera import Intrinsics, MaskPatch

# --- Common part of SAM and SAM 2: boxes are decoded in batches, logits become masks.

# Boxes decoded at once. A frame has about 12 objects, and so needs one pass; the limit bounds the
# memory of crowded frames.
BOX_BATCH = 16


class BoxPromptedSegmenter(ABC):
    """Segmenter on a network that takes boxes as prompts.

    An image is encoded once, and its boxes are decoded in batches. Depth is not used.

    Args:
        config: the section `perception`: `segmenter_path` and `device`.
        box_batch: boxes decoded at once.

    Raises:
        ConfigurationError: no checkpoint, another architecture, no CUDA, no memory.

    Attributes:
        wide_range: whether the network was trained in bfloat16 and runs in it on CUDA.
    """

    wide_range = False

    def __init__(self, config: PerceptionConfig, *, box_batch: int = BOX_BATCH) -> None:
        source = CheckpointSource.find("perception.segmenter_path", config.segmenter_path)
        self.device = choose_device("perception.device", config.device)
        self._box_batch = box_batch
        model, self.image_size = self._load(source)
        with enough_memory("loading the segmenter", "choose a smaller perception.segmenter_path"):
            half = choose_dtype(self.device, wide_range=self.wide_range)
            self.model, self.dtype = in_best_precision(
                model, self.device, half, self._test_logits, "the segmenter"
            )
            # The first pass allocates memory and tunes kernels; do it at start-up.
            side = self.image_size
            boxes = np.tile([0.0, 0.0, side - 1.0, side - 1.0], (box_batch, 1))
            self._masks(np.zeros((side, side, 3), np.uint8), boxes)

    @abstractmethod
    def _load(self, source: CheckpointSource) -> tuple[Any, int]:
        """The network, and the side of its square input in pixels."""

    @abstractmethod
    def _input(self, rgb: UInt8) -> torch.Tensor:
        """(1, 3, S, S) input of the network for an image (H, W, 3)."""

    @abstractmethod
    def _scale(self, height: int, width: int) -> tuple[float, float]:
        """Input pixels per image pixel, along x and y."""

    @abstractmethod
    def _at_image_size(self, logits: torch.Tensor, height: int, width: int) -> torch.Tensor:
        """Mask logits (n, 1, s, s) of the input, resampled to (n, 1, height, width)."""

    @torch.inference_mode()
    def _test_logits(self, model: Any, dtype: torch.dtype) -> torch.Tensor:
        """Mask logits of one box in a fixed image."""
        self.dtype, side = dtype, self.image_size
        embeddings = model.get_image_embeddings(self._input(noise_pattern(side, side, 3).numpy()))
        box = torch.tensor([[[0.2, 0.2, 0.8, 0.8]]], device=self.device) * side
        output = model(image_embeddings=embeddings, input_boxes=box, multimask_output=False)
        logits: torch.Tensor = output.pred_masks
        return logits

    def segment(
        self,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        boxes_xyxy: Float64,
    ) -> list[MaskPatch]:
        """One mask for each box; see `Segmenter`. Masks may overlap."""
        return [as_patch(mask) for mask in self._masks(rgb, boxes_xyxy)] if len(boxes_xyxy) else []

    @torch.inference_mode()
    def _masks(self, rgb: UInt8, boxes_xyxy: Float64) -> Bool:
        """(n, H, W) bool masks of n >= 1 boxes (n, 4), pixels."""
        height, width = rgb.shape[:2]
        scale = np.tile(self._scale(height, width), 2)
        # float32 on every device: half precision would round coordinates to half a pixel.
        boxes = torch.from_numpy((boxes_xyxy * scale).astype(np.float32)).to(self.device)
        embeddings = self.model.get_image_embeddings(self._input(rgb))
        masks = []
        for start in range(0, len(boxes), self._box_batch):
            output = self.model(
                image_embeddings=embeddings,
                input_boxes=boxes[None, start : start + self._box_batch],
                multimask_output=False,
            )
            # (1, boxes, 1, s, s): one mask for each box.
            require_finite(output.pred_masks, "segmenter_error", "the mask logits")
            logits = output.pred_masks[0].float()
            masks.append((self._at_image_size(logits, height, width)[:, 0] > 0).cpu().numpy())
        return np.concatenate(masks)


def as_patch(mask: Bool) -> MaskPatch:
    """The smallest patch that contains all pixels of a mask (H, W) bool."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return MaskPatch(0, 0, np.zeros((0, 0), bool))
    top, left = int(rows[0]), int(columns[0])
    return MaskPatch(top, left, mask[top : rows[-1] + 1, left : columns[-1] + 1].copy())


# --- SAM 2 and SAM 2.1 on torch: the paper's segmenter.

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


# --- SAM 3 on torch: the segmenter of the paper's released code. transformers has it since 5.0.

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


# --- SAM (version 1) on torch.


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
