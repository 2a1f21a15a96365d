"""Pixels of each object without depth refinement: the paper's ablations (a) and (b)."""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.lifting.pixels import Pixels
from deworldsg_ros.lifting.spatial import spatial_inliers
from deworldsg_ros.scene.arrays import Float32, Float64, Int32


def mask_pixels(depth_m: Float32, runs: Int32) -> Pixels:
    """Every valid pixel of an object's mask: ablation (b).

    The arguments are those of `spatial_inliers`.
    """
    return spatial_inliers(depth_m, runs, 0.0, np.inf)


def box_pixels(depth_m: Float32, box_xyxy: Float64) -> Pixels:
    """Every valid pixel of an object's box: ablation (a).

    Boxes may overlap; a pixel then belongs to several objects.

    Args:
        depth_m: (H, W) float32 metres, 0 = invalid.
        box_xyxy: (4,) pixels; a box contains the pixels whose centres lie in it.
    """
    height, width = depth_m.shape
    x1, y1, x2, y2 = box_xyxy.tolist()
    left, top = max(math.ceil(x1), 0), max(math.ceil(y1), 0)
    right, bottom = min(math.floor(x2) + 1, width), min(math.floor(y2) + 1, height)
    box_m = depth_m[top:bottom, left:right]
    rows, columns = np.nonzero(box_m > 0)
    return Pixels(
        np.add(columns, left, dtype=np.int32),
        np.add(rows, top, dtype=np.int32),
        box_m[rows, columns],
    )
