"""The physical states of a pair, and the predicates that name them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.vocabulary import PREDICATES, plain

# --- The physical states of a pair of objects, and the predicates that name them.
#
# A pair is in one state: not related, or one of five relations in one of two directions. A state
# fixes the relation in both directions: if A is above B, then B is under A.

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


# --- The predicates of a pair, from the probabilities of its relations and the votes on it.

# Several predicates may name one relation, and share its probability by their votes. The default
# name gets these votes in addition, so that a relation without votes has a name.
NAMING_VOTES = 0.5
# Least sum of votes for a predicate that names no physical relation. Less is no evidence: a frame
# that votes gives every predicate a small probability.
MIN_OTHER_VOTES = 0.5
# Odds, before any vote, that a predicate beyond the physical relations holds.
OTHER_ODDS = 0.02
# Evidence in nats is limited to this: odds are finite.
MAX_EVIDENCE = 30.0
# Pairs that are related with a smaller probability have no beliefs: no edge would be published.
MIN_RELATED = 0.01
# An edge is published if its best predicate has at least this probability.
MIN_PROBABILITY = 0.2
# A symmetric relation is sent once a pair if its probabilities in both directions differ by less.
SAME_PROBABILITY = 0.01
# Probabilities are rounded to this many decimals, so that a tiny change makes no new message.
DECIMALS = 3
_SCALE = 10.0**DECIMALS


@kernel
def related_pairs(  # noqa: D417
    rows: Int64, relations: Float64, other_votes: Float64
) -> Bool:
    """Whether pairs may be related, or have votes beyond the physical relations; (k,) bool.

    Args:
        rows: (k,) of the pairs.
        relations, other_votes: see `PairRows`.
    """
    related = np.empty(len(rows), np.bool_)
    for index in range(len(rows)):
        row = rows[index]
        free = min(relations[row, 0, NONE], relations[row, 1, NONE])
        related[index] = free < 1.0 - MIN_RELATED or other_votes[row] >= MIN_OTHER_VOTES
    return related


@kernel
def predicate_probabilities(
    rows: Int64,
    relations: Float64,
    votes: Float64,
    frames: Float64,
    by_votes: Float64,
    with_: Bool,
    relation_of: Int64,
    canonical: Int64,
    with_index: int,
    scales: Float64,
) -> tuple[Float64, Bool]:
    """Probabilities (k, 2, R) of the predicates in both directions, and (k, 2) bool: any votes.

    Each relation's probability is divided among its predicates by their votes. Without votes, a
    relation has the name that comes first in `PREDICATES`; a table is "with" the seats that are
    near it. Predicates that name no physical relation live from votes alone, which are believed as
    those on "on" are.

    Args:
        rows: (k,) of the pairs.
        relations: (m, 2, NONE + 1) probabilities.
        votes: (k, 2, R) sums of the votes; they count as float32.
        frames: (m,) number of frames that showed both.
        by_votes: (m,) exponent of the votes.
        with_: (m, 2) bool; a table and a seat in its reach.
        relation_of: (R,) relation of each predicate; -1 = it names none.
        canonical: (NONE,) predicate that names each relation; -1 = there is none.
        with_index: of the predicate "with"; -1 = there is none.
        scales: (4,) of `VoteScales`.
    """
    count, _, width = votes.shape
    result, voted = np.zeros((count, 2, width)), np.zeros((count, 2), np.bool_)
    sums, told = np.empty(NONE), np.empty(width, np.float32)
    for index in range(count):
        row = rows[index]
        for end in range(2):
            out = result[index, end]
            sums[:], others = NAMING_VOTES, 0.0
            for name in range(width):
                told[name] = votes[index, end, name]
                voted[index, end] |= told[name] != 0.0
                if relation_of[name] >= 0:
                    sums[relation_of[name]] += told[name]
                elif told[name] > others:
                    others = told[name]
            for name in range(width):
                relation = relation_of[name]
                if relation >= 0 and canonical[relation] >= 0:
                    out[name] = relations[row, end, relation] * told[name] / sums[relation]
            for relation in range(NONE):
                is_with = relation == NEAR and with_index >= 0 and with_[row, end]
                name = with_index if is_with else canonical[relation]
                if canonical[relation] >= 0:
                    out[name] += relations[row, end, relation] * NAMING_VOTES / sums[relation]
            if others >= MIN_OTHER_VOTES:
                free = relations[row, end, NONE]
                _add_others(out, free, told, frames[row], by_votes[row], relation_of, scales)
    return result, voted


@kernel
def _add_others(
    out: Float64,
    free: float,
    votes: Float32,
    frames: float,
    by_votes: float,
    relation_of: Int64,
    scales: Float64,
) -> None:
    """Probabilities of the predicates that name no physical relation, of a pair that is `free`."""
    slope, n_half, low, even = scales
    worth = frames / (frames + n_half) * slope * by_votes
    total = 1.0
    for name in range(len(out)):
        if relation_of[name] < 0:
            share = (votes[name] / max(frames, 1e-9) + low) / (even + low)
            evidence = min(max(worth * math.log(share), -MAX_EVIDENCE), MAX_EVIDENCE)
            out[name] = OTHER_ODDS * math.exp(evidence)
            total += out[name]
    for name in range(len(out)):
        if relation_of[name] < 0:
            out[name] *= free / total


@kernel
def uncertain(probabilities: Float64, threshold_nats: float) -> Bool:
    """Whether the entropies of distributions (k, 2, R), scaled to sum to one, exceed a threshold.

    Returns:
        (k, 2) bool; false where a sum is zero.
    """
    result = np.zeros(probabilities.shape[:2], np.bool_)
    for row in range(len(probabilities)):
        for end in range(2):
            total = 0.0
            for value in probabilities[row, end]:
                total += value
            entropy = 0.0
            for value in probabilities[row, end]:
                if value > 0.0:
                    entropy -= value / total * math.log(value / total)
            result[row, end] = total > 0.0 and entropy > threshold_nats
    return result


@kernel
def said_predicates(probabilities: Float64, symmetric: Bool) -> tuple[Bool, Bool]:
    """Round probabilities (k, 2, R) in place, and find what of them is published.

    Args:
        probabilities: of the predicates of pairs in both directions.
        symmetric: (R,) bool, the predicates that hold in both directions or in none.

    Returns:
        (k, 2) bool, whether a direction is published; and (k,) bool, whether the first direction
        speaks for both.
    """
    count, _, width = probabilities.shape
    said, mutual = np.empty((count, 2), np.bool_), np.zeros(count, np.bool_)
    best, most = np.empty(2, np.int64), np.empty(2, np.float64)
    for row in range(count):
        for end in range(2):
            best[end], most[end] = 0, 0.0
            for name in range(width):
                value = np.rint(probabilities[row, end, name] * _SCALE) / _SCALE
                probabilities[row, end, name] = value
                if value > most[end]:
                    best[end], most[end] = name, value
            said[row, end] = most[end] >= MIN_PROBABILITY
        if said[row, 0] and said[row, 1] and best[0] == best[1] and symmetric[best[0]]:
            mutual[row] = abs(most[0] - most[1]) <= SAME_PROBABILITY
            said[row, 1] = not mutual[row]
    return said, mutual
