"""Triangle meshes for the 3D view: ellipsoids and arrow heads."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.view.geometry import SIGMAS, principal_axes

# Thinner ellipsoids are invisible from the side.
LEAST_SEMI_AXIS_M = 0.006
HEAD_SIDES = 10


@lru_cache(maxsize=4)
def unit_sphere(subdivisions: int) -> tuple[Float64, Int64]:
    """Icosphere: vertices (v, 3) on the unit sphere and triangles (f, 3)."""
    golden = (1 + 5**0.5) / 2
    corners = [
        (s * a, t * b, 0.0)[shift:] + (s * a, t * b, 0.0)[:shift]
        for shift in range(3)
        for a, b in ((1.0, golden),)
        for s in (-1, 1)
        for t in (-1, 1)
    ]
    vertices = np.array(corners)
    edge = min(float(np.linalg.norm(vertices[0] - other)) for other in vertices[1:])
    near = np.linalg.norm(vertices[:, None] - vertices[None], axis=2) < edge * 1.01
    triangles = np.array(
        [
            (i, j, k)
            for i in range(12)
            for j in range(i + 1, 12)
            for k in range(j + 1, 12)
            if near[i, j] and near[j, k] and near[i, k]
        ]
    )
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    for _ in range(subdivisions):
        vertices, triangles = _subdivide(vertices, triangles)
    return vertices, _facing_out(vertices, triangles)


def _subdivide(vertices: Float64, triangles: Int64) -> tuple[Float64, Int64]:
    sides = np.sort(
        np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    )
    unique, inverse = np.unique(sides, axis=0, return_inverse=True)
    middles = vertices[unique].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    a, b, c = triangles.T
    ab, bc, ca = inverse.reshape(3, -1) + len(vertices)
    return np.concatenate([vertices, middles]), np.concatenate(
        [
            np.stack(corner, axis=1)
            for corner in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))
        ]
    )


def _facing_out(vertices: Float64, triangles: Int64) -> Int64:
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    inwards = np.einsum("fi,fi->f", np.cross(b - a, c - a), a) < 0
    return np.where(inwards[:, None], triangles[:, ::-1], triangles)


def ellipsoid(mean: Float64, covariance: Float64, subdivisions: int) -> tuple[Float64, Int64]:
    """Surface at SIGMAS standard deviations: vertices (v, 3) metres and triangles (f, 3)."""
    vertices, triangles = unit_sphere(subdivisions)
    deviations, axes = principal_axes(covariance)
    semi_axes = np.maximum(SIGMAS * deviations, LEAST_SEMI_AXIS_M)
    return mean + (vertices * semi_axes) @ axes.T, triangles


def arrow_head(tip: Float64, direction: Float64, length_m: float) -> tuple[Float64, Int64]:
    """Cone with a tip along a direction (not zero): vertices (v, 3), triangles (f, 3)."""
    along = direction / np.linalg.norm(direction)
    seed = np.eye(3)[int(np.abs(along).argmin())]
    side = np.cross(along, seed)
    side /= np.linalg.norm(side)
    angles = 2 * np.pi * np.arange(HEAD_SIDES) / HEAD_SIDES
    rim = np.outer(np.cos(angles), side) + np.outer(np.sin(angles), np.cross(along, side))
    base = tip - length_m * along
    vertices = np.vstack([tip, base + 0.36 * length_m * rim])
    side_index = np.arange(HEAD_SIDES)
    mantle = np.stack(
        [np.zeros_like(side_index), side_index + 1, (side_index + 1) % HEAD_SIDES + 1], axis=1
    )
    return vertices, mantle


def joined(parts: list[tuple[Float64, Int64]]) -> tuple[Float64, Int64]:
    """Several meshes as one: vertices (v, 3), triangles (f, 3)."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    return (
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([triangles + offset for (_, triangles), offset in zip(parts, offsets)]),
    )
