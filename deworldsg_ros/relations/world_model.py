"""The interface of world models of clips, and a test double."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from deworldsg_ros.scene.arrays import Float64, UInt8, softmax
from deworldsg_ros.scene.frame_graph import Vocabulary

# --- The interface of world models of clips.


@dataclass(frozen=True)
class PairContext:
    """One direction of a pair in a clip.

    Attributes:
        subject_box_xyxy, object_box_xyxy: (4,) float64 pixels of the crop, in the clip's last
            frame.
        subject_class, object_class: indices into the vocabulary's classes.
        subject_name, object_name: names of these classes.
    """

    subject_box_xyxy: Float64
    object_box_xyxy: Float64
    subject_class: int
    object_class: int
    subject_name: str
    object_name: str


@dataclass(frozen=True)
class ClipRequest:
    """One clip, and the ordered pairs to predict from it.

    Attributes:
        clip: (T, h, w, 3) uint8 RGB, oldest frame first.
        pairs: directions to predict, usually both of one pair; the clip is encoded once.
        vocabulary: its predicates are the columns of the prediction.
    """

    clip: UInt8
    pairs: tuple[PairContext, ...]
    vocabulary: Vocabulary


class WorldModel(Protocol):
    """A frozen video model with its probe: maps a clip to predicate distributions.

    Its attributes `window` and `crop`, if it has them, choose the frames and the region of its
    clips, see `ProbeCard`.
    """

    @property
    def name(self) -> str:
        """The `source` of its published evidence."""
        ...

    @property
    def clip_length(self) -> int:
        """T, frames of its clips."""
        ...

    def predict(self, request: ClipRequest) -> Float64:
        """Predicate distributions of the pairs of a request.

        Clips differ in height and width. The world model resizes them.

        Returns:
            (pairs, R), rows >= 0 that sum to one.
        """
        ...


def require_predicates(model: WorldModel | None, predicates: tuple[str, ...]) -> None:
    """Refuse a world model whose predicates differ from the graph's, before the first frame.

    A world model with fixed predicates has a method `require_predicates`.

    Raises:
        ConfigurationError: the predicates differ.
    """
    check = getattr(model, "require_predicates", None)
    if check is not None:
        check(predicates)


# --- An untrained, deterministic test double of a world model, for tests and measurements.
#
# The class pair decides the most probable predicate; the clip changes the probabilities a little.
# Predictions are computed from hashes. The same clip gives the same prediction in every run and, up
# to rounding, on every machine.

# Ranges of the logits that a class pair and a clip contribute.
CLASS_PAIR_LOGIT = 4.0
CLIP_LOGIT = 1.0
# Extra logit of the class pair's leading predicate. Of 50 predicates the leading one gets a
# probability of about 0.8, as with a trained probe.
LEAD_LOGIT = 4.0


class FakeWorldModel:
    """Distributions from hashes of the seed, the class pair and the clip's pixels.

    Args:
        clip_length: T, frames of a clip.
        seed: another seed gives other predictions.
        lead_logit: extra logit of a class pair's leading predicate; below `CLIP_LOGIT` the clip
            may change the most probable predicate.
    """

    name = "fake"

    def __init__(self, clip_length: int, *, seed: int = 0, lead_logit: float = LEAD_LOGIT) -> None:
        self.clip_length = clip_length
        self._seed = seed
        self._lead_logit = lead_logit

    def predict(self, request: ClipRequest) -> Float64:
        """(pairs, R) float64, rows sum to one."""
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
        distribution: Float64 = softmax(logits)
        return distribution


def _uniform(key: Sequence[object], count: int) -> Float64:
    """`count` numbers in [0, 1) that depend only on the key."""
    digest = hashlib.shake_256(repr(tuple(key)).encode()).digest(4 * count)
    return np.frombuffer(digest, "<u4").astype(np.float64) / 2.0**32
