"""Synthetic RGB-D scenes with known masks."""

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.perception.protocols import SegmentedObjects
from deworldsg_ros.scene.camera import Intrinsics, MaskPatch

WIDTH, HEIGHT = 320, 240
INTRINSICS = Intrinsics(262.5, 262.5, 159.5, 119.5, WIDTH, HEIGHT)
SHAPE = (HEIGHT, WIDTH)
# The camera points down by this angle.
PITCH = np.radians(30.0)
UP_CAMERA = np.array([0.0, -np.cos(PITCH), -np.sin(PITCH)])
CAMERA_HEIGHT_M = 1.5


@dataclass
class Slab:
    """An axis-aligned box, metres: x right, y forward, z up, from the floor below the camera."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    colour: tuple[int, int, int]


def render(slabs: list[Slab], noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGB, depth and the slab of each pixel (H, W), counted from 1; 0 = floor or back wall."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays_camera = INTRINSICS.back_project(u, v, np.ones(SHAPE))
    right = np.array([1.0, 0.0, 0.0])
    forward_camera = np.array([0.0, 0.0, 1.0])
    forward = forward_camera - (forward_camera @ UP_CAMERA) * UP_CAMERA
    forward /= np.linalg.norm(forward)
    axes = np.stack([right, forward, UP_CAMERA])
    rays = rays_camera @ axes.T
    eye = np.array([0.0, 0.0, CAMERA_HEIGHT_M])
    room = [
        Slab((-9, -9, -1), (9, 9, 0), (150, 140, 130)),
        Slab((-9, 4.0, -1), (9, 5, 9), (210, 210, 200)),
    ]
    depth = np.full(SHAPE, np.inf)
    owner = np.zeros(SHAPE, int)
    rgb = np.zeros((*SHAPE, 3))
    for number, slab in enumerate([*room, *slabs]):
        with np.errstate(divide="ignore", invalid="ignore"):
            near = (np.array(slab.low) - eye) / rays
            far = (np.array(slab.high) - eye) / rays
        enter, leave = np.minimum(near, far), np.maximum(near, far)
        t = enter.max(axis=2)
        hit = (t < leave.min(axis=2)) & (t > 0) & (t < depth)
        # The brightness of a face depends on its direction.
        shade = np.array([0.8, 0.9, 1.0])[enter.argmax(axis=2)]
        depth[hit] = t[hit]
        owner[hit] = max(number - 1, 0)
        rgb[hit] = (np.array(slab.colour) * shade[..., None])[hit]
    rng = np.random.default_rng(0)
    rgb = np.clip(rgb + rng.normal(0, 2, rgb.shape), 0, 255).astype(np.uint8)
    depth += rng.normal(0, 1, SHAPE) * noise_m
    return rgb, depth.astype(np.float32), owner


def segmented(names, instances, depth_m):
    scores = np.full(len(names), 0.8)
    instances = instances.astype(np.uint16)
    return SegmentedObjects(names, scores, None, instances, depth_m, INTRINSICS, UP_CAMERA)


def box_of(mask: np.ndarray) -> np.ndarray:
    """Box (4,) of a mask: x1, y1, x2, y2, pixels."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.min(), rows.min(), columns.max(), rows.max()], dtype=float)


def on_image(patch: MaskPatch, shape: tuple[int, int]) -> np.ndarray:
    """The mask on the whole image, (H, W) bool."""
    image = np.zeros(shape, dtype=bool)
    image[patch.window] = patch.pixels
    return image


def overlap(patch: MaskPatch, truth: np.ndarray) -> float:
    """IoU of a mask and the true mask."""
    mask = on_image(patch, truth.shape)
    return float((mask & truth).sum() / (mask | truth).sum())


TABLE_TOP = Slab((-0.6, 1.4, 0.66), (0.6, 2.2, 0.70), (120, 70, 40))
TABLE_LEG = Slab((-0.1, 1.7, 0.0), (0.1, 1.9, 0.66), (120, 70, 40))
CUP_ON_TABLE = Slab((-0.25, 1.6, 0.70), (-0.10, 1.75, 0.86), (200, 40, 40))
