"""The rules of `relations.rules` for all pairs at once, in plain NumPy: slow and obvious."""

import itertools

import numpy as np
from scipy.special import expit

from deworldsg_ros.relations.rules import (
    CARRIED_FIRST,
    CARRIED_SECOND,
    CENTRE_FRACTION,
    MIN_NEIGHBOUR,
    MOST,
    NEAR_CERTAINTY,
    NEAR_FLOOR_M,
    NEAR_FLOOR_SPREAD_M,
    NEAR_LEVEL_M,
    NEAR_LEVEL_SPREAD_M,
    NEAR_SUPPORT_M,
    NEAR_SUPPORT_SPREAD_M,
    NEAREST,
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
    on_floor: Float64,
    gaps_m: Float64,
    bottom_steps_m: Float64,
    centre_steps_m: Float64,
    unrelated: Float64,
    table_and_seat: Bool,
) -> Float64:
    """Probability that two objects are near, if no more specific relation holds between them.

    Both stand on one support, within reach, and each is among the nearest neighbours of the other.
    The arrays are as in `BELIEF`; `unrelated` is (m,) the probability of no specific relation.
    """
    supports = np.zeros((len(on_floor), len(on_floor)))
    first, second = pairs.T
    supports[first, second], supports[second, first] = carried.T
    together = (supports[first] * supports[second]).sum(axis=1)
    floor_reach = np.where(table_and_seat, SEAT_GAP_M, NEAR_FLOOR_M)
    on_one_floor = on_floor[first] * on_floor[second]
    on_one_floor *= expit((floor_reach - gaps_m) / NEAR_FLOOR_SPREAD_M)
    together *= expit((NEAR_SUPPORT_M - gaps_m) / NEAR_SUPPORT_SPREAD_M)
    together *= expit((NEAR_LEVEL_M - np.abs(bottom_steps_m)) / NEAR_LEVEL_SPREAD_M)
    near = np.minimum(on_one_floor + together, 1.0)
    eligible = near * unrelated > MIN_NEIGHBOUR
    distances_m = gaps_m + CENTRE_FRACTION * centre_steps_m
    close = np.zeros(pairs.shape)
    for item in range(len(on_floor)):
        rows, ends = np.nonzero((pairs == item) & eligible[:, None])
        for row, end in zip(rows, ends):
            steps_m = distances_m[row] - distances_m[rows[rows != row]]
            close[row, end] = at_most(NEAREST - 1, expit(steps_m / RANK_SPREAD_M))
    return np.asarray(NEAR_CERTAINTY * near * np.where(table_and_seat, 1.0, close.prod(axis=1)))


def at_most(number: int, probabilities: Float64) -> float:
    """Probability that at most this many of some independent events (n,) happen."""
    return sum(
        float(np.prod(np.where(happen, probabilities, 1.0 - probabilities)))
        for happen in itertools.product((False, True), repeat=len(probabilities))
        if sum(happen) <= number
    )
