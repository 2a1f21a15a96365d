"""Visual evidence and the world model's prior, and how an edge combines them (Eq. 9-10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from deworldsg_ros.scene.arrays import Bool, Float64, Int8, Int64
from deworldsg_ros.scene.wire import Provenance

PROVENANCES: tuple[Provenance, ...] = ("visual", "prior", "fused")
_VISUAL, _PRIOR, _FUSED = range(3)

# Fraction of frames whose relation logits are outliers (`edge_belief: robust`). Relation heads are
# wrong in 10 to 20 % of the frames (docs/dev/notebook.md). From 0.2 on, one confident frame
# would leave more than 1 nat of entropy among 50 predicates, and the prior would enter every pair
# that was seen once.
OUTLIER_RATE = 0.1

# If the prior completed both directions of a pair, one is published: the second one only if its
# best predicate is more probable by this margin. Predictions for the clips of one class pair have a
# standard deviation of about 0.2. At the paper's weight, a third of it remains in the fused
# distribution. With a smaller margin than a few clips can resolve, an edge would change its
# direction again and again while predictions arrive.
DIRECTION_MARGIN = 0.05


def bounded_logits(logits: Float64, outlier_rate: float) -> Float64:
    """A frame's relation logits if a fraction of all frames are outliers (beyond the paper).

    log((1 - ε) softmax(ℓ)_r + ε / R). They are summed like the logits in Eq. 9, but the evidence of
    one frame against a predicate is at most log(1 + R (1 - ε) / ε) nats.

    Args:
        logits: (m, R) float64, pre-sigmoid logits of one frame.
        outlier_rate: ε, between 0 and 1.

    Returns:
        (m, R) float64.
    """
    if not logits.size:
        return logits
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    inliers = (1.0 - outlier_rate) * weights / weights.sum(axis=1, keepdims=True)
    bounded: Float64 = np.log(inliers + outlier_rate / logits.shape[1])
    return bounded


def visual_distribution(summed_logits: Float64) -> Float64:
    """P_vis = Softmax(Σ_t ℓ_t), the visually aggregated relation distribution (Eq. 9).

    Args:
        summed_logits: (..., R) float64, logits summed over the frames in which the directed pair
            was seen; zeros for a pair that was never seen, which gives the uniform distribution.

    Returns:
        (..., R) float64, rows sum to one.
    """
    distribution: Float64 = softmax(summed_logits, axis=-1)
    return distribution


def entropy_nats(distributions: Float64) -> Float64:
    """Shannon entropy of distributions (..., R), in nats; shape (...)."""
    # The smallest positive float replaces 0 in the logarithm: 0 log 0 is 0.
    logs = np.log(np.maximum(distributions, np.finfo(np.float64).tiny))
    entropies: Float64 = np.maximum(-(distributions * logs).sum(axis=-1), 0.0)
    return entropies


def fuse_distributions(visual: Float64, prior: Float64, alpha: Float64) -> Float64:
    """P_new ∝ P_vis + α_ij · P_WM, the uncertainty-aware additive fusion (Eq. 10).

    Args:
        visual: (..., R) float64 distributions.
        prior: the same; ignored if alpha is 0.
        alpha: (...) float64, α_ij >= 0; 0 if the prior is not active.

    Returns:
        (..., R) float64, rows sum to one; exactly `visual` if alpha is 0.
    """
    weight = np.asarray(alpha, dtype=np.float64)[..., None]
    mixed = visual + weight * prior
    fused: Float64 = np.where(weight > 0, mixed / mixed.sum(axis=-1, keepdims=True), visual)
    return fused


@dataclass(frozen=True)
class FusedEdges:
    """Beliefs of E directed edges.

    Attributes:
        probabilities: (E, R) float64, rows sum to one.
        provenance_codes: (E,) int8, indices into `PROVENANCES`; meaningless if not known.
        entropies_nats: (E,) float64, of the visual distributions (uniform without evidence).
        known: (E,) bool; false = neither visual evidence nor an active prior, so no edge.
    """

    probabilities: Float64
    provenance_codes: Int8
    entropies_nats: Float64
    known: Bool


def fuse_edges(
    summed_logits: Float64,
    has_visual: Bool,
    priors: Float64,
    has_prior: Bool,
    alpha: float,
    entropy_threshold_nats: float,
) -> FusedEdges:
    """Beliefs of many directed edges (Eq. 9, the entropy gate, Eq. 10).

    The prior enters if the entropy of P_vis is above the threshold (strictly). The result of a row
    does not depend on the other rows, to the last bit.

    Args:
        summed_logits: (E, R) float64; rows without visual evidence are ignored.
        has_visual: (E,) bool.
        priors: (E, R) float64 distributions; rows without a prior are ignored.
        has_prior: (E,) bool.
        alpha: α of Eq. 10; 0 = the visual distribution only.
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


def opposite_rows(edges: Int64 | Sequence[tuple[int, int]]) -> tuple[Int64, Int64]:
    """Rows of the pairs with both directions among the edges.

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
    """Which directed edges are published, if the prior completed pairs.

    The prior completes both directions of a pair, usually with a predicate and a similar inverse.
    A direction without visual evidence is published only if the other direction has none either.
    Of two such directions, one is published: the one whose best predicate is more probable by
    `DIRECTION_MARGIN`, otherwise the one with the smaller subject id.

    Args:
        edges: (E, 2) subject and object ids, each directed edge at most once, any order.
        has_visual: (E,) bool.
        probabilities: (E, R) float64 fused distributions.

    Returns:
        (E,) bool; true for every edge with visual evidence, and for every edge whose reverse is
        not among the edges.
    """
    first, second = opposite_rows(edges)
    kept = np.ones(len(has_visual), dtype=np.bool_)
    seen_first, seen_second = has_visual[first], has_visual[second]
    greatest = probabilities.max(axis=1)
    # Neither was seen: one stays. One was seen: that one stays. Both were seen: both stay.
    second_wins = greatest[second] > greatest[first] + DIRECTION_MARGIN
    kept[first] = seen_first | (~seen_second & ~second_wins)
    kept[second] = seen_second | (~seen_first & second_wins)
    return kept
