"""Stage a: one RGB-D frame → its 2D scene graph and its instance labels."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.label_image import label_image
from deworldsg_ros.perception.nested import in_front_of, join_nested
from deworldsg_ros.perception.protocols import (
    Detections,
    Detector,
    MaskPatch,
    RelationHead,
    Segmenter,
)
from deworldsg_ros.scene.arrays import Bool, Float64, UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary
from deworldsg_ros.scene.up import UpEstimator

logger = logging.getLogger(__name__)

# Below this a box has no inside to segment.
MIN_BOX_SIDE_PX = 2.0
# A box reaches a border of the image from so near, as a share of the image's side.
BORDER_SHARE = 0.04


@dataclass(frozen=True)
class Perceived:
    """What one frame showed.

    Attributes:
        frame_graph: objects, best score first, and the relations between them.
        instances: (H, W) uint16; k + 1 on the pixels of the k-th object, 0 on nothing.
        drops: number of detections not passed on, by reason: ``box_too_small`` (or outside the
            image), ``box_is_the_view``, ``over_max_objects``, ``detected_twice`` (whole and in
            part), ``segmenter_error`` (all of the frame); and ``relation_head_error`` for those
            that went on without relations.
        failures: what a backend said when it failed on this frame, by those reasons.
    """

    frame_graph: FrameGraph
    instances: UInt16
    drops: dict[str, int] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)


class Perception:
    """Detector, segmenter and relation head, composed.

    Args:
        detector, segmenter, relation_head: the backends.
        config: thresholds and limits.
        world_up: axis of the world frame that points up: auto, z, y or -y (`UpEstimator`).
    """

    def __init__(
        self,
        detector: Detector,
        segmenter: Segmenter,
        relation_head: RelationHead,
        config: PerceptionConfig,
        *,
        world_up: str = "auto",
    ) -> None:
        self._detector = detector
        self._segmenter = segmenter
        self._relation_head = relation_head
        self._config = config
        self._up = UpEstimator(world_up)
        self._failures: dict[str, str] = {}
        self._logged: set[str] = set()
        self.vocabulary = Vocabulary(tuple(detector.classes), tuple(relation_head.predicates))
        self.score_threshold = (
            detector.default_score_threshold
            if config.score_threshold < 0
            else config.score_threshold
        )

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The 2D scene graph and the instance labels of `frame`.

        A backend that fails costs what it would have given, not the frame: see `drops`.

        Raises:
            RefusedInput: ``detector_error``.
        """
        intrinsics = frame.intrinsics
        shape = (intrinsics.height, intrinsics.width)
        up_camera = self._up_camera(frame.T_world_camera)
        self._failures = {}
        found = self.detect(frame)
        sure = found.scores >= self.score_threshold
        objects, drops = self._select(found.take(sure), intrinsics.width, intrinsics.height)
        unsure, _ = self._select(found.take(~sure), intrinsics.width, intrinsics.height)
        masks = self.segment(frame, objects, in_front_of(objects, unsure))
        if masks is None:
            drops["segmenter_error"] = len(objects)
            objects, masks = objects.take(slice(0)), []
        found_count = len(objects)
        if self._config.join_nested:
            objects, masks = join_nested(objects, masks, frame.depth_m)
        if len(objects) < found_count:
            drops["detected_twice"] = found_count - len(objects)
        classes = objects.class_probabilities.argmax(axis=1)
        instances = label_image(masks, classes.astype(np.int64), objects.scores, shape)
        relations = Relations.none(len(self.vocabulary.predicates))
        if len(objects) > 1 and self._config.top_relations:
            related = self.relate(frame, objects, instances, up_camera)
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
        """What may be an object in the image; raises RefusedInput ``detector_error``."""
        try:
            return self._detector.detect(
                frame.rgb, self._config.unsure_share * self.score_threshold
            )
        except Exception as error:  # a model can fail in more ways than can be listed
            message = self._note_failure("detector", "detector_error", error)
            raise RefusedInput("detector_error", message) from error

    def segment(
        self, frame: RgbdFrame, objects: Detections, others: Detections
    ) -> list[MaskPatch] | None:
        """A mask for each object, beside others; None where the segmenter failed."""
        try:
            masks = self._segmenter.segment(
                frame.rgb,
                frame.depth_m,
                frame.intrinsics,
                np.concatenate([objects.boxes_xyxy, others.boxes_xyxy]),
                self._likeliest_names(objects) + self._likeliest_names(others),
            )
            return masks[: len(objects)]
        except Exception as error:  # see detect
            self._note_failure("segmenter", "segmenter_error", error)
            return None

    def relate(
        self,
        frame: RgbdFrame,
        objects: Detections,
        instances: UInt16,
        up_camera: Float64,
    ) -> Relations | None:
        """The best relations between the objects; None where the relation head failed."""
        try:
            return self._relation_head.relate(
                frame.depth_m,
                frame.intrinsics,
                objects.boxes_xyxy,
                self._likeliest_names(objects),
                objects.scores,
                instances,
                up_camera,
                self._config.top_relations,
                objects.features,
            )
        except Exception as error:  # see detect
            self._note_failure("relation head", "relation_head_error", error)
            return None

    def _likeliest_names(self, objects: Detections) -> list[str]:
        return [self.vocabulary.classes[c] for c in objects.class_probabilities.argmax(axis=1)]

    def _note_failure(self, backend: str, reason: str, error: Exception) -> str:
        """Log a backend's first failure with its traceback; the others are only counted."""
        message = self._failures[reason] = f"the {backend} failed: {error}"
        if reason not in self._logged:
            self._logged.add(reason)
            logger.error(
                "%s; the run goes on without what it would have found, and further failures are "
                "counted",
                message,
                exc_info=error,
            )
        return message

    def _select(
        self, found: Detections, width: int, height: int
    ) -> tuple[Detections, Counter[str]]:
        """Boxes cut to the image, best score first, at most `max_objects`."""
        boxes = np.clip(found.boxes_xyxy, 0.0, [width - 1.0, height - 1.0] * 2)
        large = (boxes[:, 2:] - boxes[:, :2]).min(axis=1) >= MIN_BOX_SIDE_PX
        view = is_the_view(boxes, width, height) & self._config.drop_views
        usable = large & ~view
        order = np.argsort(-found.scores, kind="stable")
        order = order[usable[order]]
        kept = order[: self._config.max_objects]
        drops: Counter[str] = Counter()
        if not large.all():
            drops["box_too_small"] = int((~large).sum())
        if view.any():
            drops["box_is_the_view"] = int(view.sum())
        if len(order) > len(kept):
            drops["over_max_objects"] = len(order) - len(kept)
        return replace(found, boxes_xyxy=boxes).take(kept), drops

    def _up_camera(self, T_world_camera: Float64) -> Float64:
        """Direction against gravity in the camera frame, (3,) unit vector."""
        self._up.observe(T_world_camera)
        return np.asarray(T_world_camera[:3, :3].T @ self._up.up_world())


def is_the_view(boxes_xyxy: Float64, width: int, height: int) -> Bool:
    """Which boxes (n, 4) reach all four borders of the image.

    Nothing tells where such a thing ends: it is named after the scene, and holds what is in it.
    """
    margins = boxes_xyxy * [1.0, 1.0, -1.0, -1.0] + [0.0, 0.0, width - 1.0, height - 1.0]
    return np.asarray((margins <= BORDER_SHARE * np.array([width, height] * 2)).all(axis=1))
