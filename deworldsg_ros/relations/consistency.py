"""Which predicates of a pair's two directions contradict each other, and what follows from it."""

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

# A pair with less than this probability of a contradiction is left as it is.
NEGLIGIBLE = 1e-9

_RESTING = frozenset(
    {
        "on", "standing on", "sitting on", "lying on", "laying on", "walking on", "parked on",
        "riding", "on back of",
    }
)  # fmt: skip

# Orders in which one of two objects is first: names by which the subject is, and by which the
# object is. Not both can be first. What holds both ways (near, with, against, attached to,
# connected to, looking at) and what says nothing of an order is in none.
ORDERS: tuple[tuple[frozenset[str], frozenset[str]], ...] = (
    # The higher one. What hangs on something, or is mounted on it, may well be lower.
    (_RESTING | {"above", "over", "higher than"}, frozenset({"under", "below", "lower than"})),
    # The one that is held, by the one that holds it.
    (
        _RESTING
        | {
            "in", "inside", "standing in", "lying in", "hanging in", "walking in", "flying in",
            "build in", "built in", "supported by", "hanging from", "hanging on", "mounted on",
            "growing on",
        },
        frozenset({"holding", "carrying", "wearing", "wears"}),
    ),
    # The part, of the whole.
    (frozenset({"part of", "belonging to", "of"}), frozenset({"has", "made of"})),
    # What covers, and what is covered.
    (frozenset({"covering", "cover", "painted on"}), frozenset({"covered in"})),
    (frozenset({"in front of", "front"}), frozenset({"behind"})),
    (frozenset({"left", "left of"}), frozenset({"right", "right of"})),
    (frozenset({"bigger than"}), frozenset({"smaller than"})),
)  # fmt: skip


def contradictions(predicates: Sequence[str]) -> Bool:
    """Whether A r B contradicts B s A, by names.

    Args:
        predicates: R names, in any case, with blanks or underscores; a name that is in no order
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
    """The two directions of a pair as one belief, in which contradictions have no place.

    P(r_ab, r_ba) ∝ p_ab(r_ab) · p_ba(r_ba) · C(r_ab, r_ba), where C is 0 for predicates that
    contradict each other and 1 for others. An edge gets its marginal, and so of two certain but
    contradictory predicates the one whose alternatives are less likely; equals get half each.

    Args:
        predicates: names, in the order of the distributions.
    """

    def __init__(self, predicates: Sequence[str]) -> None:
        contradictory = contradictions(predicates)
        if contradictory.all():  # nothing goes together: there is no joint belief
            contradictory[:] = False
        self._contestable = contradictory.any(axis=0)
        # Predicates that contradict the same ones are of one kind: few kinds stand for many names.
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

        Only pairs of which both directions were seen are touched: of others one direction is told
        (`choose_directions`). Each pair's result is the same to the last bit whatever other pairs
        are beside it, and whichever of its directions comes first.

        Args:
            edges: (E, 2) subject and object ids, each directed edge at most once, any order.
            summed_logits: (E, R) float64, as `fuse_edges` had them.
            has_visual: (E,) bool, likewise.
            fused: what `fuse_edges` made of them.
        """
        contested = (fused.probabilities * self._contestable).sum(axis=1)
        first, second = opposite_rows(edges)
        seen = has_visual[first] & has_visual[second]
        chosen = seen & (contested[first] * contested[second] > NEGLIGIBLE)
        if not chosen.any():
            return fused
        first, second = first[chosen], second[chosen]
        rows = np.concatenate([first, second])
        # The visual distributions out of the logits themselves, for they may be so certain that
        # all but one predicate have probability 0.
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
        with np.errstate(divide="ignore"):  # a kind that contradicts all others has no chance
            sums = np.log(np.exp(allowed - greatest[:, :, None]).sum(axis=2)) + greatest
        return visual_distribution(own + sums[:, self._kind_of])
