"""Small rigid motions, and the linear system of point-to-plane registration."""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.scene.arrays import Float64


def rigid_motion(translation_m: Float64, rotation_vector: Float64) -> Float64:
    """Rigid transform (4, 4) of a translation and a rotation vector, radians (Rodrigues)."""
    T = np.eye(4)
    T[:3, 3] = translation_m
    angle = float(np.linalg.norm(rotation_vector))
    if angle > 0:
        x, y, z = rotation_vector / angle
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        T[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return T


def rotation_angle_deg(rotation: Float64) -> float:
    """Angle of a rotation matrix (3, 3), degrees."""
    return math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(rotation)) - 1) / 2))))


def point_to_plane(
    points: Float64, normals: Float64, distances: Float64, outlier_m: float
) -> tuple[Float64, Float64]:
    """Linear system of one Gauss-Newton step that moves points onto planes.

    The step (ω, t), a rotation vector about the origin and a translation, minimises
    Σ w (d - (x × n) · ω - n · t)².

    Args:
        points: (k, 3) x, metres.
        normals: (k, 3) n, unit normals of the planes.
        distances: (k,) d, signed distances from the points to the planes, metres.
        outlier_m: larger distances have small weights w (Cauchy).

    Returns:
        Jacobian (k, 6) with rows (x × n, n), and weights (k,) in (0, 1].
    """
    jacobian = np.concatenate((np.cross(points, normals), normals), axis=1)
    weights = 1.0 / (1.0 + (distances / outlier_m) ** 2)
    return jacobian, weights
