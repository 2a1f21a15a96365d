"""Rules between relations of different pairs: one support an object, no circles, nearest ones."""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.relations.states import (
    MIN_OTHER_VOTES,
    NEAR,
    NONE,
    RELATIONS_OF_STATE,
    STATE_COUNT,
    SUPPORTS,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64

# --- What relations of different pairs exclude: one support an object, no circles; and what is
# near.
#
# The numbers of these rules, and the rule of supports for all pairs at once, as training needs it.
# `settling` applies the rules where something changed.
#
# Pairs are rows of parallel arrays; an object is an index from 0 to n - 1.

# States in which the first object rests on, in or at the second one, and the opposite.
_CARRIED = np.isin(RELATIONS_OF_STATE, SUPPORTS)
CARRIED_FIRST, CARRIED_SECOND = _CARRIED[:, 0], _CARRIED[:, 1]
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
# A definition holds or not; measured surfaces are wrong in some of the pairs.
NEAR_CERTAINTY = 0.97


def one_support(
    states: Float64, pairs: Int64, floor_odds: Float64
) -> tuple[Float64, Float64, Float64]:
    """State probabilities if each object has one support at most.

    Every pair says how probable it is that one object rests on the other. For each object, these
    are independent events, and the floor is one more. The condition is that at most one of them
    holds. Support j then has the probability odds_j / (1 + odds of the floor + sum of all odds).
    Circles of supports are cut. The other states of a pair share what its supports leave, in
    proportion.

    Args:
        states: (m, STATE_COUNT) probabilities, rows sum to one.
        pairs: (m, 2) objects.
        floor_odds: (n,) odds that an object stands on the floor.

    Returns:
        (m, STATE_COUNT) probabilities; (m, 2) probability that the first object rests on the
        second one, and the opposite; and (n,) probability that an object stands on the floor.
    """
    carried = np.column_stack([states[:, CARRIED_FIRST].sum(1), states[:, CARRIED_SECOND].sum(1)])
    carried = np.minimum(carried, MOST)
    odds = carried / (1.0 - carried)
    total = 1.0 + floor_odds
    np.add.at(total, pairs, odds)
    kept = odds / total[pairs]
    kept *= np.minimum(1.0, MOST / np.maximum(kept.sum(axis=1, keepdims=True), 1e-300))
    _cut_all_circles(kept, pairs, len(floor_odds))
    result = states.copy()
    for end, chosen in enumerate((CARRIED_FIRST, CARRIED_SECOND)):
        factor = kept[:, end] / np.maximum(carried[:, end], 1e-300)
        result[:, chosen] = states[:, chosen] * factor[:, None]
    rest = ~(CARRIED_FIRST | CARRIED_SECOND)
    left = states[:, rest].sum(axis=1)
    factor = (1.0 - result[:, ~rest].sum(axis=1)) / np.maximum(left, 1e-300)
    result[:, rest] = states[:, rest] * factor[:, None]
    return result, kept, floor_odds / total


def _cut_all_circles(kept: Float64, pairs: Int64, count: int) -> None:
    """Halve the weakest likely support of each circle, in place, until support is a forest."""
    while True:
        rows, ends = np.nonzero(kept > 0.5)
        parent = np.full(count, -1)
        parent[pairs[rows, ends]] = pairs[rows, 1 - ends]
        place = {int(pairs[row, end]): (row, end) for row, end in zip(rows, ends)}
        state = np.zeros(count, np.int8)  # 0 = new, 1 = on this walk, 2 = leads to a root
        for start in np.flatnonzero(parent >= 0).tolist():
            walk = []
            node = start
            while node >= 0 and state[node] == 0:
                state[node] = 1
                walk.append(node)
                node = int(parent[node])
            if node >= 0 and state[node] == 1:
                circle = walk[walk.index(node) :]
                weakest = min(circle, key=lambda item: kept[place[item]])
                kept[place[weakest]] *= 0.5
                break
            state[walk] = 2
        else:
            return


assert len(CARRIED_FIRST) == STATE_COUNT


# --- What relations of different pairs exclude, settled around the objects that changed.
#
# An object has one support at most, supports make no circles, and what is near is decided by its
# neighbours (`exclusions`). These kernels apply the rules only where something changed. Objects and
# pairs are rows of arrays; `ends`, `links` and `first_links` are those of `pair_links`.

# Objects are not stacked deeper. Longer circles of supports are not cut.
MAX_CIRCLE = 64
# A pair that is near with this probability, and in no more specific relation, counts as a
# neighbour when neighbours are ranked.
MIN_NEIGHBOUR = 0.3
# States in which the first object rests on the second, and the opposite.
# Numba keeps contiguous arrays only in its cache.
_FIRST, _SECOND = np.ascontiguousarray(CARRIED_FIRST), np.ascontiguousarray(CARRIED_SECOND)


@kernel
def take_in(  # noqa: D417
    rows: Int64,
    logits: Float64,
    votes: Float64,
    near_logits: Float64,
    votes_worth: Float64,
    ends: Int64,
    seating: Bool,
    judged: Bool,
    gaps_m: Float64,
    other_votes: Float64,
    states: Float64,
    carried: Float64,
    near: Float64,
    near_votes: Float64,
    by_votes: Float64,
    relations: Float64,
    eligible: Bool,
    with_: Bool,
    live: Bool,
) -> None:
    """What the evidence on each of some pairs alone says; see `SettledRelations`.

    Args:
        rows: (k,) rows of pairs.
        logits: (k, STATE_COUNT) of their states, from all evidence.
        votes: (k, STATE_COUNT) logits of their states, from votes.
        near_logits: (k,) that votes add to "near".
        votes_worth: (k,) exponents of votes.
        ends: see `pair_links`.
        seating: (n, 2) bool, whether a node is a table, and a seat.
        judged, gaps_m, other_votes: see `PairRows`. The other arrays are written.
    """
    for index in range(len(rows)):
        row = rows[index]
        best, total = logits[index].max(), 0.0
        for state in range(STATE_COUNT):
            states[row, state] = math.exp(logits[index, state] - best)
            total += states[row, state]
        spoken, carried[row] = False, 0.0
        for state in range(STATE_COUNT):
            states[row, state] /= total
            spoken |= votes[index, state] > 0.0
            if _FIRST[state]:
                carried[row, 0] += states[row, state]
            elif _SECOND[state]:
                carried[row, 1] += states[row, state]
        for end in range(2):
            seated = seating[ends[row, end], 0] and seating[ends[row, 1 - end], 1]
            with_[row, end] = seated and judged[row] and gaps_m[row] <= SEAT_GAP_M
            carried[row, end] = min(carried[row, end], MOST)
        by_votes[row] = votes_worth[index]
        near_votes[row] = votes_worth[index] * near_logits[index]
        apart = judged[row] and np.isinf(gaps_m[row])
        spoken |= near_votes[row] > 0.0 or other_votes[row] >= MIN_OTHER_VOTES
        live[row] = spoken or not apart
        if not live[row]:
            near[row], eligible[row] = 0.0, False
            relations[row] = 0.0
            relations[row, :, NONE] = 1.0


@kernel
def settle(  # noqa: D417
    objects: Int64,
    states: Float64,
    carried: Float64,
    kept: Float64,
    floor_odds: Float64,
    on_floor: Float64,
    totals: Float64,
    gaps_m: Float64,
    bottom_steps_m: Float64,
    centre_steps_m: Float64,
    with_: Bool,
    near: Float64,
    eligible: Bool,
    shares: Float64,
    marks: Bool,
    close: Bool,
    near_votes: Float64,
    live: Bool,
    relations: Float64,
    ends: Int64,
    links: Int64,
    first_links: Int64,
) -> tuple[Int64, Int64]:
    """All rules, around some objects; arguments as in the kernels below.

    Args:
        objects: (k,) different rows.
        live: (m,) bool; other pairs are not related.

    Returns:
        Places of the supports that were cut, see `share_supports`; and the rows of the pairs whose
        relations changed.
    """
    cut = share_supports(
        objects, carried, kept, floor_odds, on_floor, totals, ends, links, first_links
    )
    ranked = find_neighbours(
        objects,
        states,
        carried,
        kept,
        on_floor,
        gaps_m,
        bottom_steps_m,
        with_,
        near,
        eligible,
        shares,
        marks,
        ends,
        links,
        first_links,
    )
    moved = rank_neighbours(ranked, gaps_m, centre_steps_m, eligible, close, links, first_links)
    rows = _pairs_around(objects, moved, live, marks, ends, links, first_links)
    return cut, relate(rows, states, carried, kept, near, close, with_, near_votes, relations)


@kernel
def _pairs_around(
    objects: Int64,
    more: Int64,
    live: Bool,
    marks: Bool,
    ends: Int64,
    links: Int64,
    first_links: Int64,
) -> Int64:
    """Rows of the live pairs of objects, and of some more; the latter may be there twice."""
    count = len(more)
    for item in objects:
        marks[item] = True
        place = first_links[item]
        while place:
            count += 1
            place = links[(place - 1) >> 1, (place - 1) & 1]
    rows = np.empty(count, np.int64)
    count = 0
    for item in objects:
        place = first_links[item]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            # A pair of two of the objects is in the lists of both.
            if live[row] and (end == 0 or not marks[ends[row, 0]]):
                rows[count] = row
                count += 1
            place = links[row, end]
    for row in more:
        if live[row] and not marks[ends[row, 0]] and not marks[ends[row, 1]]:
            rows[count] = row
            count += 1
    for item in objects:
        marks[item] = False
    return rows[:count]


@kernel
def share_supports(  # noqa: D417
    objects: Int64,
    carried: Float64,
    kept: Float64,
    floor_odds: Float64,
    on_floor: Float64,
    totals: Float64,
    ends: Int64,
    links: Int64,
    first_links: Int64,
) -> Int64:
    """Let each object have one support at most, and cut circles.

    Args:
        objects: (k,) rows of the objects to settle; each may stand where it wants now.
        carried: (m, 2) probability that one object of a pair rests on the other, by the pair alone.
        kept: (m, 2) the same if each object has one support at most; written.
        floor_odds: (n,) odds that an object stands on the floor.
        on_floor: (n,) probability that it does; written.
        totals: (n,) sum of the odds of all that an object may rest on; written.
        ends, links, first_links: see `pair_links`.

    Returns:
        Places (2 · row + end) of the supports that were cut, to break circles.
    """
    for item in objects:
        total = 1.0 + floor_odds[item]
        place = first_links[item]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            total += carried[row, end] / (1.0 - carried[row, end])
            place = links[row, end]
        totals[item] = total
        on_floor[item] = floor_odds[item] / total
    for item in objects:
        place = first_links[item]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            first = carried[row, 0] / (1.0 - carried[row, 0]) / totals[ends[row, 0]]
            second = carried[row, 1] / (1.0 - carried[row, 1]) / totals[ends[row, 1]]
            factor = min(1.0, MOST / max(first + second, 1e-300))
            kept[row, 0], kept[row, 1] = first * factor, second * factor
            place = links[row, end]
    return _cut_circles(objects, kept, ends, links, first_links)


@kernel
def _cut_circles(
    objects: Int64, kept: Float64, ends: Int64, links: Int64, first_links: Int64
) -> Int64:
    """Halve the weakest likely support of each circle with one of the objects; their places."""
    cut = np.empty(len(objects), np.int64)
    count = 0
    for item in objects:
        node, weakest, least = item, 0, 2.0
        for _ in range(MAX_CIRCLE):
            place = _likely(node, kept, links, first_links)
            if not place:
                break
            row, end = (place - 1) >> 1, (place - 1) & 1
            if kept[row, end] < least:
                weakest, least = place - 1, kept[row, end]
            node = ends[row, 1 - end]
            if node == item:
                kept[weakest >> 1, weakest & 1] *= 0.5
                cut[count] = weakest
                count += 1
                break
    return cut[:count]


@kernel
def _likely(item: int, kept: Float64, links: Int64, first_links: Int64) -> int:
    """Place + 1 of the pair in which an object probably rests on the other one; 0 = none."""
    place = first_links[item]
    while place:
        row, end = (place - 1) >> 1, (place - 1) & 1
        if kept[row, end] > 0.5:
            return int(place)
        place = links[row, end]
    return 0


@kernel
def find_neighbours(  # noqa: D417
    objects: Int64,
    states: Float64,
    carried: Float64,
    kept: Float64,
    on_floor: Float64,
    gaps_m: Float64,
    bottom_steps_m: Float64,
    with_: Bool,
    near: Float64,
    eligible: Bool,
    shares: Float64,
    marks: Bool,
    ends: Int64,
    links: Int64,
    first_links: Int64,
) -> Int64:
    """Judge which pairs of the objects stand side by side on one support.

    Args:
        objects: (k,) rows.
        states: (m, STATE_COUNT) probabilities by the pair alone.
        carried, kept, on_floor: see `share_supports`.
        gaps_m: (m,) horizontal gap of the bounds; infinite out of reach.
        bottom_steps_m: (m,) difference of the heights of the bottoms.
        with_: (m, 2) bool; a table and a seat in its reach, in this order or the other.
        near: (m,) probability that both stand on one support within reach; written.
        eligible: (m,) bool; the pair counts when neighbours are ranked; written.
        shares, marks: (n,) zeros and false, scratch.

    Returns:
        The objects, and those with a pair whose eligibility changed: they are to be ranked.
    """
    found = [item for item in objects]
    for item in objects:
        marks[item] = True
    for item in objects:
        _spread(item, 1.0, kept, shares, ends, links, first_links)
        place = first_links[item]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            place = links[row, end]
            other = ends[row, 1 - end]
            now = False
            near[row] = 0.0
            if not np.isinf(gaps_m[row]):
                together = _together(other, kept, shares, ends, links, first_links)
                floor = on_floor[item] * on_floor[other]
                seated = with_[row, 0] or with_[row, 1]
                near[row] = _beside(floor, together, gaps_m[row], bottom_steps_m[row], seated)
                free = _unrelated(states[row], carried[row], kept[row])
                now = near[row] * free > MIN_NEIGHBOUR
            if now != eligible[row] and not marks[other]:
                marks[other] = True
                found.append(other)
            eligible[row] = now
        _spread(item, 0.0, kept, shares, ends, links, first_links)
    for item in found:
        marks[item] = False
    return np.array(found)


@kernel
def _spread(
    item: int,
    factor: float,
    kept: Float64,
    shares: Float64,
    ends: Int64,
    links: Int64,
    first_links: Int64,
) -> None:
    """Write what an object may rest on into `shares`, times a factor."""
    place = first_links[item]
    while place:
        row, end = (place - 1) >> 1, (place - 1) & 1
        shares[ends[row, 1 - end]] = factor * kept[row, end]
        place = links[row, end]


@kernel
def _together(
    item: int, kept: Float64, shares: Float64, ends: Int64, links: Int64, first_links: Int64
) -> float:
    """Probability that an object rests on the support of another one, whose shares are given."""
    total = 0.0
    place = first_links[item]
    while place:
        row, end = (place - 1) >> 1, (place - 1) & 1
        total += kept[row, end] * shares[ends[row, 1 - end]]
        place = links[row, end]
    return total


@kernel
def _beside(
    floor: float, together: float, gap_m: float, bottom_step_m: float, seated: bool
) -> float:
    """Probability that two objects stand side by side, on the floor or together on a support."""
    reach = SEAT_GAP_M if seated else NEAR_FLOOR_M
    floor *= _expit((reach - gap_m) / NEAR_FLOOR_SPREAD_M)
    together *= _expit((NEAR_SUPPORT_M - gap_m) / NEAR_SUPPORT_SPREAD_M)
    together *= _expit((NEAR_LEVEL_M - abs(bottom_step_m)) / NEAR_LEVEL_SPREAD_M)
    return float(min(floor + together, 1.0))


@kernel
def _expit(value: float) -> float:
    return 1.0 / (1.0 + math.exp(-value)) if value > -700.0 else 0.0


@kernel
def _unrelated(states: Float64, carried: Float64, kept: Float64) -> float:
    """Probability of state 0 after `share_supports`."""
    scaled, left = _scaled(states, carried, kept)
    return float(states[0] * (1.0 - scaled) / max(left, 1e-300))


@kernel
def _scaled(states: Float64, carried: Float64, kept: Float64) -> tuple[float, float]:
    """Sum of the supports of a pair that are left, and of its other states before."""
    first = second = left = 0.0
    for state in range(STATE_COUNT):
        if _FIRST[state]:
            first += states[state]
        elif _SECOND[state]:
            second += states[state]
        else:
            left += states[state]
    first *= kept[0] / max(carried[0], 1e-300)
    second *= kept[1] / max(carried[1], 1e-300)
    return first + second, left


@kernel
def rank_neighbours(  # noqa: D417
    objects: Int64,
    gaps_m: Float64,
    centre_steps_m: Float64,
    eligible: Bool,
    close: Bool,
    links: Int64,
    first_links: Int64,
) -> Int64:
    """Find the `NEAREST` eligible pairs of each object.

    Args:
        objects: (k,) rows.
        gaps_m, eligible: see `find_neighbours`.
        centre_steps_m: (m,) horizontal distance of the centres.
        close: (m, 2) bool; the pair is one of the nearest of that object; written.
        links, first_links: see `pair_links`.

    Returns:
        Rows of the pairs whose `close` changed; some twice.
    """
    changed = [np.int64(0)][:0]
    places = np.zeros(NEAREST, np.int64)
    distances = np.empty(NEAREST)
    for item in objects:
        places[:], distances[:] = 0, np.inf
        place = first_links[item]
        while place:
            row = (place - 1) >> 1
            if eligible[row]:
                distance = gaps_m[row] + CENTRE_FRACTION * centre_steps_m[row]
                _insert(distance, place, distances, places)
            place = links[row, (place - 1) & 1]
        place = first_links[item]
        while place:
            row, end = (place - 1) >> 1, (place - 1) & 1
            now = np.any(places == place)
            if close[row, end] != now:
                close[row, end] = now
                changed.append(row)
            place = links[row, end]
    return np.array(changed)


@kernel
def _insert(distance: float, place: int, distances: Float64, places: Int64) -> None:
    """Keep the smallest distances, in order. Of equal ones, the smaller place counts first."""
    index = len(distances)
    while index > 0:
        before = distances[index - 1]
        if before < distance or (before == distance and places[index - 1] < place):
            break
        index -= 1
        if index + 1 < len(distances):
            distances[index + 1], places[index + 1] = distances[index], places[index]
    if index < len(distances):
        distances[index], places[index] = distance, place


@kernel
def relate(  # noqa: D417
    rows: Int64,
    states: Float64,
    carried: Float64,
    kept: Float64,
    near: Float64,
    close: Bool,
    with_: Bool,
    near_votes: Float64,
    relations: Float64,
) -> Int64:
    """The relations of pairs in both directions.

    Args:
        rows: (k,) rows of pairs; it is overwritten.
        states, carried, kept, near, close, with_: see above.
        near_votes: (m,) logits that votes add to "near".
        relations: (m, 2, len(RELATIONS)) probabilities; written.

    Returns:
        The rows of the pairs whose relations changed.
    """
    count = 0
    now = np.empty((2, NONE + 1))
    for index in range(len(rows)):
        row = rows[index]
        scaled, left = _scaled(states[row], carried[row], kept[row])
        factor = (1.0 - scaled) / max(left, 1e-300)
        first = kept[row, 0] / max(carried[row, 0], 1e-300)
        second = kept[row, 1] / max(carried[row, 1], 1e-300)
        now[:] = 0.0
        for state in range(1, STATE_COUNT):
            by = first if _FIRST[state] else (second if _SECOND[state] else factor)
            now[0, RELATIONS_OF_STATE[state, 0]] += states[row, state] * by
            now[1, RELATIONS_OF_STATE[state, 1]] += states[row, state] * by
        unrelated = states[row, 0] * factor
        beside = NEAR_CERTAINTY * near[row]
        if not (with_[row, 0] or with_[row, 1] or (close[row, 0] and close[row, 1])):
            beside = 0.0
        beside = min(max(beside, 1.0 - NEAR_CERTAINTY), NEAR_CERTAINTY)
        beside = _expit(math.log(beside / (1.0 - beside)) + near_votes[row])
        changed = False
        for end in range(2):
            now[end, NEAR] = unrelated * beside
            now[end, NONE] += unrelated * (1.0 - beside)
            for relation in range(NONE + 1):
                changed |= relations[row, end, relation] != now[end, relation]
                relations[row, end, relation] = now[end, relation]
        if changed:
            rows[count] = row
            count += 1
    return rows[:count]
