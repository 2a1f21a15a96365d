"""The world model's prior of a class pair: the running mean of its predictions."""

from __future__ import annotations

from typing import Annotated, Protocol

import msgspec
import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.limits import MAX_PREDICTION_SUM_ERROR

Index = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]


class PriorState(msgspec.Struct, frozen=True):
    """A prior as plain values.

    Attributes:
        class_count, predicate_count: of the prior.
        class_pairs: subject and object class of each pair that has a prior.
        counts: number of its predictions.
        sums: sum of its predictions.
    """

    class_count: Index
    predicate_count: Index
    class_pairs: list[tuple[Index, Index]]
    counts: list[Annotated[int, msgspec.Meta(ge=1, le=2**52)]]
    sums: list[list[float]]


class Prior(Protocol):
    """A prior of class pairs.

    Attributes:
        changed: class pairs whose prior changed, since the reader emptied it.
    """

    changed: set[tuple[int, int]]

    def lookup(self, pair_classes: Int64) -> tuple[Float64, Bool]:
        """Priors (m, R) of class pairs (m, 2), and (m,) bool, whether there is one."""
        ...


class ClassPairPrior:
    """P_WM(r | c_s, c_o): mean of the probe's distributions by (subject class, object class).

    It is computed from predictions only, never from ground truth. Up to rounding, the order of the
    predictions does not matter. A pair of classes without a prediction has no prior.

    Attributes:
        changed: class pairs whose prior changed, since the reader emptied it.
    """

    def __init__(self, class_count: int, predicate_count: int) -> None:
        self.class_count = class_count
        self.predicate_count = predicate_count
        # Row of a class pair in the arrays below; -1 = none yet.
        self._rows = np.full((class_count, class_count), -1, np.int64)
        self._sums: Float64 = np.zeros((0, predicate_count))
        self._counts: Int64 = np.zeros(0, np.int64)
        self.changed: set[tuple[int, int]] = set()

    def __len__(self) -> int:
        """Number of class pairs that have a prior."""
        return len(self._counts)

    def update(self, pair_classes: Int64, predictions: Float64) -> None:
        """Add predictions; rows of NaN (no clip was encoded) are skipped.

        Args:
            pair_classes: (m, 2) int64, subject and object class of each row.
            predictions: (m, R) float64 distributions.

        Raises:
            RefusedInput: ``invalid_prediction`` for an unknown class, or a row that is not a
                distribution; then no row is added.
        """
        predicted = ~np.isnan(predictions).any(axis=1)
        classes, values = pair_classes[predicted], predictions[predicted]
        try:
            self._check(classes, values)
        except ValueError as error:
            raise RefusedInput("invalid_prediction", str(error)) from error
        if not len(classes):
            return
        pairs = np.unique(classes, axis=0)
        self._add_rows(pairs[self._rows[pairs[:, 0], pairs[:, 1]] < 0])
        rows = self._rows[classes[:, 0], classes[:, 1]]
        np.add.at(self._sums, rows, values / values.sum(axis=1, keepdims=True))
        np.add.at(self._counts, rows, 1)
        self.changed.update(map(tuple, pairs.tolist()))

    def lookup(self, pair_classes: Int64) -> tuple[Float64, Bool]:
        """The priors of many class pairs.

        Args:
            pair_classes: (E, 2) int64.

        Returns:
            priors (E, R) float64, zeros for pairs without one, and has_prior (E,) bool.
        """
        rows = self._rows[pair_classes[:, 0], pair_classes[:, 1]]
        has_prior = rows >= 0
        priors = np.zeros((len(rows), self.predicate_count))
        known = rows[has_prior]
        priors[has_prior] = self._sums[known] / self._counts[known, None]
        return priors, has_prior

    def to_state(self) -> PriorState:
        """Plain values from which `from_state` makes an equal prior."""
        pairs = np.argwhere(self._rows >= 0)
        rows = self._rows[pairs[:, 0], pairs[:, 1]]
        return PriorState(
            self.class_count,
            self.predicate_count,
            [(first, second) for first, second in pairs.tolist()],
            self._counts[rows].tolist(),
            self._sums[rows].tolist(),
        )

    @classmethod
    def from_state(cls, state: PriorState) -> ClassPairPrior:
        """The prior of saved plain values.

        Raises:
            ValueError: if they do not fit together.
        """
        prior = cls(state.class_count, state.predicate_count)
        pairs = np.array(state.class_pairs, np.int64).reshape(-1, 2)
        counts = np.array(state.counts, np.int64)
        # Rows of another length than R are no array.
        sums = np.array(state.sums, np.float64).reshape(-1, prior.predicate_count)
        if not len(pairs) == len(counts) == len(sums) == len(np.unique(pairs, axis=0)):
            raise ValueError(
                f"saved prior: {len(pairs)} class pairs, {len(counts)} counts and {len(sums)} "
                "sums: expected one count and sum for each class pair, no pair twice"
            )
        if (counts < 1).any():
            raise ValueError(f"saved prior: a count is {counts.min()}: expected >= 1")
        prior._check(pairs, sums / counts[:, None])
        prior._add_rows(pairs)
        prior._counts, prior._sums = counts, sums
        return prior

    def _check(self, classes: Int64, values: Float64) -> None:
        if values.shape != (len(classes), self.predicate_count):
            raise ValueError(
                f"predictions have shape {values.shape}: "
                f"expected {(len(classes), self.predicate_count)}"
            )
        if not len(classes):
            return
        if classes.min() < 0 or classes.max() >= self.class_count:
            raise ValueError(
                f"class pairs name classes {classes.min()} to {classes.max()}: "
                f"expected 0 to {self.class_count - 1}"
            )
        sums = values.sum(axis=1)
        if not (
            values.min() >= 0 and np.allclose(sums, 1.0, rtol=0, atol=MAX_PREDICTION_SUM_ERROR)
        ):
            raise ValueError(
                f"predictions have a minimum of {values.min():.3g} and sums from "
                f"{sums.min():.6g} to {sums.max():.6g}: expected distributions"
            )

    def _add_rows(self, pairs: Int64) -> None:
        self._rows[pairs[:, 0], pairs[:, 1]] = len(self) + np.arange(len(pairs))
        self._sums = np.vstack([self._sums, np.zeros((len(pairs), self.predicate_count))])
        self._counts = np.concatenate([self._counts, np.zeros(len(pairs), np.int64)])
