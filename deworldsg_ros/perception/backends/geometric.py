"""Relation head without a network: predicates from the metric layout of each pair."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.perception.geometry.layout import Layout, measure_layout
from deworldsg_ros.perception.geometry.predicates import (
    CEILING_LOGIT,
    FLOOR_LOGIT,
    GENERAL,
    MIN_LOGIT,
    predicate_logits,
)
from deworldsg_ros.perception.protocols import SegmentedObjects
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import Relations

# In a predicate set with "on", these synonyms would take a part of its probability.
SYNONYMS_OF_ON = frozenset({"standing on", "supported by", "hanging on"})


class GeometricRelationHead:
    """Relation head for any predicate set.

    It judges the predicates whose names it knows. All others ("eating", "made of") keep
    `FLOOR_LOGIT`.

    Args:
        predicates: names, in the order of the logits.
    """

    def __init__(self, predicates: tuple[str, ...]) -> None:
        self.predicates = predicates
        self._is_general = np.array([name in GENERAL for name in predicates], dtype=bool)
        self._column = {name: column for column, name in enumerate(predicates)}
        # Compile the kernel now, so that the first image does not wait.
        measure_layout(
            np.ones((4, 4), dtype=np.float32),
            Intrinsics(4.0, 4.0, 2.0, 2.0, 4, 4),
            np.ones((4, 4), dtype=np.uint16),
            1,
            np.array([0.0, -1.0, 0.0]),
        )

    def relate(self, objects: SegmentedObjects, max_relations: int) -> Relations:
        """The best ordered pairs, specific predicates first; see `RelationHead`."""
        count = len(objects)
        if count < 2 or max_relations <= 0:
            return Relations.none(len(self.predicates))
        layout = measure_layout(
            objects.depth_m, objects.intrinsics, objects.instances, count, objects.up_camera
        )
        logits = self.logits(layout, objects.class_names)
        scores = objects.scores
        # EGTR's pair score; the sigmoid of the best logit replaces its connectivity.
        best = logits.max(axis=2)
        pair_scores = scores[:, None] * scores[None, :] / (1.0 + np.exp(-best))
        candidates = np.flatnonzero((best > MIN_LOGIT).ravel())
        general = self._is_general[logits.argmax(axis=2).ravel()[candidates]]
        order = np.lexsort((-pair_scores.ravel()[candidates], general))[:max_relations]
        kept = candidates[order]
        pairs = np.stack([kept // count, kept % count], axis=1).astype(np.int64)
        return Relations(
            pairs=pairs,
            logits=logits[pairs[:, 0], pairs[:, 1]],
            scores=pair_scores[pairs[:, 0], pairs[:, 1]],
        )

    def logits(self, layout: Layout, class_names: list[str]) -> Float64:
        """Logits (n, n, R), before the sigmoid, of subject and object; the diagonal is the floor.

        Args:
            layout: of the n objects.
            class_names: most likely class of each.
        """
        count = len(class_names)
        result = np.full((count, count, len(self.predicates)), FLOOR_LOGIT)
        skipped = SYNONYMS_OF_ON if "on" in self._column else frozenset()
        for name, values in predicate_logits(layout, class_names).items():
            if name in self._column and name not in skipped:
                result[..., self._column[name]] = values
        usable = layout.valid[:, None] & layout.valid[None, :] & ~np.eye(count, dtype=bool)
        result[~usable] = FLOOR_LOGIT
        return np.clip(result, FLOOR_LOGIT, CEILING_LOGIT)
