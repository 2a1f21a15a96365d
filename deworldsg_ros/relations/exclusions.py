"""What relations of different pairs exclude: one support an object, no circles; and what is near.

The numbers of these rules, and the rule of supports for all pairs at once, as training needs it.
`settling` applies the rules where something changed.

Pairs are rows of parallel arrays; an object is an index from 0 to n - 1.
"""

from __future__ import annotations

import numpy as np

from deworldsg_ros.relations.physical_states import RELATIONS_OF_STATE, STATE_COUNT, SUPPORTS
from deworldsg_ros.scene.arrays import Float64, Int64

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
    _cut_circles(kept, pairs, len(floor_odds))
    result = states.copy()
    for end, chosen in enumerate((CARRIED_FIRST, CARRIED_SECOND)):
        factor = kept[:, end] / np.maximum(carried[:, end], 1e-300)
        result[:, chosen] = states[:, chosen] * factor[:, None]
    rest = ~(CARRIED_FIRST | CARRIED_SECOND)
    left = states[:, rest].sum(axis=1)
    factor = (1.0 - result[:, ~rest].sum(axis=1)) / np.maximum(left, 1e-300)
    result[:, rest] = states[:, rest] * factor[:, None]
    return result, kept, floor_odds / total


def _cut_circles(kept: Float64, pairs: Int64, count: int) -> None:
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
