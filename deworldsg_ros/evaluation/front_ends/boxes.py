"""True boxes and classes in the configured perception: its masks and its relations.

Errors of the detector are absent, so that edges are measured apart from them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from deworldsg_ros.evaluation.front_ends.annotated import AnnotatedObjects
from deworldsg_ros.evaluation.front_ends.assembly import Detection
from deworldsg_ros.evaluation.front_ends.injection import Injection
from deworldsg_ros.perception.protocols import Detections, Detector
from deworldsg_ros.perception.stage import Perceived, Perception
from deworldsg_ros.scene.arrays import UInt8
from deworldsg_ros.scene.camera import RgbdFrame


class AnnotatedBoxes:
    """A detector that states the detections of the frame in hand, whatever the image shows.

    Attributes:
        classes: of the data set.
        default_score_threshold: below the score of a true box.
        detections: of the frame in hand.
    """

    default_score_threshold = 0.5

    def __init__(self, classes: tuple[str, ...]) -> None:
        self.classes = classes
        self.detections: list[Detection] = []

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """The detections in hand; see `Detector`."""
        found = [item for item in self.detections if item.score >= score_threshold]
        found = sorted(found, key=lambda item: -item.score)
        return Detections(
            np.array([item.box_xyxy for item in found], np.float64).reshape(-1, 4),
            np.array([item.class_probabilities for item in found]).reshape(-1, len(self.classes)),
            np.array([item.score for item in found], np.float64),
        )


class BoxesFrontEnd:
    """Perception with annotated boxes instead of a detector.

    Args:
        objects: the annotated objects of the scan.
        classes: of the data set.
        build: makes the perception around a detector.
        injection: injects faults into the boxes and classes.
    """

    def __init__(
        self,
        objects: AnnotatedObjects,
        classes: tuple[str, ...],
        build: Callable[[Detector], Perception],
        injection: Injection,
    ) -> None:
        self._objects = objects
        self._detector = AnnotatedBoxes(classes)
        self._perception = build(self._detector)
        self._injection = injection
        self.vocabulary = self._perception.vocabulary

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The annotated objects of a frame, with our masks and relations.

        Raises:
            EvaluationError: the frame is not in the scan.
        """
        seen = self._injection.apply(
            self._objects.detect(frame), frame, self._objects.number(frame)
        )
        self._detector.detections = list(seen.detections)
        return self._perception.perceive(frame)
