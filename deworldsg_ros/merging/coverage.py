"""How much of what a frame shows of a node lies in the mask of each object."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.merging.absence import (
    MIN_VISIBLE_POINTS,
    NEAR_M,
    SAMPLED_POINTS,
    THROUGH_FRACTION,
    THROUGH_M,
    in_camera,
)
from deworldsg_ros.merging.cell_beliefs import FrameArrays
from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.scene.frame_graph import DepthGrid
from deworldsg_ros.scene.nodes import NodeTable


def coverage(
    nodes: NodeTable,
    rows: Int64,
    values: Int64,
    T_camera_world: Float64,
    grid: DepthGrid | None,
    otherwise: Float64,
) -> Float64:
    """Fraction of the visible surface of each node that lies in the mask of each object.

    Args:
        nodes: the nodes of the graph.
        rows: (k,) rows of nodes.
        values: (n,) value of each object in the instances of the grid.
        T_camera_world: (4, 4) float64.
        grid: of the frame; None = not available.
        otherwise: (n, k) fractions for nodes of which the grid shows too little, and without
            instances for all.

    Returns:
        (n, k) float64 in [0, 1].
    """
    if grid is None or grid.instances is None or not len(values):
        return otherwise
    per_px, camera = 1.0 / grid.stride_px, grid.intrinsics
    return _coverage(
        nodes.surface_points_world,
        nodes.surface_counts,
        rows,
        values,
        (
            T_camera_world,
            grid.depth_mm,
            grid.instances,
            (camera.fx * per_px, camera.fy * per_px, camera.cx * per_px, camera.cy * per_px),
        ),
        otherwise,
    )


@kernel
def _coverage(
    points: Float32,
    counts: Int64,
    rows: Int64,
    values: Int64,
    frame: FrameArrays,
    otherwise: Float64,
) -> Float64:
    T, depth_mm, instances, (fx, fy, cx, cy) = frame
    height, width = depth_mm.shape
    object_of = np.full(values.max() + 1, -1, np.int64)
    for index in range(len(values)):
        object_of[values[index]] = index
    fractions = otherwise.copy()
    hits = np.empty(len(values), np.int64)
    for column in range(len(rows)):
        hits[:] = 0
        visible = 0
        # The points are in the order of a hash: the first ones are a sample.
        for place in range(min(counts[rows[column]], SAMPLED_POINTS)):
            x, y, z = points[rows[column], place]
            right, down, ahead = in_camera(T, np.float64(x), np.float64(y), np.float64(z))
            if ahead < NEAR_M:
                continue
            u, v = fx * right / ahead + cx, fy * down / ahead + cy
            if u < 0.0 or v < 0.0 or u >= width or v >= height:
                continue
            measured_m = 0.001 * depth_mm[int(v), int(u)]
            if measured_m == 0.0 or abs(measured_m - ahead) > THROUGH_M + THROUGH_FRACTION * ahead:
                continue
            visible += 1
            value = instances[int(v), int(u)]
            if value < len(object_of) and object_of[value] >= 0:
                hits[object_of[value]] += 1
        if visible >= MIN_VISIBLE_POINTS:
            for index in range(len(values)):
                fractions[index, column] = hits[index] / visible
    return fractions
