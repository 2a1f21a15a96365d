"""Eq. 9, the entropy gate, Eq. 10 and the choice of a direction, against obvious references."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.relations import fuse_edge, provenances

from deworldsg_ros.relations.paper import (
    PROVENANCES,
    entropy_nats,
    fuse_distributions,
    fuse_edges,
    visual_distribution,
)

seeds = st.integers(0, 10_000)


def random_edges(seed, edges=7, predicates=5):
    generator = np.random.default_rng(seed)
    logits = generator.normal(0, 2, (edges, predicates))
    priors = generator.dirichlet(np.ones(predicates), edges)
    return logits, generator.random(edges) < 0.6, priors, generator.random(edges) < 0.6


def reference(logits, prior, alpha, threshold):
    """Eq. 9 and 10 for one edge, in plain Python."""
    width = len(prior if logits is None else logits)
    exponentials = [math.exp(value) for value in ([0.0] * width if logits is None else logits)]
    visual = [value / sum(exponentials) for value in exponentials]
    entropy = -sum(p * math.log(p) for p in visual if p > 0)
    if prior is None or alpha == 0 or not entropy > threshold:
        return None if logits is None else (visual, "visual", entropy)
    mixed = [v + alpha * p for v, p in zip(visual, prior)]
    fused = [value / sum(mixed) for value in mixed]
    return fused, "prior" if logits is None else "fused", entropy


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from([0.0, 0.5, 3.0]), st.sampled_from([0.0, 1.0, 1.5, 5.0]))
def test_fuse_edge_equals_the_reference(seed, alpha, threshold):
    for logits, seen, prior, told in zip(*random_edges(seed)):
        args = (logits if seen else None, prior if told else None)
        if not seen and not told:
            assert fuse_edge(None, None, alpha, threshold) is None
            continue
        wanted = reference(*args, alpha, threshold)
        edge = fuse_edge(*args, alpha, threshold)
        if wanted is None:
            assert edge is None
            continue
        np.testing.assert_allclose(edge.probabilities, wanted[0], rtol=1e-12)
        assert edge.provenance == wanted[1]
        assert edge.entropy_nats == pytest.approx(wanted[2], abs=1e-12)


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(1, 60))
def test_a_row_does_not_depend_on_the_other_rows(seed, predicates):
    """Changes and snapshots are computed over different sets of edges and must agree exactly."""
    logits, seen, priors, told = random_edges(seed, 9, predicates)
    fused = fuse_edges(logits, seen, priors, told, 0.5, 1.0)
    for row in range(len(fused.known)):
        edge = fuse_edge(
            logits[row] if seen[row] else None, priors[row] if told[row] else None, 0.5, 1.0
        )
        assert (edge is not None) == fused.known[row]
        if edge is not None:
            assert (edge.probabilities == fused.probabilities[row]).all()
            assert edge.provenance == provenances(fused)[row]
            assert edge.entropy_nats == fused.entropies_nats[row]


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_results_are_distributions_and_follow_a_permutation_of_predicates(seed):
    logits, seen, priors, told = random_edges(seed)
    order = np.random.default_rng(seed).permutation(logits.shape[1])
    fused = fuse_edges(logits, seen, priors, told, 0.5, 1.0)
    permuted = fuse_edges(logits[:, order], seen, priors[:, order], told, 0.5, 1.0)
    np.testing.assert_allclose(fused.probabilities.sum(axis=1), 1.0, rtol=1e-12)
    assert (fused.probabilities >= 0).all()
    np.testing.assert_allclose(permuted.probabilities, fused.probabilities[:, order], rtol=1e-12)
    assert (permuted.provenance_codes == fused.provenance_codes).all()


def test_no_edges():
    fused = fuse_edges(
        np.zeros((0, 3)), np.zeros(0, bool), np.zeros((0, 3)), np.zeros(0, bool), 0.5, 1
    )
    assert (
        len(fused.known) == 0 and fused.probabilities.shape == (0, 3) and provenances(fused) == []
    )


def test_alpha_of_zero_leaves_the_visual_distribution():
    logits, _, priors, _ = random_edges(1)
    everywhere = np.ones(len(logits), bool)
    fused = fuse_edges(logits, everywhere, priors, everywhere, 0.0, 0.0)
    assert (fused.probabilities == visual_distribution(logits)).all()
    assert set(provenances(fused)) == {"visual"}
    assert fuse_edge(None, priors[0], 0.0, 0.0) is None


def test_gate_is_strict_at_the_threshold():
    logits, prior = np.array([0.3, 0.1, -0.2]), np.array([0.7, 0.2, 0.1])
    entropy = float(entropy_nats(visual_distribution(logits)))
    assert fuse_edge(logits, prior, 0.5, entropy).provenance == "visual"
    below = math.nextafter(entropy, 0)
    edge = fuse_edge(logits, prior, 0.5, below)
    assert edge.provenance == "fused"
    visual = visual_distribution(logits)
    np.testing.assert_allclose(edge.probabilities, (visual + 0.5 * prior) / 1.5, rtol=1e-14)


def test_strong_visual_evidence_is_not_overridden():
    edge = fuse_edge(np.array([9.0, 0, 0, 0]), np.array([0, 0, 0, 1.0]), 100.0, 1.0)
    assert edge.provenance == "visual" and edge.probabilities.argmax() == 0


def test_pair_without_visual_evidence_is_completed_by_the_prior():
    edge = fuse_edge(None, np.array([0.6, 0.4, 0.0]), 0.5, 1.0)
    assert edge.provenance == "prior"
    assert edge.entropy_nats == pytest.approx(math.log(3))
    np.testing.assert_allclose(edge.probabilities, (1 / 3 + 0.5 * np.array([0.6, 0.4, 0])) / 1.5)


def test_ambiguous_edge_without_a_prior_stays_visual():
    assert fuse_edge(np.zeros(4), None, 0.5, 1.0).provenance == "visual"


def test_without_evidence_and_prior_there_is_no_edge():
    assert fuse_edge(None, None, 0.5, 1.0) is None
    # Two predicates cannot be less certain than ln 2: the prior stays inactive.
    assert fuse_edge(None, np.array([0.9, 0.1]), 0.5, 1.0) is None


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3, 1e6])
def test_visual_distribution_is_stable(scale):
    distribution = visual_distribution(scale * np.array([[1.0, -1.0, 0.5], [-1.0, -1.0, -1.0]]))
    assert np.isfinite(distribution).all()
    np.testing.assert_allclose(distribution.sum(axis=1), 1.0)


def test_no_evidence_is_uniform_and_a_common_offset_does_not_matter():
    assert (visual_distribution(np.zeros(4)) == 0.25).all()
    logits = np.array([2.0, 0.0, -1.0])
    np.testing.assert_allclose(visual_distribution(logits + 500), visual_distribution(logits))


@pytest.mark.parametrize(
    ("distribution", "wanted"),
    [([1.0, 0, 0], 0.0), ([0.5, 0.5, 0], math.log(2)), ([0.25] * 4, math.log(4))],
)
def test_entropy_in_nats(distribution, wanted):
    assert entropy_nats(np.array(distribution)) == pytest.approx(wanted, abs=1e-15)


def test_more_alpha_means_more_prior():
    visual, prior = np.full(3, 1 / 3), np.array([1.0, 0, 0])
    first = [fuse_distributions(visual, prior, np.array(a))[0] for a in (0.0, 0.5, 1.0, 10.0)]
    assert first == sorted(first) and first[0] == pytest.approx(1 / 3) and first[-1] < 1


def test_every_provenance_occurs():
    logits, seen, priors, told = random_edges(0, edges=60)
    fused = fuse_edges(0.3 * logits, seen, priors, told, 0.5, 1.0)
    known = [name for name, known in zip(provenances(fused), fused.known) if known]
    assert set(known) == set(PROVENANCES)
