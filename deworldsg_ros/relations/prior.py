"""The world model's prior of a class pair: the running mean of its predictions."""

from __future__ import annotations

from typing import Any

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.errors import RefusedInput

# A distribution may sum to one as loosely as float32 arithmetic leaves it.
SUM_TOLERANCE = 1e-3


class ClassPairPrior:
    """P_WM(r | c_s, c_o): mean of the probe's distributions by (subject class, object class).

    Only predictions enter, never a ground truth. The order of predictions does not matter, up to
    rounding. A pair of classes without a prediction has no prior.
    """

    def __init__(self, class_count: int, predicate_count: int) -> None:
        self.class_count = class_count
        self.predicate_count = predicate_count
        # Row of a class pair in the arrays below, -1 where it has none yet.
        self._rows = np.full((class_count, class_count), -1, np.int64)
        self._sums: Float64 = np.zeros((0, predicate_count))
        self._counts: Int64 = np.zeros(0, np.int64)

    def __len__(self) -> int:
        """Number of class pairs that have a prior."""
        return len(self._counts)

    def update(self, pair_classes: Int64, predictions: Float64) -> Int64:
        """Add predictions; rows of NaN (no clip was encoded) are passed over.

        Args:
            pair_classes: (m, 2) int64, subject and object class of each row.
            predictions: (m, R) float64 distributions.

        Returns:
            (k, 2) int64, the class pairs whose prior changed, each once, in order.

        Raises:
            RefusedInput: ``invalid_prediction`` for a class that does not exist, or a row that is
                not a distribution; nothing of it is added.
        """
        told = ~np.isnan(predictions).any(axis=1)
        classes, values = pair_classes[told], predictions[told]
        try:
            self._check(classes, values)
        except ValueError as error:
            raise RefusedInput("invalid_prediction", str(error)) from error
        changed = np.unique(classes, axis=0)
        self._add_rows(changed[self._rows[changed[:, 0], changed[:, 1]] < 0])
        rows = self._rows[classes[:, 0], classes[:, 1]]
        np.add.at(self._sums, rows, values / values.sum(axis=1, keepdims=True))
        np.add.at(self._counts, rows, 1)
        return changed

    def mean(self, subject_class: int, object_class: int) -> Float64 | None:
        """The prior of a class pair, (R,) float64 that sums to one; None where it has none."""
        priors, has_prior = self.lookup(np.array([[subject_class, object_class]], np.int64))
        return priors[0] if has_prior[0] else None

    def lookup(self, pair_classes: Int64) -> tuple[Float64, Bool]:
        """The priors of many class pairs.

        Args:
            pair_classes: (E, 2) int64.

        Returns:
            priors (E, R) float64, zeros where there is none, and has_prior (E,) bool.
        """
        rows = self._rows[pair_classes[:, 0], pair_classes[:, 1]]
        has_prior = rows >= 0
        priors = np.zeros((len(rows), self.predicate_count))
        known = rows[has_prior]
        priors[has_prior] = self._sums[known] / self._counts[known, None]
        return priors, has_prior

    def revisions(self, pair_classes: Int64) -> Int64:
        """How often each class pair's prior has changed, (E,) int64; 0 where it has none."""
        rows = self._rows[pair_classes[:, 0], pair_classes[:, 1]]
        revisions = np.zeros(len(rows), np.int64)
        revisions[rows >= 0] = self._counts[rows[rows >= 0]]
        return revisions

    def to_state(self) -> dict[str, Any]:
        """Plain values from which `from_state` makes an equal prior."""
        pairs = np.argwhere(self._rows >= 0)
        rows = self._rows[pairs[:, 0], pairs[:, 1]]
        return {
            "class_count": self.class_count,
            "predicate_count": self.predicate_count,
            "class_pairs": pairs.tolist(),
            "counts": self._counts[rows].tolist(),
            "sums": self._sums[rows].tolist(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> ClassPairPrior:
        """The prior of saved plain values.

        Raises:
            ValueError: where they do not fit together.
        """
        prior = cls(state["class_count"], state["predicate_count"])
        pairs = np.array(state["class_pairs"], np.int64).reshape(-1, 2)
        counts = np.array(state["counts"], np.int64)
        sums = np.array(state["sums"], np.float64).reshape(-1, prior.predicate_count)
        if not len(pairs) == len(counts) == len(sums) == len(np.unique(pairs, axis=0)):
            raise ValueError(
                f"saved prior: {len(pairs)} class pairs, {len(counts)} counts and {len(sums)} "
                "sums: wanted one count and sum for each class pair, none twice"
            )
        if (counts < 1).any():
            raise ValueError(f"saved prior: a count is {counts.min()}: wanted >= 1")
        prior._check(pairs, sums / counts[:, None])
        prior._add_rows(pairs)
        prior._counts, prior._sums = counts, sums
        return prior

    def _check(self, classes: Int64, values: Float64) -> None:
        if values.shape != (len(classes), self.predicate_count):
            raise ValueError(
                f"predictions have shape {values.shape}: "
                f"wanted {(len(classes), self.predicate_count)}"
            )
        if not len(classes):
            return
        if classes.min() < 0 or classes.max() >= self.class_count:
            raise ValueError(
                f"class pairs name classes {classes.min()} to {classes.max()}: "
                f"wanted 0 to {self.class_count - 1}"
            )
        sums = values.sum(axis=1)
        if not (values.min() >= 0 and np.allclose(sums, 1.0, rtol=0, atol=SUM_TOLERANCE)):
            raise ValueError(
                f"predictions have a least value of {values.min():.3g} and sums of "
                f"{sums.min():.6g} to {sums.max():.6g}: wanted distributions"
            )

    def _add_rows(self, pairs: Int64) -> None:
        self._rows[pairs[:, 0], pairs[:, 1]] = len(self) + np.arange(len(pairs))
        self._sums = np.vstack([self._sums, np.zeros((len(pairs), self.predicate_count))])
        self._counts = np.concatenate([self._counts, np.zeros(len(pairs), np.int64)])
