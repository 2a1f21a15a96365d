"""Stage a: image → 2D scene graph and instance image.

`stage` runs a detector, a segmenter and a relation head (`backends`) on each frame. `protocols`
defines them and `registry` builds them by name.
"""

from deworldsg_ros.perception.protocols import (
    Detections,
    Detector,
    RelationHead,
    SegmentedObjects,
    Segmenter,
)
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived, Perception
from deworldsg_ros.scene.camera import MaskPatch

__all__ = [
    "Detections",
    "Detector",
    "MaskPatch",
    "Perceived",
    "Perception",
    "RelationHead",
    "SegmentedObjects",
    "Segmenter",
    "build_perception",
]
