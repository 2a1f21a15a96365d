"""Segmenter for RGB-D images without a network."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import read_only
from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.perception.superpixels.box_cut import cut_boxes
from deworldsg_ros.perception.superpixels.mask_upsampling import upsample_labels
from deworldsg_ros.perception.superpixels.regions import find_regions, reduce_frame
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8
from deworldsg_ros.scene.camera import Intrinsics

# Cells across the image. Fewer cells lose chair legs, more cost time.
TARGET_WIDTH = 213


class RgbdSegmenter:
    """The visible surface of the object in each box, from colour and depth, all boxes jointly."""

    def __init__(self) -> None:
        # Compile the kernels now, so that the first image does not wait.
        side = 24
        self.segment(
            np.zeros((side, side, 3), dtype=np.uint8),
            np.ones((side, side), dtype=np.float32),
            Intrinsics(side, side, side / 2, side / 2, side, side),
            # In the small box lies no whole region, in the large one there is one.
            np.array([[4.0, 4.0, 16.0, 16.0], [0.0, 0.0, side, side]]),
        )

    def segment(
        self,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        boxes_xyxy: Float64,
    ) -> list[MaskPatch]:
        """One mask for each box; see `Segmenter`. Masks do not overlap."""
        if len(boxes_xyxy) == 0:
            return []
        rgb, depth_m = read_only(rgb), read_only(depth_m)
        height, width = depth_m.shape
        stride = max(1, round(width / TARGET_WIDTH))
        cells = reduce_frame(rgb, depth_m, intrinsics, stride)
        regions = find_regions(cells)
        rows, columns = regions.labels.shape
        limits = np.array([columns - 1, rows - 1] * 2)
        boxes_cells = np.clip(np.round(boxes_xyxy) // stride, 0, limits).astype(np.int64)
        owner = cut_boxes(regions, boxes_cells)
        labels = upsample_labels(
            owner[regions.labels], cells.rgb, cells.points[..., 2], rgb, depth_m, stride
        )
        patches = []
        for row, box in enumerate(boxes_xyxy):
            left, top = np.clip(np.round(box[:2]), 0, [width, height]).astype(int)
            right, bottom = np.clip(np.round(box[2:]) + 1, 0, [width, height]).astype(int)
            patches.append(MaskPatch(int(top), int(left), labels[top:bottom, left:right] == row))
        return patches
