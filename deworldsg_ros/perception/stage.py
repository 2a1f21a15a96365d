"""Stage a: one RGB-D frame → its 2D scene graph and its instance image."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.instance_image import instance_image
from deworldsg_ros.perception.nested import in_front_of, join_nested
from deworldsg_ros.perception.protocols import (
    Detections,
    Detector,
    MaskPatch,
    RelationHead,
    SegmentedObjects,
    Segmenter,
)
from deworldsg_ros.perception.upright import Uprighter, UprightFrame, turned_back
from deworldsg_ros.scene.arrays import Bool, Float64, UInt16
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary
from deworldsg_ros.scene.names import check_names
from deworldsg_ros.scene.up import UpEstimator

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
        drops: number of dropped detections by reason: ``box_too_small`` (or outside the image),
            ``box_is_the_view`` (fills the image), ``over_max_objects``, ``detected_twice``
            (nested), ``segmenter_error`` (all of the frame). ``relation_head_error`` counts the
            objects that are passed on without relations.
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
        world_up: axis of the world frame that points up: auto, z, y or -y (`UpEstimator`).
        detectors: frames that `detect` can take at the same time, in other threads than that of
            `perceive`; 0 = it runs in the thread of `perceive` alone.

    Attributes:
        vocabulary: classes of the detector and predicates of the relation head.
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
    ) -> None:
        self.detectors = detectors
        self._detector = detector
        self._segmenter = segmenter
        self._relation_head = relation_head
        self._refine = config.refine_detections
        self._up = UpEstimator(world_up)
        self._uprighter = Uprighter(world_up) if config.refine_detections else None
        self._failures: dict[str, str] = {}
        self._logged: set[str] = set()
        self.vocabulary = _vocabulary(detector, relation_head)
        self.configure(config)

    def configure(self, config: PerceptionConfig) -> None:
        """Use another `score_threshold` and `max_relations` from the next frame on."""
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
        return replace(found, frame_graph=graph, instances=instances, turns=seen.turns)

    def _perceive(self, frame: RgbdFrame, detect: Callable[[], Detections]) -> Perceived:
        intrinsics = frame.intrinsics
        self._up.observe(frame.T_world_camera)
        self._failures = {}
        found = detect()
        strong = found.scores >= self.score_threshold
        objects, drops = _select(found.take(strong), intrinsics, self._refine)
        weak, _ = _select(found.take(~strong), intrinsics, self._refine)
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
        )
        return Perceived(frame_graph, instances, dict(drops), self._failures)

    def detect(self, frame: RgbdFrame) -> Detections:
        """Objects and, if refined, weak boxes of an upright frame; raises ``detector_error``."""
        fraction = WEAK_SCORE_FRACTION if self._refine else 1.0
        try:
            return self._detector.detect(frame.rgb, fraction * self.score_threshold)
        except Exception as error:  # a model can fail in more ways than can be listed
            message = self._note_failure("detector", "detector_error", error)
            raise RefusedInput("detector_error", message) from error

    def segment(
        self, frame: RgbdFrame, objects: Detections, weak: Detections
    ) -> list[MaskPatch] | None:
        """A mask of each object, without the pixels of `weak`; None if the segmenter failed."""
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


def _vocabulary(detector: Detector, relation_head: RelationHead) -> Vocabulary:
    """The names of the models, which come from files: messages and maps have to be readable."""
    names = Vocabulary(tuple(detector.classes), tuple(relation_head.predicates))
    for kind, of_kind in (("classes", names.classes), ("predicates", names.predicates)):
        try:
            check_names(of_kind)
        except ValueError as error:
            raise ConfigurationError(f"{kind} of the models: {error}") from error
    return names
