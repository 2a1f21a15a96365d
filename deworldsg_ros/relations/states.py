"""The physical states of a pair, the predicates that name them, and what is kept of both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
# States in which the first or the second one is above.
ABOVE_STATES = [1 + 2 * DIRECTED.index(ABOVE), 2 + 2 * DIRECTED.index(ABOVE)]


# --- What is kept of each published node, and of each pair of them.
#
# Numba takes no arrays of bool within records; these are 0 and 1.

# By slot of the node; zeros for nodes that are not published. Lengths are metres in the upright
# frame: axes 0 and 1 are horizontal, axis 2 is up.
SHAPE = np.dtype(
    [
        ("node_id", np.int64),
        # Number of points of the shape, their trimmed bounds, mean and covariance.
        ("count", np.int64),
        ("low", np.float64, 3),
        ("high", np.float64, 3),
        # The same along the two horizontal diagonals, x + y and y - x.
        ("slant_low", np.float64, 2),
        ("slant_high", np.float64, 2),
        ("mean", np.float64, 3),
        ("covariance", np.float64, (3, 3)),
        # The class of the highest probability, and whether it is a table, and a seat.
        ("best_class", np.int64),
        ("seating", np.uint8, 2),
        # Odds that it stands on the floor; the probability that it does; the sum of the odds of all
        # that it may rest on (`rules`).
        ("floor_odds", np.float64),
        ("on_floor", np.float64),
        ("total", np.float64),
        # Zero and false between the calls of the rules.
        ("share", np.float64),
        ("mark", np.bool_),
    ],
    align=True,
)

# By row of the pair (`graph.pairs`); zeros for pairs that are not followed. Fields of two values
# have one for each direction. A node has fifteen such pairs: most numbers have 32 bits.
BELIEF = np.dtype(
    [
        # Both nodes are published, and the pair was judged at least once.
        ("known", np.bool_),
        # It waits to be judged, and has another geometry since.
        ("waits", np.bool_),
        ("moved", np.bool_),
        # Both nodes have enough points. Then the logits are those of the physical model.
        ("judged", np.bool_),
        ("state_logits", np.float32, STATE_COUNT),
        # Horizontal gap of the outlines, negative if they overlap; infinite out of reach.
        # Difference of the heights of the bottoms, and horizontal distance of the centres, where in
        # reach.
        ("gap_m", np.float32),
        ("bottom_step_m", np.float32),
        ("centre_step_m", np.float32),
        # Most votes on a predicate that names no physical relation, and the exponent of all votes.
        ("other_votes", np.float32),
        ("votes_worth", np.float32),
        # By the pair alone: its states; that one end rests on the other; logits that votes add to
        # "near", on a support and on the floor; a table and a seat in its reach; false if it is
        # apart and no votes matter.
        ("states", np.float32, STATE_COUNT),
        ("carried", np.float64, 2),
        ("near_votes", np.float32, 2),
        ("with_", np.uint8, 2),
        ("live", np.bool_),
        # After what others exclude: that one end rests on the other; that both stand side by side;
        # the part of this that is on the floor; that both stand side by side and none carries the
        # other, 0 if it is small; for each end, that the pair is one of its nearest, and that
        # something beside it stands between.
        ("kept", np.float64, 2),
        ("near", np.float32),
        ("floor_part", np.float32),
        ("beside", np.float32),
        ("close", np.float32, 2),
        ("between", np.float32, 2),
        ("relations", np.float32, (2, NONE + 1)),
        # Whether a prior may enter, by classes of subject and object; and a number for the
        # probabilities in the message, 0 = no message.
        ("open", np.uint8, 2),
        ("classes", np.int32, 2),
        ("said", np.int64, 2),
    ],
    align=True,
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
# Of the 64-bit hash FNV-1a.
_PRIME = np.int64(0x100000001B3)


class PredicateNames(NamedTuple):
    """The relations that the predicates of a vocabulary name.

    Attributes:
        relation_of: (R,) relation of each predicate; -1 = it names none.
        canonical: (NONE,) predicate that names each relation; -1 = there is none.
        with_index: of the predicate "with"; -1 = there is none.
    """

    relation_of: Int64
    canonical: Int64
    with_index: int

    @classmethod
    def of(cls, predicates: Sequence[str]) -> PredicateNames:
        """Those of a vocabulary."""
        with_index = predicates.index("with") if "with" in predicates else -1
        return cls(relation_of_predicates(predicates), canonical_predicates(predicates), with_index)


def related_pairs(beliefs: NDArray[Any], rows: Int64) -> Bool:
    """Whether pairs (k,) may be related, or have votes beyond the physical relations; (k,) bool."""
    there, back = beliefs["relations"][:, :, NONE][rows].T
    related: Bool = np.minimum(there, back) < 1.0 - MIN_RELATED
    return related | (beliefs["other_votes"][rows] >= MIN_OTHER_VOTES)


@kernel
def predicate_probabilities(
    beliefs: NDArray[Any],
    votes: Float32,
    frames: Int64,
    names: PredicateNames,
    scales: Float64,
) -> tuple[Float64, Bool]:
    """Probabilities (k, 2, R) of the predicates in both directions, and (k, 2) bool: any votes.

    Each relation's probability is divided among its predicates by their votes. Without votes, a
    relation has the name that comes first in `PREDICATES`; a table is "with" the seats that are
    near it. Predicates that name no physical relation live from votes alone, which are believed as
    those on "on" are.

    Args:
        beliefs: (k,) of the pairs, `BELIEF`.
        votes: (k, 2, R) sums of the votes.
        frames: (k,) number of frames that showed both.
        names: of the vocabulary.
        scales: (4,) of `VoteScales`.
    """
    relation_of, canonical, with_index = names
    slope, n_half, low, even = scales
    count, _, width = votes.shape
    result, voted = np.zeros((count, 2, width)), np.zeros((count, 2), np.bool_)
    sums = np.empty(NONE)
    for index in range(count):
        for end in range(2):
            relations, with_ = beliefs[index].relations[end], beliefs[index].with_[end]
            told, out = votes[index, end], result[index, end]
            sums[:], others = NAMING_VOTES, 0.0
            for name in range(width):
                voted[index, end] |= told[name] != 0.0
                if relation_of[name] >= 0:
                    sums[relation_of[name]] += told[name]
                elif told[name] > others:
                    others = told[name]
            for name in range(width):
                relation = relation_of[name]
                if relation >= 0 and canonical[relation] >= 0:
                    out[name] = relations[relation] * told[name] / sums[relation]
            for relation in range(NONE):
                is_with = relation == NEAR and with_index >= 0 and with_ > 0
                name = with_index if is_with else canonical[relation]
                if canonical[relation] >= 0:
                    out[name] += relations[relation] * NAMING_VOTES / sums[relation]
            if others >= MIN_OTHER_VOTES:
                # Probabilities of the predicates that name no physical relation.
                shown, total = frames[index], 1.0
                worth = shown / (shown + n_half) * slope * beliefs[index].votes_worth
                for name in range(width):
                    if relation_of[name] < 0:
                        share = (told[name] / max(shown, 1e-9) + low) / (even + low)
                        evidence = min(max(worth * math.log(share), -MAX_EVIDENCE), MAX_EVIDENCE)
                        out[name] = OTHER_ODDS * math.exp(evidence)
                        total += out[name]
                for name in range(width):
                    if relation_of[name] < 0:
                        out[name] *= relations[NONE] / total
    return result, voted


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
def said_predicates(probabilities: Float64, sources: Int64, symmetric: Bool) -> tuple[Int64, Bool]:
    """Round probabilities (k, 2, R) in place, and find what of them is published.

    Args:
        probabilities: of the predicates of pairs in both directions.
        sources: (k, 2) numbers of what they come from.
        symmetric: (R,) bool, the predicates that hold in both directions or in none.

    Returns:
        (k, 2) a number for the probabilities and their source, 0 if the direction is not published;
        and (k,) bool, whether the first direction speaks for both.
    """
    count, _, width = probabilities.shape
    said, mutual = np.zeros((count, 2), np.int64), np.zeros(count, np.bool_)
    best, most = np.empty(2, np.int64), np.empty(2, np.float64)
    for row in range(count):
        for end in range(2):
            best[end], most[end] = 0, 0.0
            number = np.int64(sources[row, end])
            for name in range(width):
                value = np.rint(probabilities[row, end, name] * _SCALE)
                number = (number ^ np.int64(value)) * _PRIME  # FNV-1a, which wraps around
                probabilities[row, end, name] = value / _SCALE
                if probabilities[row, end, name] > most[end]:
                    best[end], most[end] = name, probabilities[row, end, name]
            if most[end] >= MIN_PROBABILITY:
                said[row, end] = number << 2 | 1
        if said[row, 0] and said[row, 1] and best[0] == best[1] and symmetric[best[0]]:
            mutual[row] = abs(most[0] - most[1]) <= SAME_PROBABILITY
            if mutual[row]:
                said[row, 0] |= 2
                said[row, 1] = 0
    return said, mutual
