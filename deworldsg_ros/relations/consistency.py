"""Contradictions between the predicates of a pair's two directions, and their removal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from deworldsg_ros.relations.evidence import (
    PROVENANCES,
    FusedEdges,
    opposite_rows,
    visual_distribution,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64

_VISUAL = PROVENANCES.index("visual")

# Below this probability of a contradiction, the beliefs of a pair are not changed.
_NEGLIGIBLE = 1e-9

_RESTING = frozenset(
    {
        "on", "standing on", "sitting on", "lying on", "laying on", "walking on", "parked on",
        "riding", "on back of",
    }
)  # fmt: skip

# Each order puts one of two objects first. The first set contains the predicates whose subject is
# first, the second set those whose object is first. Both objects cannot be first. Symmetric
# predicates (near, with, against, attached to, connected to, looking at) are in no order.
ORDERS: tuple[tuple[frozenset[str], frozenset[str]], ...] = (
    # The higher one. An object that hangs on another, or is mounted on it, may be lower.
    (_RESTING | {"above", "over", "higher than"}, frozenset({"under", "below", "lower than"})),
    # The held one, before its holder.
    (
        _RESTING
        | {
            "in", "inside", "standing in", "lying in", "hanging in", "walking in", "flying in",
            "build in", "built in", "supported by", "hanging from", "hanging on", "mounted on",
            "growing on",
        },
        frozenset({"holding", "carrying", "wearing", "wears"}),
    ),
    # The part, before the whole.
    (frozenset({"part of", "belonging to", "of"}), frozenset({"has", "made of"})),
    # The cover, before the covered one.
    (frozenset({"covering", "cover", "painted on"}), frozenset({"covered in"})),
    (frozenset({"in front of", "front"}), frozenset({"behind"})),
    (frozenset({"left", "left of"}), frozenset({"right", "right of"})),
    (frozenset({"bigger than"}), frozenset({"smaller than"})),
)  # fmt: skip


def contradictions(predicates: Sequence[str]) -> Bool:
    """Whether "A r B" contradicts "B s A", for all predicates r and s.

    Args:
        predicates: R names in any case, with blanks or underscores. A name that is in no order
            contradicts nothing.

    Returns:
        (R, R) bool, symmetric.
    """
    names = [name.lower().replace("_", " ") for name in predicates]
    found = np.zeros((len(names), len(names)), np.bool_)
    for order in ORDERS:
        for side in order:
            of_side = np.array([name in side for name in names], np.bool_)
            found |= of_side[:, None] & of_side[None, :]
    return found


class Consistency:
    """The two directions of a pair as one belief without contradictions.

    P(r_ab, r_ba) ∝ p_ab(r_ab) · p_ba(r_ba) · C(r_ab, r_ba), where C is 0 for predicates that
    contradict each other and 1 otherwise. Each edge gets its marginal. If both directions are
    certain and contradict each other, the one with the less likely alternatives prevails. Two
    equal beliefs get half each.

    Args:
        predicates: names, in the order of the distributions.
    """

    def __init__(self, predicates: Sequence[str]) -> None:
        contradictory = contradictions(predicates)
        if contradictory.all():  # no pair of predicates is allowed: there is no joint belief
            contradictory[:] = False
        self._contestable = contradictory.any(axis=0)
        # Predicates that contradict the same ones are of one kind. There are few kinds.
        kinds, firsts, kind_of = np.unique(
            contradictory, axis=0, return_index=True, return_inverse=True
        )
        self._kind_of = kind_of.reshape(-1)
        self._by_kind = np.argsort(self._kind_of, kind="stable")
        self._starts = np.searchsorted(self._kind_of[self._by_kind], np.arange(len(kinds)))
        self._allowed = ~kinds[:, firsts]

    def reconcile(
        self,
        edges: Int64 | Sequence[tuple[int, int]],
        summed_logits: Float64,
        has_visual: Bool,
        fused: FusedEdges,
    ) -> FusedEdges:
        """Fused beliefs in which the directions of a pair do not contradict each other.

        Only pairs with visual evidence in both directions change; of others one direction is
        published (`choose_directions`). The result of a pair does not depend on the other pairs or
        on the order of its directions, to the last bit.

        Args:
            edges: (E, 2) subject and object ids, each directed edge at most once, any order.
            summed_logits: (E, R) float64, the argument of `fuse_edges`.
            has_visual: (E,) bool, likewise.
            fused: the result of `fuse_edges`.
        """
        contested = (fused.probabilities * self._contestable).sum(axis=1)
        first, second = opposite_rows(edges)
        seen = has_visual[first] & has_visual[second]
        chosen = seen & (contested[first] * contested[second] > _NEGLIGIBLE)
        if not chosen.any():
            return fused
        first, second = first[chosen], second[chosen]
        rows = np.concatenate([first, second])
        # Visual distributions come from the logits: they may be so certain that all but one
        # predicate have probability 0.
        logs = np.where(
            (fused.provenance_codes[rows] == _VISUAL)[:, None],
            summed_logits[rows],
            np.log(np.maximum(fused.probabilities[rows], np.finfo(np.float64).tiny)),
        )
        probabilities = fused.probabilities.copy()
        probabilities[rows] = self._marginals(logs, np.roll(logs, len(first), axis=0))
        return replace(fused, probabilities=probabilities)

    def _marginals(self, own: Float64, other: Float64) -> Float64:
        """p_own(r) · Σ_s p_other(s) C(r, s), normalised.

        Args:
            own: (E, R) logarithms, up to a constant of each row.
            other: the same of the opposite directions.
        """
        masses = np.logaddexp.reduceat(other[:, self._by_kind], self._starts, axis=1)
        allowed = np.where(self._allowed, masses[:, None, :], -np.inf)
        greatest = np.maximum(allowed.max(axis=2), np.finfo(np.float64).min)
        with np.errstate(divide="ignore"):  # a kind that contradicts all others
            sums = np.log(np.exp(allowed - greatest[:, :, None]).sum(axis=2)) + greatest
        return visual_distribution(own + sums[:, self._kind_of])
