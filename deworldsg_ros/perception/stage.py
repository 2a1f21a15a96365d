"""Stage a: one RGB-D frame → its 2D scene graph and its instance image."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.protocols import (
    Detections,
    Detector,
    Embedder,
    RelationHead,
    SegmentedObjects,
    Segmenter,
    unit_embeddings,
)
from deworldsg_ros.perception.source import DetectionSource
from deworldsg_ros.scene.arrays import (
    Bool,
    Float32,
    Float64,
    Int64,
    UInt8,
    UInt16,
    areas,
    shared_areas,
)
from deworldsg_ros.scene.camera import (
    Intrinsics,
    MaskPatch,
    RgbdFrame,
    UpEstimator,
    Uprighter,
    UprightFrame,
)
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.frame_graph import GRID, Embeddings, FrameGraph, Relations, Vocabulary
from deworldsg_ros.scene.limits import check_names

# --- The results of a frame that was turned upright, for the image as the camera took it: boxes and
# instances are turned back exactly.


def turned_back(
    frame_graph: FrameGraph, instances: UInt16, turns: int
) -> tuple[FrameGraph, UInt16]:
    """Frame graph and instance image (H, W) of `turned`, for the image before the turns."""
    if turns % 4 == 0:
        return frame_graph, instances
    instances = np.ascontiguousarray(np.rot90(instances, -turns))
    boxes, height = frame_graph.boxes_xyxy, frame_graph.height
    width = frame_graph.width
    for _ in range(turns % 4):
        boxes = _turned_back_once(boxes, height)
        width, height = height, width
    turned = replace(frame_graph, boxes_xyxy=boxes, width=width, height=height, rgb_grid=None)
    return turned, instances


def _turned_back_once(boxes_xyxy: Float64, height: int) -> Float64:
    """Boxes (n, 4) before one quarter turn, which led to an image of this height."""
    u1, v1, u2, v2 = boxes_xyxy.T
    return np.stack([height - 1 - v2, u1, height - 1 - v1, u2], axis=1)


# --- Boxes inside other boxes of a frame: nested detections of one object, and weak detections.
#
# Suppression by IoU keeps a small box inside a large one of the same class.

# Two objects have one class if the cosine of their class distributions exceeds this: how certain
# the names are matters little.
SAME_CLASS = 0.3
# A box is nested if more than this fraction of it is inside another: edges are a few pixels off.
NESTED_FRACTION = 0.8
# A part has less than this fraction of the area of the whole. From there on the IoU is 0.5 or more,
# and detectors suppress one of two such boxes. Objects in a row have similar sizes.
PART_OF_AREA = 0.5
# Two surfaces are at one depth if their median depths differ by less: a constant, and a fraction of
# the depth for the noise of the sensor.
DEPTH_STEP_M = 0.05
DEPTH_STEP_FRACTION = 0.03


def join_nested(
    objects: Detections, masks: list[MaskPatch], depth_m: Float32
) -> tuple[Detections, list[MaskPatch]]:
    """Join nested detections of one object.

    A box inside a larger box of its class and at its depth is a part of the same object, such as
    the lit part of a screen. The joined object has both boxes and both masks, and the class and
    score of the better detection. A box with several such boxes inside is a group of objects and
    is removed. At different depths, both objects are kept: one is seen through the other's gaps. A
    row of equal objects is kept: a box of similar size, or beside another one of similar size.

    Args:
        objects: n objects, best score first.
        masks: n masks.
        depth_m: (H, W) float32, metres; 0 = invalid.

    Returns:
        The objects, best score first, and their masks.
    """
    within = _nested(objects)
    for inner, outer in np.argwhere(within):
        within[inner, outer] = _at_one_depth(masks[inner], masks[outer], depth_m)
    if not within.any():
        return objects, masks
    boxes, masks = objects.boxes_xyxy.copy(), list(masks)
    # A chain of three nested boxes is no group: each box counts only for the largest around it.
    outermost = within & ~(within.astype(int) @ within > 0)
    removed = outermost.sum(axis=0) > 1
    for inner, outer in np.argwhere(within):
        if removed[inner] or removed[outer]:
            continue
        keep, other = min(inner, outer), max(inner, outer)  # the better score comes first
        boxes[keep] = _hull(boxes[inner], boxes[outer])
        masks[keep] = _union(masks[inner], masks[outer], depth_m.shape)
        removed[other] = True
    kept = np.flatnonzero(~removed)
    return replace(objects, boxes_xyxy=boxes).take(kept), [masks[row] for row in kept]


def in_front_of(objects: Detections, weak: Detections) -> Detections:
    """The weak detections inside a larger object of another class.

    A weak detection that overlaps an object of its own class may be a part of it, and is left out.
    """
    inside, overlaps, same_class = _compare(weak, objects)
    part = (overlaps & same_class).any(axis=1)
    return weak.take(np.flatnonzero((inside & ~same_class).any(axis=1) & ~part))


def _nested(objects: Detections) -> Bool:
    """(n, n) bool: the row's box may be a part of the object of the column's box, of its class.

    Neighbours in a row of equal objects, such as books, also have boxes inside each other.
    """
    inside, overlaps, same_class = _compare(objects, objects)
    area = areas(objects.boxes_xyxy)
    ratio = area[:, None] / area[None, :]
    part = inside & same_class & (ratio < PART_OF_AREA)
    similar = (ratio > PART_OF_AREA) & (ratio < 1.0 / PART_OF_AREA)
    beside = overlaps & same_class & similar & ~inside & ~inside.T
    np.fill_diagonal(beside, False)
    in_row = np.flatnonzero(beside.any(axis=1))
    part[:, in_row] = False
    return np.asarray(part)


def _compare(a: Detections, b: Detections) -> tuple[Bool, Bool, Bool]:
    """(n, m) bool each: a is inside b, which is larger; they overlap; they have one class."""
    area_a, area_b = areas(a.boxes_xyxy), areas(b.boxes_xyxy)
    shared = shared_areas(a.boxes_xyxy, b.boxes_xyxy)
    inside = (shared > NESTED_FRACTION * area_a[:, None]) & (area_a[:, None] < area_b[None, :])
    p, q = a.class_probabilities, b.class_probabilities
    lengths = np.outer(np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1))
    same_class = p @ q.T > SAME_CLASS * lengths
    return inside, shared > 0, same_class


def _at_one_depth(inner: MaskPatch, outer: MaskPatch, depth_m: Float32) -> bool:
    """Whether the median depths agree; masks without depth count as being at one depth."""
    medians = [_median_depth(mask, depth_m) for mask in (inner, outer)]
    step_m = DEPTH_STEP_M + DEPTH_STEP_FRACTION * min(medians)
    return not abs(medians[0] - medians[1]) > step_m


def _median_depth(mask: MaskPatch, depth_m: Float32) -> float:
    values = depth_m[mask.window][mask.pixels]
    values = values[values > 0]
    return float(np.median(values)) if len(values) else float("nan")


def _hull(a_xyxy: Float64, b_xyxy: Float64) -> Float64:
    return np.concatenate([np.minimum(a_xyxy[:2], b_xyxy[:2]), np.maximum(a_xyxy[2:], b_xyxy[2:])])


def _union(a: MaskPatch, b: MaskPatch, shape: tuple[int, ...]) -> MaskPatch:
    image = np.zeros(shape, dtype=bool)
    image[a.window] |= a.pixels
    image[b.window] |= b.pixels
    return MaskPatch(0, 0, image)


# --- Masks of one frame → its instance image.


def instance_image(
    masks: Sequence[MaskPatch], classes: Int64, scores: Float64, shape: tuple[int, int]
) -> UInt16:
    """The instance image of masks that may overlap (paper, Section 4.1).

    A pixel in masks of different classes is ambiguous and belongs to no object. A pixel in several
    masks of one class belongs to the one with the highest score, or the first of equal scores.

    Args:
        masks: n masks.
        classes: (n,) most likely class of each.
        scores: (n,) detection scores.
        shape: H, W of the image.

    Returns:
        (H, W) uint16: k + 1 on the pixels of row k, else 0.

    Raises:
        ValueError: more masks than uint16 can number.
    """
    if len(masks) > np.iinfo(np.uint16).max:
        raise ValueError(f"{len(masks)} masks, expected at most {np.iinfo(np.uint16).max}")
    labels = np.zeros(shape, dtype=np.uint16)
    ambiguous = np.zeros(shape, dtype=bool)
    # The class of each label; label 0 is the background and has none.
    class_of_label = np.concatenate(([-1], np.asarray(classes, dtype=np.int64)))
    # Best first: a later mask takes only free pixels.
    for row in np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable"):
        mask = masks[row]
        here = labels[mask.window]
        taken = mask.pixels & (here != 0)
        if taken.any():
            ambiguous[mask.window] |= taken & (class_of_label[here] != classes[row])
        here[mask.pixels & (here == 0)] = row + 1
    labels[ambiguous] = 0
    return labels


# --- The colour of each object.

# The colour of an object comes from about this many pixels of the patch around it, evenly spaced.
COLOUR_SAMPLES = 200
# Factors and offsets from the 8-bit CIELAB of OpenCV.
LAB_SCALE, LAB_OFFSET = np.array([100.0 / 255.0, 1.0, 1.0]), np.array([0.0, 128.0, 128.0])


def mean_colours(
    rgb: UInt8, instances: UInt16, windows: Sequence[tuple[slice, slice]]
) -> Float32 | None:
    """Mean colour of each object, in CIELAB.

    Half of its pixels count, those of medium lightness: neither the highlights nor the shadows, nor
    what a mask contains of a lighter or darker background.

    Args:
        rgb: (H, W, 3) uint8, RGB order.
        instances: (H, W) uint16 instance image.
        windows: n slices of rows and columns around the objects.

    Returns:
        (n, 3) float32; a row of NaN for an object without a sampled pixel. None if no object has a
        colour.
    """
    samples = []
    for row, (rows, columns) in enumerate(windows):
        area = (rows.stop - rows.start) * (columns.stop - columns.start)
        step = max(1, round(math.sqrt(area / COLOUR_SAMPLES)))
        of_object = instances[rows, columns][step // 2 :: step, step // 2 :: step] == row + 1
        samples.append(rgb[rows, columns][step // 2 :: step, step // 2 :: step][of_object])
    counts = np.array([len(pixels) for pixels in samples], np.int64)
    if not counts.any():
        return None
    lab = cv2.cvtColor(np.concatenate(samples)[:, None], cv2.COLOR_RGB2Lab)[:, 0]
    colours = np.full((len(counts), 3), np.nan, np.float32)
    ends = counts.cumsum()
    for row in np.flatnonzero(counts).tolist():
        own = lab[ends[row] - counts[row] : ends[row]]
        quarter = counts[row] // 4
        medium = own[:, 0].argsort(kind="stable")[quarter : counts[row] - quarter]
        colours[row] = (own[medium].mean(axis=0) - LAB_OFFSET) * LAB_SCALE
    return colours


# --- Which objects are embedded: a few a second, each after another while.

# Objects that are embedded in each second, by the stamps of the frames; also the most in one frame.
EMBEDDED_PER_S = 2.0
# Objects that are remembered as embedded.
MOST_EMBEDDED = 64
# An object is the one of an earlier frame if their boxes overlap by this fraction of their union.
# Another view of it counts as new.
SAME_BOX = 0.3
# The crop is the square around the box, and this fraction of its side more.
CROP_MARGIN = 0.1


class EmbeddingQueue:
    """Chooses the objects of a frame to embed: those that waited longest, then the largest."""

    def __init__(self) -> None:
        self._budget = 1.0
        self._last_ns: int | None = None
        self._boxes = np.zeros((0, 4))
        self._stamps_ns = np.zeros(0, np.int64)

    def choose(self, boxes_xyxy: Float64, stamp_ns: int) -> list[int]:
        """Rows of boxes (n, 4), ascending; the frames come in order of time."""
        if self._last_ns is not None:
            passed_s = max(stamp_ns - self._last_ns, 0) / 1e9
            self._budget = min(self._budget + EMBEDDED_PER_S * passed_s, EMBEDDED_PER_S)
        self._last_ns = stamp_ns
        count = min(int(self._budget + 1e-6), len(boxes_xyxy))
        if not count:
            return []
        shared = shared_areas(boxes_xyxy, self._boxes)
        sizes = areas(boxes_xyxy)
        unions = sizes[:, None] + areas(self._boxes)[None] - shared
        seen_ns = np.where(shared > SAME_BOX * unions, self._stamps_ns, -1).max(axis=1, initial=-1)
        rows = sorted(np.lexsort((-sizes, seen_ns))[:count].tolist())
        self._budget -= count
        self._boxes = np.concatenate([self._boxes, boxes_xyxy[rows]])[-MOST_EMBEDDED:]
        stamps_ns = np.concatenate([self._stamps_ns, np.full(count, stamp_ns)])
        self._stamps_ns = stamps_ns[-MOST_EMBEDDED:]
        return rows


def square_crop(rgb: UInt8, box_xyxy: Float64) -> UInt8:
    """The square of an image (H, W, 3) around a box, as far as the image reaches."""
    x1, y1, x2, y2 = box_xyxy.tolist()
    half = 0.5 * (1.0 + CROP_MARGIN) * max(x2 - x1, y2 - y1, 1.0)
    x, y = (x1 + x2) / 2, (y1 + y2) / 2
    top, left = (max(math.floor(value - half), 0) for value in (y, x))
    return rgb[top : math.ceil(y + half) + 1, left : math.ceil(x + half) + 1]


# --- Stage a: one RGB-D frame → its 2D scene graph and its instance image.

logger = logging.getLogger(__name__)

# A smaller box has no interior to segment.
MIN_BOX_SIDE_PX = 2.0
# Masks and pairs of objects cost time and memory. A frame of an indoor scene has about 12 objects.
MAX_OBJECTS = 50
# A weak box inside a larger object keeps its pixels from this fraction of the score threshold on.
# docs/dev/notebook.md compares 0.5, 0.75 and 1.
WEAK_SCORE_FRACTION = 0.5
# A box reaches a border of the image if it is nearer than this fraction of the image's side.
# Detectors end their boxes a few pixels before the border.
BORDER_FRACTION = 0.04


@dataclass(frozen=True)
class Perceived:
    """The result of one frame.

    Attributes:
        frame_graph: objects, best score first, and the relations between them.
        instances: (H, W) uint16 instance image; k + 1 on the pixels of the k-th object, else 0.
        drops: number of dropped detections by reason: ``over_max_names``, ``box_too_small`` (or
            outside the image), ``box_is_the_view`` (fills the image), ``over_max_objects``,
            ``detected_twice`` (nested), ``segmenter_error`` (all of the frame).
            ``relation_head_error`` counts the objects that are passed on without relations,
            and ``embedder_error`` without embeddings.
        failures: error message of each backend that failed on this frame, by reason.
        turns: quarter turns counter-clockwise after which perception saw the image.
    """

    frame_graph: FrameGraph
    instances: UInt16
    drops: dict[str, int] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    turns: int = 0


class Perception:
    """Detector, segmenter and relation head, composed.

    `detect`, `segment` and `relate` are the parts of `perceive` that a run times.

    Args:
        detector, segmenter, relation_head: the backends.
        config: the section `perception`.
        world_up: axis of the world frame that points up, or auto (`UpEstimator`).
        embedder: embeds some objects of each frame, in place of the detector's own embeddings.
        detectors: frames that `detect` can take at the same time, in other threads than that of
            `perceive`; 0 = it runs in the thread of `perceive` alone.

    Attributes:
        vocabulary: classes of the newest detections and predicates of the relation head.
        score_threshold: minimum score of an object, in [0, 1].
    """

    def __init__(
        self,
        detector: Detector,
        segmenter: Segmenter,
        relation_head: RelationHead,
        config: PerceptionConfig,
        *,
        world_up: str = "auto",
        detectors: int = 0,
        embedder: Embedder | None = None,
    ) -> None:
        self.detectors = detectors
        self._embedder, self._queue = embedder, EmbeddingQueue()
        self._detector = detector
        self._segmenter = segmenter
        self._relation_head = relation_head
        self._words = config.words
        self._refine = config.refine_detections
        self._up = UpEstimator(world_up)
        # Another process has seen the image as it is.
        self._source = detector if isinstance(detector, DetectionSource) else None
        upright = config.refine_detections and self._source is None
        self._uprighter = Uprighter(world_up) if upright else None
        self._failures: dict[str, str] = {}
        self._logged: set[str] = set()
        self.vocabulary = _vocabulary(detector.classes, relation_head.predicates)
        self.configure(config)

    def check(self, config: PerceptionConfig) -> None:
        """Raise ConfigurationError for words that the detector cannot look for."""
        if hasattr(self._detector, "check_words"):
            self._detector.check_words(config.words)
        elif config.words:
            raise ConfigurationError(
                f"perception.words needs a detector of free text, and perception.detector is "
                f"'{config.detector}': set it to open_vocabulary, with a perception.detector_path"
            )

    def take_over(self, other: Perception, config: PerceptionConfig) -> None:
        """Keep the columns of another perception's classes, which this one replaces."""
        if hasattr(self._detector, "use_words"):
            self._detector.use_words(config.words, other.vocabulary.classes)

    def configure(self, config: PerceptionConfig) -> None:
        """Use other `score_threshold`, `max_relations` and `words` from the next frame on.

        Raises:
            ConfigurationError: as `check`; nothing changes.
        """
        self.check(config)
        if config.words != self._words:
            self._detector.use_words(config.words)  # type: ignore[attr-defined]
            self._words = config.words
        self._max_relations = config.max_relations
        self.score_threshold = (
            self._detector.default_score_threshold
            if config.score_threshold < 0
            else config.score_threshold
        )

    def watch(self, wrap: Callable[[str, Any], Any]) -> None:
        """Replace each backend by the result of a function of its name and the backend."""
        self._detector = wrap("detector", self._detector)
        self._segmenter = wrap("segmenter", self._segmenter)
        self._relation_head = wrap("relation_head", self._relation_head)
        if self._embedder is not None:
            self._embedder = wrap("embedder", self._embedder)

    def turn_upright(self, frame: RgbdFrame) -> UprightFrame:
        """The next frame, upright; as it is if detections are not refined."""
        if self._uprighter is None:
            return UprightFrame(frame, frame)
        return self._uprighter.turn(frame)

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The 2D scene graph and the instance image of `frame`.

        A segmenter or relation head that fails does not stop the run: `drops` counts the lost
        objects.

        Args:
            frame: the frames come in order of time.

        Raises:
            RefusedInput: ``detector_error``.
        """
        seen = self.turn_upright(frame)
        return self.perceive_detected(seen, lambda: self.detect(seen.upright))

    def perceive_detected(self, seen: UprightFrame, detect: Callable[[], Detections]) -> Perceived:
        """`perceive` of a frame whose objects are detected elsewhere.

        Args:
            seen: of `turn_upright`; the frames come in order of time.
            detect: gives the result of `detect` for the upright frame, or raises its error.
        """
        found = self._perceive(seen.upright, detect)
        graph, instances = turned_back(found.frame_graph, found.instances, seen.turns)
        if graph is not found.frame_graph:  # its samples are of other pixels
            graph = replace(graph, rgb_grid=np.ascontiguousarray(seen.original.rgb[GRID, GRID]))
        return replace(found, frame_graph=graph, instances=instances, turns=seen.turns)

    def _perceive(self, frame: RgbdFrame, detect: Callable[[], Detections]) -> Perceived:
        intrinsics = frame.intrinsics
        self._up.observe(frame.T_world_camera)
        self._failures = {}
        found = detect()
        if found.classes is not None and found.classes != self.vocabulary.classes:
            self.vocabulary = _vocabulary(found.classes, self.vocabulary.predicates)
        strong = found.scores >= self.score_threshold
        objects, drops = _select(found.take(strong), intrinsics, self._refine)
        weak, _ = _select(found.take(~strong), intrinsics, self._refine)
        if self._source is not None:
            drops += self._source.take_drops()
        masks = self.segment(frame, objects, in_front_of(objects, weak))
        if masks is None:
            drops["segmenter_error"] = len(objects)
            objects, masks = objects.take(slice(0)), []
        if self._refine:
            count = len(objects)
            objects, masks = join_nested(objects, masks, frame.depth_m)
            if len(objects) < count:
                drops["detected_twice"] = count - len(objects)
        instances = instance_image(
            masks,
            objects.class_probabilities.argmax(axis=1),
            objects.scores,
            (intrinsics.height, intrinsics.width),
        )
        relations = Relations.none(len(self.vocabulary.predicates))
        if len(objects) > 1 and self._max_relations:
            related = self.relate(frame, objects, instances)
            if related is None:
                drops["relation_head_error"] = len(objects)
            else:
                relations = related
        embeddings = self._embeddings(frame, objects)
        if "embedder_error" in self._failures:
            drops["embedder_error"] = len(objects)
        frame_graph = FrameGraph(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            width=intrinsics.width,
            height=intrinsics.height,
            vocabulary=self.vocabulary,
            boxes_xyxy=objects.boxes_xyxy,
            class_probabilities=objects.class_probabilities,
            scores=objects.scores,
            relations=relations,
            colours_lab=mean_colours(frame.rgb, instances, [mask.window for mask in masks]),
            embeddings=embeddings,
            rgb_grid=np.ascontiguousarray(frame.rgb[GRID, GRID]),
        )
        return Perceived(frame_graph, instances, dict(drops), self._failures)

    def _embeddings(self, frame: RgbdFrame, objects: Detections) -> Embeddings | None:
        """Those of the embedder or the detector; None if there are none, or the embedder failed."""
        rows, vectors, model = np.arange(len(objects)), objects.embeddings, objects.embedding_model
        if self._embedder is not None:
            rows = np.array(self._queue.choose(objects.boxes_xyxy, frame.stamp_ns), np.int64)
            crops = [square_crop(frame.rgb, objects.boxes_xyxy[row]) for row in rows]
            try:
                vectors = self._embedder.embed(crops) if crops else None
            except Exception as error:  # see detect
                self._note_failure("embedder", "embedder_error", error)
                return None
            model = self._embedder.model_name
        if vectors is None:
            return None
        found = unit_embeddings(vectors, rows, model)
        return found if len(found.rows) else None

    def detect(self, frame: RgbdFrame) -> Detections:
        """Objects and, if refined, weak boxes of an upright frame; raises ``detector_error``."""
        fraction = WEAK_SCORE_FRACTION if self._refine else 1.0
        if self._source is not None and frame.sent is not None:
            return self._source.take(frame.sent, fraction * self.score_threshold)
        try:
            found = self._detector.detect(frame.rgb, fraction * self.score_threshold)
            return found.doubted() if self._refine else found
        except RefusedInput:
            raise
        except Exception as error:  # a model can fail in more ways than can be listed
            message = self._note_failure("detector", "detector_error", error)
            raise RefusedInput("detector_error", message) from error

    def segment(
        self, frame: RgbdFrame, objects: Detections, weak: Detections
    ) -> list[MaskPatch] | None:
        """A mask of each object: the detector's, or the segmenter's without the pixels of `weak`.

        None if the segmenter failed.
        """
        if objects.masks is not None:
            return list(objects.masks)
        boxes_xyxy = np.concatenate([objects.boxes_xyxy, weak.boxes_xyxy])
        try:
            masks = self._segmenter.segment(frame.rgb, frame.depth_m, frame.intrinsics, boxes_xyxy)
            return masks[: len(objects)]
        except Exception as error:  # see detect
            self._note_failure("segmenter", "segmenter_error", error)
            return None

    def relate(self, frame: RgbdFrame, objects: Detections, instances: UInt16) -> Relations | None:
        """The best relations between the objects; None if the relation head failed."""
        segmented = SegmentedObjects(
            class_names=[
                self.vocabulary.classes[c] for c in objects.class_probabilities.argmax(axis=1)
            ],
            scores=objects.scores,
            features=objects.features,
            instances=instances,
            depth_m=frame.depth_m,
            intrinsics=frame.intrinsics,
            up_camera=np.asarray(frame.T_world_camera[:3, :3].T @ self._up.up_world()),
        )
        try:
            return self._relation_head.relate(segmented, self._max_relations)
        except Exception as error:  # see detect
            self._note_failure("relation head", "relation_head_error", error)
            return None

    def _note_failure(self, backend: str, reason: str, error: Exception) -> str:
        """Log the first failure of a backend with its traceback; later ones are only counted."""
        message = self._failures[reason] = f"the {backend} failed: {error}"
        if reason not in self._logged:
            self._logged.add(reason)
            logger.error(
                "%s; the run continues without its result, and further failures are counted",
                message,
                exc_info=error,
            )
        return message


def _select(
    found: Detections, intrinsics: Intrinsics, refine: bool
) -> tuple[Detections, Counter[str]]:
    """Boxes clipped to the image, best score first, at most `MAX_OBJECTS`; and the drops."""
    width, height = intrinsics.width, intrinsics.height
    boxes = np.clip(found.boxes_xyxy, 0.0, [width - 1.0, height - 1.0] * 2)
    large = (boxes[:, 2:] - boxes[:, :2]).min(axis=1) >= MIN_BOX_SIDE_PX
    view = fills_image(boxes, width, height) & refine
    usable = large & ~view
    order = np.argsort(-found.scores, kind="stable")
    order = order[usable[order]]
    kept = order[:MAX_OBJECTS]
    drops: Counter[str] = Counter()
    if not large.all():
        drops["box_too_small"] = int((~large).sum())
    if view.any():
        drops["box_is_the_view"] = int(view.sum())
    if len(order) > len(kept):
        drops["over_max_objects"] = len(order) - len(kept)
    return replace(found, boxes_xyxy=boxes).take(kept), drops


def fills_image(boxes_xyxy: Float64, width: int, height: int) -> Bool:
    """(n,) bool: which boxes (n, 4), in pixels, reach all four borders of the image.

    The image does not show where such an object ends. Its class is that of the whole scene, and
    its mask contains other objects.
    """
    margins = boxes_xyxy * [1.0, 1.0, -1.0, -1.0] + [0.0, 0.0, width - 1.0, height - 1.0]
    return np.asarray((margins <= BORDER_FRACTION * np.array([width, height] * 2)).all(axis=1))


def _vocabulary(classes: Sequence[str], predicates: Sequence[str]) -> Vocabulary:
    """The names of the models, which come from files: messages and maps have to be readable."""
    names = Vocabulary(tuple(classes), tuple(predicates))
    for kind, of_kind in (("classes", names.classes), ("predicates", names.predicates)):
        try:
            check_names(of_kind)
        except ValueError as error:
            raise ConfigurationError(f"{kind} of the models: {error}") from error
    return names
