"""The physical states of a pair of objects, and the predicates that name them.

A pair is in one state: not related, or one of five relations in one of two directions. A state
fixes the relation in both directions: if A is above B, then B is under A.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.predicates import PREDICATES, plain

# Relations of an ordered pair. The first five are the columns of the physical model.
ON, IN, ATTACHED, AGAINST, ABOVE, UNDER, NEAR, NONE = range(8)
RELATIONS = ("on", "in", "attached to", "against", "above", "under", "near", "none")
# Relations in which the object carries, contains or holds the subject. There is one at most.
SUPPORTS = (ON, IN, ATTACHED)
DIRECTED = (ON, IN, ATTACHED, AGAINST, ABOVE)
_CONVERSE = {ABOVE: UNDER}

# State 0: not related. State 1 + 2 d: relation DIRECTED[d] of first and second. State 2 + 2 d: of
# second and first.
STATE_COUNT = 1 + 2 * len(DIRECTED)
# Relation of (first, second) and of (second, first) in each state, (STATE_COUNT, 2).
RELATIONS_OF_STATE: Int64 = np.array(
    [(NONE, NONE)]
    + [
        ends
        for relation in DIRECTED
        for ends in (
            (relation, _CONVERSE.get(relation, NONE)),
            (_CONVERSE.get(relation, NONE), relation),
        )
    ],
    np.int64,
)


def relation_of_predicates(predicates: Sequence[str]) -> Int64:
    """Relation of each predicate name, (R,) int64; -1 = it names no physical relation."""
    of_name = {name: index for index, names in enumerate(PREDICATES) for name in names}
    return np.array([of_name.get(plain(name), -1) for name in predicates], np.int64)


def canonical_predicates(predicates: Sequence[str]) -> Int64:
    """Index of the predicate that names each relation but NONE, (7,) int64; -1 = there is none."""
    known = {plain(name): index for index, name in reversed(list(enumerate(predicates)))}
    chosen = [[known[name] for name in names if name in known] for names in PREDICATES]
    return np.array([indices[0] if indices else -1 for indices in chosen], np.int64)


def states_of_relations(relations: Float64) -> Float64:
    """Logits of the states from logits of ordered pairs.

    Args:
        relations: (2, m, len(DIRECTED)) logits of first and second, and of second and first,
            relative to "not related".

    Returns:
        (m, STATE_COUNT), 0 for "not related".
    """
    states = np.zeros((relations.shape[1], STATE_COUNT))
    states[:, 1::2], states[:, 2::2] = relations[0], relations[1]
    return states
