"""Common part of SAM and SAM 2: boxes are decoded in batches, logits become masks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch

from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
)
from deworldsg_ros.checkpoints.precision import in_best_precision, noise_pattern, require_finite
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, UInt8
from deworldsg_ros.scene.camera import Intrinsics

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
