"""Rules between relations of different pairs: one support an object, no circles, nearest ones.

An object has one support at most, supports make no circles, and what is near is decided by its
neighbours. The kernels apply the rules to some objects and their pairs, where something changed.
Objects are slots of nodes, and pairs are rows: see `graph.pairs`, and `SHAPE` and `BELIEF`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.graph.pairs import PAIR, link
from deworldsg_ros.relations.states import (
    BELIEF,
    MIN_OTHER_VOTES,
    NEAR,
    NONE,
    RELATIONS_OF_STATE,
    SHAPE,
    STATE_COUNT,
    SUPPORTS,
)
from deworldsg_ros.scene.arrays import Float64, Int32, Int64

# States in which the first object rests on, in or at the second one, and the opposite.
# Numba keeps contiguous arrays only in its cache.
_CARRIED = np.isin(RELATIONS_OF_STATE, SUPPORTS)
CARRIED_FIRST, CARRIED_SECOND = map(np.ascontiguousarray, _CARRIED.T)
# Odds are finite.
MOST = 1.0 - 1e-6

# Near: horizontal gap of furniture on the floor, and of objects on one support; and the standard
# deviation of a measured gap.
NEAR_FLOOR_M, NEAR_FLOOR_SPREAD_M = 0.5, 0.05
NEAR_SUPPORT_M, NEAR_SUPPORT_SPREAD_M = 0.10, 0.012
# Near, on one support: difference of the bottoms, which neighbours hide.
NEAR_LEVEL_M, NEAR_LEVEL_SPREAD_M = 0.10, 0.02
# Near: each object is one of this many nearest neighbours of the other. The ground truth of the
# simulated rooms has the same rule (tools/physics_rooms).
NEAREST = 2
# Near: the distance of the centres counts this much beside the gap, when neighbours are ranked. The
# gaps of books in a row are all 0.
CENTRE_FRACTION = 0.1
# Near: a seat is with a table within this gap, whatever else is near it.
SEAT_GAP_M = 0.35
# Scale of the error of the difference of two such distances.
RANK_SPREAD_M = 0.02
# A definition holds or not; measured surfaces are wrong in some of the pairs. Whatever the votes
# are, one of seven sure ones is wrong in simulated rooms that nothing was fitted to.
NEAR_CERTAINTY, MAX_NEAR = 0.97, 0.85


# Objects are not stacked deeper. Longer circles of supports are not cut.
MAX_CIRCLE = 64
# A pair that is near with this probability, and in no more specific relation, counts as a
# neighbour when neighbours are ranked.
MIN_NEIGHBOUR = 0.3


class Scene(NamedTuple):
    """The arrays of all objects and pairs.

    Attributes:
        shapes: (n,) of `SHAPE`, by slot.
        firsts: (n,) first place of the list of each object.
        pairs: (m,) of `PAIR`.
        beliefs: (m,) of `BELIEF`; pairs that are not known do not count.
    """

    shapes: NDArray[Any]
    firsts: Int32
    pairs: NDArray[Any]
    beliefs: NDArray[Any]


@kernel
def take_in(
    scene: Scene,
    rows: Int64,
    logits: Float64,
    votes: Float64,
    near_logits: Float64,
    votes_worth: Float64,
) -> None:
    """Write what the evidence on each of some pairs alone says.

    Args:
        scene: its beliefs are written.
        rows: (k,) of the pairs.
        logits: (k, STATE_COUNT) of their states, from all evidence.
        votes: (k, STATE_COUNT) logits of their states, from votes.
        near_logits: (k,) that votes add to "near".
        votes_worth: (k,) exponents of votes.
    """
    weights = np.empty(STATE_COUNT)
    for index in range(len(rows)):
        belief, slots = scene.beliefs[rows[index]], scene.pairs[rows[index]].slots
        best, total = logits[index].max(), 0.0
        for state in range(STATE_COUNT):
            weights[state] = math.exp(logits[index, state] - best)
            total += weights[state]
        spoken = False
        belief.carried[0] = belief.carried[1] = 0.0
        for state in range(STATE_COUNT):
            belief.states[state] = weights[state] / total
            spoken |= votes[index, state] > 0.0
            if CARRIED_FIRST[state]:
                belief.carried[0] += weights[state] / total
            elif CARRIED_SECOND[state]:
                belief.carried[1] += weights[state] / total
        in_seat_reach = belief.judged and belief.gap_m <= SEAT_GAP_M
        for end in range(2):
            table = scene.shapes[slots[end]].seating[0]
            seat = scene.shapes[slots[1 - end]].seating[1]
            belief.with_[end] = table * seat * in_seat_reach
            belief.carried[end] = min(belief.carried[end], MOST)
        belief.votes_worth = votes_worth[index]
        belief.near_votes = votes_worth[index] * near_logits[index]
        apart = belief.judged and np.isinf(belief.gap_m)
        spoken |= belief.near_votes > 0.0 or belief.other_votes >= MIN_OTHER_VOTES
        belief.live = spoken or not apart
        if not belief.live:
            belief.near, belief.eligible = 0.0, False
            belief.relations[:] = 0.0
            belief.relations[:, NONE] = 1.0


def settle(scene: Scene, slots: Int64) -> tuple[Int64, Int64]:
    """Apply all rules around some objects (k,), each once.

    Returns:
        Places (2 · row + end) of the supports that were cut, to break circles; and the rows of the
        pairs whose relations changed.
    """
    cut = share_supports(scene, slots)
    moved = rank_neighbours(scene, find_neighbours(scene, slots))
    return cut, relate(scene, slots, moved)


@kernel
def share_supports(scene: Scene, slots: Int64) -> Int64:
    """Let each of some objects have one support at most, and cut circles.

    Every pair says how probable it is that one object rests on the other. For each object, these
    are independent events, and the floor is one more. The condition is that at most one of them
    holds. Support j then has the probability odds_j / (1 + odds of the floor + sum of all odds).
    The weakest likely support of a circle is halved.

    Args:
        scene: ``kept``, ``total`` and ``on_floor`` are written.
        slots: (k,) of the objects; each may stand where it wants now.

    Returns:
        Places (2 · row + end) of the supports that were halved.
    """
    shapes, firsts, pairs, beliefs = scene
    for slot in slots:
        total = 1.0 + shapes[slot].floor_odds
        place = firsts[slot]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            total += beliefs[row].carried[end] / (1.0 - beliefs[row].carried[end])
            place = pairs[row].links[end]
        shapes[slot].total = total
        shapes[slot].on_floor = shapes[slot].floor_odds / total
    for slot in slots:
        place = firsts[slot]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            belief, ends = beliefs[row], pairs[row].slots
            place = pairs[row].links[end]
            if belief.known:
                first = belief.carried[0] / (1.0 - belief.carried[0]) / shapes[ends[0]].total
                second = belief.carried[1] / (1.0 - belief.carried[1]) / shapes[ends[1]].total
                factor = min(1.0, MOST / max(first + second, 1e-300))
                belief.kept[0], belief.kept[1] = first * factor, second * factor
    cut, count = np.empty(len(slots), np.int64), 0
    for slot in slots:
        node, weakest, least = slot, 0, 2.0
        for _ in range(MAX_CIRCLE):
            # The pair in which the object probably rests on the other one.
            place = firsts[node]
            while place and beliefs[(place - 1) >> 1].kept[(place - 1) & 1] <= 0.5:
                place = pairs[(place - 1) >> 1].links[(place - 1) & 1]
            if not place:
                break
            row, end = (place - 1) >> 1, (place - 1) & 1
            if beliefs[row].kept[end] < least:
                weakest, least = place - 1, beliefs[row].kept[end]
            node = pairs[row].slots[1 - end]
            if node == slot:
                beliefs[weakest >> 1].kept[weakest & 1] *= 0.5
                cut[count] = weakest
                count += 1
                break
    return cut[:count].copy()


@kernel
def find_neighbours(scene: Scene, slots: Int64) -> Int64:
    """Judge which pairs of some objects (k,) stand side by side on one support.

    Args:
        scene: ``near`` and ``eligible`` are written.
        slots: (k,) of the objects.

    Returns:
        The objects, and those with a pair whose eligibility changed: they are to be ranked.
    """
    shapes, firsts, pairs, beliefs = scene
    found = [slot for slot in slots]
    states = np.empty(STATE_COUNT)
    for slot in slots:
        shapes[slot].mark = True
    for slot in slots:
        # What the object may rest on has its share, until all of its pairs are judged.
        _spread(scene, slot, 1.0)
        place = firsts[slot]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            place = pairs[row].links[end]
            belief, other = beliefs[row], pairs[row].slots[1 - end]
            if not belief.known:
                continue
            now = False
            belief.near = 0.0
            if not np.isinf(belief.gap_m):
                # Probability that the other one rests on the same support.
                together, at = 0.0, firsts[other]
                while at:
                    ends = pairs[(at - 1) >> 1].slots
                    share = shapes[ends[1 - ((at - 1) & 1)]].share
                    together += beliefs[(at - 1) >> 1].kept[(at - 1) & 1] * share
                    at = pairs[(at - 1) >> 1].links[(at - 1) & 1]
                floor = shapes[slot].on_floor * shapes[other].on_floor
                belief.near = _beside(belief, floor, together)
                _share(belief, states)
                now = belief.near * states[0] > MIN_NEIGHBOUR
            if now != belief.eligible and not shapes[other].mark:
                shapes[other].mark = True
                found.append(np.int64(other))
            belief.eligible = now
        _spread(scene, slot, 0.0)
    for slot in found:
        shapes[slot].mark = False
    return np.array(found)


@kernel
def _spread(scene: Scene, slot: int, factor: float) -> None:
    """Write what an object may rest on as the shares of these objects, times a factor."""
    place = scene.firsts[slot]
    while place:
        row, end = (place - 1) >> 1, (place - 1) & 1
        other = scene.pairs[row].slots[1 - end]
        scene.shapes[other].share = factor * scene.beliefs[row].kept[end]
        place = scene.pairs[row].links[end]


@kernel
def _beside(belief: Any, floor: float, together: float) -> float:
    """Probability that two objects stand side by side, on the floor or together on a support."""
    reach = SEAT_GAP_M if belief.with_[0] + belief.with_[1] > 0 else NEAR_FLOOR_M
    floor *= 1.0 / (1.0 + math.exp(-(reach - belief.gap_m) / NEAR_FLOOR_SPREAD_M))
    step_m = abs(belief.bottom_step_m)
    together *= 1.0 / (1.0 + math.exp(-(NEAR_SUPPORT_M - belief.gap_m) / NEAR_SUPPORT_SPREAD_M))
    together *= 1.0 / (1.0 + math.exp(-(NEAR_LEVEL_M - step_m) / NEAR_LEVEL_SPREAD_M))
    return float(min(floor + together, 1.0))


@kernel
def _share(belief: Any, states: Float64) -> None:
    """Write the states of a pair (STATE_COUNT,) after `share_supports`.

    States in which something rests on something else have what is kept of them. The others share
    the rest, in proportion.
    """
    first = second = left = 0.0
    for state in range(STATE_COUNT):
        if CARRIED_FIRST[state]:
            first += belief.states[state]
        elif CARRIED_SECOND[state]:
            second += belief.states[state]
        else:
            left += belief.states[state]
    by_first = belief.kept[0] / max(belief.carried[0], 1e-300)
    by_second = belief.kept[1] / max(belief.carried[1], 1e-300)
    others = (1.0 - (first * by_first + second * by_second)) / max(left, 1e-300)
    for state in range(STATE_COUNT):
        by = others
        if CARRIED_FIRST[state]:
            by = by_first
        elif CARRIED_SECOND[state]:
            by = by_second
        states[state] = belief.states[state] * by


@kernel
def rank_neighbours(scene: Scene, slots: Int64) -> Int64:
    """Find how probably each eligible pair of some objects (k,) is one of their `NEAREST`.

    Distances are measured with errors: another neighbour is nearer with a probability that follows
    from the difference of both distances. These count as independent.

    Args:
        scene: ``close`` is written.
        slots: (k,) of the objects.

    Returns:
        Rows of the pairs whose ``close`` changed; some twice.
    """
    _, firsts, pairs, beliefs = scene
    changed = [np.int64(0)][:0]
    fewer = np.empty(NEAREST)
    for slot in slots:
        places, distances = [np.int64(0)][:0], [0.0][:0]
        place = firsts[slot]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            if beliefs[row].eligible:
                places.append(place)
                distances.append(beliefs[row].gap_m + CENTRE_FRACTION * beliefs[row].centre_step_m)
            elif beliefs[row].close[end] != 0.0:
                beliefs[row].close[end] = 0.0
                changed.append(np.int64(row))
            place = pairs[row].links[end]
        for index in range(len(places)):
            # Probability that 0, 1, … of the others are nearer.
            fewer[:] = 0.0
            fewer[0] = 1.0
            for other in range(len(places)):
                if other == index:
                    continue
                step = (distances[other] - distances[index]) / RANK_SPREAD_M
                nearer = 1.0 / (1.0 + math.exp(min(max(step, -50.0), 50.0)))
                for number in range(NEAREST - 1, 0, -1):
                    fewer[number] += nearer * (fewer[number - 1] - fewer[number])
                fewer[0] *= 1.0 - nearer
            row, end = (places[index] - 1) >> 1, (places[index] - 1) & 1
            now = np.float32(fewer.sum())
            if beliefs[row].close[end] != now:
                beliefs[row].close[end] = now
                changed.append(np.int64(row))
    return np.array(changed)


@kernel
def relate(scene: Scene, slots: Int64, more: Int64) -> Int64:
    """Write the relations of pairs in both directions.

    Args:
        scene: ``relations`` is written.
        slots: (k,) of the objects whose pairs are related anew, and
        more: (l,) rows of others.

    Returns:
        The rows of the pairs whose relations changed.
    """
    shapes, firsts, pairs, beliefs = scene
    rows = [np.int64(0)][:0]
    for slot in slots:
        shapes[slot].mark = True
    for row in more:
        ends = pairs[row].slots
        if not shapes[ends[0]].mark and not shapes[ends[1]].mark:
            rows.append(row)
    for slot in slots:
        place = firsts[slot]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            # A pair of two of the objects is in the lists of both.
            if end == 0 or not shapes[pairs[row].slots[0]].mark:
                rows.append(np.int64(row))
            place = pairs[row].links[end]
    for slot in slots:
        shapes[slot].mark = False
    changed = [np.int64(0)][:0]
    states, now = np.empty(STATE_COUNT), np.empty((2, NONE + 1), np.float32)
    for row in rows:
        belief = beliefs[row]
        if not belief.known or not belief.live:
            continue
        _share(belief, states)
        now[:] = 0.0
        for state in range(1, STATE_COUNT):
            now[0, RELATIONS_OF_STATE[state, 0]] += states[state]
            now[1, RELATIONS_OF_STATE[state, 1]] += states[state]
        beside = NEAR_CERTAINTY * belief.near
        if belief.with_[0] + belief.with_[1] == 0:
            beside *= belief.close[0] * belief.close[1]
        beside = min(max(beside, 1.0 - NEAR_CERTAINTY), NEAR_CERTAINTY)
        logit = math.log(beside / (1.0 - beside)) + belief.near_votes
        beside = MAX_NEAR / (1.0 + math.exp(-logit))
        is_new = False
        for end in range(2):
            now[end, NEAR] = states[0] * beside
            now[end, NONE] += states[0] * (1.0 - beside)
            for relation in range(NONE + 1):
                is_new |= belief.relations[end, relation] != now[end, relation]
                belief.relations[end, relation] = now[end, relation]
        if is_new:
            changed.append(row)
    return np.array(changed)


def one_support(
    states: Float64, pairs: Int64, floor_odds: Float64
) -> tuple[Float64, Float64, Float64]:
    """`share_supports` for all objects at once.

    Args:
        states: (m, STATE_COUNT) probabilities, rows sum to one.
        pairs: (m, 2) objects, each pair once.
        floor_odds: (n,) odds that an object stands on the floor.

    Returns:
        (m, STATE_COUNT) probabilities; (m, 2) probability that the first object rests on the
        second one, and the opposite; and (n,) probability that an object stands on the floor.
    """
    count, rows = len(floor_odds), np.arange(len(pairs))
    scene = Scene(
        np.zeros(count, SHAPE),
        np.zeros(count, np.int32),
        np.zeros(len(pairs), PAIR),
        np.zeros(len(pairs), BELIEF),
    )
    scene.shapes["floor_odds"], scene.pairs["slots"] = floor_odds, pairs
    link(scene.pairs, scene.firsts, np.zeros(count, np.int32), rows)
    beliefs = scene.beliefs
    beliefs["known"], beliefs["states"] = True, states
    carried = [states[:, CARRIED_FIRST].sum(1), states[:, CARRIED_SECOND].sum(1)]
    beliefs["carried"] = np.minimum(np.column_stack(carried), MOST)
    share_supports(scene, np.arange(count))
    result = np.empty(states.shape)
    for belief, shared in zip(beliefs, result):
        _share(belief, shared)
    return result, beliefs["kept"].copy(), scene.shapes["on_floor"].copy()
