"""Differences of two graphs: of one session by id, of two sessions by place and class."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from deworldsg_ros.client.objects import SceneObject

# An object moved if the centre of its box did by this much, and by this part of its longest side:
# the box of a large object depends on the part that was seen. Two front ends in the rendered rooms
# differ by less in 98 of 100 objects.
MOVED_M, MOVED_PART = 0.08, 0.25
# Objects of two sessions are one object if their centres are within this distance, or within half
# of the longer side of the larger box.
SAME_PLACE_M = 0.3
# An object of the same class farther away than that has moved, up to this distance.
REACH_M = 3.0
# Cost of a pair that is out of reach: more than that of all other pairs together.
_FAR = 1e6


@dataclass(frozen=True)
class Pairing:
    """An object before and after.

    Attributes:
        before, after: the object in the two graphs.
        distance_m: of the centres.
    """

    before: SceneObject
    after: SceneObject

    @property
    def distance_m(self) -> float:
        """Distance of the centres of the boxes."""
        return float(np.linalg.norm(np.subtract(self.after.position_m, self.before.position_m)))

    @property
    def is_relabelled(self) -> bool:
        """Whether it has two names; to gain or lose one is no change."""
        return _are_called_differently(self.before, self.after)

    @property
    def has_moved(self) -> bool:
        """Whether the distance is more than the box of a resting object changes."""
        side = max(*self.before.size_m, *self.after.size_m)
        return self.distance_m > max(MOVED_M, MOVED_PART * side)


@dataclass(frozen=True)
class Changes:
    """The difference of two graphs.

    Attributes:
        added, gone: objects of the second, and of the first graph only.
        moved, relabelled: objects of both; one may be in both lists.
        same: number of objects that did neither.
    """

    added: tuple[SceneObject, ...]
    gone: tuple[SceneObject, ...]
    moved: tuple[Pairing, ...]
    relabelled: tuple[Pairing, ...]
    same: int

    def __bool__(self) -> bool:
        return bool(self.added or self.gone or self.moved or self.relabelled)

    @property
    def lines(self) -> list[str]:
        """One sentence for each change."""
        found = [f"added {item.name}{_not_sure(item)} at {_place(item)}" for item in self.added]
        found += [f"gone {item.name}{_not_sure(item)} from {_place(item)}" for item in self.gone]
        found += [
            f"moved {pair.after.name} by {pair.distance_m:.2f} m to {_place(pair.after)}"
            for pair in self.moved
        ]
        found += [
            f"relabelled {pair.before.name} as {pair.after.name}{_not_sure(pair.after)}"
            for pair in self.relabelled
        ]
        return found

    @property
    def dated_lines(self) -> list[str]:
        """The lines of what came, went and moved, with times."""
        found = [
            f"new {item.name}{_not_sure(item)} at {_place(item)}, since {_when(item.first_seen_ns)}"
            for item in self.added
        ]
        found += [
            f"gone {item.name}{_not_sure(item)} from {_place(item)}, "
            f"seen there until {_when(item.last_seen_ns)}"
            for item in self.gone
        ]
        found += [
            f"moved {pair.after.name} by {pair.distance_m:.2f} m to {_place(pair.after)}, "
            f"seen at its old place until {_when(pair.before.last_seen_ns)}"
            for pair in self.moved
        ]
        return found

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "added": [item.to_dict() for item in self.added],
            "gone": [item.to_dict() for item in self.gone],
            "moved": [
                {
                    "before": pair.before.to_dict(),
                    "after": pair.after.to_dict(),
                    "distance_m": round(pair.distance_m, 3),
                }
                for pair in self.moved
            ],
            "relabelled": [
                {"before": pair.before.to_dict(), "after": pair.after.to_dict()}
                for pair in self.relabelled
            ],
            "same": self.same,
        }


def changes_by_id(before: Mapping[int, SceneObject], after: Mapping[int, SceneObject]) -> Changes:
    """The changes between two graphs of one session; objects by id."""
    pairs = [Pairing(before[i], after[i]) for i in after if i in before]
    return _changes(
        [after[i] for i in after if i not in before],
        [before[i] for i in before if i not in after],
        pairs,
    )


def changes_by_place(before: Iterable[SceneObject], after: Iterable[SceneObject]) -> Changes:
    """The changes between graphs of two sessions in one world frame.

    Objects at one place are one object, whatever they are called. Of the rest, objects of one class
    in reach are one object that moved.
    """
    first, second = list(before), list(after)
    pairs = matched_by_place(first, second)
    first = _without(first, (pair.before for pair in pairs))
    second = _without(second, (pair.after for pair in pairs))
    moved = _matched(first, second, _move_cost, lambda _: REACH_M)
    return _changes(
        _without(second, (pair.after for pair in moved)),
        _without(first, (pair.before for pair in moved)),
        [*pairs, *moved],
    )


def matched_by_place(before: list[SceneObject], after: list[SceneObject]) -> list[Pairing]:
    """Objects at one place, one to one, whatever they are called."""
    return _matched(before, after, _place_cost, _place_reach_m)


def _matched(
    before: list[SceneObject],
    after: list[SceneObject],
    cost: Callable[[SceneObject, SceneObject], float],
    reach_m: Callable[[SceneObject], float],
) -> list[Pairing]:
    """The assignment of least total cost; pairs of infinite cost are left out.

    Args:
        before: the objects of one graph.
        after: those of the other one.
        cost: of a pair; infinite beyond the reach of both.
        reach_m: of an object.
    """
    # Slow to import, and only for changes.
    from scipy.optimize import linear_sum_assignment
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    costs = {(a, b): cost(before[a], after[b]) for a, b in _near(before, after, reach_m)}
    costs = {pair: value for pair, value in costs.items() if value < np.inf}
    if not costs:
        return []
    # Objects that no chain of pairs connects are not in each other's way.
    rows, columns = np.array(list(costs)).T
    ends, size = (rows, len(before) + columns), len(before) + len(after)
    group = connected_components(coo_array((np.ones(len(rows)), ends), (size, size)), False)[1]
    found = []
    order = np.argsort(group[rows], kind="stable")
    for pairs in np.split(order, np.flatnonzero(np.diff(group[rows][order])) + 1):
        of_a, of_b = np.unique(rows[pairs]).tolist(), np.unique(columns[pairs]).tolist()
        table = [[costs.get((a, b), _FAR) for b in of_b] for a in of_a]
        found += [(of_a[i], of_b[k]) for i, k in zip(*linear_sum_assignment(table))]
    return [Pairing(before[a], after[b]) for a, b in sorted(found) if (a, b) in costs]


def _near(
    before: list[SceneObject],
    after: list[SceneObject],
    reach_m: Callable[[SceneObject], float],
) -> set[tuple[int, int]]:
    """Pairs of indices within the reach of either object."""
    from scipy.spatial import cKDTree  # slow to import, and only for changes

    if not before or not after:
        return set()
    places = [np.array([item.position_m for item in items]) for items in (before, after)]
    # Beyond rounding.
    reaches = [1.001 * np.array([reach_m(item) for item in items]) for items in (before, after)]
    of_a = cKDTree(places[1]).query_ball_point(places[0], reaches[0])
    of_b = cKDTree(places[0]).query_ball_point(places[1], reaches[1])
    near = {(a, b) for a, found in enumerate(of_a) for b in found}
    return near | {(a, b) for b, found in enumerate(of_b) for a in found}


def _place_reach_m(item: SceneObject) -> float:
    return max(SAME_PLACE_M, max(item.size_m) / 2)


def _are_called_differently(a: SceneObject, b: SceneObject) -> bool:
    return a.is_named and b.is_named and a.label != b.label


def _place_cost(a: SceneObject, b: SceneObject) -> float:
    """Cost of taking two objects for one that did not move; infinite if they are too far apart."""
    distance = float(np.linalg.norm(np.subtract(a.position_m, b.position_m)))
    reach = max(_place_reach_m(a), _place_reach_m(b))
    # Different classes at one place are rarer than noise of the place.
    if _are_called_differently(a, b):
        reach, distance = reach / 2, distance + reach / 2
        return distance if distance <= 2 * reach else np.inf
    return distance if distance <= reach else np.inf


def _move_cost(a: SceneObject, b: SceneObject) -> float:
    distance = float(np.linalg.norm(np.subtract(a.position_m, b.position_m)))
    same = a.label == b.label and a.is_named
    return distance if same and distance <= REACH_M else np.inf


def _changes(added: list[SceneObject], gone: list[SceneObject], pairs: list[Pairing]) -> Changes:
    moved = [pair for pair in pairs if pair.has_moved]
    relabelled = [pair for pair in pairs if pair.is_relabelled]
    same = sum(not pair.has_moved and not pair.is_relabelled for pair in pairs)
    return Changes(tuple(added), tuple(gone), tuple(moved), tuple(relabelled), same)


def _without(items: list[SceneObject], taken: Iterable[SceneObject]) -> list[SceneObject]:
    ids = {item.id for item in taken}
    return [item for item in items if item.id not in ids]


def _place(item: SceneObject) -> str:
    return " ".join(f"{value:.2f}" for value in item.position_m)


def _not_sure(item: SceneObject) -> str:
    return "" if item.is_sure else " (not sure)"


def _when(stamp_ns: int) -> str:
    """A time of the local clock, to the second."""
    return datetime.fromtimestamp(stamp_ns / 1e9).isoformat(" ", "seconds")
