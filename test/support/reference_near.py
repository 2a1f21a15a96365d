"""What is near, for all pairs at once: the reference of `relations.rules`."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import expit

from deworldsg_ros.relations.rules import (
    CENTRE_FRACTION,
    MIN_NEIGHBOUR,
    NEAR_CERTAINTY,
    NEAR_FLOOR_M,
    NEAR_FLOOR_SPREAD_M,
    NEAR_LEVEL_M,
    NEAR_LEVEL_SPREAD_M,
    NEAR_SUPPORT_M,
    NEAR_SUPPORT_SPREAD_M,
    NEAREST,
    SEAT_GAP_M,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64


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

    Args:
        pairs: (m, 2) objects.
        carried: (m, 2) probability that the first rests on the second, and the opposite.
        on_floor: (n,) probability that an object stands on the floor.
        gaps_m: (m,) horizontal gap of the bounds.
        bottom_steps_m: (m,) difference of the heights of the bottoms.
        centre_steps_m: (m,) horizontal distance of the centres.
        unrelated: (m,) probability that no more specific relation holds.
        table_and_seat: (m,) bool; a table and a seat, in any order.

    Returns:
        (m,) from 0 to `NEAR_CERTAINTY`.
    """
    count = len(on_floor)
    children = np.concatenate([pairs[:, 0], pairs[:, 1]])
    parents = np.concatenate([pairs[:, 1], pairs[:, 0]])
    supports = csr_matrix(
        (np.concatenate([carried[:, 0], carried[:, 1]]), (children, parents)), (count, count)
    )
    first, second = pairs[:, 0], pairs[:, 1]
    together = np.asarray(supports[first].multiply(supports[second]).sum(axis=1)).ravel()
    floor_reach = np.where(table_and_seat, SEAT_GAP_M, NEAR_FLOOR_M)
    on_one_floor = (
        on_floor[first] * on_floor[second]
        * expit((floor_reach - gaps_m) / NEAR_FLOOR_SPREAD_M)
    )  # fmt: skip
    on_one_support = (
        together
        * expit((NEAR_SUPPORT_M - gaps_m) / NEAR_SUPPORT_SPREAD_M)
        * expit((NEAR_LEVEL_M - np.abs(bottom_steps_m)) / NEAR_LEVEL_SPREAD_M)
    )
    near = np.minimum(on_one_floor + on_one_support, 1.0)
    eligible = near * unrelated > MIN_NEIGHBOUR
    ranks = _ranks(pairs, gaps_m + CENTRE_FRACTION * centre_steps_m, eligible, count)
    near = np.where((ranks.max(axis=1) < NEAREST) | table_and_seat, near, 0.0)
    return np.asarray(NEAR_CERTAINTY * near)


def _ranks(pairs: Int64, distances_m: Float64, eligible: Bool, count: int) -> Int64:
    """Rank (m, 2) of each pair's distance among the eligible pairs of either object."""
    rows = np.flatnonzero(eligible)
    objects = pairs[rows].T.ravel()
    order = np.lexsort((np.tile(distances_m[rows], 2), objects))
    starts = np.searchsorted(objects[order], np.arange(count))
    position = np.empty(len(order), np.int64)
    position[order] = np.arange(len(order)) - starts[objects[order]]
    ranks = np.full((len(pairs), 2), max(len(pairs), NEAREST), np.int64)
    ranks[rows] = position.reshape(2, -1).T
    return ranks
