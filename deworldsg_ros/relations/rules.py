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
# Near, on one support: two things do not stand in one place. Outlines that are deeper in each other
# are of things in a pile; those of books in a row overlap less.
OVERLAP_M, OVERLAP_SPREAD_M = 0.06, 0.02
# Near: outlines closer than this have nothing between them. Something lies between two if it is
# higher than this part of the height that they share.
BETWEEN_GAP_M, BETWEEN_HEIGHT = 0.015, 0.25
# Pairs with something between them are near so much less often, in simulated rooms.
BETWEEN_WORTH = 0.8
# Near before the votes, where the geometry denies it, and where it is sure: nodes are wrong, and
# hidden neighbours are nearer (fitted to simulated rooms).
LEAST_NEAR, MOST_NEAR = 0.04, 0.7


# Objects are not stacked deeper. Longer circles of supports are not cut.
MAX_CIRCLE = 64
# Neighbours that stand beside an object with this probability count by it when they are ranked.
MIN_NEIGHBOUR = 0.05


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
        near_logits: (k, 2) that votes add to "near", on a support and on the floor.
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
        belief.near_votes[0] = votes_worth[index] * near_logits[index, 0]
        belief.near_votes[1] = votes_worth[index] * near_logits[index, 1]
        apart = belief.judged and np.isinf(belief.gap_m)
        spoken |= belief.near_votes[0] > 0.0 or belief.other_votes >= MIN_OTHER_VOTES
        belief.live = spoken or not apart
        if not belief.live:
            belief.near = belief.floor_part = belief.beside = 0.0
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
        scene: ``near``, ``floor_part`` and ``beside`` are written.
        slots: (k,) of the objects.

    Returns:
        The objects, and those with a neighbour that counts otherwise: they are to be ranked.
    """
    shapes, firsts, pairs, beliefs = scene
    found = [slot for slot in slots]
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
            now = np.float32(0.0)
            belief.near = belief.floor_part = 0.0
            if not np.isinf(belief.gap_m):
                # Probability that the other one rests on the same support.
                together, at = 0.0, firsts[other]
                while at:
                    ends = pairs[(at - 1) >> 1].slots
                    share = shapes[ends[1 - ((at - 1) & 1)]].share
                    together += beliefs[(at - 1) >> 1].kept[(at - 1) & 1] * share
                    at = pairs[(at - 1) >> 1].links[(at - 1) & 1]
                gap_m, step_m = max(belief.gap_m, 0.0), abs(belief.bottom_step_m)
                reach = SEAT_GAP_M if belief.with_[0] + belief.with_[1] > 0 else NEAR_FLOOR_M
                floor = shapes[slot].on_floor * shapes[other].on_floor
                # The sigmoid of x is 0.5 + 0.5 tanh(x / 2), whatever the size of x.
                floor *= 0.5 + 0.5 * math.tanh(0.5 * (reach - gap_m) / NEAR_FLOOR_SPREAD_M)
                for margin in (
                    (NEAR_SUPPORT_M - gap_m) / NEAR_SUPPORT_SPREAD_M,
                    (NEAR_LEVEL_M - step_m) / NEAR_LEVEL_SPREAD_M,
                    (OVERLAP_M + belief.gap_m) / OVERLAP_SPREAD_M,
                ):
                    together *= 0.5 + 0.5 * math.tanh(0.5 * margin)
                belief.near = min(floor + together, 1.0)
                belief.floor_part = floor / max(floor + together, 1e-30)
                # Whatever else they are called: a chair at a table is the nearest thing of another.
                now = np.float32(belief.near * (1.0 - belief.kept[0] - belief.kept[1]))
                now = now if now > MIN_NEIGHBOUR else np.float32(0.0)
            if now != belief.beside and not shapes[other].mark:
                shapes[other].mark = True
                found.append(np.int64(other))
            belief.beside = now
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
    """Find how probably each neighbour of some objects (k,) is one of the `NEAREST`.

    Also, how probably another neighbour stands between. It does so by the part of the corridor that
    it takes, times the probability that it is a neighbour.

    Distances are measured with errors: another neighbour is nearer with a probability that follows
    from the difference of both distances, times that of being a neighbour. These count as
    independent.

    Args:
        scene: ``close`` and ``between`` are written.
        slots: (k,) of the objects.

    Returns:
        Rows of the pairs with another value; some twice.
    """
    shapes, firsts, pairs, beliefs = scene
    changed = [np.int64(0)][:0]
    fewer = np.empty(NEAREST)
    for slot in slots:
        places, distances, weights = [np.int64(0)][:0], [0.0][:0], [0.0][:0]
        place = firsts[slot]
        while place:
            belief, end = beliefs[(place - 1) >> 1], (place - 1) & 1
            if belief.beside > 0.0:
                places.append(place)
                gap_m = max(np.float64(belief.gap_m), 0.0)
                distances.append(gap_m + CENTRE_FRACTION * belief.centre_step_m)
                weights.append(np.float64(belief.beside))
            elif belief.close[end] != 0.0 or belief.between[end] != 0.0:
                belief.close[end] = belief.between[end] = 0.0
                changed.append(np.int64((place - 1) >> 1))
            place = pairs[(place - 1) >> 1].links[end]
        # Outlines of the neighbours, and last of the object: x, y, both diagonals, height.
        outlines = np.empty((len(places) + 1, 5, 2))
        for index in range(len(places) + 1):
            item = slot
            if index < len(places):
                ends = pairs[(places[index] - 1) >> 1].slots
                item = np.int64(ends[1 - ((places[index] - 1) & 1)])
            shape, outline = shapes[item], outlines[index]
            for axis in range(2):
                outline[axis, 0], outline[axis, 1] = shape.low[axis], shape.high[axis]
                outline[2 + axis, 0] = shape.slant_low[axis]
                outline[2 + axis, 1] = shape.slant_high[axis]
            outline[4, 0], outline[4, 1] = shape.low[2], shape.high[2]
        for index in range(len(places)):
            row, end = (places[index] - 1) >> 1, (places[index] - 1) & 1
            # Probability that 0, 1, … of the others are nearer.
            fewer[:] = 0.0
            fewer[0] = 1.0
            between, is_apart = 0.0, beliefs[row].gap_m > BETWEEN_GAP_M
            for other in range(len(places)):
                if other == index:
                    continue
                step = (distances[index] - distances[other]) / RANK_SPREAD_M
                nearer = weights[other] * (0.5 + 0.5 * math.tanh(0.5 * step))
                for number in range(NEAREST - 1, 0, -1):
                    fewer[number] += nearer * (fewer[number - 1] - fewer[number])
                fewer[0] *= 1.0 - nearer
                if is_apart:
                    covered = _covered(outlines[-1], outlines[index], outlines[other])
                    between = max(between, weights[other] * covered)
            close, hidden = np.float32(fewer.sum()), np.float32(between)
            if beliefs[row].close[end] != close or beliefs[row].between[end] != hidden:
                beliefs[row].close[end], beliefs[row].between[end] = close, hidden
                changed.append(np.int64(row))
    return np.array(changed)


@kernel
def _covered(one: Float64, other: Float64, third: Float64) -> float:
    """Part of the width of the corridor between two outlines (5, 2) in which a third one stands.

    The corridor is the rectangle between both, along the axes or the diagonals, whichever sets them
    farther apart.
    """
    bottom, top = max(one[4, 0], other[4, 0]), min(one[4, 1], other[4, 1])
    if third[4, 1] < bottom + BETWEEN_HEIGHT * (top - bottom) or third[4, 0] >= top:
        return 0.0
    along, widest = 0, -1.0
    for axis in range(0, 4, 2):
        x, y = (
            max(one[axis, 0], other[axis, 0]) - min(one[axis, 1], other[axis, 1]),
            max(one[axis + 1, 0], other[axis + 1, 0]) - min(one[axis + 1, 1], other[axis + 1, 1]),
        )
        squared = max(x, 0.0) ** 2 + max(y, 0.0) ** 2
        if squared > widest:
            along, widest = (axis if x >= y else axis + 1), squared
    across, part = along ^ 1, 0.0
    for axis in (along, across):
        first = max(one[axis, 0], other[axis, 0])
        last = min(one[axis, 1], other[axis, 1])
        low, high = min(first, last), max(first, last)
        shared = min(high, third[axis, 1]) - max(low, third[axis, 0])
        if shared <= 0.0:
            return 0.0
        part = shared / max(high - low, 0.01)
    return min(part, 1.0)


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
        beside = belief.near * (1.0 - BETWEEN_WORTH * max(belief.between[0], belief.between[1]))
        votes = belief.near_votes[0]
        if belief.with_[0] + belief.with_[1] == 0:
            beside *= belief.close[0] * belief.close[1]
            votes += belief.floor_part * (belief.near_votes[1] - votes)
        beside = LEAST_NEAR + (MOST_NEAR - LEAST_NEAR) * beside
        logit = math.log(beside / (1.0 - beside)) + votes
        beside = 1.0 / (1.0 + math.exp(-logit))
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
