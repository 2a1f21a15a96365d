"""Baselines: other methods on the same detections, reimplemented here."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from deworldsg_ros.base.timing import Times, timed
from deworldsg_ros.graph.messages import listed
from deworldsg_ros.lifting.stage import box_covariance, whole_box
from deworldsg_ros.pipeline import Perceiver, watch_parts
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt8
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import EvaluationError, RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary
from deworldsg_ros.scene.gaussian import fuse, hellinger_distance, transform
from deworldsg_ros.wire import messages as wire

# --- The graph of the baselines: nodes absorb one another, relations are counted.
#
# New nodes are added to the graph and pushed on a stack. The popped node is compared with all other
# nodes. The best node that the baseline accepts absorbs it and is pushed on the stack.

# Number of classes and predicates of each node and edge in the message.
TOP_K = 5


@dataclass(frozen=True)
class BaselineNode:
    """One object of a baseline.

    Attributes:
        mean_world: (3,) float64, metres.
        covariance_world: (3, 3) float64, square metres.
        class_scores: (C,) float64, not negative.
        weight: weight in a fusion.
        points_world: (n, 3) float64, metres, points for the protocol.
        first_ns, last_ns: stamps of the first and last observation.
        observations: number of observations.
        colours: colour histogram of any length; empty if the baseline has none.
    """

    mean_world: Float64
    covariance_world: Float64
    class_scores: Float64
    weight: float
    points_world: Float64
    first_ns: int
    last_ns: int
    observations: int = 1
    colours: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def label(self) -> int:
        """The class with the highest score."""
        return int(self.class_scores.argmax())


Choose = Callable[[BaselineNode, Sequence[BaselineNode]], "int | None"]


def fuse_nodes(keeper: BaselineNode, other: BaselineNode, class_scores: Float64) -> BaselineNode:
    """Both nodes in one, moments fused by Eq. 7. Two weights of 0 count as 1 and 1."""
    weights = (keeper.weight, other.weight)
    weights = weights if sum(weights) > 0 else (1.0, 1.0)
    mean, covariance = fuse(
        weights[0],
        keeper.mean_world,
        keeper.covariance_world,
        weights[1],
        other.mean_world,
        other.covariance_world,
    )
    return replace(
        keeper,
        mean_world=mean,
        covariance_world=covariance,
        class_scores=class_scores,
        weight=keeper.weight + other.weight,
        points_world=np.concatenate([keeper.points_world, other.points_world]),
        first_ns=min(keeper.first_ns, other.first_ns),
        last_ns=max(keeper.last_ns, other.last_ns),
        observations=keeper.observations + other.observations,
        colours=keeper.colours + other.colours,
    )


class BaselineGraph:
    """A graph whose nodes absorb one another.

    Args:
        vocabulary: classes and predicates.
        frame_id: world frame.
        choose: returns the index of the other node that absorbs a node, or None.
        fuse: returns the keeper and the absorbed node in one.

    Attributes:
        nodes: nodes by id, in order of creation.
        counts: (R,) int64 by ordered pair, number of predictions of each predicate.
    """

    def __init__(
        self,
        vocabulary: Vocabulary,
        frame_id: str,
        choose: Choose,
        fuse: Callable[[BaselineNode, BaselineNode], BaselineNode],
    ) -> None:
        self.vocabulary = vocabulary
        self.frame_id = frame_id
        self.nodes: dict[int, BaselineNode] = {}
        self.counts: dict[tuple[int, int], Int64] = {}
        self._choose = choose
        self._fuse = fuse
        self._next_id = 1
        self._newest_ns = 0

    def integrate(
        self, nodes: Sequence[BaselineNode], relations: Relations, stamp_ns: int
    ) -> list[int]:
        """Integrate the nodes of a frame and the relations between them.

        Args:
            nodes: nodes of the frame.
            relations: pairs of indices into `nodes`; the best predicate of each pair counts once.
            stamp_ns: stamp of the frame.

        Returns:
            Id of the node of the graph for each node of the frame.
        """
        self._newest_ns = stamp_ns
        created = list(range(self._next_id, self._next_id + len(nodes)))
        self._next_id += len(nodes)
        self.nodes.update(zip(created, nodes))
        merged_into: dict[int, int] = {}
        stack = list(created)
        while stack:
            node_id = stack.pop()
            if node_id not in self.nodes:
                continue
            keeper_id = self._absorb(node_id)
            if keeper_id is not None:
                merged_into[node_id] = keeper_id
                stack.append(keeper_id)
        node_ids = [_resolve(node_id, merged_into) for node_id in created]
        for (subject, object_), logits in zip(relations.pairs.tolist(), relations.logits):
            pair = (node_ids[subject], node_ids[object_])
            if pair[0] != pair[1]:
                counts = self.counts.setdefault(pair, np.zeros(len(logits), np.int64))
                counts[int(logits.argmax())] += 1
        return node_ids

    def _absorb(self, node_id: int) -> int | None:
        """Merge a node into the best other node; returns the id of that node, or None."""
        node = self.nodes[node_id]
        other_ids = [other for other in self.nodes if other != node_id]
        chosen = self._choose(node, [self.nodes[other] for other in other_ids])
        if chosen is None:
            return None
        keeper_id = other_ids[chosen]
        self.nodes[keeper_id] = self._fuse(self.nodes[keeper_id], node)
        del self.nodes[node_id]
        for pair in [pair for pair in self.counts if node_id in pair]:
            counts = self.counts.pop(pair)
            moved = (
                keeper_id if pair[0] == node_id else pair[0],
                keeper_id if pair[1] == node_id else pair[1],
            )
            if moved[0] != moved[1]:
                self.counts[moved] = self.counts.get(moved, np.zeros_like(counts)) + counts
        return keeper_id

    def message(self) -> wire.SceneGraphMessage:
        """The graph as a message, with the points of the nodes as surface points."""
        return wire.SceneGraphMessage(
            schema=wire.schema_of(wire.SceneGraphMessage),
            stamp=wire.stamp_from_ns(self._newest_ns),
            frame_id=self.frame_id,
            sequence=0,
            nodes=[self._node_state(node_id, node) for node_id, node in self.nodes.items()],
            edges=[self._edge_state(pair) for pair in sorted(self.counts)],
        )

    def _node_state(self, node_id: int, node: BaselineNode) -> wire.NodeState:
        beliefs = _beliefs(_fractions(node.class_scores), self.vocabulary.classes)
        return wire.NodeState(
            id=node_id,
            label=beliefs[0].label,
            classes=beliefs,
            mean_m=node.mean_world.tolist(),
            covariance_m2=node.covariance_world.ravel().tolist(),
            observations=node.observations,
            first_seen=wire.stamp_from_ns(node.first_ns),
            last_seen=wire.stamp_from_ns(node.last_ns),
            surface_points_m=node.points_world.tolist(),
        )

    def _edge_state(self, pair: tuple[int, int]) -> wire.EdgeState:
        fractions = _fractions(self.counts[pair])
        beliefs = _beliefs(fractions, self.vocabulary.predicates)
        positive = fractions[fractions > 0]
        return wire.EdgeState(
            subject=pair[0],
            object=pair[1],
            predicate=beliefs[0].label,
            probability=beliefs[0].probability,
            predicates=beliefs,
            provenance="visual",
            entropy_nats=max(0.0, float(-(positive * np.log(positive)).sum())),
            observations=int(self.counts[pair].sum()),
        )


def _resolve(node_id: int, merged_into: dict[int, int]) -> int:
    while node_id in merged_into:
        node_id = merged_into[node_id]
    return node_id


def _fractions(scores: Float64 | Int64) -> Float64:
    return np.asarray(scores / scores.sum(), np.float64)


def _beliefs(fractions: Float64, names: Sequence[str]) -> list[wire.Belief]:
    (best,) = listed(fractions[None], names, TOP_K)
    return [item for item in best.beliefs if item.probability > 0]


# --- The output of a baseline's lifting.


@dataclass(frozen=True)
class Lifted:
    """Nodes of one frame.

    Attributes:
        nodes: lifted nodes.
        rows: row of the frame graph of each node.
        drops: number of objects left out, by reason.
    """

    nodes: list[BaselineNode]
    rows: list[int]
    drops: Counter[str]


# --- FROSS (Hou et al., ICCV 2025): boxes lifted at their centre, merged by class and distance.
#
# Implemented from the published description; docs/dev/evaluation/protocol.md lists the open
# choices.

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


# --- Kim et al. (3-D Scene Graph, 2019): windows of boxes, merged by three similarities.
#
# Implemented from the published description; docs/dev/evaluation/protocol.md lists the open
# choices.

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


# --- A baseline with the interface of the pipeline: same input, a graph as output.


class Baseline(Protocol):
    """Lifting and association of a baseline."""

    name: str

    def lift(
        self,
        frame_graph: FrameGraph,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        T_world_camera: Float64,
    ) -> Lifted:
        """Nodes of one frame."""
        ...

    def choose(self, node: BaselineNode, others: Sequence[BaselineNode]) -> int | None:
        """Index of the node that absorbs `node`, or None."""
        ...

    def fuse(self, keeper: BaselineNode, other: BaselineNode) -> BaselineNode:
        """Both nodes in one."""
        ...


class BaselinePipeline:
    """perceive → lift → merge, one frame at a time.

    Args:
        baseline: lifts and merges.
        perceiver: source of detections and relations.

    Attributes:
        drops: number of objects left out so far, by reason.
        times_s: seconds of each stage, one entry per frame.
    """

    def __init__(self, baseline: Baseline, perceiver: Perceiver) -> None:
        self.drops: Counter[str] = Counter()
        self.times_s: dict[str, Times] = {
            name: Times() for name in ("perception", "lifting", "merging")
        }
        watch_parts(perceiver, self.times_s)
        self._baseline = baseline
        self._perceiver = perceiver
        self._graph: BaselineGraph | None = None

    def process(self, frame: RgbdFrame) -> list[int]:
        """Integrate a frame into the graph; returns the node id of each lifted object."""
        with timed(self.times_s["perception"]):
            perceived = self._perceiver.perceive(frame)
        frame_graph = perceived.frame_graph
        with timed(self.times_s["lifting"]):
            lifted = self._baseline.lift(
                frame_graph, frame.rgb, frame.depth_m, frame.intrinsics, frame.T_world_camera
            )
        if self._graph is None:
            self._graph = BaselineGraph(
                frame_graph.vocabulary, frame.frame_id, self._baseline.choose, self._baseline.fuse
            )
        with timed(self.times_s["merging"]):
            node_ids = self._graph.integrate(
                lifted.nodes, between(frame_graph.relations, lifted.rows), frame.stamp_ns
            )
        self.drops.update(perceived.drops)
        self.drops.update(lifted.drops)
        return node_ids

    def graph(self) -> wire.SceneGraphMessage:
        """The graph so far; raises RefusedInput ``no_frames`` before the first frame."""
        if self._graph is None:
            raise RefusedInput("no_frames", "no frame was processed: the graph does not exist yet")
        return self._graph.message()


def between(relations: Relations, rows: Sequence[int]) -> Relations:
    """Relations between these rows of the frame graph, with indices into `rows` as pairs."""
    index_of = {row: index for index, row in enumerate(rows)}
    kept = [
        number
        for number, (subject, object_) in enumerate(relations.pairs.tolist())
        if subject in index_of and object_ in index_of
    ]
    pairs = [[index_of[end] for end in pair] for pair in relations.pairs[kept].tolist()]
    return Relations(
        np.array(pairs, np.int64).reshape(-1, 2), relations.logits[kept], relations.scores[kept]
    )


# --- Baselines: other methods on the same detections, reimplemented here.

__all__ = ["BASELINES", "Baseline", "BaselinePipeline", "build_baseline"]

BASELINES: dict[str, type[Fross] | type[Kim]] = {"fross": Fross, "kim": Kim}


def build_baseline(name: str) -> Baseline:
    """The baseline of this name; raises EvaluationError."""
    if name not in BASELINES:
        raise EvaluationError(f"baseline '{name}': expected one of {', '.join(BASELINES)}")
    return BASELINES[name]()
