"""The lifting stage: frame graph, instance image and depth become a local 3D graph."""

from __future__ import annotations

from collections import Counter
from itertools import accumulate
from typing import Protocol

import numpy as np

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting.constants import (
    DEPTH_GRID_STRIDE_PX,
    LiftingConstants,
)
from deworldsg_ros.lifting.depth_layer import dominant_layer
from deworldsg_ros.lifting.moments import Estimate, estimate_gaussian
from deworldsg_ros.lifting.pixels import valid_depth
from deworldsg_ros.lifting.spatial import masks_of, spatial_inliers, valid_pixel_count
from deworldsg_ros.lifting.unrefined import box_pixels, mask_pixels
from deworldsg_ros.scene.arrays import Float32, Float64, Int32, UInt16
from deworldsg_ros.scene.camera import Intrinsics, check_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import (
    DepthGrid,
    FrameGraph,
    LocalGraph,
    Relations,
    Vocabulary,
    lifted,
)
from deworldsg_ros.scene.gaussian import transform


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
            are counted in `drops` under ``few_mask_pixels``, ``few_spatial_inliers`` (Eq. 1) or
            ``few_depth_inliers`` (Eq. 2). Their relations are removed.

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
            depth_grid=_depth_grid(depth_m, instances, intrinsics),
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
        """An object by the pixels of its mask or box; the reason if there are too few."""
        config, constants = self._config, self._constants
        if config.pixels == "box":
            pixels = box_pixels(depth_m, box_xyxy)
        elif config.pixels == "mask":
            pixels = mask_pixels(depth_m, runs)
        else:
            pixels = spatial_inliers(depth_m, runs, config.tau, constants.epsilon_m)
        least = constants.min_pixels
        if len(pixels) < least:
            had_few = config.pixels != "refined" or valid_pixel_count(depth_m, runs) < least
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


def _depth_grid(depth_m: Float32, instances: UInt16, intrinsics: Intrinsics) -> DepthGrid:
    """Valid depth in whole millimetres, and instances, on every N-th pixel."""
    every = slice(DEPTH_GRID_STRIDE_PX // 2, None, DEPTH_GRID_STRIDE_PX)
    samples_mm = np.rint(depth_m[every, every] * 1000.0)
    samples_mm = np.minimum(samples_mm, np.iinfo(np.uint16).max).astype(np.uint16)
    samples = np.ascontiguousarray(instances[every, every], np.uint16)
    return DepthGrid(samples_mm, DEPTH_GRID_STRIDE_PX, intrinsics, samples)
