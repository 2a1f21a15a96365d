"""Renders colour, depth and instance ids of a room with embree.

One ray goes through the centre of each pixel, so colour, depth and instance belong to the same
surface. Light: the sky of the ceiling, one lamp with shadows and one without.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from .shapes import Item, Material, box

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

WIDTH, HEIGHT = 640, 480
FOCAL_PX, CX, CY = 525.0, 319.5, 239.5


@dataclass(frozen=True)
class Frame:
    """One exact view.

    Attributes:
        color_bgr: (H, W, 3) uint8.
        depth_m: (H, W) float32, z along the optical axis; 0 = no value.
        instances: (H, W) uint16; 0 = nothing.
        cos_incidence: (H, W) float32.
    """

    color_bgr: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    instances: NDArray[np.uint16]
    cos_incidence: NDArray[np.float32]


@dataclass(frozen=True)
class Scene:
    """Triangles in the world, and the tables that shade them."""

    embree: EmbreeScene
    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.int32]
    face_material: NDArray[np.int32]
    face_object: NDArray[np.int32]
    face_item: NDArray[np.int32]
    to_local: NDArray[np.float32]
    paint: NDArray[np.float32]
    lamps: NDArray[np.float32]


def shell(size: tuple[float, float, float], rng: np.random.Generator, first: int) -> list[Item]:
    """Walls, floor and ceiling as items, numbered from `first`."""
    w, d, h = (s / 2 for s in size)
    t = 0.1
    plain = rng.uniform(0.45, 0.85)
    tint = tuple(plain * rng.uniform(0.85, 1.0, 3))
    wall = Material(
        tint,
        tuple(rng.uniform(0.88, 1.0) * c for c in tint),
        int(rng.choice([2, 4, 5, 6])),
        float(rng.uniform(0.05, 0.4)),
    )
    ground = tuple(
        rng.uniform(0.15, 0.5) * c for c in (1.0, rng.uniform(0.7, 1.0), rng.uniform(0.5, 1.0))
    )
    floor = Material(
        ground,
        tuple(0.75 * c for c in ground),
        int(rng.choice([1, 3, 6])),
        float(rng.uniform(0.06, 0.3)),
    )
    top = Material((0.8, 0.8, 0.78), (0.76, 0.76, 0.74), 4, 0.05)
    boxes = [
        ("wall", box((-w - t, d, 0), (w + t, d + t, 2 * h)), wall),
        ("wall", box((-w - t, -d - t, 0), (w + t, -d, 2 * h)), wall),
        ("wall", box((w, -d, 0), (w + t, d, 2 * h)), wall),
        ("wall", box((-w - t, -d, 0), (-w, d, 2 * h)), wall),
        ("floor", box((-w - t, -d - t, -t), (w + t, d + t, 0)), floor),
        ("ceiling", box((-w - t, -d - t, 2 * h), (w + t, d + t, 2 * h + t)), top),
    ]
    items = []
    for k, (label, part, material) in enumerate(boxes):
        items.append(Item(label, "shell", [part], [material], anchor="world", number=first + k))
    return items


def assemble(
    items: list[Item], size: tuple[float, float, float], yaw: float, rng: np.random.Generator
) -> Scene:
    """The scene in the world frame, which is the frame of the room turned by a yaw."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    c, s = np.cos(yaw), np.sin(yaw)
    spin = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    vertices, normals, faces, material, owner, item_of, local, paint = (
        [],
        [],
        [],
        [],
        [],
        [],
        [],
        [],
    )
    start = 0
    for index, item in enumerate(items):
        rotation, position = spin @ item.rotation, spin @ item.position
        local.append(np.column_stack([rotation.T, -rotation.T @ position]))
        offset = len(paint)
        paint += [_row(m, rng) for m in item.materials]
        for part in item.parts:
            if not part.visible:
                continue
            mesh = part.mesh
            vertices.append(mesh.vertices @ rotation.T + position)
            normals.append(mesh.normals @ rotation.T)
            faces.append(mesh.faces + start)
            count = len(mesh.faces)
            material.append(np.full(count, offset + part.material))
            owner.append(np.full(count, item.number))
            item_of.append(np.full(count, index))
            start += len(mesh.vertices)
    points = np.concatenate(vertices).astype(np.float32)
    corners = np.concatenate(faces).astype(np.int32)
    embree = EmbreeScene()
    TriangleMesh(embree, np.ascontiguousarray(points[corners]))
    w, d, h = size
    lamps = [
        [
            rng.uniform(-0.25, 0.25) * w,
            rng.uniform(-0.25, 0.25) * d,
            h - 0.15,
            rng.uniform(0.5, 0.9),
        ],
        [rng.uniform(-0.4, 0.4) * w, rng.uniform(-0.4, 0.4) * d, h * 0.7, rng.uniform(0.1, 0.35)],
    ]
    turned = [[*(spin @ lamp[:3]), lamp[3]] for lamp in lamps]
    return Scene(
        embree, points, np.concatenate(normals).astype(np.float32), corners,
        np.concatenate(material).astype(np.int32), np.concatenate(owner).astype(np.int32),
        np.concatenate(item_of).astype(np.int32), np.array(local, np.float32),
        np.array(paint, np.float32), np.array(turned, np.float32),
    )  # fmt: skip


def _row(material: Material, rng: np.random.Generator) -> list[float]:
    # The catalogue gives colours as a screen shows them; light adds up in linear values.
    colours = [c**1.9 for c in (*material.albedo, *material.second)]
    return [*colours, material.pattern, material.scale_m, rng.uniform(0, 100)]


def rays(T_world_camera: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Origins and unit directions (H W, 3) through all pixel centres."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    camera = np.stack(
        [(columns - CX) / FOCAL_PX, (rows - CY) / FOCAL_PX, np.ones(columns.shape)], -1
    )
    camera = camera.reshape(-1, 3)
    camera /= np.linalg.norm(camera, axis=1, keepdims=True)
    directions = np.ascontiguousarray(camera @ T_world_camera[:3, :3].T, np.float32)
    origins = np.ascontiguousarray(
        np.broadcast_to(T_world_camera[:3, 3], directions.shape), np.float32
    )
    return origins, directions


def render(
    scene: Scene, T_world_camera: NDArray[np.float64], gain: float, rng: np.random.Generator
) -> Frame:
    """One view. `gain` is the exposure."""
    origins, directions = rays(T_world_camera)
    hit = scene.embree.run(origins, directions, query="INTERSECT", output=True)
    face = hit["primID"]
    points, albedo, normals = _surface(
        face, hit["u"], hit["v"], hit["tfar"], origins, directions, scene.faces, scene.normals,
        scene.face_material, scene.face_item, scene.to_local, scene.paint,
    )  # fmt: skip
    to_lamp = scene.lamps[0, :3] - points
    start = points + 2e-3 * normals
    shadow = scene.embree.run(start, to_lamp.astype(np.float32), query="INTERSECT", output=True)
    lit = np.where((shadow["primID"] >= 0) & (shadow["tfar"] < 1.0), 0.15, 1.0).astype(np.float32)
    radiance = _light(points, normals, albedo, lit, scene.lamps)
    radiance[face < 0] = 0
    depth = hit["tfar"] * (directions @ T_world_camera[:3, 2].astype(np.float32))
    geometric = hit["Ng"] / np.maximum(np.linalg.norm(hit["Ng"], axis=1, keepdims=True), 1e-20)
    cosine = np.abs(np.einsum("ij,ij->i", geometric, directions))
    shape = (HEIGHT, WIDTH)
    return Frame(
        _expose(radiance.reshape(*shape, 3), gain, rng),
        np.where(face < 0, 0, depth).reshape(shape).astype(np.float32),
        np.where(face < 0, 0, scene.face_object[face]).reshape(shape).astype(np.uint16),
        cosine.reshape(shape).astype(np.float32),
    )


def _expose(
    radiance: NDArray[np.float32], gain: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    light = cv2.GaussianBlur(radiance, (0, 0), 0.6) * 1.5 * gain
    grain = rng.standard_normal(light.shape, np.float32)
    light = np.maximum(light + grain * (0.004 + 0.008 * np.sqrt(np.maximum(light, 0))), 0)
    picture = 255 * np.clip(light / (0.75 + 0.45 * light), 0, 1) ** (1 / 2.2)
    return np.clip(picture, 0, 255).astype(np.uint8)[..., ::-1].copy()


@numba.njit(cache=True)
def _hash(x, y, z, seed):
    n = (
        np.int64(x) * 73856093
        ^ np.int64(y) * 19349663
        ^ np.int64(z) * 83492791
        ^ np.int64(seed * 997)
    )
    n = (n ^ (n >> 13)) * 1274126177
    return ((n ^ (n >> 16)) & 0xFFFF) / 65535.0


@numba.njit(cache=True)
def _noise(x, y, z, seed):
    ix, iy, iz = np.floor(x), np.floor(y), np.floor(z)
    fx, fy, fz = x - ix, y - iy, z - iz
    fx, fy, fz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)
                total += weight * _hash(ix + a, iy + b, iz + c, seed)
    return total


@numba.njit(cache=True)
def _mix(pattern, x, y, z, scale, seed):
    """Share of the second colour at a local point."""
    u, v, w = x / scale, y / scale, z / scale
    if pattern == 1:
        bend = 3.0 * _noise(u * 0.15, v * 0.8, w * 0.8, seed)
        return 0.5 + 0.5 * np.sin(4.0 * (v + w) * 0.7 + bend * 4.0)
    if pattern == 2:
        return 1.0 if np.floor(u + v * 0.2 + w) % 2 else 0.0
    if pattern == 3:
        return 1.0 if (np.floor(u) + np.floor(v) + np.floor(w)) % 2 else 0.0
    if pattern == 4:
        return 0.6 * _noise(u * 3, v * 3, w * 3, seed)
    if pattern == 5:
        return min(max(0.5 + 0.5 * np.sin(0.25 * (u + v + 1.3 * w) + seed), 0.0), 1.0)
    if pattern == 6:
        return (
            1.0
            if _noise(u * 0.8, v * 0.8, w * 0.8, seed) > 0.58
            else 0.1 * _noise(u * 6, v * 6, w * 6, seed)
        )
    return 0.0


@numba.njit(cache=True, fastmath=True)
def _surface(
    face,
    u,
    v,
    distance,
    origins,
    directions,
    faces,
    vertex_normals,
    face_material,
    face_item,
    to_local,
    paint,
):
    count = face.shape[0]
    points = np.zeros((count, 3), np.float32)
    albedo = np.zeros((count, 3), np.float32)
    normals = np.zeros((count, 3), np.float32)
    for k in range(count):
        f = face[k]
        if f < 0:
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        wb, wc = u[k], v[k]
        wa = 1.0 - wb - wc
        length, facing = 0.0, 0.0
        for i in range(3):
            points[k, i] = origins[k, i] + distance[k] * directions[k, i]
            n = wa * vertex_normals[a, i] + wb * vertex_normals[b, i] + wc * vertex_normals[c, i]
            normals[k, i] = n
            length += n * n
            facing += n * directions[k, i]
        scale = (-1.0 if facing > 0 else 1.0) / max(np.sqrt(length), 1e-9)
        for i in range(3):
            normals[k, i] *= scale
        T, m = to_local[face_item[f]], paint[face_material[f]]
        x = T[0, 0] * points[k, 0] + T[0, 1] * points[k, 1] + T[0, 2] * points[k, 2] + T[0, 3]
        y = T[1, 0] * points[k, 0] + T[1, 1] * points[k, 1] + T[1, 2] * points[k, 2] + T[1, 3]
        z = T[2, 0] * points[k, 0] + T[2, 1] * points[k, 1] + T[2, 2] * points[k, 2] + T[2, 3]
        share = _mix(int(m[6]), x + 1e-4, y + 1e-4, z + 1e-4, m[7], m[8])
        mottle = 0.92 + 0.16 * _noise(x * 25, y * 25, z * 25, m[8] + 7)
        for i in range(3):
            albedo[k, i] = (m[i] * (1 - share) + m[3 + i] * share) * mottle
    return points, albedo, normals


@numba.njit(cache=True, fastmath=True)
def _light(points, normals, albedo, lit, lamps):
    radiance = np.zeros_like(albedo)
    for k in range(points.shape[0]):
        total = 0.30 + 0.14 * normals[k, 2] + 0.05 * normals[k, 0]
        for j in range(2):
            dx, dy, dz = (
                lamps[j, 0] - points[k, 0],
                lamps[j, 1] - points[k, 1],
                lamps[j, 2] - points[k, 2],
            )
            square = dx * dx + dy * dy + dz * dz
            cosine = (dx * normals[k, 0] + dy * normals[k, 1] + dz * normals[k, 2]) / np.sqrt(
                square
            )
            shade = lit[k] if j == 0 else 1.0
            total += max(cosine, 0.0) * lamps[j, 3] * shade * 3.0 / (1.5 + square * 0.6)
        for i in range(3):
            radiance[k, i] = albedo[k, i] * total
    return radiance
