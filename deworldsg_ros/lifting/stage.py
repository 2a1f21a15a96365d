"""The lifting stage: frame graph, instance image and depth become a local 3D graph."""

from __future__ import annotations

from collections import Counter

import numpy as np

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting.constants import (
    DEPTH_GRID_STRIDE_PX,
    LARGE_SURFACE_FACTOR,
    POINT_AREA_M2,
    LiftingConstants,
)
from deworldsg_ros.lifting.depth_layer import dominant_layer
from deworldsg_ros.lifting.moments import back_project, estimate_gaussians
from deworldsg_ros.lifting.pixels import Pixels, valid_depth, valid_pixel_counts
from deworldsg_ros.lifting.spatial import spatial_inliers
from deworldsg_ros.lifting.unrefined import box_pixels, mask_pixels
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.camera import Intrinsics, check_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import (
    DepthGrid,
    FrameGraph,
    LocalGraph,
    Relations,
    Vocabulary,
)


class Lifting:
    """Lifts the objects of a frame to 3D Gaussians in the world frame; keeps no state.

    Args:
        config: thresholds of Eq. 1-4, and which pixels belong to an object.
        constants: fixed values; only tests change them.
    """

    def __init__(
        self, config: LiftingConfig, constants: LiftingConstants = LiftingConstants()
    ) -> None:
        self._config = config
        self._constants = constants

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
        inliers, drops = self._inliers(depth_m, instances, frame_graph)

        rows = np.array(sorted(inliers), np.int64)
        objects = [inliers[row] for row in rows]
        means, covariances, depths_m = estimate_gaussians(
            objects, intrinsics, T_world_camera, self._config.covariance_ridge_m2
        )
        point_counts = self._point_counts(objects, depths_m, intrinsics)
        return LocalGraph(
            stamp_ns=frame_graph.stamp_ns,
            frame_id=frame_id,
            width=frame_graph.width,
            height=frame_graph.height,
            T_world_camera=np.array(T_world_camera, np.float64),
            vocabulary=frame_graph.vocabulary,
            instance_ids=rows + 1,
            boxes_xyxy=frame_graph.boxes_xyxy[rows],
            class_probabilities=frame_graph.class_probabilities[rows],
            scores=frame_graph.scores[rows],
            means_world=means,
            covariances_world=covariances,
            depths_m=depths_m,
            pixel_counts=np.array([len(pixels) for pixels in objects], np.int64),
            surface_points_world=_surface_points(objects, point_counts, intrinsics, T_world_camera),
            relations=_kept_relations(frame_graph.relations, rows, len(frame_graph)),
            drops=drops,
            depth_grid=_depth_grid(depth_m, instances, intrinsics),
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
        instances = np.ones((8, 8), np.uint16)
        intrinsics = Intrinsics(8.0, 8.0, 4.0, 4.0, 8, 8)
        Lifting(LiftingConfig()).lift(graph, instances, depth_m, intrinsics, np.eye(4), "")

    def _inliers(
        self, depth_m: Float32, instances: UInt16, frame_graph: FrameGraph
    ) -> tuple[dict[int, Pixels], dict[str, int]]:
        """Final pixels of each kept object, by row of the frame graph, and the drops by reason."""
        config, constants = self._config, self._constants
        min_pixels = constants.min_pixels
        inliers: dict[int, Pixels] = {}
        drops: Counter[str] = Counter()
        candidates, valid_counts = self._candidates(depth_m, instances, frame_graph)
        for row, (pixels, valid_count) in enumerate(zip(candidates, valid_counts)):
            if valid_count < min_pixels:
                drops["few_mask_pixels"] += 1
                continue
            if len(pixels) < min_pixels:
                drops["few_spatial_inliers"] += 1
                continue
            if config.pixels == "refined":
                layer_m = dominant_layer(
                    pixels.depths_m, config.gamma_base_m, constants.alpha, constants.beta
                )
                pixels = pixels.within(*layer_m)
                if len(pixels) < min_pixels:
                    drops["few_depth_inliers"] += 1
                    continue
            inliers[row] = pixels
        return inliers, dict(drops)

    def _candidates(
        self, depth_m: Float32, instances: UInt16, frame_graph: FrameGraph
    ) -> tuple[list[Pixels], list[int]]:
        """Pixels of each object before Eq. 2, and its number of valid pixels before Eq. 1."""
        counts = valid_pixel_counts(depth_m, instances, len(frame_graph))
        if counts[0]:
            raise RefusedInput(
                "unknown_instance",
                f"{counts[0]} pixels of the instance image have an id above {len(frame_graph)}, up "
                f"to {instances.max()}: expected at most {len(frame_graph)}, the number of objects "
                "in the frame graph",
            )
        if self._config.pixels == "box":
            candidates = box_pixels(depth_m, frame_graph.boxes_xyxy)
            return candidates, [len(pixels) for pixels in candidates]
        if self._config.pixels == "mask":
            candidates = mask_pixels(depth_m, instances, counts)
        else:
            candidates = spatial_inliers(
                depth_m, instances, counts, self._config.tau, self._constants.epsilon_m
            )
        return candidates, counts[1:].tolist()

    def _point_counts(
        self, objects: list[Pixels], depths_m: Float64, intrinsics: Intrinsics
    ) -> list[int]:
        """Number of surface points of each object: more for a large surface, at most its pixels."""
        usual = self._constants.surface_points
        pixels = np.array([len(item) for item in objects], np.int64)
        areas_m2 = pixels * depths_m**2 / (intrinsics.fx * intrinsics.fy)
        by_area = (areas_m2 / POINT_AREA_M2).astype(np.int64)
        counts = np.clip(by_area, usual, LARGE_SURFACE_FACTOR * usual)
        numbers: list[int] = np.minimum(counts, pixels).tolist()
        return numbers


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


def _surface_points(
    objects: list[Pixels], counts: list[int], intrinsics: Intrinsics, T_world_camera: Float64
) -> tuple[Float32, ...]:
    """Evenly spaced sample of each object's pixels as points (count, 3), world frame, metres."""
    if not objects:
        return ()
    chosen = [
        np.arange(count) * len(pixels) // max(count, 1) for count, pixels in zip(counts, objects)
    ]
    sample = Pixels(
        np.concatenate([pixels.columns[at] for pixels, at in zip(objects, chosen)]),
        np.concatenate([pixels.rows[at] for pixels, at in zip(objects, chosen)]),
        np.concatenate([pixels.depths_m[at] for pixels, at in zip(objects, chosen)]),
    )
    points = back_project(sample, intrinsics, T_world_camera).astype(np.float32)
    return tuple(np.split(points, np.cumsum(counts)[:-1]))


def _depth_grid(depth_m: Float32, instances: UInt16, intrinsics: Intrinsics) -> DepthGrid:
    """Valid depth in whole millimetres, and instances, on every N-th pixel."""
    every = slice(DEPTH_GRID_STRIDE_PX // 2, None, DEPTH_GRID_STRIDE_PX)
    samples_mm = np.rint(depth_m[every, every] * 1000.0)
    samples_mm = np.minimum(samples_mm, np.iinfo(np.uint16).max).astype(np.uint16)
    samples = np.ascontiguousarray(instances[every, every], np.uint16)
    return DepthGrid(samples_mm, DEPTH_GRID_STRIDE_PX, intrinsics, samples)


def _kept_relations(relations: Relations, rows: Int64, count: int) -> Relations:
    """Relations between kept rows, with the rows renumbered."""
    renumbered = np.full(count, -1, np.int64)
    renumbered[rows] = np.arange(len(rows))
    pairs = renumbered[relations.pairs]
    kept = (pairs >= 0).all(axis=1)
    return Relations(pairs[kept], relations.logits[kept], relations.scores[kept])
