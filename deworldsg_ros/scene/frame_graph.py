"""The graphs of one frame: in the image (FrameGraph) and lifted into the world (LocalGraph)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from deworldsg_ros.scene import checks, limits
from deworldsg_ros.scene.arrays import Bool, Float16, Float32, Float64, Int64, UInt8, UInt16
from deworldsg_ros.scene.camera import Intrinsics, check_pose
from deworldsg_ros.scene.errors import RefusedInput

# Of the samples of an image that a frame carries along: every n-th pixel, from pixel n // 2 on.
GRID_STRIDE_PX = 8
GRID = slice(GRID_STRIDE_PX // 2, None, GRID_STRIDE_PX)


@dataclass(frozen=True)
class Vocabulary:
    """Names of the classes and of the predicates, in the order of the distributions."""

    classes: tuple[str, ...]
    predicates: tuple[str, ...]


@dataclass(frozen=True)
class Relations:
    """Visual relation logits of ordered pairs of one frame's objects (m pairs, R predicates).

    Attributes:
        pairs: (m, 2) int64, subject and object, rows of the frame's objects, subject != object.
        logits: (m, R) float64, pre-sigmoid.
        scores: (m,) float64 in [0, 1], the pair scores by which the best were kept.
    """

    pairs: Int64
    logits: Float64
    scores: Float64

    def __post_init__(self) -> None:
        count = len(self.pairs)
        checks.check_pairs("relation pairs", self.pairs, count, limits.MAX_INT)
        width = self.logits.shape[-1]
        checks.check_array("relation logits", self.logits, (count, width), limits.MAX_LOGIT)
        checks.check_probabilities("relation scores", self.scores, (count,))

    @staticmethod
    def none(predicate_count: int) -> Relations:
        """No relations."""
        return Relations(np.zeros((0, 2), np.int64), np.zeros((0, predicate_count)), np.zeros(0))


@dataclass(frozen=True)
class Embeddings:
    """What the image shows of some objects of a frame, as vectors of a model.

    Attributes:
        rows: (m,) int64, the objects, ascending.
        vectors: (m, D) float16, of length one.
        model: name of the model.
    """

    rows: Int64
    vectors: Float16
    model: str

    def __post_init__(self) -> None:
        size = self.vectors.shape[-1]
        checks.check_shape("embeddings", self.vectors, (len(self.rows), size))
        if not 1 <= size <= limits.MAX_EMBEDDING:
            raise ValueError(f"embeddings of {size} values: expected 1 to {limits.MAX_EMBEDDING}")
        lengths = np.linalg.norm(self.vectors.astype(np.float32), axis=1)
        if not (np.abs(lengths - 1.0) < 0.01).all():
            raise ValueError("an embedding is not of length 1")
        if not self.model:
            raise ValueError("embeddings without the name of their model")
        limits.check_names([self.model])

    def check_rows(self, count: int) -> None:
        """Raise ValueError unless the rows are of `count` objects, each once."""
        if len(self.rows) and not (
            self.rows[0] >= 0 and (np.diff(self.rows) > 0).all() and self.rows[-1] < count
        ):
            raise ValueError(f"embeddings of the rows {self.rows.tolist()} of {count} objects")

    def take(self, rows: Int64) -> Embeddings | None:
        """Those of the objects of `rows`, ascending, renumbered; None if there are none."""
        kept = np.isin(self.rows, rows)
        if not kept.any():
            return None
        return Embeddings(np.searchsorted(rows, self.rows[kept]), self.vectors[kept], self.model)


@dataclass(frozen=True)
class FrameGraph:
    """The 2D scene graph of one frame (n objects, C classes), best score first.

    Attributes:
        stamp_ns: time of the image.
        frame_id: camera optical frame.
        width, height: image size in pixels.
        vocabulary: names of classes and predicates.
        boxes_xyxy: (n, 4) float64 pixels, corners x1, y1, x2, y2, inside the image.
        class_probabilities: (n, C) float64, calibrated, rows sum to one.
        scores: (n,) float64, the detector's own score.
        relations: visual relations between rows.
        colours_lab: (n, 3) float32, mean colour of each object, CIELAB; a row of NaN, or None = not
            known.
        embeddings: what the image shows of some of the objects; None = of none.
        rgb_grid: (h, w, 3) uint8, samples of the image in both directions (`GRID`); None = not
            available.

    The k-th object (from 0) has the value k + 1 in the frame's instance image, (H, W) uint16.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    vocabulary: Vocabulary
    boxes_xyxy: Float64
    class_probabilities: Float64
    scores: Float64
    relations: Relations
    colours_lab: Float32 | None = None
    embeddings: Embeddings | None = None
    rgb_grid: UInt8 | None = None

    def __post_init__(self) -> None:
        count = len(self.boxes_xyxy)
        shape = len(range(self.height)[GRID]), len(range(self.width)[GRID]), 3
        if self.rgb_grid is not None and self.rgb_grid.shape != shape:
            raise ValueError(f"colour grid is {self.rgb_grid.shape}: expected {shape}")
        if self.embeddings is not None:
            self.embeddings.check_rows(count)
        checks.check_boxes(self.boxes_xyxy, count)
        checks.check_colours(self.colours_lab, count)
        _check_objects(count, self.vocabulary, self.class_probabilities, self.scores)
        _check_relations(count, self.vocabulary, self.relations)

    def __len__(self) -> int:
        return len(self.boxes_xyxy)


@dataclass(frozen=True)
class DepthGrid:
    """Every n-th pixel of the depth image and of the instance image.

    It shows which space the camera saw as free, and which object each surface belongs to.

    Attributes:
        depth_mm: (h, w) uint16, millimetres along the optical axis; 0 = invalid. Row r, column c
            is the pixel (stride_px // 2 + c * stride_px, stride_px // 2 + r * stride_px).
        stride_px: pixels between samples.
        intrinsics: of the whole image.
        instances: (h, w) uint16, value of the instance image on the same pixels; 0 = no object.
            None = not available.
        rgb: (h, w, 3) uint8 on the same pixels; None = not available.
    """

    depth_mm: UInt16
    stride_px: int
    intrinsics: Intrinsics
    instances: UInt16 | None = None
    rgb: UInt8 | None = None

    def __post_init__(self) -> None:
        if self.stride_px < 1:
            raise ValueError(f"stride of the depth grid is {self.stride_px}: expected >= 1")
        first = self.stride_px // 2
        height, width = self.intrinsics.height, self.intrinsics.width
        shape = (
            len(range(first, height, self.stride_px)),
            len(range(first, width, self.stride_px)),
        )
        checks.check_shape("depth grid", self.depth_mm, shape)
        if self.instances is not None:
            checks.check_shape("instances of the depth grid", self.instances, shape)
        if self.rgb is not None and self.rgb.shape != (*shape, 3):
            raise ValueError(f"colours of the depth grid are {self.rgb.shape}: expected {shape}")


@dataclass(frozen=True)
class LocalGraph:
    """The local 3D scene graph of one frame, world frame (n lifted objects).

    Attributes:
        stamp_ns: time of the image.
        frame_id: world frame of means, covariances and surface points.
        width, height: image size in pixels.
        T_world_camera: (4, 4) float64 pose that lifted it.
        vocabulary: names of classes and predicates.
        instance_ids: (n,) int64, value of the object in the frame's instance image (from 1).
        boxes_xyxy: (n, 4) float64 pixels.
        class_probabilities: (n, C) float64, rows sum to one.
        scores: (n,) float64.
        means_world: (n, 3) float64, metres (Eq. 4).
        covariances_world: (n, 3, 3) float64, square metres, positive definite (Eq. 4).
        depths_m: (n,) float64, mean depth of the inliers in the camera frame (z of Eq. 8).
        pixel_counts: (n,) int64, number of refined inlier pixels.
        surface_points_world: n arrays (k, 3) float32, a deterministic sample of the inliers.
        relations: visual relations between rows.
        drops: number of objects not lifted, by reason.
        depth_grid: depth and instances of the whole image; None = not available.
        colours_lab, embeddings: as those of the frame graph.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    T_world_camera: Float64
    vocabulary: Vocabulary
    instance_ids: Int64
    boxes_xyxy: Float64
    class_probabilities: Float64
    scores: Float64
    means_world: Float64
    covariances_world: Float64
    depths_m: Float64
    pixel_counts: Int64
    surface_points_world: tuple[Float32, ...]
    relations: Relations
    drops: dict[str, int] = field(default_factory=dict)
    depth_grid: DepthGrid | None = None
    colours_lab: Float32 | None = None
    embeddings: Embeddings | None = None

    def __post_init__(self) -> None:
        count = len(self.means_world)
        if self.embeddings is not None:
            self.embeddings.check_rows(count)
        try:
            check_pose(self.T_world_camera)
        except RefusedInput as refusal:
            raise ValueError(str(refusal)) from refusal
        checks.check_boxes(self.boxes_xyxy, count)
        checks.check_instance_ids(self.instance_ids, count)
        checks.check_colours(self.colours_lab, count)
        checks.check_counts("pixel counts", self.pixel_counts, count)
        _check_objects(count, self.vocabulary, self.class_probabilities, self.scores)
        _check_relations(count, self.vocabulary, self.relations)
        self.check_geometry()

    def check_geometry(self) -> None:
        """Check what lifting computes; raises ValueError."""
        count = len(self.means_world)
        checks.check_array("means", self.means_world, (count, 3), limits.MAX_COORDINATE_M)
        checks.check_covariances(self.covariances_world, count)
        checks.check_depths(self.depths_m, count)
        checks.check_surfaces(self.surface_points_world, count)

    def __len__(self) -> int:
        return len(self.means_world)


Checked = TypeVar("Checked", Relations, LocalGraph)


def _unchecked(kind: type[Checked], **attributes: Any) -> Checked:
    item = object.__new__(kind)
    item.__dict__.update(attributes)
    return item


def lifted(
    frame: FrameGraph, rows: Int64, frame_id: str, T_world_camera: Float64, **geometry: Any
) -> LocalGraph:
    """The local graph of some objects of a frame graph; only its geometry is checked.

    Args:
        frame: checked when it came in.
        rows: (n,) of the objects in the frame graph, ascending.
        frame_id: world frame.
        T_world_camera: (4, 4) pose, checked.
        geometry: the other attributes of `LocalGraph`.

    Raises:
        ValueError: as `LocalGraph`.
    """
    local = _unchecked(
        LocalGraph,
        stamp_ns=frame.stamp_ns,
        frame_id=frame_id,
        width=frame.width,
        height=frame.height,
        T_world_camera=np.array(T_world_camera, np.float64),
        vocabulary=frame.vocabulary,
        instance_ids=rows + 1,
        boxes_xyxy=frame.boxes_xyxy[rows],
        class_probabilities=frame.class_probabilities[rows],
        scores=frame.scores[rows],
        relations=_between(frame.relations, rows, len(frame)),
        colours_lab=None if frame.colours_lab is None else frame.colours_lab[rows],
        embeddings=None if frame.embeddings is None else frame.embeddings.take(rows),
        **geometry,
    )
    local.check_geometry()
    return local


def _between(relations: Relations, rows: Int64, count: int) -> Relations:
    """Relations between some of the rows, with the rows renumbered."""
    if len(rows) == count:
        return relations
    renumbered = np.full(count, -1, np.int64)
    renumbered[rows] = np.arange(len(rows))
    pairs = renumbered[relations.pairs]
    kept = (pairs >= 0).all(axis=1)
    logits, scores = relations.logits[kept], relations.scores[kept]
    return derived(relations, pairs=pairs[kept], logits=logits, scores=scores)


def derived(item: Checked, **changes: Any) -> Checked:
    """A local graph or relations with some attributes replaced, without the checks of new ones.

    For changes that cannot make it invalid: it came in checked, and no value comes from outside.
    """
    return _unchecked(type(item), **{**item.__dict__, **changes})


def _check_objects(
    count: int, vocabulary: Vocabulary, class_probabilities: Float64, scores: Float64
) -> None:
    shape = (count, len(vocabulary.classes))
    checks.check_distributions("class probabilities", class_probabilities, shape)
    checks.check_probabilities("scores", scores, (count,))


def _check_relations(count: int, vocabulary: Vocabulary, relations: Relations) -> None:
    if relations.logits.shape[1] != len(vocabulary.predicates):
        raise ValueError(
            f"relation logits have {relations.logits.shape[1]} predicates: "
            f"expected {len(vocabulary.predicates)}"
        )
    if len(relations.pairs) and relations.pairs.max() >= count:
        raise ValueError(f"a relation names object {relations.pairs.max()} of {count}")


@dataclass(frozen=True)
class RelationEvidence:
    """Geometric neighbours of one frame (Eq. 8), with a world model's predictions for some.

    Attributes:
        stamp_ns: frame whose local graph the pairs refer to.
        vocabulary: names of classes and predicates.
        pairs: (m, 2) int64 ordered pairs, subject and object, rows of that local graph.
        pair_classes: (m, 2) int64, arg-max classes of subject and object in that frame.
        geo_costs: (m,) float64, the cost of Eq. 8.
        predictions: (m, R) float64, the probe's distribution of each pair; a row of NaN if no
            clip was encoded.
        source: name of the world model, ``none`` without one.
    """

    stamp_ns: int
    vocabulary: Vocabulary
    pairs: Int64
    pair_classes: Int64
    geo_costs: Float64
    predictions: Float64
    source: str

    def __post_init__(self) -> None:
        count, class_count = len(self.pairs), len(self.vocabulary.classes)
        checks.check_pairs("evidence pairs", self.pairs, count, limits.MAX_INT)
        name = "evidence pair classes"
        checks.check_array(name, self.pair_classes, (count, 2), class_count - 1)
        if count and self.pair_classes.min() < 0:
            raise ValueError(f"{name} contain {self.pair_classes.min()}: expected >= 0")
        checks.check_array("geometric costs", self.geo_costs, (count,), limits.MAX_COST)
        if self.predictions.shape != (count, len(self.vocabulary.predicates)):
            raise ValueError(
                f"predictions have shape {self.predictions.shape}: "
                f"expected {(count, len(self.vocabulary.predicates))}"
            )

    @property
    def predicted(self) -> Bool:
        """(m,) bool: rows with a prediction."""
        return np.asarray(~np.isnan(self.predictions).any(axis=1))
