"""One clip at a time through the world model, with its output checked."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from deworldsg_ros.relations.clips import QueuedClip, Rgb, crop_clip, without_first
from deworldsg_ros.relations.world_model import ClipRequest, PairContext, WorldModel
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import RelationEvidence
from deworldsg_ros.scene.limits import MAX_PREDICTION_SUM_ERROR


class ClipEncoder:
    """Runs the world model on clips. A failure of the model costs one clip and nothing else.

    Args:
        world_model: encodes the clips.
        report: called with one sentence on each new failure; default: the log.

    Attributes:
        failure: reason of the last failure: that of a refusal, else ``world_model_error``.
    """

    def __init__(
        self, world_model: WorldModel, report: Callable[[str], None] | None = None
    ) -> None:
        self._world_model = world_model
        self._report = logging.getLogger(__name__).warning if report is None else report
        self._last_report = ""
        self.failure = ""

    def encode(self, clip: QueuedClip, images: list[Rgb]) -> RelationEvidence | None:
        """Predictions for both directions of a clip's pair; None if the world model failed.

        Args:
            clip: a queued clip.
            images: its frames, oldest first; not used if the clip holds its pixels.
        """
        request = clip_request(clip, images, self._world_model.clip_length)
        try:
            predictions = checked_distributions(
                self._world_model.predict(request),
                len(request.pairs),
                len(request.vocabulary.predicates),
            )
        except Exception as error:  # a backend may raise anything; the other stages go on
            self.failure = "world_model_error"
            if isinstance(error, RefusedInput):
                self.failure = error.reason
            self._report_once(
                f"world model '{self._world_model.name}' failed: {type(error).__name__}: {error}"
            )
            return None
        i, j = clip.rows
        return RelationEvidence(
            stamp_ns=clip.stamp_ns,
            vocabulary=clip.vocabulary,
            pairs=np.array([[i, j], [j, i]], np.int64),
            pair_classes=np.array([clip.classes, clip.classes[::-1]], np.int64),
            geo_costs=np.full(2, clip.geo_cost),
            predictions=predictions,
            source=self._world_model.name,
        )

    def _report_once(self, message: str) -> None:
        """Report a failure unless it repeats the last one; the caller counts all of them."""
        if message != self._last_report:
            self._last_report = message
            self._report(message)


def clip_request(clip: QueuedClip, images: list[Rgb], clip_length: int) -> ClipRequest:
    """The pixels of a queued clip and both directions of its pair, in pixels of the crop."""
    x1, y1, _, _ = clip.crop_xyxy
    boxes = [box - np.array([x1, y1, x1, y1], np.float64) for box in clip.boxes_xyxy]
    names = [clip.vocabulary.classes[index] for index in clip.classes]
    directions = tuple(
        PairContext(
            subject_box_xyxy=boxes[subject],
            object_box_xyxy=boxes[object_],
            subject_class=clip.classes[subject],
            object_class=clip.classes[object_],
            subject_name=names[subject],
            object_name=names[object_],
        )
        for subject, object_ in ((0, 1), (1, 0))
    )
    pixels = clip.pixels
    if pixels is None:
        pixels = crop_clip(images, clip.crop_xyxy, clip_length)
    return ClipRequest(without_first(pixels, clip.skipped), directions, clip.vocabulary)


def checked_distributions(output: Float64, pair_count: int, predicate_count: int) -> Float64:
    """A world model's output as float64 rows that sum to one.

    Args:
        output: (pair_count, predicate_count), any float type; sums within
            `MAX_PREDICTION_SUM_ERROR` of one.
        pair_count: rows expected.
        predicate_count: columns expected.

    Raises:
        ValueError: another shape, or rows that are not distributions.
    """
    values = np.asarray(output, dtype=np.float64)
    if values.shape != (pair_count, predicate_count):
        raise ValueError(
            f"output has shape {values.shape}: expected {(pair_count, predicate_count)}"
        )
    sums = values.sum(axis=1)
    if (
        not (np.isfinite(values).all() and (values >= 0).all())
        or (np.abs(sums - 1) > MAX_PREDICTION_SUM_ERROR).any()
    ):
        raise ValueError(
            f"output is {values.tolist()}: expected rows >= 0 that sum to one, one per pair"
        )
    distributions: Float64 = values / sums[:, None]
    return distributions
