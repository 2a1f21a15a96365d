"""The predictions of the embedded world model as the prior of class pairs (Eq. 9-10)."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.relations.pair_table import PairTable
from deworldsg_ros.relations.physical_states import (
    NONE,
    RELATIONS_OF_STATE,
    STATE_COUNT,
    canonical_predicates,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.frame_graph import Vocabulary

# A prediction of a pair enters the prior of its classes if the model says, with this probability,
# that the pair is related in this direction. Otherwise it abstains.
MIN_RELATED = 0.5
# Predictions are summed as whole numbers of this. Such sums are exact: taking a prediction back
# leaves no trace, and the order does not matter.
UNIT = 2.0**-40

ClassPair = tuple[int, int]


@kernel
def _predictions(
    rows: Int64, judged: Bool, state_logits: Float64, named: Float64
) -> tuple[Int64, Bool]:
    """Predictions (k, 2, NONE) of pairs in both directions, in `UNIT`s; and which there are."""
    values = np.zeros((len(rows), 2, NONE), np.int64)
    told = np.zeros((len(rows), 2), np.bool_)
    weights = np.empty(STATE_COUNT, np.float64)
    predictions = np.empty(NONE, np.float64)
    for index in range(len(rows)):
        logits, best, total = state_logits[rows[index]], 0.0, 0.0
        for state in range(STATE_COUNT):
            best = max(best, logits[state])  # the first one is 0
        for state in range(STATE_COUNT):
            weights[state] = math.exp(logits[state] - best)
            total += weights[state]
        if not judged[rows[index]] or weights[0] / total >= 1.0 - MIN_RELATED:
            continue
        for end in range(2):
            related = 0.0
            for relation in range(NONE):
                predictions[relation] = 0.0
                for state in range(STATE_COUNT):
                    predictions[relation] += weights[state] / total * named[end, state, relation]
                related += predictions[relation]
            told[index, end] = related > MIN_RELATED
            for relation in range(NONE if told[index, end] else 0):
                values[index, end, relation] = np.rint(predictions[relation] / (related * UNIT))
    return values, told


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
        known = table.places
        rows = np.array([known[pair_key] for pair_key in keys if pair_key in known], np.int64)
        values, told = _predictions(rows, table.judged, table.state_logits, self._named)
        places, ends = np.nonzero(told)
        if not len(places):
            return
        of_rows = rows[places]
        classes = table.shapes.best_classes[table.ends[of_rows]].tolist()
        for place, end, pair_key, both in zip(
            places.tolist(), ends.tolist(), table.ids[of_rows].tolist(), classes
        ):
            pair = (both[end], both[1 - end])
            self._told.setdefault(pair_key, []).append((pair, values[place, end]))
            self._add(pair, values[place, end], 1)

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
        if not self._sums:
            return priors, has_prior
        named = np.flatnonzero(self._canonical >= 0)
        names = self._canonical[named]
        for row, classes in enumerate(map(tuple, pair_classes.tolist())):
            if classes in self._sums:
                sums, count = self._sums[classes]
                priors[row, names] = sums[named] * UNIT / count
                has_prior[row] = True
        return priors, has_prior
