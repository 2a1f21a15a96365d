"""Geometric neighbours among the objects of a frame (Eq. 8)."""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.scene.arrays import Float64, Int64


def geometric_costs(boxes_xyxy: Float64, depths_m: Float64, width: int, height: int) -> Float64:
    """Geometric cost of every pair of a frame's objects (Eq. 8).

    cost = |c_i - c_j| / (2 D) + |z_i - z_j|, with box centres c in pixels, the image diagonal D in
    pixels, and mean depths z in metres. Like the paper, it adds a ratio to a length in metres.

    Args:
        boxes_xyxy: (n, 4) float64 pixels.
        depths_m: (n,) float64, mean depth of each object's inliers in the camera frame.
        width: image width in pixels.
        height: image height in pixels.

    Returns:
        (n, n) float64, symmetric, zero diagonal.
    """
    centres = (boxes_xyxy[:, :2] + boxes_xyxy[:, 2:]) / 2
    offsets = centres[:, None, :] - centres[None, :, :]
    distances_px = np.hypot(offsets[..., 0], offsets[..., 1])
    depth_gaps_m = np.abs(depths_m[:, None] - depths_m[None, :])
    costs: Float64 = 0.5 * distances_px / math.hypot(width, height) + depth_gaps_m
    return costs


def neighbour_pairs(
    boxes_xyxy: Float64, depths_m: Float64, width: int, height: int, threshold: float
) -> tuple[Int64, Float64]:
    """Ordered pairs whose geometric cost is strictly below a threshold (Eq. 8).

    Args:
        boxes_xyxy: (n, 4) float64 pixels.
        depths_m: (n,) float64, as in `geometric_costs`.
        width: image width in pixels.
        height: image height in pixels.
        threshold: of the cost; 0.45 in the paper.

    Returns:
        pairs (m, 2) int64 of rows, both directions of each neighbour pair, in lexicographic
        order; and their costs (m,) float64.
    """
    costs = geometric_costs(boxes_xyxy, depths_m, width, height)
    near = costs < threshold
    np.fill_diagonal(near, False)
    pairs = np.argwhere(near).astype(np.int64, copy=False).reshape(-1, 2)
    return pairs, costs[pairs[:, 0], pairs[:, 1]]
