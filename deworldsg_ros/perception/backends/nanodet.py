"""NanoDet-g 416 with integers of 8 bits on ONNX Runtime: the embedded detector, 80 classes of COCO.

`tools/calibration/quantize_detector.py` makes the weights.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from deworldsg_ros.perception.networks.calibration import SoftmaxCalibration
from deworldsg_ros.perception.networks.nms import cluster_boxes
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8
from deworldsg_ros.scene.boxes import pairwise_iou
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabularies import COCO_CLASSES

WEIGHTS = Path(__file__).parents[1] / "weights" / "nanodet_g_416_coco_int8.onnx"
# Side of the network's input and strides of its outputs, pixels.
INPUT_SIZE = 416
STRIDES = (8, 16, 32)
# The distance to each side of a box is a distribution over 0 to 10 strides.
BINS = 11
# Of the training images, BGR, 8-bit scale.
MEAN_BGR = np.array([103.53, 116.28, 123.675], dtype=np.float32)
STD_BGR = np.array([57.375, 57.12, 58.395], dtype=np.float32)
# (3, 256) float32: the input of the network for each channel and each 8-bit value.
INPUT_OF_VALUE = (np.arange(256, dtype=np.float32) - MEAN_BGR[:, None]) / STD_BGR[:, None]
# Cells with a lower score are ignored. The limit saves time, and is below all useful thresholds.
CANDIDATE_SCORE = 0.15
# Boxes of one class with a larger overlap show one object.
SAME_CLASS_IOU = 0.5
# Boxes of any classes with a larger overlap show one object.
ANY_CLASS_IOU = 0.75
# Fitted by tools/calibration/calibrate_detector.py; see docs/dev/perception.md.
CALIBRATION = SoftmaxCalibration(temperature=0.35)


class NanoDetDetector:
    """Detector on the shipped weights.

    Args:
        threads: threads of ONNX Runtime; 0 = all cores.
        weights: the ONNX file.

    Raises:
        ConfigurationError: there is no such file.
    """

    classes = COCO_CLASSES
    default_score_threshold = 0.4

    def __init__(self, *, threads: int = 2, weights: Path = WEIGHTS) -> None:
        if not weights.is_file():
            raise ConfigurationError(
                f"NanoDet weights {weights}: no such file, install the package again"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # Spinning threads would keep cores busy between frames, which other nodes need.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session = onnxruntime.InferenceSession(
            str(weights), options, providers=["CPUExecutionProvider"]
        )
        self._input = self._session.get_inputs()[0].name

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """Objects of `rgb`, (H, W, 3) uint8, with score >= `score_threshold`, best first."""
        boxes, class_scores = self.candidates(rgb)
        return combine(boxes, class_scores, score_threshold)

    def candidates(self, rgb: UInt8) -> tuple[Float64, Float64]:
        """Output of the network before suppression: boxes (k, 4) in pixels, scores (k, 80)."""
        tensor, scale = letterbox(rgb)
        heads = self._session.run(None, {self._input: tensor})
        boxes, class_scores = decode([np.asarray(head)[0] for head in heads])
        height, width = rgb.shape[:2]
        # Pixel centres are at integers here, and at halves in the network.
        return np.clip(boxes / scale - 0.5, -0.5, [width - 0.5, height - 0.5] * 2), class_scores


def letterbox(rgb: UInt8) -> tuple[Float32, float]:
    """Network input (1, 3, 416, 416) float32 BGR with the image at the top left, and its scale."""
    height, width = rgb.shape[:2]
    scale = INPUT_SIZE / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    resized = cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR)
    # The part below or beside the image is black.
    tensor = np.empty((1, 3, INPUT_SIZE, INPUT_SIZE), dtype=np.float32)
    tensor[0] = INPUT_OF_VALUE[:, 0, None, None]
    for channel, table in enumerate(INPUT_OF_VALUE):
        tensor[0, channel, : size[1], : size[0]] = cv2.LUT(resized[..., 2 - channel], table)
    return tensor, scale


def decode(heads: list[Float32]) -> tuple[Float64, Float64]:
    """Candidate boxes (k, 4) in input pixels and their sigmoid class scores (k, 80).

    Args:
        heads: for each stride the scores (cells, 80) and the side distributions (cells, 44), in
            any order.
    """
    boxes, scores = [], []
    for stride in STRIDES:
        side = -(-INPUT_SIZE // stride)
        cells = [head for head in heads if len(head) == side * side]
        class_scores = next(head for head in cells if head.shape[1] == len(COCO_CLASSES))
        side_logits = next(head for head in cells if head.shape[1] == 4 * BINS)
        rows = np.flatnonzero(class_scores.max(axis=1) > CANDIDATE_SCORE)
        logits = side_logits[rows].astype(np.float64).reshape(len(rows), 4, BINS)
        weights = np.exp(logits - logits.max(axis=2, keepdims=True))
        # The expectation over the bins is the distance to left, top, right and bottom.
        distances = (weights @ np.arange(BINS)) / weights.sum(axis=2) * stride
        centres = (np.stack([rows % side, rows // side], axis=1) + 0.5) * stride
        boxes.append(np.hstack([centres - distances[:, :2], centres + distances[:, 2:]]))
        scores.append(class_scores[rows].astype(np.float64))
    return np.concatenate(boxes), np.concatenate(scores)


def combine(
    boxes_xyxy: Float64,
    class_scores: Float64,
    score_threshold: float,
    calibration: Callable[[Float64], Float64] = CALIBRATION,
) -> Detections:
    """Candidates → objects: suppression, and combined class scores of nearly identical boxes.

    Nearly identical boxes show one object, even if one scores as a vase and one as a bottle. The
    score of each class is the best among them.

    Args:
        boxes_xyxy: (k, 4) pixels.
        class_scores: (k, 80) sigmoid scores.
        score_threshold: minimum score of an object.
        calibration: scores (n, 80) to distributions.
    """
    best = class_scores.max(axis=1) if len(class_scores) else np.zeros(0)
    keeper = cluster_boxes(
        boxes_xyxy,
        best,
        class_scores.argmax(axis=1) if len(class_scores) else np.zeros(0, np.int64),
        same_class_iou=SAME_CLASS_IOU,
        any_class_iou=ANY_CLASS_IOU,
    )
    kept = np.flatnonzero((keeper == np.arange(len(keeper))) & (best >= score_threshold))
    kept = kept[np.argsort(-best[kept], kind="stable")]
    evidence = class_scores[kept].copy()
    near = pairwise_iou(boxes_xyxy[kept], boxes_xyxy) > ANY_CLASS_IOU
    for row in range(len(kept)):
        evidence[row] = class_scores[near[row]].max(axis=0)
    return Detections(boxes_xyxy[kept], calibration(evidence), best[kept])
