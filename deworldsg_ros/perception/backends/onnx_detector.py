"""An exported detector of fixed classes on ONNX Runtime, without torch."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix

from deworldsg_ros.checkpoints.cards import ONNX_CARD, OnnxCard, read_onnx_card
from deworldsg_ros.checkpoints.catalogue import ONNX_FILE
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.backends.embedded import open_session
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8, corners_of, softmax
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput

INPUT, OUTPUTS = "pixel_values", ["logits", "pred_boxes"]


class OnnxDetector:
    """Detector on a folder that `deworldsg models export` wrote.

    Args:
        config: the section `perception`: `detector_path` and `threads`.

    Raises:
        ConfigurationError: no such folder, or a network that does not fit its card.

    Attributes:
        classes: names, in the order of the distributions.
        default_score_threshold: minimum score of an object, of the card.
        card: inputs and outputs.
    """

    def __init__(self, config: PerceptionConfig) -> None:
        folder = Path(config.detector_path).expanduser()
        if not config.detector_path or not (folder / ONNX_FILE).is_file():
            raise ConfigurationError(
                f"perception.detector_path '{config.detector_path}' has no {ONNX_FILE}: name a "
                "folder of `deworldsg models export`"
            )
        self.card = read_onnx_card(folder / ONNX_CARD)
        self.classes = self.card.classes
        self.default_score_threshold = self.card.score_threshold
        try:
            self._session = open_session(folder / ONNX_FILE, config.threads)
            logits, boxes = self.outputs(np.zeros((480, 640, 3), np.uint8))
        except Exception as error:  # ONNX Runtime has errors of its own
            raise ConfigurationError(
                f"{folder / ONNX_FILE} cannot be run ({str(error).splitlines()[0]}): export it "
                "again with `deworldsg models export`"
            ) from error
        least = max(self.card.columns) + 1 + self.card.no_object
        if boxes.shape != (len(logits), 4) or logits.shape[1] < least:
            raise ConfigurationError(
                f"{folder / ONNX_FILE} gives logits of shape {logits.shape} and boxes of shape "
                f"{boxes.shape}, expected at least {least} columns and 4: export it again"
            )

    def outputs(self, rgb: UInt8) -> tuple[Float64, Float64]:
        """Logits (n, K) of all outputs, and boxes (n, 4): centre and size in [0, 1]."""
        logits, boxes = self._session.run(OUTPUTS, {INPUT: network_input(rgb, self.card)})
        return np.asarray(logits[0], np.float64), np.asarray(boxes[0], np.float64)

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """Objects of `rgb`, (H, W, 3) uint8, with score >= `score_threshold`, best first."""
        logits, boxes = self.outputs(rgb)
        if not (np.isfinite(logits).all() and np.isfinite(boxes).all()):
            raise RefusedInput("detector_error", "the exported detector gives NaN or infinity")
        used = logits[:, self.card.columns]
        probabilities = np.asarray(softmax(used / self.card.temperature))
        if self.card.no_object:
            scores = np.asarray(softmax(logits))[:, self.card.columns].max(axis=1)
        elif self.card.class_scores == "softmax":
            scores = probabilities.max(axis=1)
        else:
            scores = 1 / (1 + np.exp(-used.max(axis=1)))
        rows = np.flatnonzero(scores >= score_threshold)
        rows = rows[np.argsort(-scores[rows], kind="stable")]
        height, width = rgb.shape[:2]
        corners = corners_of(boxes[rows]) * [width, height, width, height] - 0.5
        return Detections(corners, probabilities[rows], scores[rows])


def network_input(rgb: UInt8, card: OnnxCard) -> Float32:
    """(1, 3, height, width): the image stretched with antialiasing, as torch does, and normalised.

    Args:
        rgb: (H, W, 3) uint8.
        card: size and normalisation.
    """
    rows, columns = _weights(rgb.shape[0], card.height), _weights(rgb.shape[1], card.width)
    values = rows @ rgb.reshape(rgb.shape[0], -1).astype(np.float32)
    values = values.reshape(card.height, rgb.shape[1], 3).transpose(1, 0, 2)
    values = columns @ np.ascontiguousarray(values).reshape(rgb.shape[1], -1)
    values = values.reshape(card.width, card.height, 3).transpose(2, 1, 0)
    mean, std = (np.array(part, np.float32)[:, None, None] for part in (card.mean, card.std))
    normalised: Float32 = ((values / np.float32(255) - mean) / std)[None].astype(np.float32)
    return normalised


@lru_cache(maxsize=16)
def _weights(source: int, target: int) -> csr_matrix:
    """(target, source) float32: linear interpolation, or a triangle over the source if it shrinks.

    Pixel centres are at halves.
    """
    scale = source / target
    centres = (np.arange(target) + 0.5) * scale
    distances = np.abs(np.arange(source) + 0.5 - centres[:, None]) / max(scale, 1.0)
    weights = np.clip(1 - distances, 0, None)
    return csr_matrix((weights / weights.sum(axis=1, keepdims=True)).astype(np.float32))
