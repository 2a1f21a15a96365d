"""Pixels of each object without depth refinement: the paper's ablations (a) and (b)."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.lifting.pixels import Pixels
from deworldsg_ros.lifting.spatial import spatial_inliers
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt16


def mask_pixels(depth_m: Float32, instances: UInt16, valid_counts: Int64) -> list[Pixels]:
    """Every valid pixel of each object's mask: ablation (b).

    The arguments are those of `spatial_inliers`.
    """
    return spatial_inliers(depth_m, instances, valid_counts, 0.0, np.inf)


def box_pixels(depth_m: Float32, boxes_xyxy: Float64) -> list[Pixels]:
    """Every valid pixel of each object's box: ablation (a).

    Boxes may overlap; a pixel then belongs to several objects.

    Args:
        depth_m: (H, W) float32 metres, 0 = invalid.
        boxes_xyxy: (n, 4) pixels; a box contains the pixels whose centres lie in it.
    """
    height, width = depth_m.shape
    objects = []
    for x1, y1, x2, y2 in boxes_xyxy:
        left, top = max(int(np.ceil(x1)), 0), max(int(np.ceil(y1)), 0)
        right, bottom = min(int(np.floor(x2)) + 1, width), min(int(np.floor(y2)) + 1, height)
        box_m = depth_m[top:bottom, left:right]
        rows, columns = np.nonzero(box_m > 0)
        objects.append(
            Pixels(
                np.add(columns, left, dtype=np.int32),
                np.add(rows, top, dtype=np.int32),
                box_m[rows, columns],
            )
        )
    return objects
