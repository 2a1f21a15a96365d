"""The surface beneath the bottom edge of each object, as the image shows it."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel, read_only
from deworldsg_ros.scene.arrays import Float32, Float64, UInt16
from deworldsg_ros.scene.camera import Intrinsics

# Depth at the border of a mask is unreliable: it is read this far from it, on either side.
BORDER_PX = 2
# The surface beneath is looked for within this distance of the edge.
REACH_PX = 6
# The border of a mask is its bottom edge where it is at most this far above the object's lowest
# points. The surface beneath is at most this far from them in height: depth noise and the slope of
# a few pixels.
HEIGHT_M = 0.06
# A surface that is nearer by more than this hides the bottom; one that is farther is behind it.
DEPTH_STEP_M = 0.15
# A shorter visible edge may not be representative.
MIN_EDGE_PX = 5


def surfaces_beneath(
    depth_m: Float32,
    intrinsics: Intrinsics,
    instances: UInt16,
    up_camera: Float64,
    low_m: Float64,
) -> Float64:
    """Fraction (n, n) of the bottom edge of i below which, in the image, a surface of j continues.

    A support is in contact with the bottom of an object. Below the object's bottom edge the image
    therefore shows the support, at the same height and depth.

    Args:
        depth_m: (H, W) float32, metres; 0 = invalid.
        intrinsics: of the depth.
        instances: (H, W) uint16, k = k-th object.
        up_camera: (3,) unit vector against gravity, camera frame.
        low_m: (n,) height of the lowest points of the objects 1..n, metres above the camera.

    Returns:
        Row i is NaN if hardly any of the bottom edge of i is visible.
    """
    # A pixel (u, v) at depth z is z (a u + b v + c) above the camera.
    a, b = up_camera[0] / intrinsics.fx, up_camera[1] / intrinsics.fy
    height = np.array([a, b, up_camera[2] - a * intrinsics.cx - b * intrinsics.cy])
    return _surfaces_beneath(
        read_only(depth_m),
        read_only(instances),
        height,
        _down_in_image(up_camera),
        np.ascontiguousarray(low_m),
    )


def _down_in_image(up_camera: Float64) -> tuple[int, int]:
    """The step in rows and columns, of one pixel, that is nearest to the downward direction."""
    if abs(up_camera[1]) >= abs(up_camera[0]):
        return (-1, 0) if up_camera[1] > 0 else (1, 0)
    return (0, -1) if up_camera[0] > 0 else (0, 1)


@kernel
def _rise(height: Float64, depth: float, v: int, u: int) -> float:
    """Height of pixel (u, v) at a depth over the camera, metres."""
    return depth * (height[0] * u + height[1] * v + height[2])


@kernel
def _pixel_beneath(
    depth_m: Float32, instances: UInt16, v: int, u: int, down: tuple[int, int]
) -> tuple[int, int]:
    """The first pixel below the edge at (u, v) with depth that is not of the same object.

    It is (v, u) itself if none is within reach.
    """
    for step in range(1 + BORDER_PX, 1 + REACH_PX):
        y, x = v + step * down[0], u + step * down[1]
        if instances[y, x] != instances[v, u] and depth_m[y, x] > 0:
            return y, x
    return v, u


@kernel
def _surfaces_beneath(
    depth_m: Float32,
    instances: UInt16,
    height: Float64,
    down: tuple[int, int],
    low_m: Float64,
) -> Float64:
    """`surfaces_beneath`, for the height coefficients and the downward step of the image."""
    rows, columns = instances.shape
    count = len(low_m)
    edge = np.zeros(count, np.float64)
    beneath = np.zeros((count, count), np.float64)
    # Both ends of a step from inside the mask to the surface beneath are inside the image.
    margin_v, margin_u = REACH_PX * abs(down[0]), REACH_PX * abs(down[1])
    for v in range(margin_v, rows - margin_v):
        for u in range(margin_u, columns - margin_u):
            label = instances[v, u]
            if not 0 < label <= count or instances[v + down[0], u + down[1]] == label:
                continue
            y, x = v - BORDER_PX * down[0], u - BORDER_PX * down[1]
            z, low = depth_m[y, x], low_m[label - 1]
            inside = instances[y, x] == label and z > 0
            if not inside or _rise(height, z, y, x) > low + HEIGHT_M:
                continue
            y, x = _pixel_beneath(depth_m, instances, v, u, down)
            other, other_z = instances[y, x], depth_m[y, x]
            if other == label or other_z < z - DEPTH_STEP_M:
                continue  # something in front hides the bottom
            edge[label - 1] += 1.0
            level = abs(_rise(height, other_z, y, x) - low) < HEIGHT_M
            if level and other_z < z + DEPTH_STEP_M and 0 < other <= count:
                beneath[label - 1, other - 1] += 1.0
    for row in range(count):
        for other in range(count):
            beneath[row, other] /= edge[row] if edge[row] >= MIN_EDGE_PX else np.nan
    return beneath
