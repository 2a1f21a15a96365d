"""Stage b in one reading: frame graph, instance labels and depth become a local 3D graph."""

from __future__ import annotations

from collections import Counter

import numpy as np

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting.depth_layer import dominant_layer
from deworldsg_ros.lifting.moments import back_project, estimate_gaussians
from deworldsg_ros.lifting.pixels import Pixels, valid_depth, valid_pixel_counts
from deworldsg_ros.lifting.regions import box_pixels, mask_pixels, smooth_pixels, valid_pixels
from deworldsg_ros.lifting.spatial import spatial_inliers
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

# Two samples of a wardrobe have to meet in cells of 3 cm, with those beside them: so much visible
# surface gets a point of its own, where the usual number leaves more, up to a few times that.
POINT_AREA_M2 = 0.003
LARGE_FACTOR = 4


class Lifting:
    """Lifts the objects of a frame to 3D Gaussians in the world frame; keeps no state."""

    def __init__(self, config: LiftingConfig) -> None:
        self.config = config

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
            instances: (H, W) uint16, 0 = nothing, k = k-th object of the frame graph.
            depth_m: (H, W) float32 metres; 0, NaN, infinity and negative values are invalid.
            intrinsics: of both images.
            T_world_camera: (4, 4) float64.
            frame_id: name of the world frame.

        Returns:
            The objects with enough valid pixels, in the order of the frame graph; the others are
            counted in `drops` under ``few_mask_pixels``, ``few_spatial_inliers`` (Eq. 1) or
            ``few_depth_inliers`` (Eq. 2), and their relations vanish with them.

        Raises:
            RefusedInput: ``grid_mismatch`` where sizes differ, ``invalid_pose``,
                ``unknown_instance`` where the instance image has values beyond the frame graph.
        """
        _check_grids(frame_graph, instances, depth_m, intrinsics)
        check_pose(T_world_camera)
        depth_m = valid_depth(depth_m)
        refined, drops = self._refine(depth_m, instances, frame_graph)

        rows = np.array(sorted(refined), np.int64)
        objects = [refined[row] for row in rows]
        means, covariances, depths_m = estimate_gaussians(
            objects, intrinsics, T_world_camera, self.config.covariance_ridge_m2
        )
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
            surface_points_world=_surface_points(
                objects,
                _point_numbers(objects, depths_m, intrinsics, self.config.surface_points),
                intrinsics,
                T_world_camera,
            ),
            relations=_kept_relations(frame_graph.relations, rows, len(frame_graph)),
            drops=drops,
            depth_grid=_depth_grid(depth_m, intrinsics, self.config.depth_grid_stride_px),
        )

    def warm_up(self) -> None:
        """Compile the kernels, or load them from numba's cache, before the first frame."""
        vocabulary = Vocabulary(("thing",), ())
        nothing = Relations.none(0)
        graph = FrameGraph(
            0, "", 8, 8, vocabulary, np.zeros((1, 4)), np.ones((1, 1)), np.ones(1), nothing
        )
        # Two layers, steps of many sizes: every kernel has work.
        depth_m = (1.0 + 0.001 * np.arange(64) ** 1.5).reshape(8, 8).astype(np.float32)
        depth_m[5:] += 5.0
        instances = np.ones((8, 8), np.uint16)
        intrinsics = Intrinsics(8.0, 8.0, 4.0, 4.0, 8, 8)
        Lifting(LiftingConfig()).lift(graph, instances, depth_m, intrinsics, np.eye(4), "")

    def _refine(
        self, depth_m: Float32, instances: UInt16, frame_graph: FrameGraph
    ) -> tuple[dict[int, Pixels], dict[str, int]]:
        """Final inliers by object (row of the frame graph), and the drops by reason."""
        config = self.config
        valid_counts = valid_pixel_counts(depth_m, instances, len(frame_graph))
        if valid_counts[0]:
            raise RefusedInput(
                "unknown_instance",
                f"{valid_counts[0]} pixels of the instance image, up to {instances.max()}: "
                f"wanted values up to {len(frame_graph)}, the number of objects in the frame graph",
            )
        if config.regions == "boxes":
            valid = box_pixels(depth_m, valid_pixels(depth_m), frame_graph.boxes_xyxy)
            valid_counts = np.array([0, *map(len, valid)], np.int64)
        refined: dict[int, Pixels] = {}
        drops: Counter[str] = Counter()
        for row, pixels in enumerate(
            self._spatial(depth_m, instances, valid_counts, frame_graph.boxes_xyxy)
        ):
            if valid_counts[row + 1] < config.min_pixels:
                drops["few_mask_pixels"] += 1
                continue
            if len(pixels) < config.min_pixels:
                drops["few_spatial_inliers"] += 1
                continue
            if not config.refine:
                refined[row] = pixels
                continue
            layer_m = dominant_layer(
                pixels.depths_m, config.gamma_base_m, config.alpha, config.beta
            )
            kept = pixels.within(*layer_m)
            if len(kept) < config.min_pixels:
                drops["few_depth_inliers"] += 1
                continue
            refined[row] = kept
        return refined, dict(drops)

    def _spatial(
        self,
        depth_m: Float32,
        instances: UInt16,
        valid_counts: Int64,
        boxes_xyxy: Float64,
    ) -> list[Pixels]:
        """Pixels of each object, of its mask or box, after Eq. 1 or without it."""
        tau, epsilon_m, refine = self.config.tau, self.config.epsilon_m, self.config.refine
        if self.config.regions == "boxes":
            kept = smooth_pixels(depth_m, tau, epsilon_m) if refine else valid_pixels(depth_m)
            return box_pixels(depth_m, kept, boxes_xyxy)
        if not refine:
            return mask_pixels(depth_m, instances, valid_counts)
        return spatial_inliers(depth_m, instances, valid_counts, tau, epsilon_m)


def _check_grids(
    frame_graph: FrameGraph,
    instances: UInt16,
    depth_m: Float32,
    intrinsics: Intrinsics,
) -> None:
    wanted = (frame_graph.height, frame_graph.width)
    grids = {
        "instance image": instances.shape,
        "depth": depth_m.shape,
        "camera_info": (intrinsics.height, intrinsics.width),
    }
    for name, shape in grids.items():
        if shape != wanted:
            raise RefusedInput(
                "grid_mismatch", f"{name} is (rows, columns) {shape}: the frame graph has {wanted}"
            )


def _point_numbers(
    objects: list[Pixels], depths_m: Float64, intrinsics: Intrinsics, number: int
) -> list[int]:
    """Surface points that each object gives: this number, more of a large surface, or all."""
    pixels = np.array([len(item) for item in objects], np.int64)
    areas_m2 = pixels * depths_m**2 / (intrinsics.fx * intrinsics.fy)
    wanted = np.clip((areas_m2 / POINT_AREA_M2).astype(np.int64), number, LARGE_FACTOR * number)
    numbers: list[int] = np.minimum(wanted, pixels).tolist()
    return numbers


def _surface_points(
    objects: list[Pixels], numbers: list[int], intrinsics: Intrinsics, T_world_camera: Float64
) -> tuple[Float32, ...]:
    """So many points of each object, world frame: every n-th of its inliers."""
    if not objects:
        return ()
    chosen = [
        np.arange(number) * len(pixels) // max(number, 1)
        for number, pixels in zip(numbers, objects)
    ]
    sample = Pixels(
        np.concatenate([pixels.columns[at] for pixels, at in zip(objects, chosen)]),
        np.concatenate([pixels.rows[at] for pixels, at in zip(objects, chosen)]),
        np.concatenate([pixels.depths_m[at] for pixels, at in zip(objects, chosen)]),
    )
    points = back_project(sample, intrinsics, T_world_camera).astype(np.float32)
    return tuple(np.split(points, np.cumsum(numbers)[:-1]))


def _depth_grid(depth_m: Float32, intrinsics: Intrinsics, stride_px: int) -> DepthGrid | None:
    """Valid depth on every n-th pixel, in whole millimetres; None where n is 0."""
    if stride_px == 0:
        return None
    samples_mm = np.rint(depth_m[stride_px // 2 :: stride_px, stride_px // 2 :: stride_px] * 1000.0)
    samples_mm = np.minimum(samples_mm, np.iinfo(np.uint16).max).astype(np.uint16)
    return DepthGrid(samples_mm, stride_px, intrinsics)


def _kept_relations(relations: Relations, rows: Int64, count: int) -> Relations:
    """Relations whose both ends are among these rows, with the rows renumbered."""
    renumbered = np.full(count, -1, np.int64)
    renumbered[rows] = np.arange(len(rows))
    pairs = renumbered[relations.pairs]
    kept = (pairs >= 0).all(axis=1)
    return Relations(pairs[kept], relations.logits[kept], relations.scores[kept])
