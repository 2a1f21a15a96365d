"""Diffuse light, computed once per vertex. It does not depend on the viewer.

The value is irradiance / π, so radiance = albedo × value. Direct light comes from the window, the
sun, the lamps and the ceiling panels, with shadows. Indirect light bounces four times between
surfaces, along stratified cosine-weighted rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix

from .room import HALF_X, HEIGHT, WINDOW_H, WINDOW_W, WINDOW_Y, WINDOW_Z
from .scene import Scene

# Rays per call of the ray caster; bounds its memory.
CHUNK = 400_000
# Rays start this far from their surface, so that they do not hit it.
OFFSET_M = 1.5e-3


@dataclass(frozen=True)
class AreaLight:
    """Rectangle that emits towards `along_u × along_v`. Radiance in units of the scene."""

    corner: tuple[float, float, float]
    along_u: tuple[float, float, float]
    along_v: tuple[float, float, float]
    radiance: tuple[float, float, float]


LIGHTS = (
    AreaLight(
        (-HALF_X - 0.14, WINDOW_Y - WINDOW_W / 2, WINDOW_Z),
        (0, WINDOW_W, 0), (0, 0, WINDOW_H), (6.5, 7.4, 8.6),
    ),
    AreaLight((-1.30, 0.25, 1.84), (0.3, 0, 0), (0, -0.3, 0), (26.0, 22.0, 16.0)),
    AreaLight((0.7, 0.3, HEIGHT - 0.02), (1.8, 0, 0), (0, -1.4, 0), (4.2, 3.8, 3.2)),
    AreaLight((-1.9, 1.9, HEIGHT - 0.02), (1.4, 0, 0), (0, -0.7, 0), (4.4, 4.0, 3.4)),
    AreaLight((-1.9, -1.0, HEIGHT - 0.02), (1.4, 0, 0), (0, -0.8, 0), (3.4, 3.1, 2.6)),
    AreaLight((2.70, -2.15, 1.36), (0.2, 0, 0), (0, -0.2, 0), (14.0, 11.0, 7.0)),
)  # fmt: skip
SUN_DIRECTION = np.array([-0.78, -0.16, 0.60]) / np.linalg.norm([-0.78, -0.16, 0.60])
SUN_IRRADIANCE = np.array([2.1, 1.85, 1.45])


def bake(scene: Scene, seed: int, rays: int = 96, light_samples: int = 24) -> NDArray[np.float32]:
    """Irradiance / π of each vertex, (n, 3) float32."""
    rng = np.random.default_rng(seed)
    smoother = _neighbour_mean(scene)
    points, normals = scene.vertices, scene.normals
    direct = _direct(scene, points, normals, rng, light_samples)
    leaves = np.flatnonzero(scene.two_sided[scene.vertex_material])
    back = _direct(scene, points[leaves], -normals[leaves], rng, light_samples)
    direct[leaves] = 0.62 * direct[leaves] + 0.38 * back
    direct = 0.5 * direct + 0.5 * (smoother @ direct)

    hits, buried = _gather_rays(scene, rng, rays)
    albedo = scene.mean_albedo[scene.vertex_material]
    lit = scene.emission[scene.vertex_material][:, None]
    glow = np.where((lit > 0) & (lit <= 2.0), 0.35 * lit, 0.0) * albedo
    total = direct.copy()
    indirect = np.zeros_like(direct)
    for _ in range(4):
        radiance = np.vstack([np.minimum(albedo, 0.85) * total + glow, np.zeros((1, 3))])
        indirect = np.stack([radiance[:, c][hits].mean(1) for c in range(3)], 1)
        total = direct + indirect
    for _ in range(4):
        indirect = 0.4 * indirect + 0.6 * (smoother @ indirect)
    return _fill_buried(direct + indirect, buried, smoother).astype(np.float32)


def _direct(
    scene: Scene,
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    rng: np.random.Generator,
    samples: int,
) -> NDArray[np.float64]:
    out = np.zeros((len(points), 3))
    side = max(2, int(np.sqrt(samples)))
    for light in LIGHTS:
        u, v = np.array(light.along_u, float), np.array(light.along_v, float)
        face = np.cross(u, v)
        area = np.linalg.norm(face)
        face = face / area
        for i in range(side):
            for j in range(side):
                s = (i + rng.random(len(points))) / side
                t = (j + rng.random(len(points))) / side
                target = np.array(light.corner) + s[:, None] * u + t[:, None] * v
                ray = target - points
                distance = np.linalg.norm(ray, axis=1)
                ray /= distance[:, None]
                facing = np.einsum("ij,ij->i", ray, normals)
                emitting = -(ray @ face)
                weight = np.clip(facing, 0, 1) * np.clip(emitting, 0, 1) / distance**2
                weight *= area / (np.pi * side * side)
                weight = np.minimum(weight, 0.5)
                use = np.flatnonzero(weight > 1e-6)
                seen = _visible(scene, points[use], normals[use], ray[use], distance[use])
                out[use] += (weight[use] * seen)[:, None] * np.array(light.radiance)
    facing = normals @ SUN_DIRECTION
    use = np.flatnonzero(facing > 0.01)
    for _ in range(6):
        ray = SUN_DIRECTION + 0.012 * rng.normal(size=(len(use), 3))
        seen = _visible(scene, points[use], normals[use], ray, np.full(len(use), 30.0))
        out[use] += (facing[use] * seen / 6)[:, None] * SUN_IRRADIANCE
    return out


def _visible(
    scene: Scene,
    points: NDArray,
    normals: NDArray,
    directions: NDArray,
    distances: NDArray,
) -> NDArray[np.float64]:
    seen = np.empty(len(points))
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        origins = (points[part] + OFFSET_M * normals[part]).astype(np.float32)
        reach = (distances[part] - 2e-3).astype(np.float32)
        result = scene.shadow_embree.run(
            origins, directions[part].astype(np.float32), dists=reach, query="OCCLUDED"
        )
        seen[part] = result < 0
    return seen


def _gather_rays(
    scene: Scene, rng: np.random.Generator, rays: int
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Vertex that each ray hits (n, rays), n for none; and (n,) whether a vertex is buried."""
    count = len(scene.vertices)
    hits = np.full((count, rays), count, np.int32)
    backs = np.zeros(count, np.int32)
    k = np.arange(rays)
    radius = np.sqrt((k + 0.5) / rays)
    golden = k * np.pi * (3 - np.sqrt(5))
    height = np.sqrt(1 - radius**2)
    step = max(1, CHUNK // rays)
    for start in range(0, count, step):
        part = slice(start, min(start + step, count))
        n = scene.normals[part].astype(float)
        helper = np.where(np.abs(n[:, 2:]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]])
        a = np.cross(helper, n)
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        b = np.cross(n, a)
        angle = golden + 2 * np.pi * rng.random((len(n), 1))
        directions = (
            (radius * np.cos(angle))[..., None] * a[:, None]
            + (radius * np.sin(angle))[..., None] * b[:, None]
            + height[None, :, None] * n[:, None]
        ).reshape(-1, 3)
        origins = np.repeat(scene.vertices[part] + OFFSET_M * n, rays, axis=0)
        seen, behind = _seen_vertices(scene, origins, directions)
        hits[part] = seen.reshape(-1, rays)
        backs[part] = behind.reshape(-1, rays).sum(1)
    return hits, backs > 0.45 * rays


def _seen_vertices(
    scene: Scene, origins: NDArray, directions: NDArray
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Nearest vertex of the triangle that each ray hits; and whether the ray hits its back."""
    result = scene.embree.run(
        origins.astype(np.float32), directions.astype(np.float32), query="INTERSECT", output=True
    )
    face = result["primID"]
    u, v = result["u"], result["v"]
    corner = np.argmax(np.stack([1 - u - v, u, v]), axis=0)
    vertex = scene.faces[face, corner].astype(np.int64)
    facing = np.einsum("ij,ij->i", scene.normals[vertex], directions)
    material = scene.vertex_material[vertex]
    missed = (face < 0) | (scene.emission[material] > 2.0)
    behind = ~missed & (facing > 0.05) & ~scene.two_sided[material]
    vertex[missed | behind] = len(scene.vertices)
    return vertex, behind


def _neighbour_mean(scene: Scene):
    """Sparse (n, n) mean of a vertex and its neighbours. Seams with equal normals are joined."""
    key = np.round(np.hstack([scene.vertices * 1e4, scene.normals * 20])).astype(np.int64)
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    group = group.reshape(-1)
    f = group[scene.faces]
    rows = np.concatenate([f[:, 0], f[:, 1], f[:, 2], f[:, 1], f[:, 2], f[:, 0]])
    cols = np.concatenate([f[:, 1], f[:, 2], f[:, 0], f[:, 0], f[:, 1], f[:, 2]])
    n = len(first)
    links = coo_matrix((np.ones(len(rows)), (rows, cols)), (n, n)).tocsr()
    links.data[:] = 1.0
    links = links + coo_matrix((np.ones(n), (np.arange(n), np.arange(n))), (n, n))
    links = links.multiply(1 / np.asarray(links.sum(1))).tocsr()
    count = len(group)
    spread = coo_matrix((np.ones(count), (np.arange(count), group)), (count, n)).tocsr()
    collect = spread.T.multiply(1 / np.asarray(spread.sum(0)).T).tocsr()
    return spread @ links @ collect


def _fill_buried(values: NDArray, buried: NDArray[np.bool_], smoother) -> NDArray:
    """Copy light to vertices inside other objects from their neighbours outside."""
    values = values.copy()
    known = ~buried
    values[buried] = 0
    for _ in range(12):
        weight = smoother @ known.astype(float)
        average = smoother @ (values * known[:, None])
        reach = (~known) & (weight > 1e-9)
        if not reach.any():
            break
        values[reach] = average[reach] / weight[reach, None]
        known = known | reach
    return values
