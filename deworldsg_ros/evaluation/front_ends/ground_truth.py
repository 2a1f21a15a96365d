"""Detections and relations from the annotation; perfect without injected faults.

The masks come from the instance image of the frame. If the data set has none, each depth pixel
belongs to the object of the nearest annotated surface point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial import cKDTree

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends.assembly import (
    Detection,
    FrameDetections,
    Relation,
    assemble,
    spread,
    visible_box,
)
from deworldsg_ros.evaluation.front_ends.injection import Injection
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.recordings.folders.annotations import ScanAnnotation, ScanPoints
from deworldsg_ros.scene.arrays import UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import Vocabulary

# Probability of the true class and predicate; the rest is spread evenly.
TRUE_PROBABILITY = 0.9
# Range of random relation scores: only the best relations of a frame are kept, and random scores
# give each relation its turn.
RELATION_SCORES = (0.8, 1.0)
# Without instance images: step between the pixels that are looked up, for speed, and maximum
# distance of the annotated point of a pixel.
PIXEL_STRIDE = 2
MAX_DISTANCE_M = 0.05


class GroundTruthFrontEnd:
    """Detects the annotated objects and relations.

    Args:
        frame_numbers: number of each frame by its stamp in nanoseconds.
        instances: returns the instance image (H, W) of a frame, or None.
        annotation: annotated objects and relations of the scan.
        points: annotated surface points of the scan.
        vocabulary: classes and predicates of the data set.
        seed: random seed of the relation scores.
        top_relations: number of relations kept per frame.
        injection: injects faults; None = no faults.
    """

    def __init__(
        self,
        frame_numbers: Mapping[int, int],
        instances: Callable[[RgbdFrame], UInt16 | None],
        annotation: ScanAnnotation,
        points: ScanPoints,
        vocabulary: Vocabulary,
        *,
        seed: int = 0,
        top_relations: int = 10,
        injection: Injection | None = None,
    ) -> None:
        self.vocabulary = vocabulary
        self._frame_numbers = frame_numbers
        self._instances = instances
        self._annotation = annotation
        self._seed = seed
        self._top_relations = top_relations
        self._injection = injection
        listed = np.isin(points.object_ids, list(annotation.objects))
        usable = listed & np.isfinite(points.points_world).all(axis=1)
        self._tree = cKDTree(points.points_world[usable]) if usable.any() else None
        self._point_ids = points.object_ids[usable]

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """Detections and relations of a frame, with faults; raises EvaluationError."""
        number = self._frame_numbers.get(frame.stamp_ns)
        if number is None:
            raise EvaluationError(f"frame with the stamp {frame.stamp_ns} ns is not in this scan")
        instances = self._instances(frame)
        if instances is None:
            instances = self._nearest_objects(frame)
        detections: list[Detection] = []
        indices: dict[int, int] = {}
        for object_id, class_index in self._annotation.objects.items():
            box = visible_box(instances, object_id)
            if box is not None:
                indices[object_id] = len(detections)
                scores = spread({class_index: TRUE_PROBABILITY}, len(self.vocabulary.classes))
                detections.append(Detection(box, scores, TRUE_PROBABILITY, object_id))
        seen = FrameDetections(detections, self._relate(number, indices), instances)
        if self._injection is not None:
            seen = self._injection.apply(seen, frame, number)
        return assemble(frame, self.vocabulary, seen, self._top_relations)

    def _relate(self, number: int, indices: Mapping[int, int]) -> list[Relation]:
        stated: dict[tuple[int, int], dict[int, float]] = {}
        for subject, object_, predicate in self._annotation.relations:
            if subject in indices and object_ in indices and subject != object_ and predicate >= 0:
                stated.setdefault((subject, object_), {})[predicate] = TRUE_PROBABILITY
        relations = []
        for (subject, object_), probabilities in stated.items():
            generator = np.random.default_rng([self._seed, 1, number, subject, object_])
            relations.append(
                Relation(
                    indices[subject],
                    indices[object_],
                    float(generator.uniform(*RELATION_SCORES)),
                    spread(probabilities, len(self.vocabulary.predicates)),
                )
            )
        return relations

    def _nearest_objects(self, frame: RgbdFrame) -> UInt16:
        """Instance image (H, W) from the annotated point nearest to each depth pixel."""
        labels = np.zeros(frame.depth_m.shape, np.uint16)
        depth_m = frame.depth_m[::PIXEL_STRIDE, ::PIXEL_STRIDE]
        rows, columns = np.nonzero(depth_m > 0)
        if self._tree is None or not len(rows):
            return labels
        points_camera = frame.intrinsics.back_project(
            columns * PIXEL_STRIDE,
            rows * PIXEL_STRIDE,
            depth_m[rows, columns].astype(np.float64),
        )
        T = frame.T_world_camera
        points_world = points_camera @ T[:3, :3].T + T[:3, 3]
        distances, nearest = self._tree.query(points_world, distance_upper_bound=MAX_DISTANCE_M)
        near = np.isfinite(distances)
        coarse = np.zeros(depth_m.shape, np.uint16)
        coarse[rows[near], columns[near]] = self._point_ids[nearest[near]]
        fine = coarse.repeat(PIXEL_STRIDE, axis=0).repeat(PIXEL_STRIDE, axis=1)
        height, width = frame.depth_m.shape
        labels[:] = fine[:height, :width]
        labels[~(frame.depth_m > 0)] = 0
        return labels
