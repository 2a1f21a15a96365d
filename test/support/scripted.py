"""Synthetic frames of three objects, and a perceiver with their true detections."""

from pathlib import Path

import numpy as np

from deworldsg_ros.config import load_config
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary

CONFIGURATIONS = Path(__file__).resolve().parents[2] / "config"
# The paper publishes a node after one observation, so tests need few frames.
PAPER = load_config(CONFIGURATIONS / "paper_rules.yaml")
VOCABULARY = Vocabulary(("cup", "table", "chair"), ("on", "near", "under"))
INTRINSICS = Intrinsics(100.0, 100.0, 79.5, 59.5, 160, 120)
# Box in the image, depth and class of each object; the cup is close to the table.
OBJECTS = (((60, 40, 80, 60), 1.0, 0), ((20, 60, 90, 100), 1.1, 1), ((110, 20, 150, 110), 2.5, 2))


class Scripted:
    """A perceiver with the true detections and one relation between the cup and the table."""

    def __init__(self, logits: tuple[float, ...] = (3.0, -3.0, -3.0)) -> None:
        self.logits = np.array([logits])

    def perceive(self, frame: RgbdFrame) -> Perceived:
        instances = np.zeros(frame.depth_m.shape, np.uint16)
        for row, ((x1, y1, x2, y2), depth_m, _) in enumerate(OBJECTS):
            window = (slice(y1, y2), slice(x1, x2))
            instances[window][np.abs(frame.depth_m[window] - depth_m) < 0.05] = row + 1
        count = len(OBJECTS)
        graph = FrameGraph(
            frame.stamp_ns,
            "camera",
            160,
            120,
            VOCABULARY,
            np.array([box for box, _, _ in OBJECTS], np.float64),
            np.full((count, 3), 0.05) + 0.85 * np.eye(3)[[kind for _, _, kind in OBJECTS]],
            np.full(count, 0.9),
            Relations(np.array([[0, 1]]), self.logits, np.array([0.8])),
        )
        return Perceived(graph, instances, {})


def frame(index: int) -> RgbdFrame:
    """Frame of a fixed camera. The millimetre noise depends on the index."""
    rng = np.random.default_rng(index)
    depth_m = np.zeros((120, 160), np.float32)
    for (x1, y1, x2, y2), distance_m, _ in reversed(OBJECTS):
        depth_m[y1:y2, x1:x2] = distance_m
    depth_m[depth_m > 0] += rng.normal(0, 0.002, int((depth_m > 0).sum())).astype(np.float32)
    rgb = rng.integers(0, 255, (120, 160, 3), dtype=np.uint8)
    return RgbdFrame(index * 10**8, rgb, depth_m, INTRINSICS, np.eye(4), "map")
