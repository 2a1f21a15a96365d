"""The annotated objects in view: a detection of each, with its true box, class and pixels.

The pixels come from the instance image of the frame. If the data set has none, each depth pixel
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
    spread,
    visible_box,
)
from deworldsg_ros.recordings.folders.annotations import ScanAnnotation, ScanPoints
from deworldsg_ros.scene.arrays import UInt16
from deworldsg_ros.scene.camera import RgbdFrame

# Probability of the true class and predicate; the rest is spread evenly.
TRUE_PROBABILITY = 0.9
# Without instance images: step between the pixels that are looked up, for speed, and maximum
# distance of the annotated point of a pixel.
PIXEL_STRIDE = 2
MAX_DISTANCE_M = 0.05


class AnnotatedObjects:
    """Detects the annotated objects of a scan in its frames, without an error.

    Args:
        frame_numbers: number of each frame by its stamp in nanoseconds.
        instances: returns the instance image (H, W) of a frame, or None.
        annotation: annotated objects of the scan.
        points: annotated surface points of the scan.
        class_count: number of classes of the data set.
    """

    def __init__(
        self,
        frame_numbers: Mapping[int, int],
        instances: Callable[[RgbdFrame], UInt16 | None],
        annotation: ScanAnnotation,
        points: ScanPoints,
        class_count: int,
    ) -> None:
        self._frame_numbers = frame_numbers
        self._instances = instances
        self._classes = annotation.objects
        self._class_count = class_count
        listed = np.isin(points.object_ids, list(annotation.objects))
        usable = listed & np.isfinite(points.points_world).all(axis=1)
        self._tree = cKDTree(points.points_world[usable]) if usable.any() else None
        self._point_ids = points.object_ids[usable]

    def number(self, frame: RgbdFrame) -> int:
        """Number of a frame in its scan; raises EvaluationError if it is from another scan."""
        number = self._frame_numbers.get(frame.stamp_ns)
        if number is None:
            raise EvaluationError(f"frame with the stamp {frame.stamp_ns} ns is not in this scan")
        return number

    def detect(self, frame: RgbdFrame) -> FrameDetections:
        """A detection of each visible object, in the order of the annotation; no relations."""
        instances = self._instances(frame)
        if instances is None:
            instances = self._nearest_objects(frame)
        detections = []
        for object_id, class_index in self._classes.items():
            box = visible_box(instances, object_id)
            if box is not None:
                probabilities = spread({class_index: TRUE_PROBABILITY}, self._class_count)
                detections.append(Detection(box, probabilities, TRUE_PROBABILITY, object_id))
        return FrameDetections(detections, [], instances)

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
