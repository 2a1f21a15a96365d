"""FROSS (Hou et al., ICCV 2025): boxes lifted at their centre, merged by class and distance.

Implemented from the published description; docs/dev/evaluation/protocol.md lists the open choices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from deworldsg_ros.evaluation.baselines.graph import BaselineNode, fuse_nodes
from deworldsg_ros.evaluation.baselines.lifting import Lifted
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import FrameGraph
from deworldsg_ros.scene.gaussian import hellinger_distance, transform

# Below this distance two nodes of one class merge (FROSS).
MAX_HELLINGER_DISTANCE = 0.85
# Spacing of the grid of evaluation points in the central half of the box (FROSS).
GRID_PX = 50


class Fross:
    """Stages b and c of FROSS."""

    name = "FROSS"

    def lift(
        self,
        frame_graph: FrameGraph,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        T_world_camera: Float64,
    ) -> Lifted:
        """Nodes of the objects that have depth at the centre of their box.

        Drops: ``no_centre_depth``, or ``empty_box`` if a side is shorter than a pixel.
        """
        nodes, rows, drops = [], [], Counter[str]()
        for row, box in enumerate(frame_graph.boxes_xyxy):
            u, v, width, height = whole_box(box)
            if width < 1 or height < 1:
                drops["empty_box"] += 1
                continue
            depth = float(depth_m[v, u])
            if not 0.0 < depth < np.inf:
                drops["no_centre_depth"] += 1
                continue
            centre = intrinsics.back_project(np.array([u]), np.array([v]), np.array([depth]))[0]
            mean, covariance = transform(
                centre, box_covariance(u, v, width, height, depth, intrinsics), T_world_camera
            )
            points = evaluation_points(u, v, width, height, depth_m, intrinsics, T_world_camera)
            rows.append(row)
            nodes.append(
                BaselineNode(
                    mean,
                    covariance,
                    frame_graph.class_probabilities[row],
                    float(len(points)),
                    points,
                    frame_graph.stamp_ns,
                    frame_graph.stamp_ns,
                )
            )
        return Lifted(nodes, rows, drops)

    def choose(self, node: BaselineNode, others: Sequence[BaselineNode]) -> int | None:
        """Index of the nearest node of the same class by Hellinger distance; None if too far.

        In the released code two equal Gaussians give NaN and never merge. Here the Bhattacharyya
        distance is clamped at 0 (`scene.gaussian`).
        """
        indices = [index for index, other in enumerate(others) if other.label == node.label]
        if not indices:
            return None
        distances = hellinger_distance(
            node.mean_world,
            node.covariance_world,
            np.array([others[index].mean_world for index in indices]),
            np.array([others[index].covariance_world for index in indices]),
        )
        nearest = int(distances.argmin())
        return indices[nearest] if distances[nearest] < MAX_HELLINGER_DISTANCE else None

    def fuse(self, keeper: BaselineNode, other: BaselineNode) -> BaselineNode:
        """Both nodes in one, weighted by their numbers of evaluation points."""
        weights = np.array([keeper.weight, other.weight])
        weights = weights / weights.sum() if weights.sum() > 0 else np.array([0.5, 0.5])
        scores = weights[0] * keeper.class_scores + weights[1] * other.class_scores
        return fuse_nodes(keeper, other, scores)


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


def evaluation_points(
    u: int,
    v: int,
    width: int,
    height: int,
    depth_m: Float32,
    intrinsics: Intrinsics,
    T_world_camera: Float64,
) -> Float64:
    """Points (n, 3) of a 50-pixel grid in the central half of the box, world frame."""
    columns = np.arange(u - width // 4, u + width // 4, GRID_PX)
    rows = np.arange(v - height // 4, v + height // 4, GRID_PX)
    columns = columns[(columns >= 0) & (columns < intrinsics.width)]
    rows = rows[(rows >= 0) & (rows < intrinsics.height)]
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    depths = depth_m[pixels[:, 1], pixels[:, 0]]
    valid = (depths > 0) & np.isfinite(depths)
    kept = pixels[valid]
    points = intrinsics.back_project(kept[:, 0], kept[:, 1], depths[valid].astype(np.float64))
    return np.asarray(points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])
