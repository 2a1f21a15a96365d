"""A deterministic stand-in for a world model, for tests and measurements; it has learnt nothing.

The class pair decides which predicate leads, and by how much, mostly; the clip changes the numbers
and not the leader. It gives the same answer to the same clip in every run and on every machine (to
rounding): hashes, no random generator.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.world_model import ClipRequest, PairContext
from deworldsg_ros.scene.arrays import Float64

# Ranges of the logits that a class pair and a clip contribute.
CLASS_PAIR_LOGIT = 4.0
CLIP_LOGIT = 1.0
# What the leader has more: of 50 predicates it gets about 0.8, as the greatest of a trained probe.
LEAD_LOGIT = 4.0


class FakeWorldModel:
    """Distributions from hashes of the seed, the class pair and the clip's content.

    Args:
        clip_length: T.
        seed: other seeds, other answers.
        lead_logit: what a class pair's leading predicate has more than its hash gives; below
            `CLIP_LOGIT` the clip may change the leader.
    """

    name = "fake"

    def __init__(self, clip_length: int, seed: int, lead_logit: float = LEAD_LOGIT) -> None:
        self.clip_length = clip_length
        self._seed = seed
        self._lead_logit = lead_logit

    def predict_batch(self, requests: Sequence[ClipRequest]) -> list[Float64]:
        """(pairs, R) float64 for each request."""
        return [self._predict(request) for request in requests]

    def _predict(self, request: ClipRequest) -> Float64:
        # Integer sums do not depend on the order of summation.
        content = request.clip.sum(axis=(0, 1, 2), dtype=np.int64).tolist()
        predicate_count = len(request.vocabulary.predicates)
        rows = [self._distribution(pair, content, predicate_count) for pair in request.pairs]
        return np.array(rows, np.float64).reshape(len(rows), predicate_count)

    def _distribution(self, pair: PairContext, content: list[int], predicate_count: int) -> Float64:
        key = [self._seed, pair.subject_name, pair.object_name]
        logits = CLASS_PAIR_LOGIT * _uniform(key, predicate_count)
        logits[logits.argmax()] += self._lead_logit
        logits = logits + CLIP_LOGIT * _uniform([*key, *content], predicate_count)
        weights = np.exp(logits - logits.max())
        distribution: Float64 = weights / weights.sum()
        return distribution


def _uniform(key: Sequence[object], count: int) -> Float64:
    """`count` numbers in [0, 1) that depend on the key alone."""
    digest = hashlib.shake_256(repr(tuple(key)).encode()).digest(4 * count)
    return np.frombuffer(digest, "<u4").astype(np.float64) / 2.0**32


def build(config: RelationsConfig) -> FakeWorldModel:
    """The fake of the configured clip length and seed."""
    return FakeWorldModel(config.clip_length, config.seed)
