"""The predictions of the embedded world model as the prior of class pairs (Eq. 9-10)."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from deworldsg_ros.relations.pair_table import PairTable
from deworldsg_ros.relations.physical_states import NONE, RELATIONS_OF_STATE, canonical_predicates
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.softmax import softmax

# A prediction of a pair enters the prior of its classes if the model says, with this probability,
# that the pair is related in this direction. Otherwise it abstains.
MIN_RELATED = 0.5
# Predictions are summed as whole numbers of this. Such sums are exact: taking a prediction back
# leaves no trace, and the order does not matter.
UNIT = 2.0**-40

ClassPair = tuple[int, int]


class PredictedPrior:
    """The mean prediction of the physical model, by classes of subject and object.

    The model abstains for pairs that are probably not related.

    Args:
        vocabulary: of the graph.

    Attributes:
        changed: class pairs whose prior changed, since the reader emptied it.
    """

    def __init__(self, vocabulary: Vocabulary) -> None:
        self.changed: set[ClassPair] = set()
        self._canonical = canonical_predicates(vocabulary.predicates)
        self._predicate_count = len(vocabulary.predicates)
        # Which states are a relation that has a name: (2, STATE_COUNT, NONE), by direction.
        named = RELATIONS_OF_STATE.T[:, :, None] == np.arange(NONE)
        self._named = (named & (self._canonical >= 0)).astype(np.float64)
        # By class pair: sum of the predictions of each relation, and their number.
        self._sums: dict[ClassPair, tuple[Int64, int]] = {}
        # By key of a pair: what it adds, to which class pair.
        self._told: dict[int, list[tuple[ClassPair, Int64]]] = {}

    def __len__(self) -> int:
        """Number of class pairs that have a prior."""
        return len(self._sums)

    def follow(self, table: PairTable, keys: Collection[int]) -> None:
        """Take in the pairs with these keys as they are now, in place of what they said before."""
        for pair_key in keys:
            for pair, values in self._told.pop(pair_key, ()):
                self._add(pair, -values, -1)
        rows = np.array([table.row(pair_key) for pair_key in keys if pair_key in table], np.int64)
        rows = rows[table.judged[rows]]
        states = softmax(table.state_logits[rows])
        related = states[:, 0] < 1.0 - MIN_RELATED
        rows, states = rows[related], states[related]
        if not len(rows):
            return
        classes = table.shapes.best_classes[table.ends[rows]]
        for end in (0, 1):
            predictions = states @ self._named[end]
            total = predictions.sum(axis=1)
            for index in np.flatnonzero(total > MIN_RELATED).tolist():
                first, second = classes[index, end], classes[index, 1 - end]
                values = np.rint(predictions[index] / (total[index] * UNIT)).astype(np.int64)
                pair = (int(first), int(second))
                self._told.setdefault(int(table.ids[rows[index]]), []).append((pair, values))
                self._add(pair, values, 1)

    def _add(self, classes: ClassPair, values: Int64, count: int) -> None:
        sums, known = self._sums.get(classes, (np.zeros(NONE, np.int64), 0))
        self.changed.add(classes)
        if known + count:
            self._sums[classes] = (sums + values, known + count)
        else:
            del self._sums[classes]

    def lookup(self, pair_classes: Int64) -> tuple[Float64, Bool]:
        """The priors of many class pairs; see `ClassPairPrior.lookup`."""
        priors = np.zeros((len(pair_classes), self._predicate_count))
        has_prior = np.zeros(len(pair_classes), np.bool_)
        named = np.flatnonzero(self._canonical >= 0)
        for row, classes in enumerate(map(tuple, pair_classes.tolist())):
            if classes in self._sums:
                sums, count = self._sums[classes]
                priors[row, self._canonical[named]] = sums[named] * UNIT / count
                has_prior[row] = True
        return priors, has_prior
