"""Depth, objects and plain colours of a home in a pinhole camera: triangles and a depth buffer.

It takes a few milliseconds on one core and needs no graphics. Colours are flat, lit from the camera
and from above; `mujoco_view.py` renders better ones for a detector.
"""

from __future__ import annotations

import numba
import numpy as np
from home import Home

from deworldsg_ros.scene.camera import Intrinsics, invert_pose

NEAR_M = 0.05


class Triangles:
    """The triangles of a home, by object; 0 = walls, floor and ceiling."""

    def __init__(self, home: Home) -> None:
        self._home = home
        self._still = _shell(home)
        self.move()

    def move(self) -> None:
        """Take the objects from where the home has them now."""
        parts = [*self._still]
        for number in self._home.present:
            item = self._home.items[number - 1]
            for part in item.parts:
                if part.visible:
                    corners = part.mesh.vertices[part.mesh.faces]
                    material = item.materials[part.material]
                    colour = 0.7 * np.array(material.albedo) + 0.3 * np.array(material.second)
                    parts.append((corners @ item.rotation.T + item.position, colour, number))
        self.corners = np.concatenate([p[0] for p in parts])
        normals = np.cross(
            self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0]
        )
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        counts = [len(p[0]) for p in parts]
        self.colours = np.repeat([p[1] for p in parts], counts, axis=0)
        self.owners = np.repeat([p[2] for p in parts], counts).astype(np.uint16)

    def render(
        self, T_world_camera: np.ndarray, camera: Intrinsics
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """RGB (h, w, 3) uint8, depth (h, w) float32 in metres, and the object of each pixel."""
        T = invert_pose(T_world_camera)
        seen = self.corners @ T[:3, :3].T + T[:3, 3]
        way = T_world_camera[:3, 3] - self.corners.mean(axis=1)
        facing = np.abs((way * self.normals).sum(axis=1)) / np.linalg.norm(way, axis=1)
        light = 0.45 + 0.35 * facing + 0.2 * np.abs(self.normals[:, 2])
        flat = np.clip(255 * (self.colours * light[:, None]) ** 0.7, 0, 255).astype(np.uint8)
        return _fill(seen, flat, self.owners, *_pinhole(camera))


def _pinhole(camera: Intrinsics) -> tuple[float, float, float, float, int, int]:
    return camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height


def _shell(home: Home) -> list[tuple[np.ndarray, np.ndarray, int]]:
    """Walls, floor and ceiling."""
    shade = np.random.default_rng(len(home.items)).uniform(0.55, 0.85, 3)
    x0, y0, x1, y1 = home.extent()
    level = [np.array([[x0, y0, low], [x1, y1, low + 0.1]]) for low in (-0.1, 2.5)]
    colours = [shade * [0.6, 0.5, 0.4], np.array([0.85] * 3)]
    found = [(_box(box), shade, 0) for box in home.walls]
    return found + [(_box(box), colour, 0) for box, colour in zip(level, colours)]


def _box(box: np.ndarray) -> np.ndarray:
    """The twelve triangles (12, 3, 3) of a box between two corners (2, 3)."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    points = box[0] + corners * (box[1] - box[0])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return points[np.array([[(a, b, c), (a, c, d)] for a, b, c, d in quads]).reshape(-1, 3)]


@numba.njit(cache=True)
def _fill(triangles, colours, owners, fx, fy, cx, cy, width, height):
    """Fill an image with triangles (n, 3, 3) in the camera frame; see `Triangles.render`."""
    inverse = np.zeros((height, width), np.float32)
    faces = np.full((height, width), -1, np.int32)
    polygon, screen = np.empty((4, 3)), np.empty((4, 3))
    wide, high = max(cx, width - cx) / fx, max(cy, height - cy) / fy
    for index in range(len(triangles)):
        # Most triangles are behind the camera or beside the image.
        behind, left, right, above, below = 0, 0, 0, 0, 0
        for k in range(3):
            x, y, z = triangles[index, k, 0], triangles[index, k, 1], triangles[index, k, 2]
            behind += z < NEAR_M
            left += x < -wide * z
            right += x > wide * z
            above += y < -high * z
            below += y > high * z
        if 3 in (behind, left, right, above, below):
            continue
        count = 0
        for k in range(3):
            a, b = triangles[index, k], triangles[index, (k + 1) % 3]
            if a[2] >= NEAR_M:
                polygon[count] = a
                count += 1
            if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
                polygon[count] = a + (NEAR_M - a[2]) / (b[2] - a[2]) * (b - a)
                count += 1
        for k in range(count):
            z = polygon[k, 2]
            screen[k, 0] = fx * polygon[k, 0] / z + cx
            screen[k, 1] = fy * polygon[k, 1] / z + cy
            screen[k, 2] = 1.0 / z
        for k in range(1, count - 1):
            _triangle(screen[0], screen[k], screen[k + 1], index, inverse, faces)
    rgb = np.zeros((height, width, 3), np.uint8)
    depth = np.zeros((height, width), np.float32)
    shown = np.zeros((height, width), np.uint16)
    for v in range(height):
        for u in range(width):
            face = faces[v, u]
            if face >= 0:
                depth[v, u], shown[v, u] = 1.0 / inverse[v, u], owners[face]
                for k in range(3):
                    rgb[v, u, k] = colours[face, k]
    return rgb, depth, shown


@numba.njit(cache=True)
def _triangle(a, b, c, index, inverse, faces):
    height, width = inverse.shape
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if abs(area) < 1e-9:
        return
    # Inverse depth is affine in the image.
    right = ((b[2] - a[2]) * (c[1] - a[1]) - (c[2] - a[2]) * (b[1] - a[1])) / area
    down = ((c[2] - a[2]) * (b[0] - a[0]) - (b[2] - a[2]) * (c[0] - a[0])) / area
    top = max(0, int(np.ceil(min(a[1], b[1], c[1]))))
    bottom = min(height - 1, int(np.floor(max(a[1], b[1], c[1]))))
    for v in range(top, bottom + 1):
        first, last = np.inf, -np.inf
        for p, q in ((a, b), (b, c), (c, a)):
            if (p[1] <= v) != (q[1] <= v):
                u = p[0] + (v - p[1]) / (q[1] - p[1]) * (q[0] - p[0])
                first, last = min(first, u), max(last, u)
        if last < 0.0 or first > width - 1:
            continue
        start, stop = max(0, int(np.ceil(first))), min(width - 1, int(np.floor(last)))
        z = a[2] + right * (start - a[0]) + down * (v - a[1])
        for u in range(start, stop + 1):
            if z > inverse[v, u]:
                inverse[v, u], faces[v, u] = z, index
            z += right
