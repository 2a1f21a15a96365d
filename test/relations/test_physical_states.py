"""The physical states of a pair, their converses, and the predicates that name them."""

from __future__ import annotations

import numpy as np
import pytest

from deworldsg_ros.relations.states import (
    ABOVE,
    AGAINST,
    ATTACHED,
    DIRECTED,
    IN,
    NEAR,
    NONE,
    ON,
    PREDICATES,
    RELATIONS,
    RELATIONS_OF_STATE,
    STATE_COUNT,
    SUPPORTS,
    UNDER,
    canonical_predicates,
    relation_of_predicates,
    states_of_relations,
)
from deworldsg_ros.scene.vocabulary import (
    PREDICATE_SETS,
    REPLICA_SSG_PREDICATES,
    SCANNET_PREDICATES,
)


def named(predicates: tuple[str, ...]) -> dict[str, set[str]]:
    """The names of each relation in a vocabulary."""
    of = relation_of_predicates(predicates).tolist()
    return {
        relation: {name for name, index in zip(predicates, of) if index == row}
        for row, relation in enumerate(RELATIONS[:NONE])
    }


def test_each_state_names_both_directions() -> None:
    assert RELATIONS_OF_STATE.tolist() == [
        [NONE, NONE],
        [ON, NONE], [NONE, ON],
        [IN, NONE], [NONE, IN],
        [ATTACHED, NONE], [NONE, ATTACHED],
        [AGAINST, NONE], [NONE, AGAINST],
        [ABOVE, UNDER], [UNDER, ABOVE],
    ]  # fmt: skip
    assert STATE_COUNT == len(RELATIONS_OF_STATE) == 11


def test_of_two_states_one_is_the_other_seen_from_the_other_end() -> None:
    for state in range(1, STATE_COUNT, 2):
        assert (RELATIONS_OF_STATE[state + 1] == RELATIONS_OF_STATE[state, ::-1]).all()
    assert set(SUPPORTS) < set(DIRECTED)
    assert [RELATIONS[index] for index in DIRECTED] == [
        "on", "in", "attached to", "against", "above",
    ]  # fmt: skip


@pytest.mark.parametrize("count", [0, 1, 4])
def test_states_have_the_logits_of_their_ordered_pairs(count: int) -> None:
    logits = np.random.default_rng(count).normal(size=(2, count, len(DIRECTED)))
    states = states_of_relations(logits)
    assert states.shape == (count, STATE_COUNT) and (states[:, 0] == 0).all()
    for state in range(1, STATE_COUNT):
        relation, end = divmod(state - 1, 2)
        np.testing.assert_array_equal(states[:, state], logits[end, :, relation])
    swapped = states_of_relations(logits[::-1])
    order = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9]
    np.testing.assert_array_equal(swapped, states[:, order])


def test_the_predicates_of_replica_ssg() -> None:
    assert named(REPLICA_SSG_PREDICATES) == {
        "on": {
            "on", "standing on", "sitting on", "lying on", "laying on", "parked on", "on back of",
        },
        "in": {"in"},
        "attached to": {"attached to", "hanging from", "mounted on"},
        "against": {"against"},
        "above": {"above", "over"},
        "under": {"under"},
        "near": {"near", "with"},
    }  # fmt: skip
    canonical = canonical_predicates(REPLICA_SSG_PREDICATES).tolist()
    assert [REPLICA_SSG_PREDICATES[index] for index in canonical] == list(RELATIONS[:NONE])


def test_the_predicates_of_3dssg() -> None:
    assert named(SCANNET_PREDICATES) == {
        "on": {"standing on", "supported by"},
        "in": set(),
        "attached to": {"attached to", "build in", "hanging on"},
        "against": {"connected to"},
        "above": set(),
        "under": set(),
        "near": set(),
    }
    canonical = canonical_predicates(SCANNET_PREDICATES).tolist()
    names = [SCANNET_PREDICATES[index] if index >= 0 else None for index in canonical]
    assert names == ["standing on", None, "attached to", "connected to", None, None, None]


@pytest.mark.parametrize("predicates", [(), *PREDICATE_SETS.values()])
def test_the_name_of_a_relation_is_one_of_its_predicates(predicates: tuple[str, ...]) -> None:
    of, canonical = relation_of_predicates(predicates), canonical_predicates(predicates)
    assert of.shape == (len(predicates),) and canonical.shape == (NONE,)
    for relation, index in enumerate(canonical.tolist()):
        assert of[index] == relation if index >= 0 else relation not in of


def test_spelling_does_not_matter_and_no_name_has_two_relations() -> None:
    assert relation_of_predicates(["Standing_On", "NEAR", "over", "riding", ""]).tolist() == [
        ON, NEAR, ABOVE, -1, -1,
    ]  # fmt: skip
    assert canonical_predicates(["Close_By", "next to"]).tolist() == [-1] * NEAR + [1]
    names = [name for group in PREDICATES for name in group]
    assert len(names) == len(set(names))
