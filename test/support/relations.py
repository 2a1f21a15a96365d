"""Small local graphs and world models for the tests of the relations stage."""

import threading
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.paper import PROVENANCES, ClassPairPrior, FusedEdges, fuse_edges
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.scene.frame_graph import LocalGraph, Relations, Vocabulary

WIDTH, HEIGHT = 64, 48
VOCABULARY = Vocabulary(("chair", "table", "cup"), ("on", "near", "under", "behind"))


def local_graph(stamp_ns, boxes_xyxy, depths_m, classes) -> LocalGraph:
    count = len(boxes_xyxy)
    probabilities = np.full((count, len(VOCABULARY.classes)), 0.1)
    probabilities[np.arange(count), np.asarray(classes, int)] = 0.8
    return LocalGraph(
        stamp_ns=stamp_ns,
        frame_id="world",
        width=WIDTH,
        height=HEIGHT,
        T_world_camera=np.eye(4),
        vocabulary=VOCABULARY,
        instance_ids=np.arange(1, count + 1),
        boxes_xyxy=np.asarray(boxes_xyxy, np.float64).reshape(-1, 4),
        class_probabilities=probabilities,
        scores=np.ones(count),
        means_world=np.zeros((count, 3)),
        covariances_world=np.tile(np.eye(3), (count, 1, 1)),
        depths_m=np.asarray(depths_m, np.float64),
        pixel_counts=np.full(count, 50),
        surface_points_world=tuple(np.zeros((0, 3), np.float32) for _ in range(count)),
        relations=Relations.none(len(VOCABULARY.predicates)),
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


@dataclass(frozen=True)
class FusedEdge:
    """Belief of one directed edge."""

    probabilities: np.ndarray
    provenance: str
    entropy_nats: float


def fuse_edge(visual_logits, prior, alpha, entropy_threshold_nats) -> FusedEdge | None:
    """`fuse_edges` for one edge. Logits and prior may be None. Returns None without an edge."""
    known = visual_logits if visual_logits is not None else prior
    if known is None:
        return None
    empty = np.zeros_like(known)
    fused = fuse_edges(
        (empty if visual_logits is None else visual_logits)[None],
        np.array([visual_logits is not None]),
        (empty if prior is None else prior)[None],
        np.array([prior is not None]),
        alpha,
        entropy_threshold_nats,
    )
    if not fused.known[0]:
        return None
    return FusedEdge(fused.probabilities[0], provenances(fused)[0], float(fused.entropies_nats[0]))


def provenances(fused: FusedEdges) -> list[str]:
    return [PROVENANCES[code] for code in fused.provenance_codes.tolist()]


def mean_of(prior: ClassPairPrior, subject_class: int, object_class: int) -> np.ndarray | None:
    """The prior of one class pair, or None."""
    priors, has_prior = prior.lookup(np.array([[subject_class, object_class]]))
    return priors[0] if has_prior[0] else None
