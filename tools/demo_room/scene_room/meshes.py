"""Generated triangle meshes: boxes with rounded edges, bodies of revolution, tubes, leaves.

A mesh has vertices (n, 3) in metres, unit normals (n, 3), texture coordinates (n, 2) in metres and
faces (m, 3). `scene.assemble` divides texture coordinates by the tile size of the material.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mesh:
    """A piece of surface."""

    vertices: Array
    normals: Array
    uv: Array
    faces: NDArray[np.int64]

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
        """Translated copy, metres."""
        return replace(self, vertices=self.vertices + np.array([x, y, z]))

    def turned(self, axis: str, degrees: float) -> Mesh:
        """Copy rotated about a coordinate axis through the origin."""
        rotation = axis_rotation(axis, degrees)
        return replace(self, vertices=self.vertices @ rotation.T, normals=self.normals @ rotation.T)

    def scaled(self, x: float, y: float, z: float) -> Mesh:
        """Copy scaled along the axes. Normals are scaled by the inverse."""
        factors = np.array([x, y, z])
        normals = self.normals / factors
        return replace(self, vertices=self.vertices * factors, normals=_unit(normals))

    def deformed(self, function: Callable[[Array], Array]) -> Mesh:
        """Copy with vertices `function(vertices)` and new normals, averaged at equal vertices."""
        vertices = function(self.vertices)
        return replace(self, vertices=vertices, normals=_smooth_normals(vertices, self.faces))

    def mapped(self, function: Callable[[Array, Array], Array]) -> Mesh:
        """Copy with texture coordinates `function(vertices, normals)`."""
        return replace(self, uv=function(self.vertices, self.normals))


def axis_rotation(axis: str, degrees: float) -> Array:
    """Rotation matrix (3, 3) about 'x', 'y' or 'z'."""
    angle = np.deg2rad(degrees)
    c, s = np.cos(angle), np.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = c
    rotation[i, j], rotation[j, i] = -s, s
    return rotation


def join(*meshes: Mesh) -> Mesh:
    """One mesh of several. Equal vertices stay separate."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets)]),
    )


def sheet(corner: Array, along_u: Array, along_v: Array, step: float, fit: bool = False) -> Mesh:
    """Flat rectangle with normal `along_u × along_v`. `fit` maps one texture to all of it."""
    corner, along_u, along_v = (np.asarray(a, float) for a in (corner, along_u, along_v))
    size_u, size_v = np.linalg.norm(along_u), np.linalg.norm(along_v)
    count_u, count_v = (max(1, int(np.ceil(s / step))) for s in (size_u, size_v))
    s, t = np.meshgrid(np.linspace(0, 1, count_u + 1), np.linspace(0, 1, count_v + 1))
    s, t = s.ravel()[:, None], t.ravel()[:, None]
    vertices = corner + s * along_u + t * along_v
    normal = np.cross(along_u, along_v)
    uv = np.hstack([s, t]) if fit else np.hstack([s * size_u, t * size_v])
    return Mesh(
        vertices,
        np.tile(normal / np.linalg.norm(normal), (len(vertices), 1)),
        uv,
        _grid_faces(count_v + 1, count_u + 1),
    )


def box(x: float, y: float, z: float, radius: float = 0.006, step: float = 0.05) -> Mesh:
    """Box of the given size, standing on z = 0 and centred in x and y, with rounded edges."""
    half = np.array([x, y, z]) / 2
    radius = min(radius, float(half.min()) * 0.999)
    pieces = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        a = _edge_samples(half[first], radius, step)
        b = _edge_samples(half[second], radius, step)
        grid_a, grid_b = np.meshgrid(a, b)
        for sign in (1.0, -1.0):
            points = np.empty((grid_a.size, 3))
            points[:, axis] = sign * half[axis]
            points[:, first] = sign * grid_a.ravel()
            points[:, second] = grid_b.ravel()
            inner = np.clip(points, -(half - radius), half - radius)
            normals = _unit(points - inner)
            vertices = inner + radius * normals
            # The grain of a texture runs along v; u and v follow the face, z is v where it can be.
            u_axis, v_axis = {0: (1, 2), 1: (0, 2), 2: (0, 1)}[axis]
            uv = points[:, [u_axis, v_axis]] + half[[u_axis, v_axis]]
            pieces.append(Mesh(vertices, normals, uv, _grid_faces(len(b), len(a))))
    return join(*pieces).moved(z=float(half[2]))


def lathe(profile: list[tuple[float, float]], segments: int = 40, smooth: int = 0) -> Mesh:
    """Body of revolution about z from (radius, height) points. The outside is right of the path.

    A repeated point makes a sharp edge. With `smooth` > 0 the path is a spline of `smooth` points.
    """
    path = np.array(profile, float)
    if smooth:
        path = _catmull_rom(path, smooth)
    keep_sharp = np.r_[True, np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-9]
    runs = np.split(path, np.flatnonzero(~keep_sharp)) if not keep_sharp.all() else [path]
    pieces = [_lathe_run(run, segments) for run in runs if len(run) > 1]
    return join(*pieces)


def tube(path: Array, radius: float | Array, segments: int = 10, step: float = 0.03) -> Mesh:
    """Round bar along a polyline, with closed ends. `radius` is one number or one per point."""
    path = np.asarray(path, float)
    radii = np.broadcast_to(np.asarray(radius, float), (len(path),))
    path, radii = _resample(path, radii, step)
    tangents = _unit(np.gradient(path, axis=0))
    side = np.cross(tangents[0], [0.0, 0.0, 1.0])
    if np.linalg.norm(side) < 1e-3:
        side = np.array([1.0, 0.0, 0.0])
    frames = []
    for tangent in tangents:
        side = side - tangent * (side @ tangent)
        side = side / np.linalg.norm(side)
        frames.append((side, np.cross(tangent, side)))
    angles = np.linspace(0, 2 * np.pi, segments + 1)
    normals = np.array(
        [np.outer(np.cos(angles), a) + np.outer(np.sin(angles), b) for a, b in frames]
    )
    vertices = path[:, None] + radii[:, None, None] * normals
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    uv = np.stack(np.broadcast_arrays(angles * float(radii.max()), length[:, None]), -1)
    rows, columns = vertices.shape[:2]
    body = Mesh(
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        uv.reshape(-1, 2),
        _grid_faces(rows, columns)[:, ::-1],
    )
    caps = []
    for end, sign in ((0, -1.0), (-1, 1.0)):
        ring = np.vstack([path[end], vertices[end]])
        index = np.arange(1, columns)
        faces = np.stack([np.zeros_like(index), index, index + 1], 1)
        caps.append(
            Mesh(
                ring,
                np.tile(sign * tangents[end], (len(ring), 1)),
                np.zeros((len(ring), 2)),
                faces if sign > 0 else faces[:, ::-1],
            )
        )
    return join(body, *caps)


def ball(radius: float, segments: int = 24) -> Mesh:
    """Sphere standing on z = 0."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    profile = [(radius * np.cos(a), radius * np.sin(a) + radius) for a in angles]
    profile[0], profile[-1] = (1e-5, 0.0), (1e-5, 2 * radius)
    return lathe(profile, segments)


def leaf(length: float, width: float, droop: float, fold: float = 0.15) -> Mesh:
    """Pointed leaf from the origin along +x, bent down by `droop` at its tip."""
    along, across = 12, 6
    s, t = np.meshgrid(np.linspace(0, 1, along + 1), np.linspace(-1, 1, across + 1))
    s, t = s.ravel(), t.ravel()
    half_width = width / 2 * np.sin(np.pi * np.clip(s, 0, 1) ** 0.75) ** 0.8
    vertices = np.stack(
        [
            length * s * (1 - 0.15 * droop * s),
            half_width * t,
            length * (0.35 * s - droop * s**2) + fold * half_width * np.abs(t),
        ],
        1,
    )
    faces = _grid_faces(across + 1, along + 1)
    uv = np.stack([0.5 + t / 2, s], 1)
    return Mesh(vertices, _smooth_normals(vertices, faces), uv, faces)


def puffed(mesh: Mesh, amount: float) -> Mesh:
    """Cushion from a box that is centred in x and y. Faces bulge by `amount` metres."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    centre, half = (low + high) / 2, (high - low) / 2

    def swell(vertices: Array) -> Array:
        q = (vertices - centre) / half
        weights = np.stack(
            [
                np.sign(q[:, i])
                * np.abs(q[:, i]) ** 3
                * np.prod(np.cos(np.clip(q[:, [j for j in range(3) if j != i]], -1, 1) * 1.45), 1)
                for i in range(3)
            ],
            1,
        )
        return vertices + amount * weights

    return mesh.deformed(swell)


def _lathe_run(path: Array, segments: int) -> Mesh:
    steps = np.diff(path, axis=0)
    outward = _unit(np.stack([steps[:, 1], -steps[:, 0]], 1))
    corner = np.vstack([outward[:1], outward[:-1] + outward[1:], outward[-1:]])
    corner = _unit(corner)
    angles = np.linspace(0, 2 * np.pi, segments + 1)
    c, s = np.cos(angles)[None, :, None], np.sin(angles)[None, :, None]

    def spin(points: Array) -> Array:
        radial, height = points[:, None, :1], points[:, None, 1:]
        return np.concatenate(
            [radial * c, radial * s, np.broadcast_to(height, radial.shape[:1] + c.shape[1:])], -1
        )

    length = np.r_[0, np.cumsum(np.linalg.norm(steps, axis=1))]
    uv = np.stack(np.broadcast_arrays(angles * float(path[:, 0].max()), length[:, None]), -1)
    rows = len(path)
    return Mesh(
        spin(path).reshape(-1, 3),
        spin(corner).reshape(-1, 3),
        uv.reshape(-1, 2),
        _grid_faces(rows, segments + 1),
    )


def _grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, :-1].ravel(), index[1:, 1:].ravel()
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


def _edge_samples(half: float, radius: float, step: float) -> Array:
    arc = np.array([0.0, 0.3, 0.65, 1.0]) if radius > 0.012 else np.array([0.0, 0.5, 1.0])
    inner = half - radius
    count = max(1, int(np.ceil(2 * inner / step)))
    middle = np.linspace(-inner, inner, count + 1)
    return np.unique(np.r_[-half + arc * radius, middle, half - arc * radius].round(9))


def _resample(path: Array, radii: Array, step: float) -> tuple[Array, Array]:
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    marks = [length[0]]
    for start, end in zip(length[:-1], length[1:]):
        count = max(1, int(np.ceil((end - start) / step)))
        marks.extend(np.linspace(start, end, count + 1)[1:])
    at = np.array(marks)
    points = np.stack([np.interp(at, length, path[:, i]) for i in range(3)], 1)
    return points, np.interp(at, length, radii)


def _catmull_rom(points: Array, count: int) -> Array:
    padded = np.vstack([2 * points[0] - points[1], points, 2 * points[-1] - points[-2]])
    at = np.linspace(0, len(points) - 1, count)
    i = np.minimum(at.astype(int), len(points) - 2)
    t = (at - i)[:, None]
    p0, p1, p2, p3 = (padded[i + k] for k in range(4))
    curve = 0.5 * (
        2 * p1
        + (p2 - p0) * t
        + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2
        + (3 * p1 - p0 - 3 * p2 + p3) * t**3
    )
    curve[:, 0] = np.maximum(curve[:, 0], 1e-5)
    return curve


def _smooth_normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    _, group = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    group = group.reshape(-1)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    total = np.zeros((int(group.max()) + 1, 3))
    for k in range(3):
        np.add.at(total, group[faces[:, k]], face_normals)
    return _unit(total)[group]


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
