"""Small rigid motions."""

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
