"""Pixels of each object where a part of the stage is left out: the paper's ablation (a) and (b)."""

from __future__ import annotations

import cv2
import numpy as np

from deworldsg_ros.lifting.pixels import Pixels
from deworldsg_ros.lifting.spatial import spatial_inliers
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt16


def mask_pixels(depth_m: Float32, instances: UInt16, valid_counts: Int64) -> list[Pixels]:
    """Every valid pixel of each object's mask; arguments as of `spatial_inliers`."""
    return spatial_inliers(depth_m, instances, valid_counts, 0.0, np.inf)


def valid_pixels(depth_m: Float32) -> Bool:
    """(H, W) bool: pixels of a depth image with 0 for invalid that carry depth."""
    return np.asarray(depth_m > 0)


def smooth_pixels(depth_m: Float32, tau: float, epsilon_m: float) -> Bool:
    """(H, W) bool: pixels whose depth is near the median of their neighbourhood (Eq. 1)."""
    median_m = cv2.medianBlur(depth_m, 3).astype(np.float64)
    near = np.abs(depth_m - median_m) < tau * median_m + epsilon_m
    return np.asarray(near & (depth_m > 0))


def box_pixels(depth_m: Float32, kept: Bool, boxes_xyxy: Float64) -> list[Pixels]:
    """The kept pixels of each box, whatever lies in it; boxes may overlap.

    Args:
        depth_m: (H, W) float32 metres.
        kept: (H, W) bool, where depth is valid.
        boxes_xyxy: (n, 4) pixels; a pixel is in a box where its centre is.
    """
    height, width = depth_m.shape
    objects = []
    for x1, y1, x2, y2 in boxes_xyxy:
        left, top = max(int(np.ceil(x1)), 0), max(int(np.ceil(y1)), 0)
        right, bottom = min(int(np.floor(x2)) + 1, width), min(int(np.floor(y2)) + 1, height)
        rows, columns = np.nonzero(kept[top:bottom, left:right])
        depths_m = depth_m[top:bottom, left:right][rows, columns]
        objects.append(
            Pixels(
                np.add(columns, left, dtype=np.int32), np.add(rows, top, dtype=np.int32), depths_m
            )
        )
    return objects
