"""Stage a: image → 2D scene graph and instance labels."""

from deworldsg_ros.perception.protocols import (
    Detections,
    Detector,
    MaskPatch,
    RelationHead,
    Segmenter,
)
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived, Perception

__all__ = [
    "Detections",
    "Detector",
    "MaskPatch",
    "Perceived",
    "Perception",
    "RelationHead",
    "Segmenter",
    "build_perception",
]
