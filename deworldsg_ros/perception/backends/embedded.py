"""The embedded detectors, 80 classes of COCO: NanoDet-g, alone or joined with SSDLite-MobileNetV2.

Both are networks with integers of 8 bits on ONNX Runtime.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
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


def logit(scores: Float64) -> Float64:
    """Log odds of scores, kept finite."""
    clipped = np.clip(scores, SCORE_FLOOR, 1 - SCORE_FLOOR)
    return np.asarray(np.log(clipped / (1 - clipped)))


@dataclass(frozen=True)
class SoftmaxCalibration:
    """p = softmax(logit(scores) / temperature).

    Sigmoid scores are independent. If they were normalised, 80 classes at 0.01 would outweigh one
    at 0.5. The softmax of their logits keeps their order. The temperature is fitted by likelihood
    (temperature scaling, Guo et al. 2017) with tools/calibration/calibrate_detector.py.

    The softmax compares names with each other. Whether the best one is right at all is another
    question: in an object that has none of the names, or seen for a moment, it is not. The score in
    the best view of an object tells; more views add nothing (docs/dev/perception.md).

    Attributes:
        temperature: above 0; below 1 sharpens.
        certainty: slope and offset of the log odds that a name with a score is right, from those of
            the score; None = not known (tools/calibration/calibrate_names.py).
    """

    temperature: float
    certainty: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.temperature > 0:
            raise ValueError(f"calibration temperature is {self.temperature}, expected > 0")

    def __call__(self, scores: Float64) -> Float64:
        """Distributions (n, C), rows sum to one, of sigmoid scores (n, C)."""
        return np.asarray(softmax(logit(scores) / self.temperature))

    def certainties(self, scores: Float64) -> Float64 | None:
        """The probability (n,) that names with these scores are right; None = not known."""
        if self.certainty is None:
            return None
        slope, offset = self.certainty
        return np.asarray(1.0 / (1.0 + np.exp(-slope * logit(scores) - offset)))


# --- NanoDet-g 416 with integers of 8 bits on ONNX Runtime: the embedded detector, 80 classes of
# COCO.
#
# `tools/calibration/quantize_detector.py` makes the weights.

FOLDER = Path(__file__).parents[1] / "weights"
WEIGHTS = FOLDER / "nanodet_g_416_coco_int8.onnx"
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
CALIBRATION = SoftmaxCalibration(temperature=0.35, certainty=(2.9, 0.75))


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
        self._session = open_session(_shipped(weights), threads)
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


def _shipped(weights: Path) -> Path:
    if not weights.is_file():
        raise ConfigurationError(f"weights {weights}: no such file, install the package again")
    return weights


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


def suppress(
    boxes_xyxy: Float64, class_scores: Float64, score_threshold: float
) -> tuple[Int64, Float64]:
    """Candidates → objects: suppression, and combined class scores of nearly identical boxes.

    Nearly identical boxes show one object, even if one scores as a vase and one as a bottle. The
    score of each class is the best among them.

    Args:
        boxes_xyxy: (k, 4) pixels.
        class_scores: (k, C) scores.
        score_threshold: minimum score of an object.

    Returns:
        (n,) rows of the objects, best first, and (n, C) their class scores.
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
    return kept, evidence


def combine(
    boxes_xyxy: Float64,
    class_scores: Float64,
    score_threshold: float,
    calibration: SoftmaxCalibration = CALIBRATION,
    masks: Sequence[MaskPatch] | None = None,
) -> Detections:
    """`suppress`, with calibrated class distributions.

    Args:
        boxes_xyxy: (k, 4) pixels.
        class_scores: (k, C) sigmoid scores.
        score_threshold: minimum score of an object.
        calibration: of the scores.
        masks: one mask for each candidate; None = the detector has no masks.
    """
    kept, evidence = suppress(boxes_xyxy, class_scores, score_threshold)
    scores = class_scores[kept].max(axis=1) if len(kept) else np.zeros(0)
    kept_masks = None if masks is None else tuple(masks[row] for row in kept)
    return Detections(
        boxes_xyxy[kept],
        calibration(evidence),
        scores,
        masks=kept_masks,
        certainties=calibration.certainties(scores),
    )


# --- SSDLite-MobileNetV2 with integers of 8 bits: a second opinion.
#
# `tools/calibration/quantize_ssdlite.py` makes the weights.

SECOND_WEIGHTS = FOLDER / "ssdlite_mobilenet_v2_coco_int8.onnx"
SECOND_INPUT_SIZE = 300
# Boxes with a lower score say nothing. More of them take longer and change nothing.
SECOND_CANDIDATE_SCORE = 0.1
# The network's offsets of the middle and of the size of a box have these units.
MIDDLE_UNIT, SIZE_UNIT = 0.1, 0.2


class SsdLite:
    """Boxes and class scores of the second network.

    Args:
        threads: threads of ONNX Runtime; 0 = all cores.
        weights: the ONNX file.

    Raises:
        ConfigurationError: there is no such file.
    """

    def __init__(self, *, threads: int = 1, weights: Path = SECOND_WEIGHTS) -> None:
        self._session = open_session(_shipped(weights), threads)
        nothing = np.zeros((1, SECOND_INPUT_SIZE, SECOND_INPUT_SIZE, 4), np.uint8)
        self._anchors = self._session.run(["anchors"], {"pixels": nothing})[0].astype(np.float64)

    def candidates(self, rgb: UInt8) -> tuple[Float64, Float64]:
        """Output of the network before suppression: boxes (k, 4) in pixels, scores (k, 80)."""
        height, width = rgb.shape[:2]
        # The network was trained on images of this size, whatever their shape was.
        resized = cv2.resize(rgb, (SECOND_INPUT_SIZE, SECOND_INPUT_SIZE))
        pixels = cv2.cvtColor(resized, cv2.COLOR_RGB2RGBA)[None]
        logits, offsets = self._session.run(["logits", "offsets"], {"pixels": pixels})
        best = logits[0].max(axis=1)
        rows = np.flatnonzero(best > logit(np.array(SECOND_CANDIDATE_SCORE)))
        scores = 1.0 / (1.0 + np.exp(-logits[0, rows].astype(np.float64)))
        offset, anchor = offsets[0, rows, 0].astype(np.float64), self._anchors[rows]
        middle = anchor[:, :2] + MIDDLE_UNIT * offset[:, :2] * anchor[:, 2:]
        half = 0.5 * anchor[:, 2:] * np.exp(SIZE_UNIT * offset[:, 2:])
        # y comes before x; pixel centres are at integers here.
        yxyx = np.hstack([middle - half, middle + half])
        return yxyx[:, [1, 0, 3, 2]] * ([width, height] * 2) - 0.5, scores


# --- Two opinions: one detector that joins both networks.
#
# Networks of other architectures err in other ways; one network errs the same way from many sides.
# A box of the first gets, for each class, the best score of the second's boxes over it. The logit
# of a name is SCALE (logit first + SECOND logit second) + BIAS + that of the class. So a score is
# the probability that the box shows an object of this name. tools/calibration/calibrate_pair.py
# fits the constants; docs/dev/perception.md has the figures.

# The second's share of the evidence.
SECOND = 0.3
SCALE, BIAS = 0.964, 0.777
# Boxes of both networks show one object from this IoU on.
SAME_OBJECT_IOU = 0.5
# Lowest and highest score of the second: what it does not see may be there.
SECOND_LIMITS = (0.05, 0.98)
# Of classes that the networks name too rarely or too often indoors.
CLASS_BIAS = {
    "chair": 0.74,
    "dining table": 0.67,
    "potted plant": 0.47,
    "bowl": 0.22,
    "vase": 0.06,
    "bench": -0.04,
    "microwave": -0.08,
    "oven": -0.08,
    "refrigerator": -0.09,
    "tv": -0.09,
    "cell phone": -0.1,
    "bottle": -0.15,
    "book": -0.27,
}
_NAME_BIAS = BIAS + np.array([CLASS_BIAS.get(name, 0.0) for name in COCO_CLASSES])
PAIR_CALIBRATION = SoftmaxCalibration(temperature=0.6, certainty=(2.0, 0.8))


class PairDetector:
    """NanoDet and SSDLite as one detector.

    Args:
        threads: of both networks together; 0 = all cores. With one, they run in turn.
    """

    classes = COCO_CLASSES
    default_score_threshold = 0.5

    def __init__(self, *, threads: int = 2) -> None:
        threads = threads or len(os.sched_getaffinity(0))
        self._first = NanoDetDetector(threads=max(threads - 1, 1))
        self._second = SsdLite()
        self._beside = ThreadPoolExecutor(1, "second_opinion") if threads > 1 else None

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """Objects of `rgb`, (H, W, 3) uint8, with score >= `score_threshold`, best first."""
        if self._beside is None:
            first, second = self._first.candidates(rgb), self._second.candidates(rgb)
        else:
            future = self._beside.submit(self._second.candidates, rgb)
            first, second = self._first.candidates(rgb), future.result()
        return combine(*join_opinions(first, second), score_threshold, PAIR_CALIBRATION)


def join_opinions(
    first: tuple[Float64, Float64], second: tuple[Float64, Float64]
) -> tuple[Float64, Float64]:
    """Boxes (n, 4) of the first network, and the probability (n, 80) of each name.

    Args:
        first: candidates of the first network, boxes (k, 4) in pixels and scores (k, 80).
        second: those of the second.
    """
    boxes, evidence = evidence_of(first, second)
    return boxes, np.asarray(1.0 / (1.0 + np.exp(-(SCALE * evidence + _NAME_BIAS))))


def evidence_of(
    first: tuple[Float64, Float64], second: tuple[Float64, Float64]
) -> tuple[Float64, Float64]:
    """As `join_opinions`, with the evidence (n, 80) in place of the probability."""
    rows, scores = suppress(*first, CANDIDATE_SCORE)
    of_second, second_scores = suppress(*second, SECOND_CANDIDATE_SCORE)
    boxes = first[0][rows]
    same = pairwise_iou(boxes, second[0][of_second]) >= SAME_OBJECT_IOU
    agreed = np.zeros_like(scores)
    for row in np.flatnonzero(same.any(axis=1)):
        agreed[row] = second_scores[same[row]].max(axis=0)
    return boxes, logit(scores) + SECOND * logit(np.clip(agreed, *SECOND_LIMITS))
