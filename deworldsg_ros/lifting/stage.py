"""The lifting stage: frame graph, instance image and depth become a local 3D graph."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple, Protocol

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting.refine import (
    Pixels,
    dominant_layer,
    masks_of,
    spatial_inliers,
    valid_depth,
)
from deworldsg_ros.scene.arrays import Float32, Float64, Int32, UInt8, UInt16
from deworldsg_ros.scene.camera import Intrinsics, check_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import (
    GRID,
    GRID_STRIDE_PX,
    DepthGrid,
    FrameGraph,
    LocalGraph,
    Relations,
    Vocabulary,
    lifted,
)
from deworldsg_ros.scene.gaussian import transform

# --- Fixed values of the lifting stage.


@dataclass(frozen=True)
class LiftingConstants:
    """Values that no configuration changes; tests vary them.

    Attributes:
        epsilon_m: absolute tolerance to the local median, metres (Eq. 1). Printed in the paper.
        alpha: factor of the median depth step (Eq. 2). Printed in the paper.
        beta: factor of the reference depth (Eq. 2). Printed in the paper.
        min_pixels: an object with fewer valid pixels is dropped. Printed in the paper, which
            checks the mask; here it is checked after each refinement step too.
        surface_points: surface points sampled from an object in one frame. An object with a large
            surface gets up to `LARGE_SURFACE_FACTOR` times as many.
    """

    epsilon_m: float = 1e-3
    alpha: float = 10.0
    beta: float = 0.02
    min_pixels: int = 10
    surface_points: int = 200


# Every N-th pixel of the depth image is kept, in both directions, for the negative evidence of the
# merging stage: 4800 samples of a 640 x 480 image.
# A surface gets one point for each 30 cm², up to LARGE_SURFACE_FACTOR times the usual number. Two
# samples of a wardrobe then meet in the 3 cm cells of the merging stage, or in adjacent cells.
POINT_AREA_M2 = 0.003
LARGE_SURFACE_FACTOR = 4


# --- Pixels of each object without depth refinement: the paper's ablation (b).


def mask_pixels(depth_m: Float32, runs: Int32) -> Pixels:
    """Every valid pixel of an object's mask: ablation (b).

    The arguments are those of `spatial_inliers`.
    """
    return spatial_inliers(depth_m, runs, 0.0, np.inf)


def box_pixels(depth_m: Float32, box_xyxy: Float64) -> Pixels:
    """Every valid pixel of a box. Boxes may overlap; a pixel then belongs to several objects.

    Args:
        depth_m: (H, W) float32 metres, 0 = invalid.
        box_xyxy: (4,) pixels; a box contains the pixels whose centres lie in it.
    """
    height, width = depth_m.shape
    x1, y1, x2, y2 = box_xyxy.tolist()
    left, top = max(math.ceil(x1), 0), max(math.ceil(y1), 0)
    right, bottom = min(math.floor(x2) + 1, width), min(math.floor(y2) + 1, height)
    box_m = depth_m[top:bottom, left:right]
    rows, columns = np.nonzero(box_m > 0)
    return Pixels(
        np.add(columns, left, dtype=np.int32),
        np.add(rows, top, dtype=np.int32),
        box_m[rows, columns],
    )


# --- Back-projection (Eq. 3) and the Gaussian of an object (Eq. 4).

# Points that are computed at once; they fit into the first-level cache.
CHUNK = 256

# fx, fy, cx, cy in pixels.
_Camera = tuple[float, float, float, float]


class Estimate(NamedTuple):
    """An object in the camera frame.

    Attributes:
        pixel_count: number of its inliers. With fewer than the minimum, the rest is empty.
        mean: (3,) float64, metres.
        covariance: (3, 3) float64, square metres, N - 1 in the denominator, without the ridge εI.
        points: (k, 3) float64, metres, a sample of the inliers: evenly spaced in row order.
    """

    pixel_count: int
    mean: Float64
    covariance: Float64
    points: Float64


def estimate_gaussian(
    pixels: Pixels,
    layer_m: tuple[float, float],
    intrinsics: Intrinsics,
    min_pixels: int,
    surface_points: int,
) -> Estimate:
    """Sample mean and covariance of an object's points, camera frame (Eq. 4), and some points.

    The Gaussian of the points in the world frame follows by `scene.gaussian.transform`: μ → Rμ + t,
    Σ → RΣRᵀ. All points together are never stored.

    Args:
        pixels: of the object.
        layer_m: lowest and highest depth of its inliers, metres (Eq. 2).
        intrinsics: of the depth image.
        min_pixels: an object with fewer inliers is not estimated; at least 2.
        surface_points: usual size of the sample. A large surface gets more points, see
            `POINT_AREA_M2`; no object gets more than it has inliers.
    """
    camera = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    arrays = pixels.columns, pixels.rows, pixels.depths_m
    return Estimate(*_estimate(arrays, layer_m, camera, min_pixels, surface_points))


@kernel
def _estimate(
    pixels: tuple[Int32, Int32, Float32],
    layer_m: tuple[float, float],
    camera: _Camera,
    min_pixels: int,
    surface_points: int,
) -> tuple[int, Float64, Float64, Float64]:
    all_columns, all_rows, all_depths_m = pixels
    lowest_m, highest_m = layer_m
    columns = np.empty(all_columns.size, np.int32)
    rows, depths_m = np.empty(columns.size, np.int32), np.empty(columns.size, np.float32)
    count = 0
    for index in range(all_depths_m.size):
        z = all_depths_m[index]
        columns[count], rows[count], depths_m[count] = all_columns[index], all_rows[index], z
        count += (z >= lowest_m) & (z <= highest_m)
    if count < min_pixels:
        nothing = np.empty((0, 0), np.float64)
        return count, np.empty(0, np.float64), nothing, nothing
    mean, covariance = _moments(columns[:count], rows[:count], depths_m[:count], camera)
    fx, fy, cx, cy = camera
    area_m2 = count * mean[2] ** 2 / (fx * fy)
    by_area = min(int(area_m2 / POINT_AREA_M2), LARGE_SURFACE_FACTOR * surface_points)
    points = np.empty((min(max(by_area, surface_points), count), 3), np.float64)
    for index in range(len(points)):
        place = index * count // len(points)
        # As `Intrinsics.back_project` (Eq. 3), with the same operations.
        depth_m = np.float64(depths_m[place])
        points[index, 0] = (columns[place] - cx) / fx * depth_m
        points[index, 1] = (rows[place] - cy) / fy * depth_m
        points[index, 2] = depth_m
    return count, mean, covariance, points


@kernel
def _moments(
    columns: Int32, rows: Int32, depths_m: Float32, camera: _Camera
) -> tuple[Float64, Float64]:
    """Sample mean and covariance of the points of pixels."""
    fx, fy, cx, cy = camera
    count = depths_m.size
    # The sums are taken about a point of the object, not about the origin. A covariance of square
    # centimetres at a distance of metres would lose its digits otherwise.
    middle = count // 2
    z0 = np.float64(depths_m[middle])
    x0 = (columns[middle] - cx) / fx * z0
    y0 = (rows[middle] - cy) / fy * z0
    per_fx, per_fy = 1.0 / fx, 1.0 / fy
    sx = sy = sz = 0.0
    sxx = sxy = sxz = syy = syz = szz = 0.0
    # Points are computed in parallel, sums one after the other: their order decides the rounding.
    xs, ys = np.empty(CHUNK, np.float64), np.empty(CHUNK, np.float64)
    zs = np.empty(CHUNK, np.float64)
    for start in range(0, count, CHUNK):
        u, v = columns[start : start + CHUNK], rows[start : start + CHUNK]
        depths = depths_m[start : start + CHUNK]
        for index in range(depths.size):
            depth = np.float64(depths[index])
            xs[index] = (u[index] - cx) * per_fx * depth - x0
            ys[index] = (v[index] - cy) * per_fy * depth - y0
            zs[index] = depth - z0
        for index in range(depths.size):
            x, y, z = xs[index], ys[index], zs[index]
            sx += x
            sy += y
            sz += z
            sxx += x * x
            sxy += x * y
            sxz += x * z
            syy += y * y
            syz += y * z
            szz += z * z
    mean, covariance = np.empty(3, np.float64), np.empty((3, 3), np.float64)
    mean[0], mean[1], mean[2] = sx / count, sy / count, sz / count
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = sxx, syy, szz
    covariance[0, 1] = covariance[1, 0] = sxy
    covariance[0, 2] = covariance[2, 0] = sxz
    covariance[1, 2] = covariance[2, 1] = syz
    for i in range(3):
        for j in range(3):
            covariance[i, j] = (covariance[i, j] - count * mean[i] * mean[j]) / (count - 1)
    mean[0], mean[1], mean[2] = mean[0] + x0, mean[1] + y0, mean[2] + z0
    return mean, covariance


# --- A box by the one depth at its centre, as FROSS lifts it: the paper's ablation (a).


def whole_box(box_xyxy: Float64) -> tuple[int, int, int, int]:
    """Centre column, centre row, width and height of a box, truncated to whole pixels."""
    x1, y1, x2, y2 = box_xyxy.tolist()
    return int((x1 + x2) / 2), int((y1 + y2) / 2), int(x2 - x1), int(y2 - y1)


def box_covariance(
    u: int, v: int, width: int, height: int, depth_m: float, intrinsics: Intrinsics
) -> Float64:
    """Covariance of a box's object in the camera frame, (3, 3) square metres.

    The box is a uniform distribution with covariance diag(w², h²) / 12. The pseudo-inverse of the
    Jacobian of the projection, J = [[fx/Z, 0, -x fx/Z²], [0, fy/Z, -y fy/Z²]], maps it to 3D, with
    x, y in normalised image coordinates as in the released code. The mean of the variances of x and
    y is added to that of z.
    """
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    fx, fy = intrinsics.fx / depth_m, intrinsics.fy / depth_m
    jacobian = np.array([[fx, 0.0, -x * fx / depth_m], [0.0, fy, -y * fy / depth_m]])
    inverse = np.linalg.pinv(jacobian)
    covariance = inverse @ np.diag([width**2 / 12.0, height**2 / 12.0]) @ inverse.T
    covariance[2, 2] += (covariance[0, 0] + covariance[1, 1]) / 2
    return np.asarray(covariance, np.float64)


def box_estimate(
    depth_m: Float32, box_xyxy: Float64, intrinsics: Intrinsics, surface_points: int
) -> Estimate | None:
    """An object by the depth at the centre of its box; None without a valid one.

    The valid pixels of the central half of the box are its weight (`pixel_count`), and a sample of
    them its points, as the evaluation points of FROSS. They do not enter the Gaussian.

    Args:
        depth_m: (H, W) float32 metres, 0 = invalid.
        box_xyxy: (4,) pixels, inside the image.
        intrinsics: of the depth image.
        surface_points: size of the sample.
    """
    u, v, width, height = whole_box(box_xyxy)
    if width < 1 or height < 1 or not depth_m[v, u] > 0:
        return None
    z = float(depth_m[v, u])
    half_u, half_v = width // 4, height // 4
    middle = np.array([u - half_u, v - half_v, u + half_u, v + half_v], np.float64)
    pixels = box_pixels(depth_m, middle)
    count = min(len(pixels), surface_points)
    kept = np.arange(count) * len(pixels) // count
    points = intrinsics.back_project(
        pixels.columns[kept], pixels.rows[kept], pixels.depths_m[kept].astype(np.float64)
    )
    centre = intrinsics.back_project(np.array([u]), np.array([v]), np.array([z]))[0]
    covariance = box_covariance(u, v, width, height, z, intrinsics)
    return Estimate(len(pixels), centre, covariance, points)


# --- The lifting stage: frame graph, instance image and depth become a local 3D graph.


class PosedDepth(Protocol):
    """A depth image with its camera and its pose, as `Lifting.lift` takes them."""

    @property
    def depth_m(self) -> Float32:
        """(H, W) float32, metres."""
        ...

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the image."""
        ...

    @property
    def T_world_camera(self) -> Float64:  # noqa: N802, the name of the frames' field
        """(4, 4) float64."""
        ...

    @property
    def frame_id(self) -> str:
        """Name of the world frame."""
        ...


class Lifting:
    """Lifts the objects of a frame to 3D Gaussians in the world frame; keeps no state.

    Args:
        config: thresholds of Eq. 1-4, and which pixels belong to an object.
        constants: fixed values; only tests change them.
    """

    def __init__(
        self, config: LiftingConfig, constants: LiftingConstants = LiftingConstants()
    ) -> None:
        self._constants = constants
        self.configure(config)

    def configure(self, config: LiftingConfig) -> None:
        """Use another section from the next frame on."""
        self._config = config

    def lift(
        self,
        frame_graph: FrameGraph,
        instances: UInt16,
        depth_m: Float32,
        intrinsics: Intrinsics,
        T_world_camera: Float64,
        frame_id: str,
    ) -> LocalGraph:
        """Local 3D graph of one frame.

        Args:
            frame_graph: n objects and the relations between them.
            instances: (H, W) uint16, 0 = no object, k = k-th object of the frame graph.
            depth_m: (H, W) float32 metres; 0, NaN, infinity and negative values are invalid.
            intrinsics: of both images.
            T_world_camera: (4, 4) float64.
            frame_id: name of the world frame.

        Returns:
            The objects with enough valid pixels, in the order of the frame graph. Dropped objects
            are counted in `drops` under ``few_mask_pixels``, ``few_spatial_inliers`` (Eq. 1),
            ``few_depth_inliers`` (Eq. 2) or, lifted by their boxes, ``no_centre_depth``. Their
            relations are removed.

        Raises:
            RefusedInput: ``grid_mismatch`` if sizes differ, ``invalid_pose``, or
                ``unknown_instance`` if the instance image has ids beyond the frame graph.
        """
        _check_grids(frame_graph, instances, depth_m, intrinsics)
        check_pose(T_world_camera)
        depth_m = valid_depth(depth_m)
        objects, drops = self._objects(depth_m, instances, frame_graph, intrinsics)

        found = list(objects.values())
        rows = np.array(list(objects), np.int64)
        means_camera = np.array([item.mean for item in found]).reshape(-1, 3)
        covariances = np.array([item.covariance for item in found]).reshape(-1, 3, 3)
        means, covariances = transform(means_camera, covariances, T_world_camera)
        return lifted(
            frame_graph,
            rows,
            frame_id,
            T_world_camera,
            means_world=means,
            covariances_world=covariances + self._config.covariance_ridge_m2 * np.eye(3),
            depths_m=means_camera[:, 2].copy(),
            pixel_counts=np.array([item.pixel_count for item in found], np.int64),
            surface_points_world=_surface_points(found, T_world_camera),
            drops=drops,
            depth_grid=_depth_grid(depth_m, instances, intrinsics, frame_graph.rgb_grid),
        )

    def lift_frame(
        self, frame_graph: FrameGraph, instances: UInt16, frame: PosedDepth
    ) -> LocalGraph:
        """`lift` with the depth, the camera and the pose of a frame."""
        return self.lift(
            frame_graph,
            instances,
            frame.depth_m,
            frame.intrinsics,
            frame.T_world_camera,
            frame.frame_id,
        )

    def warm_up(self) -> None:
        """Compile the kernels, or load them from numba's cache, before the first frame."""
        vocabulary = Vocabulary(("object",), ())
        no_relations = Relations.none(0)
        graph = FrameGraph(
            0, "", 8, 8, vocabulary, np.zeros((1, 4)), np.ones((1, 1)), np.ones(1), no_relations
        )
        # Two depth layers with steps of many sizes run every kernel.
        depth_m = (1.0 + 0.001 * np.arange(64) ** 1.5).reshape(8, 8).astype(np.float32)
        depth_m[5:] += 5.0
        depth_m[0, 0] = np.nan
        instances = np.ones((8, 8), np.uint16)
        intrinsics = Intrinsics(8.0, 8.0, 4.0, 4.0, 8, 8)
        Lifting(LiftingConfig()).lift(graph, instances, depth_m, intrinsics, np.eye(4), "")

    def _objects(
        self,
        depth_m: Float32,
        instances: UInt16,
        frame_graph: FrameGraph,
        intrinsics: Intrinsics,
    ) -> tuple[dict[int, Estimate], dict[str, int]]:
        """The objects with enough pixels, by their row, and the drops by reason.

        One object after the other: its pixels stay in the cache until they are reduced.
        """
        masks = masks_of(instances, len(frame_graph))
        if masks.unknown:
            raise RefusedInput(
                "unknown_instance",
                f"{masks.unknown} pixels of the instance image have an id above "
                f"{len(frame_graph)}, up to {instances.max()}: expected at most "
                f"{len(frame_graph)}, the number of objects in the frame graph",
            )
        objects: dict[int, Estimate] = {}
        drops: Counter[str] = Counter()
        for row, box_xyxy in enumerate(frame_graph.boxes_xyxy):
            item = self._object(depth_m, masks.runs_of(row), box_xyxy, intrinsics)
            if isinstance(item, str):
                drops[item] += 1
            else:
                objects[row] = item
        return objects, dict(drops)

    def _object(
        self, depth_m: Float32, runs: Int32, box_xyxy: Float64, intrinsics: Intrinsics
    ) -> Estimate | str:
        """An object by the pixels of its mask, or by its box; the reason if there are too few."""
        config, constants = self._config, self._constants
        if config.pixels == "box":
            of_box = box_estimate(depth_m, box_xyxy, intrinsics, constants.surface_points)
            return of_box or "no_centre_depth"
        if config.pixels == "mask":
            pixels = mask_pixels(depth_m, runs)
        else:
            pixels = spatial_inliers(depth_m, runs, config.tau, constants.epsilon_m)
        least = constants.min_pixels
        if len(pixels) < least:
            had_few = config.pixels != "refined" or len(mask_pixels(depth_m, runs)) < least
            return "few_mask_pixels" if had_few else "few_spatial_inliers"
        layer_m = 0.0, np.inf
        if config.pixels == "refined":
            layer_m = dominant_layer(
                pixels.depths_m, config.gamma_base_m, constants.alpha, constants.beta
            )
        item = estimate_gaussian(pixels, layer_m, intrinsics, least, constants.surface_points)
        return item if item.pixel_count >= least else "few_depth_inliers"


def _check_grids(
    frame_graph: FrameGraph,
    instances: UInt16,
    depth_m: Float32,
    intrinsics: Intrinsics,
) -> None:
    expected = (frame_graph.height, frame_graph.width)
    grids = {
        "instance image": instances.shape,
        "depth": depth_m.shape,
        "camera_info": (intrinsics.height, intrinsics.width),
    }
    for name, shape in grids.items():
        if shape != expected:
            raise RefusedInput(
                "grid_mismatch",
                f"{name} has (rows, columns) {shape}: expected {expected} as in the frame graph",
            )


def _surface_points(objects: list[Estimate], T_world_camera: Float64) -> tuple[Float32, ...]:
    """Sample of each object's points (k, 3), world frame, metres."""
    if not objects:
        return ()
    points_camera = np.concatenate([item.points for item in objects])
    points = (points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]).astype(np.float32)
    ends = [*accumulate(len(item.points) for item in objects)]
    # From a list: Python cuts a tuple of a generator to its length, and keeps 2000 of each length.
    return tuple([points[start:end] for start, end in zip([0, *ends], ends)])


def _depth_grid(
    depth_m: Float32, instances: UInt16, intrinsics: Intrinsics, rgb: UInt8 | None
) -> DepthGrid:
    """Valid depth in whole millimetres, instances and colours, on every N-th pixel."""
    samples_mm = np.rint(depth_m[GRID, GRID] * 1000.0)
    samples_mm = np.minimum(samples_mm, np.iinfo(np.uint16).max).astype(np.uint16)
    samples = np.ascontiguousarray(instances[GRID, GRID], np.uint16)
    return DepthGrid(samples_mm, GRID_STRIDE_PX, intrinsics, samples, rgb)
