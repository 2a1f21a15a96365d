"""Small local graphs and world models for the tests of the relations stage."""

import threading

import numpy as np
from support import merging

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.scene.frame_graph import LocalGraph, Vocabulary

WIDTH, HEIGHT = 64, 48
VOCABULARY = Vocabulary(("chair", "table", "cup"), ("on", "near", "under", "behind"))


def local_graph(stamp_ns, boxes_xyxy, depths_m, classes) -> LocalGraph:
    count = len(boxes_xyxy)
    probabilities = np.full((count, len(VOCABULARY.classes)), 0.1)
    probabilities[np.arange(count), np.asarray(classes, int)] = 0.8
    return merging.local_graph(
        stamp_ns,
        np.zeros((count, 3)),
        np.tile(np.eye(3), (count, 1, 1)),
        probabilities,
        vocabulary=VOCABULARY,
        width=WIDTH,
        height=HEIGHT,
        boxes_xyxy=np.asarray(boxes_xyxy, np.float64).reshape(-1, 4),
        depths_m=np.asarray(depths_m, np.float64),
    )


def pair_graph(stamp_ns: int) -> LocalGraph:
    """A cup on a table: one neighbour pair."""
    return local_graph(stamp_ns, [[10, 20, 50, 40], [20, 10, 30.5, 22]], [1.5, 1.4], [1, 2])


def crowd_graph(stamp_ns: int, count: int) -> LocalGraph:
    """Objects in a row. All are neighbours of one another."""
    left = np.linspace(0, 40, count)
    boxes = np.stack([left, np.full(count, 10.0), left + 8, np.full(count, 20.0)], axis=1)
    return local_graph(stamp_ns, boxes, np.full(count, 2.0), np.arange(count) % 3)


def empty_graph(stamp_ns: int) -> LocalGraph:
    """A frame without objects."""
    return crowd_graph(stamp_ns, 0)


def picture(stamp_ns: int) -> np.ndarray:
    """An image with random pixels, seeded by the stamp."""
    generator = np.random.default_rng(stamp_ns)
    return generator.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def config(**changes) -> RelationsConfig:
    """The fake world model with clips of 4 frames, and a budget above all needs of the tests."""
    settings = {"world_model": "fake", "clip_length": 4, "max_clips_per_s": 1000.0}
    return RelationsConfig(**{**settings, **changes})


class RecordingModel(FakeWorldModel):
    """A fake world model that records its requests."""

    def __init__(self, clip_length: int = 4) -> None:
        super().__init__(clip_length)
        self.requests = []

    def predict(self, request):
        self.requests.append(request)
        return super().predict(request)


class GatedModel(RecordingModel):
    """A world model that waits for the permission of the test before each prediction."""

    def __init__(self) -> None:
        super().__init__()
        self.begun = threading.Semaphore(0)
        self.allowed = threading.Semaphore(0)

    def predict(self, request):
        self.begun.release()
        assert self.allowed.acquire(timeout=30)
        return super().predict(request)
