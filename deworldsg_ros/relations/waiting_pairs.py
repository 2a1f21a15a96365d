"""The pairs of nodes that wait to be judged."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import filterfalse

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Int64
from deworldsg_ros.scene.edges import ends_of
from deworldsg_ros.scene.waiting import take_first


class WaitingPairs:
    """Pairs that wait to be judged: those that are not in the table come first.

    Args:
        known: the pairs in the table, by key.
        published: the nodes that are published, by id.
    """

    def __init__(self, known: Mapping[int, int], published: Mapping[int, int]) -> None:
        self._known = known
        self._published = published
        self._new: dict[int, None] = {}
        self._again: dict[int, None] = {}
        # Those that have another geometry.
        self._moved: set[int] = set()

    def __len__(self) -> int:
        return len(self._new) + len(self._again)

    def add(self, keys: Collection[int]) -> None:
        """Let pairs wait. Those with a node that is not published count when it is."""
        # Most are known: a loop of Python is for the others only.
        self._again.update(dict.fromkeys(filter(self._known.__contains__, keys)))
        for pair_key in filterfalse(self._known.__contains__, keys):
            if self._are_published(pair_key):
                self._new[pair_key] = None

    def move(self, keys: Int64) -> None:
        """Let pairs wait that have another geometry."""
        moved = keys.tolist()
        self._moved.update(moved)
        self.add(moved)

    def forget(self, pair_key: int) -> None:
        """A pair has left the table."""
        self._again.pop(pair_key, None)
        self._moved.discard(pair_key)

    def take(self, at_most: int | None) -> tuple[list[int], Bool]:
        """Keys (k,) of the pairs to judge now; and (k,) which have another geometry."""
        due = []
        for pair_key in take_first(self._new, at_most):
            if self._are_published(pair_key):
                due.append(pair_key)
            else:  # a node went since
                self._moved.discard(pair_key)
        due += take_first(self._again, None if at_most is None else at_most - len(due))
        moved = np.array([pair_key in self._moved for pair_key in due], np.bool_)
        self._moved.difference_update(due)
        return due, moved

    def _are_published(self, pair_key: int) -> bool:
        first, second = ends_of(pair_key)
        return first in self._published and second in self._published
