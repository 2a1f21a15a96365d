"""What SAM and SAM 2 share as segmenters: boxes decoded in chunks, logits made into masks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch

from deworldsg_ros.checkpoints.card import IMAGENET_MEAN, IMAGENET_STD
from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
)
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, UInt8
from deworldsg_ros.scene.camera import Intrinsics

TOO_LITTLE_MEMORY = (
    "lower perception.sam_box_batch, choose a smaller perception.sam_image_size (SAM 2) or "
    "perception.segmenter_path, or free the device"
)


class BoxPromptedSegmenter(ABC):
    """Segmenter on a network that takes boxes as prompts.

    An image is encoded once; its boxes are decoded `perception.sam_box_batch` at a time. Depth and
    class names are not used.

    Args:
        config: the section `perception`: `segmenter_path`, `device`, `sam_image_size`,
            `sam_box_batch`.

    Raises:
        ConfigurationError: no checkpoint, another architecture, no CUDA, no memory.
    """

    mean, std = IMAGENET_MEAN, IMAGENET_STD

    def __init__(self, config: PerceptionConfig) -> None:
        source = CheckpointSource.find(
            "perception.segmenter_path",
            config.segmenter_path,
            local_files_only=config.local_files_only,
        )
        self.device = choose_device("perception.device", config.device)
        self.dtype = choose_dtype(self.device)
        self._chunk = config.sam_box_batch
        model, self.image_size = self._load(source, config.sam_image_size)
        with enough_memory("loading the segmenter", TOO_LITTLE_MEMORY):
            self.model = model.to(self.device, self.dtype)
            # What is allocated and tuned at the first image is so now.
            side = self.image_size
            boxes = np.tile([0.0, 0.0, side - 1.0, side - 1.0], (self._chunk, 1))
            self._masks(np.zeros((side, side, 3), np.uint8), boxes)

    @abstractmethod
    def _load(self, source: CheckpointSource, image_size: int) -> tuple[Any, int]:
        """The network and the edge of its input; `image_size` 0 = the checkpoint's."""

    @abstractmethod
    def _input(self, rgb: UInt8) -> torch.Tensor:
        """(1, 3, S, S) of an image."""

    @abstractmethod
    def _scale(self, height: int, width: int) -> tuple[float, float]:
        """Input pixels an image pixel, along x and y."""

    @abstractmethod
    def _at_image_size(self, logits: torch.Tensor, height: int, width: int) -> torch.Tensor:
        """Logits (n, 1, s, s) of the input as (n, 1, height, width) of the image."""

    def segment(
        self,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        boxes_xyxy: Float64,
        class_names: list[str] | None = None,
    ) -> list[MaskPatch]:
        """The object in each box; see `Segmenter`."""
        return [as_patch(mask) for mask in self._masks(rgb, boxes_xyxy)] if len(boxes_xyxy) else []

    @torch.inference_mode()
    def _masks(self, rgb: UInt8, boxes_xyxy: Float64) -> Bool:
        """(n, H, W) masks of n >= 1 boxes."""
        height, width = rgb.shape[:2]
        scale = np.tile(self._scale(height, width), 2)
        boxes = torch.from_numpy((boxes_xyxy * scale).astype(np.float32))
        # Half precision would round coordinates to half a pixel.
        boxes = boxes.to(self.device)
        embeddings = self.model.get_image_embeddings(self._input(rgb))
        masks = []
        for start in range(0, len(boxes), self._chunk):
            output = self.model(
                image_embeddings=embeddings,
                input_boxes=boxes[None, start : start + self._chunk],
                multimask_output=False,
            )
            # (1, boxes, 1, s, s): a box is one prompt, and gets one mask.
            logits = output.pred_masks[0].float()
            masks.append((self._at_image_size(logits, height, width)[:, 0] > 0).cpu().numpy())
        return np.concatenate(masks)


def as_patch(mask: Bool) -> MaskPatch:
    """The part of a mask (H, W) that holds all its pixels."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return MaskPatch(0, 0, np.zeros((0, 0), bool))
    top, left = int(rows[0]), int(columns[0])
    return MaskPatch(top, left, mask[top : rows[-1] + 1, left : columns[-1] + 1].copy())
