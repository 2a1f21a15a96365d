"""Detector classes of `transformers`, and the file name of the relation head."""

from __future__ import annotations

from typing import Any

from transformers import RTDetrForObjectDetection, RTDetrV2ForObjectDetection

# Detectors, by the model type in config.json.
DETECTORS: dict[str, Any] = {
    "rt_detr": RTDetrForObjectDetection,
    "rt_detr_v2": RTDetrV2ForObjectDetection,
}
# File of the relation head, beside the detector's weights.
HEAD_FILE = "egtr_head.safetensors"
