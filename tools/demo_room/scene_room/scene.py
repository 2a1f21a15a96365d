"""The room as flat arrays, ready for ray casting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from .materials import Material
from .room import PlacedObject

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

MIP_LEVELS = 6


@dataclass(frozen=True)
class TextureAtlas:
    """All textures and their mip levels in one array of texels.

    texels (t, 3) float32; offset, height, width (materials, MIP_LEVELS) int64.
    """

    texels: NDArray[np.float32]
    offset: NDArray[np.int64]
    height: NDArray[np.int64]
    width: NDArray[np.int64]


@dataclass(frozen=True)
class Scene:
    """Triangles in the world frame (metres), their materials and textures, and two ray casters."""

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]
    face_material: NDArray[np.int32]
    face_object: NDArray[np.int32]
    vertex_material: NDArray[np.int32]
    f0: NDArray[np.float32]
    roughness: NDArray[np.float32]
    emission: NDArray[np.float32]
    two_sided: NDArray[np.bool_]
    sensed: NDArray[np.bool_]
    tile_m: NDArray[np.float32]
    mean_albedo: NDArray[np.float32]
    atlas: TextureAtlas
    embree: EmbreeScene
    shadow_embree: EmbreeScene


def assemble(objects: list[PlacedObject], materials: dict[str, Material]) -> Scene:
    """One scene of all objects. Emitters cast no shadows."""
    names = sorted({material for item in objects for _, material in item.parts})
    number = {name: i for i, name in enumerate(names)}
    used = [materials[name] for name in names]
    columns: list[list[NDArray]] = [[] for _ in range(7)]
    start = 0
    for item in objects:
        for mesh, material in item.parts:
            count = len(mesh.faces)
            index = number[material]
            rows = (
                mesh.vertices,
                mesh.normals,
                mesh.uv / np.array(materials[material].tile_m),
                mesh.faces + start,
                np.full(count, index),
                np.full(count, item.object_id),
                np.full(len(mesh.vertices), index),
            )
            for column, row in zip(columns, rows):
                column.append(row)
            start += len(mesh.vertices)
    vertices, normals, uv, faces, face_material, face_object, vertex_material = (
        np.concatenate(column) for column in columns
    )
    emission = np.array([m.emission for m in used], np.float32)
    vertices = vertices.astype(np.float32)
    triangles = vertices[faces]
    return Scene(
        vertices=vertices,
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
        faces=faces.astype(np.int32),
        face_material=face_material.astype(np.int32),
        face_object=face_object.astype(np.int32),
        vertex_material=vertex_material.astype(np.int32),
        f0=np.array([m.f0 for m in used], np.float32),
        roughness=np.array([m.roughness for m in used], np.float32),
        emission=emission,
        two_sided=np.array([m.two_sided for m in used]),
        sensed=np.array([m.sensed for m in used]),
        tile_m=np.array([m.tile_m for m in used], np.float32),
        mean_albedo=np.array([m.texture.mean((0, 1)) for m in used], np.float32),
        atlas=_atlas(used),
        embree=_ray_caster(triangles),
        shadow_embree=_ray_caster(triangles[emission[face_material] <= 2.0]),
    )


def _ray_caster(triangles: NDArray[np.float32]) -> EmbreeScene:
    """Embree's scene of triangles (n, 3, 3)."""
    # Imported here, so that make_recording.py shows its help and a clear error without embreex.
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(triangles))
    return scene


def _atlas(materials: list[Material]) -> TextureAtlas:
    texels: list[NDArray[np.float32]] = []
    shape = (len(materials), MIP_LEVELS)
    offset, height, width = (np.zeros(shape, np.int64) for _ in range(3))
    start = 0
    for i, material in enumerate(materials):
        image = np.ascontiguousarray(material.texture, np.float32)
        for level in range(MIP_LEVELS):
            if level:
                size = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
                image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            offset[i, level], height[i, level], width[i, level] = start, *image.shape[:2]
            texels.append(image.reshape(-1, 3))
            start += image.shape[0] * image.shape[1]
    return TextureAtlas(np.concatenate(texels), offset, height, width)
