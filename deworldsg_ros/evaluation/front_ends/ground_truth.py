"""Detections and relations made from the annotation: perfect, or with chosen faults.

Which pixels are whose comes from the frame's instance image where the data set has one, else from
the annotated surface point nearest to each depth pixel. Every fault is drawn from a generator that
is seeded with the seed, the frame and the object, so that a run does not depend on the order of
anything, and two fault rates share their draws.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from deworldsg_ros.datasets.annotations import ScanAnnotation, ScanPoints
from deworldsg_ros.datasets.sequence import SequenceDataset
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends.assembly import Detection, Relation, assemble, spread
from deworldsg_ros.evaluation.front_ends.recorded import read_instances
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import Float64, Vocabulary

# An object is there to be detected with so many visible pixels, in a box with sides so long.
MIN_PIXELS = 200
MIN_BOX_SIDE_PX = 10
# What a detection and a relation are sure of; the rest is spread evenly.
CERTAINTY = 0.9
# Relations are ranked by scores drawn from this range, so that all get their turn.
RELATION_SCORES = (0.8, 1.0)
# Without instance images: pixels looked at, and how far the nearest annotated point may be.
PIXEL_STRIDE = 2
MAX_DISTANCE_M = 0.05


class GroundTruthFrontEnd:
    """Sees what is annotated.

    Args:
        dataset: the scan's folder.
        annotation: its objects and relations.
        points: its annotated surface points.
        vocabulary: of the data set.
        miss: share of detections that are left out.
        jitter_px: standard deviation of each box edge, pixels.
        flip: share of detections with a wrong class, any other one.
        seed: of the faults.
        top_relations: relations kept a frame.
    """

    def __init__(
        self,
        dataset: SequenceDataset,
        annotation: ScanAnnotation,
        points: ScanPoints,
        vocabulary: Vocabulary,
        *,
        miss: float = 0.0,
        jitter_px: float = 0.0,
        flip: float = 0.0,
        seed: int = 0,
        top_relations: int = 10,
    ) -> None:
        self.vocabulary = vocabulary
        self._dataset = dataset
        self._annotation = annotation
        self._miss = miss
        self._jitter_px = jitter_px
        self._flip = flip
        self._seed = seed
        self._top_relations = top_relations
        listed = np.isin(points.object_ids, list(annotation.objects))
        usable = listed & np.isfinite(points.points_world).all(axis=1)
        self._tree = cKDTree(points.points_world[usable]) if usable.any() else None
        self._point_ids = points.object_ids[usable]

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """What is annotated of this frame, with the faults."""
        number = self._dataset.frame_numbers.get(frame.stamp_ns)
        if number is None:
            raise EvaluationError(
                f"frame of {frame.stamp_ns} ns is not of {self._dataset.sequence}"
            )
        instances = self._instances(number, frame)
        detections: list[Detection] = []
        places: dict[int, int] = {}
        for object_id, class_place in self._annotation.objects.items():
            box = visible_box(instances, object_id)
            if box is None:
                continue
            detection = self._detect(number, object_id, class_place, box, frame)
            if detection is not None:
                places[object_id] = len(detections)
                detections.append(detection)
        relations = self._relate(number, places)
        return assemble(
            frame, self.vocabulary, detections, relations, instances, self._top_relations
        )

    def _detect(
        self, number: int, object_id: int, class_place: int, box: Float64, frame: RgbdFrame
    ) -> Detection | None:
        generator = np.random.default_rng([self._seed, 0, number, object_id])
        missed, flipped = generator.random(2)
        edges = generator.normal(size=4)
        count = len(self.vocabulary.classes)
        other = int(generator.integers(count - 1)) if count > 1 else 0
        if missed < self._miss:
            return None
        if flipped < self._flip and count > 1:
            class_place = other + (other >= class_place)
        size = [frame.intrinsics.width - 1.0, frame.intrinsics.height - 1.0] * 2
        box = np.clip(box + self._jitter_px * edges, 0.0, size)
        if (box[2:] - box[:2] < 1.0).any():
            return None
        return Detection(box, spread({class_place: CERTAINTY}, count), CERTAINTY, object_id)

    def _relate(self, number: int, places: Mapping[int, int]) -> list[Relation]:
        stated: dict[tuple[int, int], dict[int, float]] = {}
        for subject, object_, predicate in self._annotation.relations:
            if subject in places and object_ in places and subject != object_ and predicate >= 0:
                stated.setdefault((subject, object_), {})[predicate] = CERTAINTY
        relations = []
        for (subject, object_), probabilities in stated.items():
            generator = np.random.default_rng([self._seed, 1, number, subject, object_])
            relations.append(
                Relation(
                    places[subject],
                    places[object_],
                    float(generator.uniform(*RELATION_SCORES)),
                    spread(probabilities, len(self.vocabulary.predicates)),
                )
            )
        return relations

    def _instances(self, number: int, frame: RgbdFrame) -> NDArray[np.uint16]:
        path = self._dataset.file(number, ".instance.png")
        if path.exists() and not self._dataset.turned:
            return read_instances(path)
        return self._nearest_objects(frame)

    def _nearest_objects(self, frame: RgbdFrame) -> NDArray[np.uint16]:
        """Instance image from the annotated point nearest to each depth pixel."""
        labels = np.zeros(frame.depth_m.shape, np.uint16)
        depth_m = frame.depth_m[::PIXEL_STRIDE, ::PIXEL_STRIDE]
        rows, columns = np.nonzero(depth_m > 0)
        if self._tree is None or not len(rows):
            return labels
        camera = frame.intrinsics
        z = depth_m[rows, columns].astype(np.float64)
        x = (columns * PIXEL_STRIDE - camera.cx) / camera.fx * z
        y = (rows * PIXEL_STRIDE - camera.cy) / camera.fy * z
        T = frame.T_world_camera
        points_world = np.stack([x, y, z], axis=1) @ T[:3, :3].T + T[:3, 3]
        distances, nearest = self._tree.query(points_world, distance_upper_bound=MAX_DISTANCE_M)
        near = np.isfinite(distances)
        coarse = np.zeros(depth_m.shape, np.uint16)
        coarse[rows[near], columns[near]] = self._point_ids[nearest[near]]
        fine = coarse.repeat(PIXEL_STRIDE, axis=0).repeat(PIXEL_STRIDE, axis=1)
        height, width = frame.depth_m.shape
        labels[:] = fine[:height, :width]
        labels[~(frame.depth_m > 0)] = 0
        return labels


def visible_box(instances: NDArray[np.uint16], object_id: int) -> Float64 | None:
    """Corners x1, y1, x2, y2 of an object's pixels; None where too little is visible."""
    mask = instances == object_id
    if int(np.count_nonzero(mask)) < MIN_PIXELS:
        return None
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    box = np.array([columns[0], rows[0], columns[-1], rows[-1]], np.float64)
    return None if (box[2:] - box[:2] < MIN_BOX_SIDE_PX).any() else box
