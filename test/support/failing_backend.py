"""A test double of the detector, the segmenter and the relation head. Each can fail or hang."""

import threading
import time
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.perception import Detections, MaskPatch
from deworldsg_ros.scene.frame_graph import Relations

SHAPE = (40, 50)


@dataclass
class Faults:
    """The next calls of a model: how many raise, and how long the first other one takes."""

    raises: int = 0
    hang_s: float = 0.0

    def work(self):
        if self.raises:
            self.raises -= 1
            raise RuntimeError("injected fault")
        pause_s, self.hang_s = self.hang_s, 0.0
        time.sleep(min(pause_s, threading.TIMEOUT_MAX))


class Backend:
    """All three backends in one class; `faults` are by part."""

    classes = ("table", "cup")
    predicates = ("on", "near")
    default_score_threshold = 0.5

    def __init__(self, **faults):
        self.faults = faults
        self.features, self.shapes = None, []

    def _work(self, part):
        if part in self.faults:
            self.faults[part].work()

    def detect(self, rgb, score_threshold):
        self._work("detector")
        self.shapes.append(rgb.shape[:2])
        boxes = np.array([[2.0, 2, 20, 20], [10.0, 10, 40, 35], [4.0, 4, 30, 30]])
        probabilities = np.array([[0.9, 0.1], [0.2, 0.8], [0.6, 0.4]])
        features = np.arange(6, dtype=np.float32).reshape(3, 2)
        return Detections(boxes, probabilities, np.array([0.6, 0.9, 0.8]), features)

    def segment(self, rgb, depth_m, intrinsics, boxes_xyxy):
        self._work("segmenter")
        return [MaskPatch(3 * row, 2, np.ones((3, 4), bool)) for row in range(len(boxes_xyxy))]

    def relate(self, objects, max_relations):
        self._work("relation_head")
        self.features = objects.features
        return Relations(np.array([[0, 1]]), np.zeros((1, 2)), np.ones(1))
