"""Visual evidence and the world model's prior, and how an edge is made of them (Eq. 9-10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from deworldsg_ros.relations.prior import ClassPairPrior
from deworldsg_ros.scene.arrays import Bool, Float64, Int8, Int64

__all__ = [
    "bounded_logits",
    "PROVENANCES",
    "ClassPairPrior",
    "FusedEdge",
    "FusedEdges",
    "Provenance",
    "choose_directions",
    "entropy_nats",
    "fuse_distributions",
    "fuse_edge",
    "fuse_edges",
    "opposite_rows",
    "visual_distribution",
]

Provenance = Literal["visual", "prior", "fused"]

PROVENANCES: tuple[Provenance, ...] = ("visual", "prior", "fused")
_VISUAL, _PRIOR, _FUSED = range(3)

# Of two directions that the prior completed, the one is told whose predicate is more probable by
# this much. The prior is a running mean, of few clips at first: what a probe says of the clips of a
# class pair has a standard deviation of about 0.2, a third of which is left in the fused
# distribution at the paper's weight. With less than what some clips can tell apart, an edge would
# turn round again and again as predictions come in.
DIRECTION_MARGIN = 0.05


def bounded_logits(logits: Float64, outlier_rate: float) -> Float64:
    """A frame's relation logits, if a share of all frames says nothing (beyond the paper).

    log((1 - ε) softmax(ℓ)_r + ε / R): summed like the logits in Eq. 9, but no frame weighs more
    against a predicate than log(1 + R (1 - ε) / ε) nats.

    Args:
        logits: (m, R) float64, pre-sigmoid logits of one frame.
        outlier_rate: ε, from 0 (the paper: the logits as they are) to less than 1.

    Returns:
        (m, R) float64.
    """
    if not outlier_rate or not logits.size:
        return logits
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    told = (1.0 - outlier_rate) * weights / weights.sum(axis=1, keepdims=True)
    bounded: Float64 = np.log(told + outlier_rate / logits.shape[1])
    return bounded


def visual_distribution(summed_logits: Float64) -> Float64:
    """P_vis = Softmax(Σ_t ℓ_t), the visually aggregated relation distribution (Eq. 9).

    Args:
        summed_logits: (..., R) float64, pre-sigmoid logits summed over the frames in which the
            directed pair was seen; zeros where it never was, which gives the uniform distribution.

    Returns:
        (..., R) float64, rows sum to one.
    """
    weights = np.exp(summed_logits - summed_logits.max(axis=-1, keepdims=True))
    distribution: Float64 = weights / weights.sum(axis=-1, keepdims=True)
    return distribution


def entropy_nats(distributions: Float64) -> Float64:
    """Shannon entropy of distributions (..., R), in nats; shape (...)."""
    # The smallest positive float stands in for 0 in the logarithm: 0 log 0 is 0.
    logs = np.log(np.maximum(distributions, np.finfo(np.float64).tiny))
    entropies: Float64 = np.maximum(-(distributions * logs).sum(axis=-1), 0.0)
    return entropies


def fuse_distributions(visual: Float64, prior: Float64, alpha: Float64) -> Float64:
    """P_new ∝ P_vis + α_ij · P_WM, the uncertainty-aware additive fusion (Eq. 10).

    Args:
        visual: (..., R) float64 distributions.
        prior: likewise; not read where alpha is 0.
        alpha: (...) float64, α_ij >= 0; 0 where the prior is not active.

    Returns:
        (..., R) float64, rows sum to one; exactly `visual` where alpha is 0.
    """
    weight = np.asarray(alpha, dtype=np.float64)[..., None]
    mixed = visual + weight * prior
    fused: Float64 = np.where(weight > 0, mixed / mixed.sum(axis=-1, keepdims=True), visual)
    return fused


@dataclass(frozen=True)
class FusedEdge:
    """What is believed of one directed edge.

    Attributes:
        probabilities: (R,) float64, sums to one.
        provenance: where the belief came from.
        entropy_nats: of the visual distribution (uniform where there is no visual evidence).
    """

    probabilities: Float64
    provenance: Provenance
    entropy_nats: float


@dataclass(frozen=True)
class FusedEdges:
    """What is believed of E directed edges; the rows of `FusedEdge`.

    Attributes:
        probabilities: (E, R) float64, rows sum to one.
        provenance_codes: (E,) int8, indices into `PROVENANCES`; meaningless where not known.
        entropies_nats: (E,) float64, of the visual distributions.
        known: (E,) bool, false where there is neither visual evidence nor an active prior: no
            edge.
    """

    probabilities: Float64
    provenance_codes: Int8
    entropies_nats: Float64
    known: Bool

    def __len__(self) -> int:
        return len(self.known)

    def provenances(self) -> list[Provenance]:
        """Where each belief came from."""
        return [PROVENANCES[code] for code in self.provenance_codes.tolist()]


def fuse_edges(
    summed_logits: Float64,
    has_visual: Bool,
    priors: Float64,
    has_prior: Bool,
    alpha: float,
    entropy_threshold_nats: float,
) -> FusedEdges:
    """Beliefs of many directed edges (Eq. 9, the entropy gate, Eq. 10).

    The prior enters where the entropy of P_vis is above the threshold (strictly). Each row's
    result is the same to the last bit whatever other rows are beside it.

    Args:
        summed_logits: (E, R) float64; rows without visual evidence are not read.
        has_visual: (E,) bool.
        priors: (E, R) float64 distributions; rows without a prior are not read.
        has_prior: (E,) bool.
        alpha: α of Eq. 10; 0 leaves the visual distribution.
        entropy_threshold_nats: the paper's 1.0.
    """
    has_visual = np.asarray(has_visual, dtype=np.bool_)
    has_prior = np.asarray(has_prior, dtype=np.bool_)
    visual = visual_distribution(np.where(has_visual[:, None], summed_logits, 0.0))
    entropies = entropy_nats(visual)
    active = has_prior & (entropies > entropy_threshold_nats) & (alpha > 0)
    probabilities = fuse_distributions(
        visual, np.where(active[:, None], priors, 0.0), np.where(active, alpha, 0.0)
    )
    codes = np.where(active, np.where(has_visual, _FUSED, _PRIOR), _VISUAL).astype(np.int8)
    return FusedEdges(probabilities, codes, entropies, has_visual | active)


def fuse_edge(
    visual_logits: Float64 | None,
    prior: Float64 | None,
    alpha: float,
    entropy_threshold_nats: float,
) -> FusedEdge | None:
    """Belief of one directed edge: `fuse_edges` for a single row.

    Args:
        visual_logits: (R,) float64 summed logits, None without visual evidence.
        prior: (R,) float64 distribution of the class pair, None where there is none yet.
        alpha: α of Eq. 10.
        entropy_threshold_nats: as in `fuse_edges`.

    Returns:
        None where there is neither visual evidence nor an active prior: no edge.
    """
    known = visual_logits if visual_logits is not None else prior
    if known is None:
        return None
    empty = np.zeros_like(known)
    fused = fuse_edges(
        (empty if visual_logits is None else visual_logits)[None],
        np.array([visual_logits is not None]),
        (empty if prior is None else prior)[None],
        np.array([prior is not None]),
        alpha,
        entropy_threshold_nats,
    )
    if not fused.known[0]:
        return None
    return FusedEdge(fused.probabilities[0], fused.provenances()[0], float(fused.entropies_nats[0]))


def opposite_rows(edges: Int64 | Sequence[tuple[int, int]]) -> tuple[Int64, Int64]:
    """Rows of the pairs of which both directions are among the edges.

    Args:
        edges: (E, 2) subject and object ids, each directed edge at most once, any order.

    Returns:
        (P,) int64 each: the rows with the smaller subject id, and those of the opposite direction.
    """
    ids = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    low, high = ids.min(axis=1), ids.max(axis=1)
    # Both directions of a pair become neighbours in this order, the smaller subject first.
    order = np.lexsort((ids[:, 0], high, low))
    first, second = order[:-1], order[1:]
    both = (low[first] == low[second]) & (high[first] == high[second])
    return first[both], second[both]


def choose_directions(
    edges: Int64 | Sequence[tuple[int, int]], has_visual: Bool, probabilities: Float64
) -> Bool:
    """Which directed edges are published, where the prior has completed pairs.

    The prior completes both directions of a pair, usually with a predicate and something like its
    inverse. A direction that nothing was seen of is told only where nothing was seen of the other
    either, and then only the one whose most probable predicate is clearly more probable (by 0.05);
    where neither is, the one with the smaller subject id.

    Args:
        edges: (E, 2) subject and object ids, each directed edge at most once, any order.
        has_visual: (E,) bool.
        probabilities: (E, R) float64 fused distributions.

    Returns:
        (E,) bool; true for every edge with visual evidence, or whose reverse is not among the
        edges.
    """
    first, second = opposite_rows(edges)
    kept = np.ones(len(has_visual), dtype=np.bool_)
    seen_first, seen_second = has_visual[first], has_visual[second]
    greatest = probabilities.max(axis=1)
    # Where neither was seen, one goes; where one was, the other goes; where both were, both stay.
    second_wins = greatest[second] > greatest[first] + DIRECTION_MARGIN
    kept[first] = seen_first | (~seen_second & ~second_wins)
    kept[second] = seen_second | (~seen_first & second_wins)
    return kept
