"""Depth refinement in the spatial domain (Eq. 1)."""

from __future__ import annotations

import cv2
import numpy as np

from deworldsg_ros.kernels import kernel, read_only
from deworldsg_ros.lifting.pixels import Pixels
from deworldsg_ros.scene.arrays import Float32, Int32, Int64, UInt16, UInt64


def spatial_inliers(
    depth_m: Float32,
    instances: UInt16,
    valid_counts: Int64,
    tau: float,
    epsilon_m: float,
) -> list[Pixels]:
    """Pixels of each object whose depth is near the median of their 3x3 neighbourhood (Eq. 1).

    M_spatial = {p in M : |D(p) - D~(p)| < τ D~(p) + ε}. Invalid pixels count as 0 in the median
    and are never inliers. The image border is replicated. Depths are float32, the comparison is in
    float64.

    Args:
        depth_m: (H, W) float32 metres, 0 = invalid.
        instances: (H, W) uint16, 0 = no object, k = k-th object.
        valid_counts: result of `valid_pixel_counts`.
        tau: relative tolerance.
        epsilon_m: absolute tolerance, metres.
    """
    median_m = cv2.medianBlur(depth_m, 3)
    # One slot more than valid pixels for each object: the kernel also writes rejected pixels.
    slots = np.append(valid_counts[1:] + 1, 0)
    starts = np.cumsum(slots) - slots
    columns, rows, depths_m, ends = _scatter_inliers(
        read_only(depth_m, np.float32),
        read_only(median_m, np.float32),
        read_only(instances, np.uint16),
        starts,
        tau,
        epsilon_m,
    )
    parts = [slice(start, end) for start, end in zip(starts, ends)]
    return [Pixels(columns[part], rows[part], depths_m[part]) for part in parts]


@kernel
def _scatter_inliers(
    depth_m: Float32,
    median_m: Float32,
    instances: UInt16,
    starts: Int64,
    tau: float,
    epsilon_m: float,
) -> tuple[Int32, Int32, Float32, UInt64]:
    """One pass over the image.

    Object k has the slots starts[k - 1] to starts[k]; its inliers are in starts[k - 1] to
    ends[k - 1].
    """
    objects = starts.size - 1
    ends = starts[:-1].astype(np.uint64)
    columns = np.empty(starts[-1], np.int32)
    rows = np.empty(starts[-1], np.int32)
    depths_m = np.empty(starts[-1], np.float32)
    for row in range(depth_m.shape[0]):
        column = 0
        while column < depth_m.shape[1]:
            label = instances[row, column]
            if label == 0 or label > objects:
                column += 1
                continue
            end = ends[label - 1]
            while column < depth_m.shape[1] and instances[row, column] == label:
                depth = np.float64(depth_m[row, column])
                median = np.float64(median_m[row, column])
                columns[end] = column
                rows[end] = row
                depths_m[end] = depth_m[row, column]
                inlier = (depth > 0.0) & (abs(depth - median) < tau * median + epsilon_m)
                end += np.uint64(inlier)
                column += 1
            ends[label - 1] = end
    return columns, rows, depths_m, ends
