"""Protocols of the backends: detector, segmenter, relation head; and the data between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from deworldsg_ros.scene.camera import Intrinsics, MaskPatch
from deworldsg_ros.scene.frame_graph import Embeddings, Relations


@dataclass(frozen=True)
class Detections:
    """Objects of one image (n objects, C classes), best score first.

    Attributes:
        boxes_xyxy: (n, 4) float64 pixels, corners x1, y1, x2, y2; pixel centres at integers.
        class_probabilities: (n, C) float64, calibrated, rows sum to one.
        scores: (n,) float64 in [0, 1], the detector's own score.
        features: (n, …) float32 features of the detector for a relation head that was trained on
            them; None = none.
        classes: names of the C classes, if they are not those of the detector at all times: a
            detector of free text learns new ones, always at the end; None = `Detector.classes`.
        masks: n masks, if the detector has them: then no segmenter runs; None = none.
        embeddings: (n, D) float32, what the image shows of each object, of any length; a row that
            is 0 or not finite = not of this object; None = none.
        embedding_model: name of the model that made the embeddings.
        certainties: (n,) float64, probability that the name of an object whose best view is this
            one is right; None = what `class_probabilities` say.
    """

    boxes_xyxy: Float64
    class_probabilities: Float64
    scores: Float64
    features: Float32 | None = None
    classes: tuple[str, ...] | None = None
    masks: tuple[MaskPatch, ...] | None = None
    embeddings: Float32 | None = None
    embedding_model: str = ""
    certainties: Float64 | None = None

    def __post_init__(self) -> None:
        count = len(self.scores)
        if self.boxes_xyxy.shape != (count, 4) or len(self.class_probabilities) != count:
            raise ValueError(
                f"{count} scores, boxes of shape {self.boxes_xyxy.shape}, class probabilities of "
                f"shape {self.class_probabilities.shape}; expected one row per object"
            )
        for name in ("features", "masks", "embeddings", "certainties"):
            values = getattr(self, name)
            if values is not None and len(values) != count:
                raise ValueError(f"{count} scores, {len(values)} {name}; expected as many")
        if self.embeddings is not None:
            unit_embeddings(self.embeddings[:0], np.zeros(0, np.int64), self.embedding_model)

    def __len__(self) -> int:
        return len(self.scores)

    def take(self, rows: Int64 | Bool | slice) -> Detections:
        """The objects of `rows` (indices, mask or slice), in that order."""
        kept: list[int] = np.arange(len(self))[rows].tolist()
        return replace(
            self,
            boxes_xyxy=self.boxes_xyxy[rows],
            class_probabilities=self.class_probabilities[rows],
            scores=self.scores[rows],
            features=None if self.features is None else self.features[rows],
            masks=None if self.masks is None else tuple([self.masks[row] for row in kept]),
            embeddings=None if self.embeddings is None else self.embeddings[rows],
            certainties=None if self.certainties is None else self.certainties[rows],
        )

    def doubted(self) -> Detections:
        """With the certainties in the class distributions: what is left is on all classes."""
        if self.certainties is None:
            return self
        certain, classes = self.certainties[:, None], self.class_probabilities
        mixed = certain * classes + (1.0 - certain) / classes.shape[1]
        return replace(self, class_probabilities=mixed, certainties=None)


def unit_embeddings(vectors: Float32, rows: Int64, model: str) -> Embeddings:
    """Embeddings of the objects of `rows` (m,), scaled to length one.

    Args:
        vectors: (m, D) float32; rows that are 0 or not finite are left out.
        rows: ascending.
        model: that made them.

    Raises:
        ValueError: more than 2048 values, or no name of the model.
    """
    lengths = np.linalg.norm(vectors.astype(np.float64), axis=1)
    kept = np.isfinite(lengths) & (lengths > 0)
    unit = (vectors[kept] / lengths[kept, None]).astype(np.float16)
    return Embeddings(rows[kept], unit, model)


class Detector(Protocol):
    """Image to objects."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the C classes, in the order of the distributions.

        If they may change, each `Detections` carries its own; see there.
        """

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


class Embedder(Protocol):
    """Crops of objects to vectors."""

    @property
    def model_name(self) -> str:
        """Name of the model, by which its texts can be found."""

    def embed(self, crops: Sequence[UInt8]) -> Float32:
        """(n, D) float32 vectors of n >= 1 crops, (h, w, 3) uint8 in RGB order each."""


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
