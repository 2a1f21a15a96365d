"""Parts, items and their triangle meshes.

A part is one primitive shape. An item is a rigid object of several parts. The local frame of an
item has its origin below the middle of its footprint: z = 0 is the bottom. Lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

ROUND_SEGMENTS = 24


@dataclass(frozen=True)
class Material:
    """Colour of a part.

    Attributes:
        albedo, second: linear RGB in [0, 1]; a pattern mixes the two.
        pattern: 0 plain, 1 wood grain, 2 stripes, 3 checks, 4 speckles, 5 gradient, 6 print.
        scale_m: size of the pattern.
    """

    albedo: tuple[float, float, float]
    second: tuple[float, float, float] = (0.5, 0.5, 0.5)
    pattern: int = 0
    scale_m: float = 0.05


@dataclass(frozen=True)
class Mesh:
    """Triangles: vertices and normals (v, 3) float64, faces (f, 3) int64."""

    vertices: NDArray[np.float64]
    normals: NDArray[np.float64]
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class Part:
    """One primitive shape.

    Attributes:
        shape: box, cylinder, ellipsoid, capsule or lathe.
        size: half sizes of a box or ellipsoid; radius and half height of a cylinder or capsule.
        position, rotation: pose in the frame of the item.
        material: index into the materials of the item.
        collides: whether the physics sees it.
        visible: whether the camera sees it.
        profile: of a lathe, (n, 2) radius and height from the outside bottom over the rim inwards.
    """

    shape: str
    size: tuple[float, ...]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    material: int = 0
    collides: bool = True
    visible: bool = True
    profile: NDArray[np.float64] | None = None

    @cached_property
    def mesh(self) -> Mesh:
        """Its triangles in the frame of the item."""
        return _part_mesh(self)


@dataclass(frozen=True)
class Cavity:
    """Hollow of a container, in its frame: half sizes, or a radius twice where it is round."""

    centre: tuple[float, float]
    half: tuple[float, float]
    low: float
    rim: float
    round: bool = False


@dataclass(frozen=True)
class Top:
    """Level rectangle that carries things, in the frame of the item."""

    centre: tuple[float, float]
    half: tuple[float, float]
    height: float
    clearance: float = 2.0
    round: bool = False


@dataclass
class Item:
    """One object of the room.

    Attributes:
        number: id in all files; 0 until the room is complete.
        kind: furn, small, wallm, flat or shell.
        position, rotation: pose in the frame of the room.
        anchor: "free", "world" (does not move) or "item" (welded to `holder`).
        holder: item that this one is welded to.
    """

    label: str
    kind: str
    parts: list[Part]
    materials: list[Material]
    mass_kg: float = 1.0
    cavities: list[Cavity] = field(default_factory=list)
    tops: list[Top] = field(default_factory=list)
    anchor: str = "free"
    holder: Item | None = None
    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    number: int = 0
    _bounds: tuple[int, NDArray[np.float64], NDArray[np.float64]] | None = None

    def vertices(self, *, placed: bool = True) -> NDArray[np.float64]:
        """Corners of all visible parts (n, 3), in the room or in the frame of the item."""
        points = np.concatenate([p.mesh.vertices for p in self.parts if p.visible])
        return points @ self.rotation.T + self.position if placed else points

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner in the frame of the item."""
        if self._bounds is None or self._bounds[0] != len(self.parts):
            points = self.vertices(placed=False)
            self._bounds = len(self.parts), points.min(0), points.max(0)
        return self._bounds[1], self._bounds[2]

    @property
    def height(self) -> float:
        """Height in its own frame, m."""
        return float(self.bounds()[1][2])


def turn(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> NDArray[np.float64]:
    """Rotation by roll about x, then pitch about y, then yaw about z, radians."""
    (cz, cy, cx), (sz, sy, sx) = (fn([yaw, pitch, roll]) for fn in (np.cos, np.sin))
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]])
    about_y = np.array([[cy, 0, sy], [0, 1.0, 0], [-sy, 0, cy]])
    about_x = np.array([[1.0, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return about_z @ about_y @ about_x


def _part_mesh(part: Part) -> Mesh:
    if part.shape == "box":
        mesh = _box(part.size)
    elif part.shape == "cylinder":
        r, h = part.size
        mesh = lathe(np.array([[0, -h], [r, -h], [r, h], [0, h]]))
    elif part.shape == "ellipsoid":
        angles = np.linspace(-np.pi / 2, np.pi / 2, 13)
        ball = lathe(np.column_stack([np.cos(angles), np.sin(angles)]), smooth=True)
        scale = np.array(part.size)
        normals = ball.normals / scale
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        mesh = Mesh(ball.vertices * scale, normals, ball.faces)
    elif part.shape == "capsule":
        r, h = part.size
        angles = np.linspace(0, np.pi / 2, 6)
        cap = np.column_stack([r * np.cos(angles), h + r * np.sin(angles)])
        mesh = lathe(np.concatenate([cap[::-1] * [1, -1], cap]), smooth=True)
    else:
        assert part.profile is not None
        mesh = lathe(part.profile)
    vertices = mesh.vertices @ part.rotation.T + np.array(part.position)
    return Mesh(vertices, mesh.normals @ part.rotation.T, mesh.faces)


def lathe(profile: NDArray[np.float64], *, smooth: bool = False) -> Mesh:
    """Surface of revolution about z of a profile (n, 2) of radius and height.

    Sharp profiles get one ring of vertices on each side of an edge, so that edges stay sharp.
    """
    angles = np.linspace(0, 2 * np.pi, ROUND_SEGMENTS, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    vertices, normals, faces = [], [], []
    count = ROUND_SEGMENTS
    slopes = np.diff(profile, axis=0)
    slopes /= np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-12)
    for k in range(len(profile) - 1):
        start = 2 * k * count
        for end in (k, k + 1):
            near = slopes[k]
            if smooth:
                near = slopes[max(end - 1, 0)] + slopes[min(end, len(slopes) - 1)]
                near = near / max(np.linalg.norm(near), 1e-12)
            radius, height = profile[end]
            vertices.append(np.column_stack([radius * ring, np.full(count, height)]))
            normals.append(np.column_stack([near[1] * ring, np.full(count, -near[0])]))
        i = np.arange(count)
        j = (i + 1) % count
        faces += [
            np.column_stack([start + i, start + j, start + count + j]),
            np.column_stack([start + i, start + count + j, start + count + i]),
        ]
    return Mesh(np.concatenate(vertices), np.concatenate(normals), np.concatenate(faces))


def _box(half: tuple[float, ...]) -> Mesh:
    vertices, normals, faces = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            start = 4 * len(vertices)
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            others = [(axis + 1) % 3, (axis + 2) % 3]
            corners[:, others] = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
            normal = np.zeros((4, 3))
            normal[:, axis] = sign
            vertices.append(corners * np.array(half))
            normals.append(normal)
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return Mesh(np.concatenate(vertices), np.concatenate(normals), np.array(faces))


def box(
    low: tuple[float, float, float], high: tuple[float, float, float], material: int = 0, **more
) -> Part:
    """Box between two corners, in the frame of the item."""
    a, b = np.array(low, float), np.array(high, float)
    return Part("box", tuple((b - a) / 2), tuple((a + b) / 2), material=material, **more)


def upright(
    radius: float,
    low: float,
    high: float,
    at: tuple[float, float] = (0.0, 0.0),
    material: int = 0,
    **more,
) -> Part:
    """Vertical cylinder between two heights."""
    size = (radius, (high - low) / 2)
    return Part("cylinder", size, (*at, (high + low) / 2), material=material, **more)


def ring(profile: list[tuple[float, float]], thickness: float, sides: int = 10) -> list[Part]:
    """Walls of a round hollow for the physics: invisible boxes around an outer profile."""
    parts = []
    for (r0, z0), (r1, z1) in zip(profile, profile[1:]):
        length = float(np.hypot(r1 - r0, z1 - z0))
        tilt = float(np.arctan2(r1 - r0, z1 - z0))
        middle = (r0 + r1) / 2 - thickness / 2
        width = max(r0, r1) * np.tan(np.pi / sides) * 1.02
        for k in range(sides):
            yaw = 2 * np.pi * k / sides
            place = (middle * np.cos(yaw), middle * np.sin(yaw), (z0 + z1) / 2)
            size = (thickness / 2, width, length / 2)
            parts.append(Part("box", size, place, turn(yaw, tilt), visible=False))
    return parts
