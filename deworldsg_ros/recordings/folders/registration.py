"""Registration of a depth image to the colour camera."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Float64, UInt16
from deworldsg_ros.scene.camera import Intrinsics


def register_depth(
    depth_mm: UInt16, depth_camera: Intrinsics, color_camera: Intrinsics, T_color_depth: Float64
) -> UInt16:
    """Project depth into the colour camera; of several surfaces in a pixel, the nearest wins.

    Args:
        depth_mm: (H, W) uint16 of the depth camera; 0 = invalid.
        depth_camera: its intrinsics.
        color_camera: intrinsics of the output image.
        T_color_depth: (4, 4) float64, depth camera to colour camera, metres.

    Returns:
        (H', W') uint16 millimetres on the grid of the colour camera; 0 = no depth.
    """
    rows, columns = np.nonzero(depth_mm)
    z = depth_mm[rows, columns] * 1e-3
    points_depth = np.stack(
        [
            (columns - depth_camera.cx) / depth_camera.fx * z,
            (rows - depth_camera.cy) / depth_camera.fy * z,
            z,
        ]
    )
    x, y, z = T_color_depth[:3, :3] @ points_depth + T_color_depth[:3, 3:]
    front = z > 1e-3
    x, y, z = x[front], y[front], z[front]
    u = np.rint(color_camera.fx * x / z + color_camera.cx).astype(np.int64)
    v = np.rint(color_camera.fy * y / z + color_camera.cy).astype(np.int64)
    inside = (u >= 0) & (u < color_camera.width) & (v >= 0) & (v < color_camera.height)
    nearest = np.full(color_camera.height * color_camera.width, 65535, np.uint16)
    z_mm = np.minimum(np.rint(z[inside] * 1e3), 65534).astype(np.uint16)
    np.minimum.at(nearest, v[inside] * color_camera.width + u[inside], z_mm)
    nearest[nearest == 65535] = 0
    return nearest.reshape(color_camera.height, color_camera.width)
