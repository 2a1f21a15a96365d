"""Detections of another process: its names, how it confuses them, and class distributions.

A detector of free text sends a name and a score. What else the object may be is learned from the
detector itself: it names an object again in the next image, and sometimes in another way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.scene.arrays import Float64, UInt8, pairwise_iou
from deworldsg_ros.scene.camera import SentDetections
from deworldsg_ros.scene.checks import MAX_SUM_ERROR
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.vocabulary import plain

# As the embedded detector. Scores of detectors differ: `perception.score_threshold` replaces it.
SCORE_THRESHOLD = 0.4
# Names that a source may bring. A source that numbers its objects would bring ever new ones, and
# each costs eight bytes a node.
MAX_SOURCE_NAMES = 2048
# Two boxes of one image with more overlap (IoU) are one object that was named twice, as detectors
# of free text do.
SAME_BOX = 0.8
# Two boxes of images in a row with more overlap show the same object.
SAME_OBJECT = 0.5
# Before a source has named anything twice: as if it had repeated a name so often, and said any
# other name so often in its place.
REPEATED, OTHERS = 4.0, 4.0
# Scores that sum to one, up to rounding, are a distribution.
FULL = 0.999


class DetectionSource:
    """A detector whose results arrive with the image.

    Args:
        words: names of the classes that the source sends as numbers, from 0; see `use_words`.
    """

    default_score_threshold = SCORE_THRESHOLD

    def __init__(self, words: Sequence[str] = ()) -> None:
        self._words = tuple(words)
        self._drops: Counter[str] = Counter()
        self._index: dict[str, int] = {}
        self._classes: tuple[str, ...] = ()
        # How often the source said the name of the row, and of the column in the image before or
        # after it.
        self._said = np.zeros((0, 0))
        self._before: tuple[Float64, list[int]] = (np.zeros((0, 4)), [])

    @property
    def classes(self) -> tuple[str, ...]:
        """The names so far, in lower case."""
        return self._classes

    def check_words(self, words: Sequence[str]) -> None:
        """Any words may be names of numbers."""

    def use_words(self, words: Sequence[str], before: Sequence[str] = ()) -> None:
        """Use other names for the classes that the source sends as numbers, from 0.

        Args:
            words: all of them; a number beyond is a name itself.
            before: classes that keep their columns: those of another source, which this replaces.
        """
        self._words = tuple(words)
        for name in before:
            self._index.setdefault(name, len(self._index))
        self._classes = tuple(self._index)

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """The results come with the image: there is nothing to detect.

        Raises:
            RefusedInput: ``no_detections``.
        """
        raise RefusedInput("no_detections", "the image came without detections of another process")

    def take_drops(self) -> Counter[str]:
        """Detections left out since the last call, by reason: ``over_max_names``."""
        drops, self._drops = +self._drops, Counter()
        return drops

    def take(self, sent: SentDetections, score_threshold: float) -> Detections:
        """The objects of an image as detections, with class distributions.

        The images come in order of time.

        Args:
            sent: of the image.
            score_threshold: objects with a lower score are left out.
        """
        rows = [int(row) for row in np.argsort(-sent.scores, kind="stable")]
        named = [
            (row, self._learn(sent.names[row], sent.name_scores[row]))
            for row in rows
            if sent.scores[row] >= score_threshold
        ]
        self._drops["over_max_names"] += sum(not scores for _, scores in named)
        kept = _join([(row, scores) for row, scores in named if scores], sent.boxes_xyxy)
        at = [row for row, _ in kept]
        best = [max(scores, key=lambda name: scores[name]) for _, scores in kept]
        boxes = sent.boxes_xyxy[at].reshape(-1, 4)
        self._compare(boxes, best)
        classes = self._classes or ("object",)  # a vocabulary is never empty
        probabilities = [self._distribution(scores, name) for (_, scores), name in zip(kept, best)]
        return Detections(
            boxes_xyxy=boxes,
            class_probabilities=np.array(probabilities).reshape(len(kept), len(classes)),
            scores=sent.scores[at],
            classes=classes,
            masks=None if sent.masks is None else tuple([sent.masks[row] for row in at]),
            embeddings=None if sent.embeddings is None else sent.embeddings[at],
            embedding_model=sent.embedding_model,
        )

    def _learn(self, names: tuple[str, ...], scores: tuple[float, ...]) -> dict[int, float]:
        """Scores by index of the names; without names that are too many."""
        found: dict[int, float] = {}
        for text, score in zip(names, scores):
            number = int(text) if text.isdecimal() and len(text) < 6 else len(self._words)
            name = plain(self._words[number] if number < len(self._words) else text).strip()
            if name not in self._index:
                if not name or len(self._index) >= MAX_SOURCE_NAMES:
                    continue
                self._index[name] = len(self._index)
                self._classes = (*self._classes, name)
            index = self._index[name]
            found[index] = max(score, found.get(index, 0.0))
        return found

    def _compare(self, boxes: Float64, best: list[int]) -> None:
        """Count how the source names again what the image before showed."""
        more = len(self._classes) - len(self._said)
        if more:
            self._said = np.pad(self._said, (0, more))
        boxes_before, names_before = self._before
        self._before = boxes, best
        if not len(boxes) or not len(boxes_before):
            return
        overlaps = pairwise_iou(boxes, boxes_before)
        for row, column in enumerate(overlaps.argmax(axis=1).tolist()):
            # Each is the best one of the other: neighbours of one kind are not compared.
            if overlaps[row, column] > SAME_OBJECT and overlaps[:, column].argmax() == row:
                self._said[best[row], names_before[column]] += 1
                self._said[names_before[column], best[row]] += 1

    def _distribution(self, scores: dict[int, float], best: int) -> Float64:
        """Class probabilities (C,) of an object with these scores by name.

        Scores that sum to one are the distribution. Otherwise, what they leave open is distributed
        as the source names an object again that it gave this name.
        """
        result = np.zeros(len(self._classes))
        for name, score in scores.items():
            result[name] = score
        total = result.sum()
        if abs(total - 1.0) <= MAX_SUM_ERROR:  # as it is, to the last bit
            return result
        if total >= FULL:
            return result / total
        again = self._said[best] + OTHERS / len(self._classes)
        again[best] += REPEATED
        result += (1.0 - total) * again / again.sum()
        return result / result.sum()


def _join(
    named: list[tuple[int, dict[int, float]]], boxes: Float64
) -> list[tuple[int, dict[int, float]]]:
    """Join objects with nearly the same box, best score first: the better box, and all names."""
    if len(named) < 2:
        return named
    of_rows = boxes[[row for row, _ in named]]
    overlaps = pairwise_iou(of_rows, of_rows)
    kept: dict[int, dict[int, float]] = {}
    for place, (_, scores) in enumerate(named):
        same = next((other for other in kept if overlaps[place, other] > SAME_BOX), place)
        into = kept.setdefault(same, {})
        for name, score in scores.items():
            into[name] = max(score, into.get(name, 0.0))
    return [(named[place][0], scores) for place, scores in kept.items()]
