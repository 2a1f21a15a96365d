"""Visual evidence and the world model's prior, and how an edge combines them (Eq. 9-10)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float64, Int8
from deworldsg_ros.scene.softmax import SoftmaxWeights, softmax, softmax_weights
from deworldsg_ros.scene.wire import Provenance

PROVENANCES: tuple[Provenance, ...] = ("visual", "prior", "fused")
_VISUAL, _PRIOR, _FUSED = range(3)

# Fraction of frames whose relation logits are outliers (`edge_belief: robust`). Relation heads are
# wrong in 10 to 20 % of the frames (docs/dev/notebook.md). From 0.2 on, one confident frame
# would leave more than 1 nat of entropy among 50 predicates, and the prior would enter every pair
# that was seen once.
OUTLIER_RATE = 0.1


def bounded_logits(
    logits: Float64, outlier_rate: float, weights: SoftmaxWeights | None = None
) -> Float64:
    """A frame's relation logits if a fraction of all frames are outliers (beyond the paper).

    log((1 - ε) softmax(ℓ)_r + ε / R). They are summed like the logits in Eq. 9, but the evidence of
    one frame against a predicate is at most log(1 + R (1 - ε) / ε) nats.

    Args:
        logits: (m, R) float64, pre-sigmoid logits of one frame.
        outlier_rate: ε, between 0 and 1.
        weights: those of the logits, if they are known.

    Returns:
        (m, R) float64.
    """
    if not logits.size:
        return logits
    _, exponentials, totals = weights or softmax_weights(logits)
    inliers = (1.0 - outlier_rate) * exponentials / totals
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
    distribution: Float64 = softmax(summed_logits)
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
