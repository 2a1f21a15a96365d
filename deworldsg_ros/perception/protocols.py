"""Protocols of the backends: detector, segmenter, relation head; and the data between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import Relations


@dataclass(frozen=True)
class Detections:
    """Objects of one image (n objects, C classes), best score first.

    Attributes:
        boxes_xyxy: (n, 4) float64 pixels, corners x1, y1, x2, y2; pixel centres at integers.
        class_probabilities: (n, C) float64, calibrated, rows sum to one.
        scores: (n,) float64 in [0, 1], the detector's own score.
        features: (n, …) float32 features of the detector for a relation head that was trained on
            them; None = none.
    """

    boxes_xyxy: Float64
    class_probabilities: Float64
    scores: Float64
    features: Float32 | None = None

    def __post_init__(self) -> None:
        count = len(self.scores)
        if self.boxes_xyxy.shape != (count, 4) or len(self.class_probabilities) != count:
            raise ValueError(
                f"{count} scores, boxes of shape {self.boxes_xyxy.shape}, class probabilities of "
                f"shape {self.class_probabilities.shape}; expected one row per object"
            )
        if self.features is not None and len(self.features) != count:
            raise ValueError(f"{count} scores, {len(self.features)} features; expected as many")

    def __len__(self) -> int:
        return len(self.scores)

    def take(self, rows: Int64 | Bool | slice) -> Detections:
        """The objects of `rows` (indices, mask or slice), in that order."""
        return Detections(
            self.boxes_xyxy[rows],
            self.class_probabilities[rows],
            self.scores[rows],
            None if self.features is None else self.features[rows],
        )


@dataclass(frozen=True)
class MaskPatch:
    """Mask of one object, stored as the part of the image around it.

    Attributes:
        top, left: image row and column of the patch's first pixel.
        pixels: (h, w) bool; h or w is 0 if the object has no pixel.
    """

    top: int
    left: int
    pixels: Bool

    @property
    def window(self) -> tuple[slice, slice]:
        """The slices of the image that the patch covers."""
        height, width = self.pixels.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


class Detector(Protocol):
    """Image to objects."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the C classes, in the order of the distributions."""

    @property
    def default_score_threshold(self) -> float:
        """Minimum score of an object for this backend, in [0, 1].

        The paper's 0.7 suits softmax scores. Sigmoid scores of a small network are lower.
        """

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """Objects of `rgb`, (H, W, 3) uint8 in RGB order, with score >= `score_threshold`."""


class Segmenter(Protocol):
    """Boxes to masks."""

    def segment(
        self,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        boxes_xyxy: Float64,
    ) -> list[MaskPatch]:
        """The visible surface of the object in each box.

        Args:
            rgb: (H, W, 3) uint8, RGB order.
            depth_m: (H, W) float32, metres along the optical axis; 0 = invalid.
            intrinsics: of both images.
            boxes_xyxy: (n, 4) pixels; may reach beyond the image.

        Returns:
            n masks, in the order of the boxes.
        """


@dataclass(frozen=True)
class SegmentedObjects:
    """The n objects of one frame, input of a relation head.

    Attributes:
        class_names: n most likely classes.
        scores: (n,) float64 in [0, 1], best first.
        features: (n, …) float32, the `Detections.features`; None = none.
        instances: (H, W) uint16 instance image; k + 1 on the pixels of row k, else 0.
        depth_m: (H, W) float32, metres; 0 = invalid.
        intrinsics: of the depth.
        up_camera: (3,) float64 unit vector against gravity, camera frame.
    """

    class_names: list[str]
    scores: Float64
    features: Float32 | None
    instances: UInt16
    depth_m: Float32
    intrinsics: Intrinsics
    up_camera: Float64

    def __len__(self) -> int:
        return len(self.scores)


class RelationHead(Protocol):
    """Objects to relations between them."""

    @property
    def predicates(self) -> tuple[str, ...]:
        """Names of the R predicates, in the order of the logits."""

    def relate(self, objects: SegmentedObjects, max_relations: int) -> Relations:
        """The `max_relations` best ordered pairs of the objects, best first."""
