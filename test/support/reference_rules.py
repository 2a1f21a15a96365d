"""The rules of `relations.rules` for all pairs at once, in plain NumPy: slow and obvious."""

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from deworldsg_ros.relations.rules import (
    BETWEEN_GAP_M,
    BETWEEN_HEIGHT,
    BETWEEN_WORTH,
    CARRIED_FIRST,
    CARRIED_SECOND,
    CENTRE_FRACTION,
    LEAST_NEAR,
    MIN_NEIGHBOUR,
    MOST,
    MOST_NEAR,
    NEAR_FLOOR_M,
    NEAR_FLOOR_SPREAD_M,
    NEAR_LEVEL_M,
    NEAR_LEVEL_SPREAD_M,
    NEAR_SUPPORT_M,
    NEAR_SUPPORT_SPREAD_M,
    NEAREST,
    OVERLAP_M,
    OVERLAP_SPREAD_M,
    RANK_SPREAD_M,
    SEAT_GAP_M,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64

REST = ~(CARRIED_FIRST | CARRIED_SECOND)


def one_support(
    states: Float64, pairs: Int64, floor_odds: Float64
) -> tuple[Float64, Float64, Float64]:
    """See `relations.rules.one_support`."""
    carried = np.column_stack([states[:, CARRIED_FIRST].sum(1), states[:, CARRIED_SECOND].sum(1)])
    carried = np.minimum(carried, MOST)
    odds = carried / (1.0 - carried)
    total = 1.0 + floor_odds
    np.add.at(total, pairs, odds)
    kept = odds / total[pairs]
    kept *= np.minimum(1.0, MOST / np.maximum(kept.sum(axis=1, keepdims=True), 1e-300))
    while (circle := circle_of(kept, pairs)) is not None:
        kept[min(circle, key=kept.__getitem__)] *= 0.5
    result = states.copy()
    for end, chosen in enumerate((CARRIED_FIRST, CARRIED_SECOND)):
        factor = kept[:, end] / np.maximum(carried[:, end], 1e-300)
        result[:, chosen] = states[:, chosen] * factor[:, None]
    left = np.maximum(states[:, REST].sum(axis=1), 1e-300)
    factor = (1.0 - result[:, ~REST].sum(axis=1)) / left
    result[:, REST] = states[:, REST] * factor[:, None]
    return result, kept, floor_odds / total


def circle_of(kept: Float64, pairs: Int64) -> list[tuple[int, int]] | None:
    """Places (row, end) of the likely supports of a circle; None = they are a forest."""
    place = {int(pairs[row, end]): (row, end) for row, end in np.argwhere(kept > 0.5).tolist()}
    for start in place:
        walk, item = [], start
        while item in place and len(walk) <= len(place):
            row, end = place[item]
            walk.append((row, end))
            item = int(pairs[row, 1 - end])
            if item == start:
                return walk
    return None


def near_probabilities(
    pairs: Int64,
    carried: Float64,
    shapes: NDArray[np.void],
    on_floor: Float64,
    beliefs: NDArray[np.void],
    table_and_seat: Bool,
) -> tuple[Float64, Float64]:
    """Probability that two objects are near, if no more specific relation holds, before the votes.

    Both stand on one support, within reach, and not in one place; each is among the nearest
    neighbours of the other, and no neighbour stands between. `beliefs` has the measured geometry of
    the pairs. Also the part of standing side by side that is on the floor.
    """
    supports = np.zeros((len(on_floor), len(on_floor)))
    first, second = pairs.T
    supports[first, second], supports[second, first] = carried.T
    together = (supports[first] * supports[second]).sum(axis=1)
    gaps_m, steps_m = np.maximum(beliefs["gap_m"], 0), np.abs(beliefs["bottom_step_m"])
    floor_reach = np.where(table_and_seat, SEAT_GAP_M, NEAR_FLOOR_M)
    on_one_floor = on_floor[first] * on_floor[second]
    on_one_floor *= expit((floor_reach - gaps_m) / NEAR_FLOOR_SPREAD_M)
    together *= expit((NEAR_SUPPORT_M - gaps_m) / NEAR_SUPPORT_SPREAD_M)
    together *= expit((NEAR_LEVEL_M - steps_m) / NEAR_LEVEL_SPREAD_M)
    together *= expit((OVERLAP_M + beliefs["gap_m"]) / OVERLAP_SPREAD_M)
    near = np.minimum(on_one_floor + together, 1.0)
    near[np.isinf(gaps_m)] = 0.0
    floor_part = np.where(near > 0, on_one_floor / np.maximum(on_one_floor + together, 1e-30), 0.0)
    beside = near * (1.0 - carried.sum(axis=1))
    beside[beside <= MIN_NEIGHBOUR] = 0.0
    distances_m = gaps_m + CENTRE_FRACTION * beliefs["centre_step_m"]
    close, between = np.zeros(pairs.shape), np.zeros(pairs.shape)
    for item in range(len(on_floor)):
        rows, ends = np.nonzero((pairs == item) & (beside > 0)[:, None])
        for row, end in zip(rows, ends):
            others = rows[rows != row]
            steps = (distances_m[row] - distances_m[others]) / RANK_SPREAD_M
            close[row, end] = at_most(NEAREST - 1, beside[others] * expit(steps))
            if gaps_m[row] > BETWEEN_GAP_M:
                thirds = pairs[others].sum(axis=1) - item
                ways = [covered(*shapes[[item, pairs[row, 1 - end], third]]) for third in thirds]
                between[row, end] = max([*(beside[others] * ways), 0.0])
    near *= 1.0 - BETWEEN_WORTH * between.max(axis=1, initial=0.0)
    near *= np.where(table_and_seat, 1.0, close.prod(axis=1))
    return LEAST_NEAR + (MOST_NEAR - LEAST_NEAR) * near, floor_part


def covered(one: np.void, other: np.void, third: np.void) -> float:
    """Part of the width of the corridor between two outlines that a third one takes."""
    low, high = (np.array([s[name][2] for s in (one, other, third)]) for name in ("low", "high"))
    shared = min(high[:2]) - max(low[:2])
    if high[2] < max(low[:2]) + BETWEEN_HEIGHT * shared or low[2] >= min(high[:2]):
        return 0.0
    corridors = []
    for names in (("low", "high"), ("slant_low", "slant_high")):
        inner = [max(one[names[0]][k], other[names[0]][k]) for k in range(2)]
        outer = [min(one[names[1]][k], other[names[1]][k]) for k in range(2)]
        apart = np.subtract(inner, outer)
        ways = np.sort([inner, outer], axis=0)
        taken = np.minimum(ways[1], third[names[1]][:2]) - np.maximum(ways[0], third[names[0]][:2])
        across = 1 - int(apart.argmax())
        part = min(taken[across] / max(np.ptp(ways[:, across]), 0.01), 1.0)
        gap = np.hypot(*np.maximum(apart, 0))
        corridors.append((-gap, len(corridors), part if (taken > 0).all() else 0.0))
    return float(min(corridors)[2])


def at_most(number: int, probabilities: Float64) -> float:
    """Probability that at most this many of some independent events (n,) happen."""
    return sum(
        float(np.prod(np.where(happen, probabilities, 1.0 - probabilities)))
        for happen in itertools.product((False, True), repeat=len(probabilities))
        if sum(happen) <= number
    )
