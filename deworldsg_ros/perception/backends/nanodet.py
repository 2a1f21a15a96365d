"""NanoDet-g 416 in 8 bits on ONNX Runtime: the embedded detector, 80 classes of COCO."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import onnxruntime

from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt8, pairwise_iou, softmax
from deworldsg_ros.scene.camera import MaskPatch
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

# --- Non-maximum suppression that keeps track of the suppressed boxes.


def cluster_boxes(
    boxes_xyxy: Float64,
    scores: Float64,
    classes: Int64,
    *,
    same_class_iou: float,
    any_class_iou: float,
) -> Int64:
    """Greedy non-maximum suppression, with the suppressing box of each box.

    The best remaining box suppresses the remaining boxes of its class whose IoU exceeds
    `same_class_iou`, and those of any class whose IoU exceeds `any_class_iou`.

    Args:
        boxes_xyxy: (n, 4) pixels.
        scores: (n,).
        classes: (n,) most likely class.
        same_class_iou: IoU above which boxes of one class show one object.
        any_class_iou: IoU above which any boxes show one object.

    Returns:
        (n,) int64: row of the box that suppressed each; its own row if it was kept.
    """
    order = np.argsort(-scores, kind="stable")
    iou = pairwise_iou(boxes_xyxy[order], boxes_xyxy[order])
    same_class = classes[order][:, None] == classes[order][None, :]
    covers = (iou > any_class_iou) | (same_class & (iou > same_class_iou))
    keeper = np.full(len(order), -1, dtype=np.int64)
    for rank in range(len(order)):
        if keeper[rank] < 0:
            keeper[(keeper < 0) & covers[rank]] = rank
            keeper[rank] = rank
    result = np.empty(len(order), dtype=np.int64)
    result[order] = order[keeper]
    return result


# --- Independent sigmoid scores → one calibrated class distribution.

# Keeps the logit finite. The network's scores of absent classes are far higher.
SCORE_FLOOR = 1e-6


@dataclass(frozen=True)
class SoftmaxCalibration:
    """p = softmax(logit(scores) / temperature).

    Sigmoid scores are independent. If they were normalised, 80 classes at 0.01 would outweigh one
    at 0.5. The softmax of their logits keeps their order. The temperature is fitted by likelihood
    (temperature scaling, Guo et al. 2017) with tools/calibration/calibrate_detector.py.

    Attributes:
        temperature: above 0; below 1 sharpens.
    """

    temperature: float

    def __post_init__(self) -> None:
        if not self.temperature > 0:
            raise ValueError(f"calibration temperature is {self.temperature}, expected > 0")

    def __call__(self, scores: Float64) -> Float64:
        """Distributions (n, C), rows sum to one, of sigmoid scores (n, C)."""
        clipped = np.clip(np.asarray(scores, dtype=np.float64), SCORE_FLOOR, 1 - SCORE_FLOOR)
        logits = np.log(clipped / (1 - clipped)) / self.temperature
        return np.asarray(softmax(logits))


# --- NanoDet-g 416 with integers of 8 bits on ONNX Runtime: the embedded detector, 80 classes of
# COCO.
#
# `tools/calibration/quantize_detector.py` makes the weights.

WEIGHTS = Path(__file__).parents[1] / "weights" / "nanodet_g_416_coco_int8.onnx"
# Side of the network's input and strides of its outputs, pixels.
INPUT_SIZE = 416
STRIDES = (8, 16, 32)
# The distance to each side of a box is a distribution over 0 to 10 strides.
BINS = 11
# Cells with a lower score are ignored. The limit saves time, and is below all useful thresholds.
CANDIDATE_SCORE = 0.15
# Boxes of one class with a larger overlap show one object.
SAME_CLASS_IOU = 0.5
# Boxes of any classes with a larger overlap show one object.
ANY_CLASS_IOU = 0.75
# Fitted by tools/calibration/calibrate_detector.py; see docs/dev/perception.md.
CALIBRATION = SoftmaxCalibration(temperature=0.35)


class Tables(NamedTuple):
    """Meaning of the network's 8-bit codes: outputs that are the same for all images.

    Attributes:
        input_codes: (256, 3) uint8, code of each 8-bit value of R, G and B.
        logits: (3, 256) float32, logit of each code in the side distributions of each stride.
        scores: (3, 256) float32, ascending: sigmoid score of each code in the classes.
    """

    input_codes: UInt8
    logits: Float32
    scores: Float32


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
        self._session = open_session(weights, threads)
        nothing = np.zeros((1, INPUT_SIZE, INPUT_SIZE, 4), np.uint8)
        self._tables = Tables(*self._session.run(list(Tables._fields), {"pixels": nothing}))

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """Objects of `rgb`, (H, W, 3) uint8, with score >= `score_threshold`, best first."""
        boxes, class_scores = self.candidates(rgb)
        return combine(boxes, class_scores, score_threshold)

    def candidates(self, rgb: UInt8) -> tuple[Float64, Float64]:
        """Output of the network before suppression: boxes (k, 4) in pixels, scores (k, 80)."""
        pixels, scale = letterbox(rgb, self._tables.input_codes)
        codes = self._session.run([f"codes_{stride}" for stride in STRIDES], {"pixels": pixels})
        boxes, class_scores = decode([np.asarray(c)[0] for c in codes], self._tables)
        height, width = rgb.shape[:2]
        # Pixel centres are at integers here, and at halves in the network.
        return np.clip(boxes / scale - 0.5, -0.5, [width - 0.5, height - 0.5] * 2), class_scores


def open_session(network: Path, threads: int) -> Any:
    """A network on the CPU; `threads` 0 = all cores."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Spinning threads would keep cores busy between frames, which other nodes need.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(str(network), options, providers=["CPUExecutionProvider"])


def letterbox(rgb: UInt8, input_codes: UInt8) -> tuple[UInt8, float]:
    """Network input (1, 416, 416, 4) uint8 with the image at the top left, and its scale.

    Args:
        rgb: (H, W, 3) uint8.
        input_codes: (256, 3) uint8, see `Tables`.
    """
    height, width = rgb.shape[:2]
    scale = INPUT_SIZE / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    resized = cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR)
    # Four channels: convolutions take longer with three. The weights of the fourth are zero. The
    # part below or beside the image is black.
    pixels = np.empty((1, INPUT_SIZE, INPUT_SIZE, 4), np.uint8)
    black = np.append(input_codes[0], np.uint8(0))
    pixels[0, size[1] :], pixels[0, :, size[0] :] = black, black
    codes = cv2.LUT(resized, input_codes[None])
    pixels[0, : size[1], : size[0]] = cv2.cvtColor(codes, cv2.COLOR_RGB2RGBA)
    return pixels, scale


def decode(codes: Sequence[UInt8], tables: Tables) -> tuple[Float64, Float64]:
    """Candidate boxes (k, 4) in input pixels and their sigmoid class scores (k, 80).

    Args:
        codes: for each stride (rows, columns, 124) uint8: 80 classes, then 4 side distributions.
        tables: meaning of the codes.
    """
    centres, strides, logits, scores = [], [], [], []
    for level, stride in enumerate(STRIDES):
        side = codes[level].shape[1]
        cells = codes[level].reshape(-1, codes[level].shape[2])
        # Better scores have larger codes.
        least = np.searchsorted(tables.scores[level], np.float32(CANDIDATE_SCORE), side="right")
        rows = np.flatnonzero(cells[:, : len(COCO_CLASSES)].max(axis=1) >= least)
        found = cells[rows]
        scores.append(tables.scores[level][found[:, : len(COCO_CLASSES)]])
        logits.append(tables.logits[level][found[:, len(COCO_CLASSES) :]])
        centres.append((np.stack([rows % side, rows // side], axis=1) + 0.5) * stride)
        strides.append(np.full((len(rows), 1), stride))
    sides = np.concatenate(logits).astype(np.float64).reshape(-1, 4, BINS)
    weights = np.exp(sides - sides.max(axis=2, keepdims=True))
    # The expectation over the bins is the distance to left, top, right and bottom.
    distances = (weights @ np.arange(BINS)) / weights.sum(axis=2) * np.concatenate(strides)
    centre = np.concatenate(centres)
    boxes = np.hstack([centre - distances[:, :2], centre + distances[:, 2:]])
    return boxes, np.concatenate(scores).astype(np.float64)


def combine(
    boxes_xyxy: Float64,
    class_scores: Float64,
    score_threshold: float,
    calibration: Callable[[Float64], Float64] = CALIBRATION,
    masks: Sequence[MaskPatch] | None = None,
) -> Detections:
    """Candidates → objects: suppression, and combined class scores of nearly identical boxes.

    Nearly identical boxes show one object, even if one scores as a vase and one as a bottle. The
    score of each class is the best among them.

    Args:
        boxes_xyxy: (k, 4) pixels.
        class_scores: (k, C) sigmoid scores.
        score_threshold: minimum score of an object.
        calibration: scores (n, C) to distributions.
        masks: one mask for each candidate; None = the detector has no masks.
    """
    best = class_scores.max(axis=1) if len(class_scores) else np.zeros(0)
    # A box never suppresses a better one.
    strong = np.flatnonzero(best >= score_threshold)
    keeper = cluster_boxes(
        boxes_xyxy[strong],
        best[strong],
        class_scores[strong].argmax(axis=1) if len(strong) else np.zeros(0, np.int64),
        same_class_iou=SAME_CLASS_IOU,
        any_class_iou=ANY_CLASS_IOU,
    )
    kept = strong[keeper == np.arange(len(keeper))]
    kept = kept[np.argsort(-best[kept], kind="stable")]
    evidence = class_scores[kept].copy()
    near = pairwise_iou(boxes_xyxy[kept], boxes_xyxy) > ANY_CLASS_IOU
    for row in range(len(kept)):
        evidence[row] = class_scores[near[row]].max(axis=0)
    kept_masks = None if masks is None else tuple(masks[row] for row in kept)
    return Detections(boxes_xyxy[kept], calibration(evidence), best[kept], masks=kept_masks)
