"""Two directions of a pair that do not contradict each other, against the joint belief itself."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.relations import provenances

from deworldsg_ros.relations.consistency import ORDERS, Consistency, contradictions
from deworldsg_ros.relations.evidence import entropy_nats, fuse_edges, visual_distribution
from deworldsg_ros.scene.vocabularies import PREDICATE_SETS, REPLICA_SSG_PREDICATES

PREDICATES = ("near", "on", "in", "above", "under", "with", "flurbs")
NEAR, ON, IN, ABOVE, UNDER, WITH, FLURBS = range(7)
WIDTH = len(PREDICATES)
seeds = st.integers(0, 10_000)


def reference(forward, backward, predicates):
    """Both marginals of the joint belief, a state at a time."""
    contradictory = contradictions(predicates)
    joint = {
        (r, s): p * q
        for r, p in enumerate(forward)
        for s, q in enumerate(backward)
        if not contradictory[r, s]
    }
    whole = sum(joint.values())
    ways = range(len(predicates))
    return [
        [sum(p for state, p in joint.items() if state[side] == r) / whole for r in ways]
        for side in (0, 1)
    ]


def logits_of(**certainties):
    """Summed logits (R,) of the predicates named, zeros for the others."""
    logits = np.zeros(WIDTH)
    for name, value in certainties.items():
        logits[PREDICATES.index(name)] = value
    return logits


def reconciled(edges, logits, seen=None, priors=None, told=None, predicates=PREDICATES):
    """(E, R) distributions after fusion, and (E, R) without the joint belief."""
    logits = np.array(logits, float).reshape(len(edges), len(predicates))
    seen = np.ones(len(edges), bool) if seen is None else np.array(seen)
    priors = np.zeros_like(logits) if priors is None else priors
    told = np.zeros(len(edges), bool) if told is None else np.array(told)
    fused = fuse_edges(logits, seen, priors, told, 0.5, 1.0)
    after = Consistency(predicates).reconcile(edges, logits, seen, fused)
    assert (after.provenance_codes == fused.provenance_codes).all()
    assert (after.entropies_nats == fused.entropies_nats).all()
    return after.probabilities, fused.probabilities


def random_pairs(seed):
    """Edges among five nodes, some of them in both directions, in any order."""
    generator = np.random.default_rng(seed)
    edges = [(a, b) for a in range(5) for b in range(5) if a != b and generator.random() < 0.7]
    edges = [edges[row] for row in generator.permutation(len(edges))]
    logits = generator.normal(0, 3, (len(edges), WIDTH))
    priors = generator.dirichlet(np.ones(WIDTH), len(edges))
    seen, told = generator.random((2, len(edges))) < 0.6
    return edges, logits, seen, priors, told


@pytest.mark.parametrize(
    ("one", "other", "contradictory"),
    [
        ("on", "on", True),
        ("in", "in", True),
        ("on", "in", True),
        ("on", "above", True),
        ("above", "above", True),
        ("under", "under", True),
        ("above", "under", False),
        ("on", "under", False),
        ("in", "under", False),
        ("in", "above", False),  # a cup in a cabinet whose middle is above it
        ("near", "near", False),
        ("with", "near", False),
        ("near", "on", False),
        ("attached to", "attached to", False),
        ("against", "against", False),
        ("hanging from", "above", False),  # a lamp, the ceiling above it
        ("hanging from", "hanging from", True),
        ("standing on", "supported by", True),
        ("part of", "part of", True),
        ("part of", "has", False),
        ("has", "has", True),
        ("wearing", "on", False),
        ("wearing", "carrying", True),
        ("covered in", "covered in", True),
        ("covered in", "covering", False),
        ("behind", "behind", True),
        ("behind", "in front of", False),
        ("left", "left", True),
        ("left", "right", False),
        ("In_Front_Of", "in front of", True),
        ("flurbs", "flurbs", False),
    ],
)
def test_contradictory_predicates(one, other, contradictory):
    assert contradictions([one, other])[0, 1] == contradictory
    assert contradictions([other, one])[0, 1] == contradictory


@pytest.mark.parametrize("predicates", [*PREDICATE_SETS.values(), ()])
def test_it_contradicts_both_ways(predicates):
    found = contradictions(predicates)
    assert found.shape == (len(predicates),) * 2 and (found == found.T).all()


def test_no_predicate_is_on_both_sides_of_an_order():
    for first, second in ORDERS:
        assert not first & second


def test_nothing_that_is_annotated_contradicts(shared_dir: Path) -> None:
    column = {name: place for place, name in enumerate(REPLICA_SSG_PREDICATES)}
    contradictory = contradictions(REPLICA_SSG_PREDICATES)
    content = json.loads((shared_dir / "data/replica_ssg/relationships.json").read_text())
    both_ways = 0
    for scan in content["scans"]:
        stated = {(line[0], line[1]): column[line[3]] for line in scan["relationships"]}
        for (subject, object_), predicate in stated.items():
            other = stated.get((object_, subject))
            if other is not None:
                both_ways += 1
                assert not contradictory[predicate, other]
    assert both_ways > 100


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_edges_equal_the_reference(seed):
    edges, logits, seen, priors, told = random_pairs(seed)
    after, before = reconciled(edges, logits, seen, priors, told)
    for row, (a, b) in enumerate(edges):
        other = edges.index((b, a)) if (b, a) in edges else None
        if other is None or not (seen[row] and seen[other]):
            assert (after[row] == before[row]).all()
            continue
        wanted = reference(before[row], before[other], PREDICATES)[0]
        np.testing.assert_allclose(after[row], wanted, rtol=1e-10, atol=1e-9)
        assert after[row].sum() == pytest.approx(1, abs=1e-12)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_a_pair_does_not_depend_on_the_other_pairs_to_the_last_bit(seed):
    edges, logits, seen, priors, told = random_pairs(seed)
    whole, _ = reconciled(edges, logits, seen, priors, told)
    for row, (a, b) in enumerate(edges):
        rows = [place for place, edge in enumerate(edges) if set(edge) == {a, b}]
        alone, _ = reconciled(
            [edges[place] for place in rows], logits[rows], seen[rows], priors[rows], told[rows]
        )
        assert (alone[rows.index(row)] == whole[row]).all()


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_names_of_nodes_and_order_of_edges_do_not_matter(seed):
    edges, logits, seen, priors, told = random_pairs(seed)
    generator = np.random.default_rng(seed)
    names, order = generator.permutation(9), generator.permutation(len(edges))
    whole, _ = reconciled(edges, logits, seen, priors, told)
    renamed = [(int(names[a]), int(names[b])) for a, b in edges]
    other, _ = reconciled(
        [renamed[row] for row in order], logits[order], seen[order], priors[order], told[order]
    )
    assert (other == whole[order]).all()


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_unknown_predicates_change_nothing(seed):
    edges, logits, seen, priors, told = random_pairs(seed)
    names = tuple(f"predicate_{place}" for place in range(WIDTH))
    after, before = reconciled(edges, logits, seen, priors, told, names)
    assert (after == before).all()


BOTH = [(1, 2), (2, 1)]


def test_two_certain_contradictory_edges_become_half_and_half():
    after, _ = reconciled(BOTH, [logits_of(on=5000, near=4000)] * 2)
    for row in after:
        assert row[ON] == row[NEAR] == pytest.approx(0.5)
        assert entropy_nats(row) == pytest.approx(math.log(2))


def test_the_direction_with_the_less_likely_alternative_prevails():
    """Both as certain as numbers get; the second would rather be something else."""
    after, before = reconciled(BOTH, [logits_of(on=5000, near=3000), logits_of(on=5000, near=3010)])
    assert (before[:, ON] == 1).all()
    assert after[0, ON] == pytest.approx(1, abs=1e-4)
    assert after[1, NEAR] == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(("one", "other"), [("above", "under"), ("near", "with"), ("on", "under")])
def test_certain_edges_that_agree_stay(one, other):
    after, before = reconciled(BOTH, [logits_of(**{one: 40}), logits_of(**{other: 40})])
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_a_direction_that_was_not_seen_has_no_say():
    prior = np.full((2, WIDTH), 0.01)
    prior[:, ON] = 1 - 0.01 * (WIDTH - 1)
    after, before = reconciled(
        BOTH, [logits_of(on=9), np.zeros(WIDTH)], [True, False], prior, [False, True]
    )
    assert (after == before).all()


def test_a_vocabulary_of_contradictions_only_changes_nothing():
    after, before = reconciled(BOTH, [[3.0, 1.0], [2.0, 2.5]], predicates=("on", "in"))
    assert (after == before).all()


def test_a_predicate_that_contradicts_all_others_gets_probability_zero():
    after, _ = reconciled(BOTH, [[9.0, 0, 0], [1.0, 0, 0]], predicates=("on", "above", "in"))
    assert (after[:, 0] == 0).all() and after.sum(axis=1) == pytest.approx(1)


def test_no_edges():
    after, _ = reconciled([], [])
    assert after.shape == (0, WIDTH)


def test_the_entropy_gate_treats_each_direction_separately() -> None:
    """Two certain directions that contradict are no call for the prior (Eq. 10)."""
    logits = np.array([logits_of(on=40), logits_of(on=40)])
    prior = np.full((2, WIDTH), 1 / WIDTH)
    fused = fuse_edges(logits, np.ones(2, bool), prior, np.ones(2, bool), 0.5, 1.0)
    after = Consistency(PREDICATES).reconcile(BOTH, logits, np.ones(2, bool), fused)
    assert provenances(after) == ["visual", "visual"]
    assert (after.entropies_nats == entropy_nats(visual_distribution(logits))).all()
