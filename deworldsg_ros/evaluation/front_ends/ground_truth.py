"""Detections and relations from the annotation; perfect without injected faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from deworldsg_ros.evaluation.front_ends.annotated import TRUE_PROBABILITY, AnnotatedObjects
from deworldsg_ros.evaluation.front_ends.assembly import Relation, assemble, spread
from deworldsg_ros.evaluation.front_ends.injection import Injection
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import Vocabulary

# Range of random relation scores: only the best relations of a frame are kept, and random scores
# give each relation its turn.
RELATION_SCORES = (0.8, 1.0)


class GroundTruthFrontEnd:
    """Detects the annotated objects and relations.

    Args:
        objects: the annotated objects of the scan.
        relations: (subject id, object id, index of the predicate) of the scan.
        vocabulary: classes and predicates of the data set.
        seed: random seed of the relation scores.
        top_relations: number of relations kept per frame.
        injection: injects faults; None = no faults.
    """

    def __init__(
        self,
        objects: AnnotatedObjects,
        relations: Sequence[tuple[int, int, int]],
        vocabulary: Vocabulary,
        *,
        seed: int = 0,
        top_relations: int = 10,
        injection: Injection | None = None,
    ) -> None:
        self.vocabulary = vocabulary
        self._objects = objects
        self._stated_relations = relations
        self._seed = seed
        self._top_relations = top_relations
        self._injection = injection

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """Detections and relations of a frame, with faults; raises EvaluationError."""
        number = self._objects.number(frame)
        seen = self._objects.detect(frame)
        indices = {item.instance: index for index, item in enumerate(seen.detections)}
        seen = replace(seen, relations=self._relate(number, indices))
        if self._injection is not None:
            seen = self._injection.apply(seen, frame, number)
        return assemble(frame, self.vocabulary, seen, self._top_relations)

    def _relate(self, number: int, indices: Mapping[int, int]) -> list[Relation]:
        stated: dict[tuple[int, int], dict[int, float]] = {}
        for subject, object_, predicate in self._stated_relations:
            if subject in indices and object_ in indices and subject != object_ and predicate >= 0:
                stated.setdefault((subject, object_), {})[predicate] = TRUE_PROBABILITY
        relations = []
        for (subject, object_), probabilities in stated.items():
            generator = np.random.default_rng([self._seed, 1, number, subject, object_])
            relations.append(
                Relation(
                    indices[subject],
                    indices[object_],
                    float(generator.uniform(*RELATION_SCORES)),
                    spread(probabilities, len(self.vocabulary.predicates)),
                )
            )
        return relations
