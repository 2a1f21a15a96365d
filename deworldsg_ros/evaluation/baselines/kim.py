"""Kim et al. (3-D Scene Graph, 2019): windows of boxes, merged by three similarities.

Implemented from the published description; docs/dev/evaluation/protocol.md lists the open choices.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from deworldsg_ros.evaluation.baselines.graph import BaselineNode, fuse_nodes
from deworldsg_ros.evaluation.baselines.lifting import Lifted
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt8
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import FrameGraph

# Constants of Kim et al., where no other source is given.
# Side of the window at the centre of a box, as a fraction of the side of the box: for sides shorter
# than SHORT_SIDE_PX, and for others.
SHORT_SIDE_PX = 30
SHORT_SIDE_FRACTION, SIDE_FRACTION = 0.4, 0.2
# Points farther away along any axis are dropped.
MAX_COORDINATE_M = 10.0
# A point is an outlier if its mean distance to its neighbours is more than this many standard
# deviations above the mean of all points.
NEIGHBOURS = 10
OUTLIER_SIGMAS = 1.0
# An object with fewer points in its window is dropped.
MIN_POINTS = 11
# Points per observation for the protocol, evenly sampled from the window; the pipeline has as many.
EVALUATION_POINTS = 64

# Bins per colour channel.
COLOUR_BINS = 8
CLASS_WEIGHT, POSITION_WEIGHT, COLOUR_WEIGHT = 0.5, 0.4, 0.1
# Class similarity by the number of common classes among the best three.
CLASS_SIMILARITIES = (0.0, 0.8, 0.9, 1.0)
# Distances are divided by the first; the position similarity is 1 up to the second (0.56 m).
POSITION_SCALE_M, POSITION_REACH = 5.0, 0.112
# Kim et al. do not state it; docs/dev/evaluation/protocol.md gives the reason for this value.
MIN_SIMILARITY = 0.9


class Kim:
    """Stages b and c of Kim et al.

    Args:
        similarity_threshold: the most similar node absorbs a node if it exceeds this.
    """

    name = "Kim et al."

    def __init__(self, similarity_threshold: float = MIN_SIMILARITY) -> None:
        self.similarity_threshold = similarity_threshold

    def lift(
        self,
        frame_graph: FrameGraph,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        T_world_camera: Float64,
    ) -> Lifted:
        """Nodes of the objects with enough points in their window; drops: ``few_window_points``."""
        nodes, rows, drops = [], [], Counter[str]()
        for row, box in enumerate(frame_graph.boxes_xyxy):
            points_camera = without_outliers(window_points(box, depth_m, intrinsics))
            if len(points_camera) < MIN_POINTS:
                drops["few_window_points"] += 1
                continue
            points = points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
            kept = min(len(points), EVALUATION_POINTS)
            rows.append(row)
            nodes.append(
                BaselineNode(
                    points.mean(axis=0),
                    np.cov(points, rowvar=False),
                    frame_graph.class_probabilities[row],
                    float(len(points)),
                    points[np.arange(kept) * len(points) // kept],
                    frame_graph.stamp_ns,
                    frame_graph.stamp_ns,
                    colours=colour_histogram(rgb, box),
                )
            )
        return Lifted(nodes, rows, drops)

    def choose(self, node: BaselineNode, others: Sequence[BaselineNode]) -> int | None:
        """Index of the most similar node, of equal ones the first; None if not similar enough."""
        if not others:
            return None
        similarities = self.similarities(node, others)
        best = int(similarities.argmax())
        return best if similarities[best] > self.similarity_threshold else None

    def similarities(self, node: BaselineNode, others: Sequence[BaselineNode]) -> Float64:
        """0.5 class + 0.4 position + 0.1 colour similarity to each other node, (n,)."""
        top = top_classes(node.class_scores)
        classes = np.array([class_similarity(top, top_classes(o.class_scores)) for o in others])
        means = np.array([other.mean_world for other in others])
        colour = densest_colour(node.colours)
        distances = [math.dist(colour, densest_colour(other.colours)) for other in others]
        colours = 1.0 - np.array(distances) / (255.0 * math.sqrt(3.0))
        return np.asarray(
            CLASS_WEIGHT * classes
            + POSITION_WEIGHT * position_similarities(node.mean_world, means)
            + COLOUR_WEIGHT * colours
        )

    def fuse(self, keeper: BaselineNode, other: BaselineNode) -> BaselineNode:
        """Both nodes in one: sums of class scores and colours, moments weighted by points."""
        return fuse_nodes(keeper, other, keeper.class_scores + other.class_scores)


def window_points(box_xyxy: Float64, depth_m: Float32, intrinsics: Intrinsics) -> Float64:
    """Points (n, 3) in the window at the centre of the box, metres, camera frame."""
    x1, y1, x2, y2 = box_xyxy.tolist()
    columns = _window(x1, x2, intrinsics.width)
    rows = _window(y1, y2, intrinsics.height)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    depths = depth_m[pixels[:, 1], pixels[:, 0]]
    valid = (depths > 0) & np.isfinite(depths)
    kept = pixels[valid]
    points = intrinsics.back_project(kept[:, 0], kept[:, 1], depths[valid].astype(np.float64))
    return np.asarray(points[(np.abs(points) <= MAX_COORDINATE_M).all(axis=1)])


def _window(low: float, high: float, size: int) -> Int64:
    side = high - low
    fraction = SHORT_SIDE_FRACTION if side < SHORT_SIDE_PX else SIDE_FRACTION
    first = int(low + side * (1 - fraction) / 2)
    last = int(low + side * (1 + fraction) / 2)
    return np.arange(max(first, 0), min(last + 1, size), dtype=np.int64)


def without_outliers(points: Float64) -> Float64:
    """Points (m, 3) without outliers: mean distance to 10 neighbours at most 1 σ above average."""
    if len(points) <= NEIGHBOURS:
        return points
    distances, _ = cKDTree(points).query(points, NEIGHBOURS + 1)
    means = distances[:, 1:].mean(axis=1)
    return np.asarray(points[means <= means.mean() + OUTLIER_SIGMAS * means.std()])


def top_classes(class_scores: Float64) -> frozenset[int]:
    """The three best classes, without classes that tie with the fourth (an evenly spread rest)."""
    order = np.argsort(-class_scores, kind="stable").tolist()
    fourth = class_scores[order[3]] if len(order) > 3 else 0.0
    return frozenset(index for index in order[:3] if class_scores[index] > fourth)


def class_similarity(a: frozenset[int], b: frozenset[int]) -> float:
    """Similarity by the number of common classes; entries missing in both count as common."""
    common = len(a & b)
    return CLASS_SIMILARITIES[common + 3 - max(len(a), len(b)) if common else 0]


def position_similarities(mean: Float64, means: Float64) -> Float64:
    """Mean over the axes of min(1, 0.56 m / distance), (n,)."""
    scaled = np.abs(means - mean) / POSITION_SCALE_M
    return np.asarray((POSITION_REACH / np.maximum(scaled, POSITION_REACH)).mean(axis=1))


def colour_histogram(rgb: UInt8, box_xyxy: Float64) -> Int64:
    """Colour histogram of a box, (512,): 8 bins per channel."""
    x1, y1, x2, y2 = (int(value) for value in box_xyxy)
    bins = (rgb[y1 : y2 + 1, x1 : x2 + 1].reshape(-1, 3) // (256 // COLOUR_BINS)).astype(np.int64)
    flat = (bins[:, 0] * COLOUR_BINS + bins[:, 1]) * COLOUR_BINS + bins[:, 2]
    return np.bincount(flat, minlength=COLOUR_BINS**3).astype(np.int64)


def densest_colour(histogram: Int64) -> tuple[int, int, int]:
    """RGB of the CSS colour nearest to the densest bin of a histogram."""
    return _named_colour(int(histogram.argmax()))


@cache
def _named_colour(bin_number: int) -> tuple[int, int, int]:
    from matplotlib.colors import CSS4_COLORS

    width = 256 // COLOUR_BINS
    channels = np.array([bin_number // COLOUR_BINS**2, bin_number // COLOUR_BINS, bin_number])
    colour = (channels % COLOUR_BINS) * width + width / 2
    named = np.array(
        [[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in map(str, CSS4_COLORS.values())]
    )
    red, green, blue = named[np.linalg.norm(named - colour, axis=1).argmin()].tolist()
    return red, green, blue
