"""Surface points of objects, and local graphs of them, for the surface rule."""

import dataclasses

import numpy as np
from support.merging import local_graph, moments

from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

CUP, TABLE, CHAIR = 0, 1, 2


def slab(centre: tuple[float, float, float], size: tuple[float, float, float]) -> np.ndarray:
    """Points in a thin box with 3 mm of noise, about 2000 per square metre."""
    rng = np.random.default_rng(abs(hash((centre, size))) % 2**32)
    count = int(np.clip(2000 * max(size[0] * size[1], size[1] * size[2], 0.05), 100, 4000))
    points = rng.uniform(-0.5, 0.5, (count, 3)) * size + centre
    return (points + rng.normal(0, 0.003, points.shape)).astype(np.float32)


def frame(stamp: int, *objects: tuple[np.ndarray, int], **changes) -> LocalGraph:
    """A local graph of objects, each with surface points and a class."""
    count = len(objects)
    gaussians = [moments(points, 1e-6) for points, _ in objects]
    means = np.array([mean for mean, _ in gaussians]).reshape(-1, 3)
    covariances = np.array([covariance for _, covariance in gaussians]).reshape(-1, 3, 3)
    classes = np.full((count, 4), 0.05)
    classes[np.arange(count), [kind for _, kind in objects]] = 0.85
    points = tuple(points for points, _ in objects)
    more = {"pixel_counts": np.array([len(one) for one in points], np.int64), **changes}
    return local_graph(stamp * 10**8, means, covariances, classes, points=points, **more)


WHOLE = slab((0, 0, 1), (2.2, 0.8, 0.01))
CAMERA = Intrinsics(300.0, 300.0, 319.5, 239.5, 640, 480)
WALL_M = 1.0  # depth of the wall behind the objects
HERE = slab((0.3, 0.1, 0.7), (0.08, 0.08, 0.06))


def pixels_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of points in the depth grid of a camera at the origin, along z."""
    columns = np.floor((300 * points[:, 0] / points[:, 2] + 319.5) / 8).astype(int)
    rows = np.floor((300 * points[:, 1] / points[:, 2] + 239.5) / 8).astype(int)
    return rows, columns


def depth_grid(*surfaces: np.ndarray, background_m: float = WALL_M) -> DepthGrid:
    """Depth grid of points in front of a wall, from a camera at the origin that points along z."""
    depth_mm = np.full((60, 80), background_m * 1000, np.uint16)
    for points in surfaces:
        np.minimum.at(depth_mm, pixels_of(points), (points[:, 2] * 1000).astype(np.uint16))
    return DepthGrid(depth_mm, 8, CAMERA)


def view(stamp: int, *objects: tuple[np.ndarray, int | None], **changes) -> LocalGraph:
    """A local graph with its depth grid: what is seen of objects from the origin, along z.

    An object without a class is not detected: the masks of those behind it include it.
    """
    surfaces = [points for points, _ in objects]
    grid = depth_grid(*surfaces)
    instances = np.zeros_like(grid.depth_mm)
    found = [(points, kind) for points, kind in objects if kind is not None]
    for value, (points, _) in sorted(
        enumerate(found, 1), key=lambda item: -float(item[1][0][:, 2].mean())
    ):
        instances[pixels_of(points)] = value
    return frame(
        stamp, *found, depth_grid=dataclasses.replace(grid, instances=instances), **changes
    )
