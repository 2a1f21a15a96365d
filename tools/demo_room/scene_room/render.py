"""Renders a frame of the room: colour, depth and instance ids.

Colour is the mean of several rays per pixel. A shiny surface reflects one ray. Depth and instance
come from one ray through the centre of the pixel, so both belong to the same surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from .scene import Scene

WIDTH, HEIGHT = 640, 480
FOCAL_PX, CX, CY = 525.0, 319.5, 239.5
RAY_OFFSETS_PX = ((-0.33, -0.10), (0.10, 0.33), (0.23, -0.30))


@dataclass(frozen=True)
class RenderedFrame:
    """A rendered frame.

    Attributes:
        radiance: (H, W, 3) float32, linear.
        depth_m: (H, W) float32, z along the optical axis; 0 = no value.
        instances: (H, W) uint16 object ids; 0 = none.
        cos_incidence: (H, W) float32, cosine between the ray and the surface normal.
    """

    radiance: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    instances: NDArray[np.uint16]
    cos_incidence: NDArray[np.float32]


def render(
    scene: Scene,
    light: NDArray[np.float32],
    T_world_camera: NDArray[np.float64],
    rng: np.random.Generator,
) -> RenderedFrame:
    """Render one view with three colour rays per pixel."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    total = np.zeros((HEIGHT * WIDTH, 3), np.float32)
    for x, y in RAY_OFFSETS_PX:
        dx, dy = (c + 0.12 * (rng.random(columns.shape) - 0.5) for c in (x, y))
        origins, directions = _rays(columns + dx, rows + dy, T_world_camera)
        total += _trace(scene, light, origins, directions, rng)
    origins, directions = _rays(columns, rows, T_world_camera)
    hit = scene.embree.run(origins, directions, query="INTERSECT", output=True)
    face = hit["primID"]
    material = scene.face_material[face]
    forward = T_world_camera[:3, 2].astype(np.float32)
    depth = hit["tfar"] * (directions @ forward)
    depth[(face < 0) | ~scene.sensed[material]] = 0
    normal = hit["Ng"] / np.maximum(np.linalg.norm(hit["Ng"], axis=1, keepdims=True), 1e-20)
    cosine = np.abs(np.einsum("ij,ij->i", normal, directions))
    instances = np.where(face < 0, 0, scene.face_object[face])
    shape = (HEIGHT, WIDTH)
    return RenderedFrame(
        radiance=(total / len(RAY_OFFSETS_PX)).reshape(HEIGHT, WIDTH, 3),
        depth_m=depth.reshape(shape).astype(np.float32),
        instances=instances.reshape(shape).astype(np.uint16),
        cos_incidence=cosine.reshape(shape).astype(np.float32),
    )


def _rays(
    columns: NDArray, rows: NDArray, T_world_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    camera = np.stack(
        [(columns - CX) / FOCAL_PX, (rows - CY) / FOCAL_PX, np.ones_like(columns, float)], -1
    ).reshape(-1, 3)
    camera /= np.linalg.norm(camera, axis=1, keepdims=True)
    directions = (camera @ T_world_camera[:3, :3].T).astype(np.float32)
    origins = np.broadcast_to(T_world_camera[:3, 3].astype(np.float32), directions.shape)
    return np.ascontiguousarray(origins), np.ascontiguousarray(directions)


def _trace(
    scene: Scene,
    light: NDArray[np.float32],
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    hit = scene.embree.run(origins, directions, query="INTERSECT", output=True)
    colour, normals, mirror = _shade_hits(scene, light, directions, hit)
    shiny = np.flatnonzero(mirror > 0.012)
    if len(shiny):
        incoming = directions[shiny]
        normal = normals[shiny]
        roughness = scene.roughness[scene.face_material[hit["primID"][shiny]]][:, None]
        normal = normal + 0.3 * roughness * rng.standard_normal(normal.shape, np.float32)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        out = incoming - 2 * np.einsum("ij,ij->i", incoming, normal)[:, None] * normal
        start = origins[shiny] + incoming * hit["tfar"][shiny][:, None] + 1.5e-3 * normals[shiny]
        out = out.astype(np.float32)
        second = scene.embree.run(start.astype(np.float32), out, query="INTERSECT", output=True)
        seen, _, _ = _shade_hits(scene, light, out, second)
        colour[shiny] += mirror[shiny][:, None] * np.minimum(seen, 2.2)
    return colour


def _shade_hits(
    scene: Scene, light: NDArray[np.float32], directions: NDArray[np.float32], hit: dict
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    atlas = scene.atlas
    return _shade(
        hit["primID"], hit["u"], hit["v"], hit["tfar"], directions,
        scene.faces, scene.face_material, scene.normals, scene.uv, light,
        scene.f0, scene.emission, scene.tile_m,
        atlas.texels, atlas.offset, atlas.height, atlas.width,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, fastmath=True)
def _shade(
    face, u, v, distance, directions, faces, face_material, normals, uv, light,
    f0, emission, tile_m, texels, offset, height, width,
):  # fmt: skip
    count = face.shape[0]
    colour = np.zeros((count, 3), np.float32)
    out_normal = np.zeros((count, 3), np.float32)
    mirror = np.zeros(count, np.float32)
    for k in range(count):
        f = face[k]
        if f < 0:
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        wb, wc = u[k], v[k]
        wa = 1.0 - wb - wc
        m = face_material[f]
        n0 = wa * normals[a, 0] + wb * normals[b, 0] + wc * normals[c, 0]
        n1 = wa * normals[a, 1] + wb * normals[b, 1] + wc * normals[c, 1]
        n2 = wa * normals[a, 2] + wb * normals[b, 2] + wc * normals[c, 2]
        scale = 1.0 / max(np.sqrt(n0 * n0 + n1 * n1 + n2 * n2), 1e-9)
        cosine = -scale * (n0 * directions[k, 0] + n1 * directions[k, 1] + n2 * directions[k, 2])
        if cosine < 0:
            cosine = -cosine
            scale = -scale
        out_normal[k, 0], out_normal[k, 1], out_normal[k, 2] = n0 * scale, n1 * scale, n2 * scale
        s = wa * uv[a, 0] + wb * uv[b, 0] + wc * uv[c, 0]
        t = wa * uv[a, 1] + wb * uv[b, 1] + wc * uv[c, 1]
        # A pixel covers about distance / focal length, and more at grazing angles.
        span = distance[k] / 525.0 / max(cosine, 0.25)
        texel = span * width[m, 0] / tile_m[m, 0]
        if tile_m[m, 0] == 1.0 and tile_m[m, 1] == 1.0:
            texel *= 2.0
        level = 0
        while texel > 1.4 and level < 5:
            texel *= 0.5
            level += 1
        h, w, start = height[m, level], width[m, level], offset[m, level]
        x, y = s * w - 0.5, t * h - 0.5
        x0, y0 = int(np.floor(x)), int(np.floor(y))
        fx, fy = x - x0, y - y0
        x1, y1 = (x0 + 1) % w, (y0 + 1) % h
        x0, y0 = x0 % w, y0 % h
        p00, p01 = start + y0 * w + x0, start + y0 * w + x1
        p10, p11 = start + y1 * w + x0, start + y1 * w + x1
        for i in range(3):
            value = (texels[p00, i] * (1 - fx) + texels[p01, i] * fx) * (1 - fy) + (
                texels[p10, i] * (1 - fx) + texels[p11, i] * fx
            ) * fy
            irradiance = wa * light[a, i] + wb * light[b, i] + wc * light[c, i]
            if emission[m] > 2.0:
                colour[k, i] = value * emission[m]
            elif emission[m] > 0.0:
                colour[k, i] = value * (emission[m] + 0.12 * irradiance)
            else:
                colour[k, i] = value * irradiance
        if f0[m] > 0:
            mirror[k] = f0[m] + (1 - f0[m]) * 0.65 * (1 - cosine) ** 5
    return colour, out_normal, mirror
