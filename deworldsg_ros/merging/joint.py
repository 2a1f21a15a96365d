"""Evidence that two nodes are parts of one object, or two objects."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection

import numpy as np

from deworldsg_ros.merging.matching import Matches
from deworldsg_ros.scene.arrays import Float64

Pair = tuple[int, int]

# Weight of a frame in which an object that matched one node touched the other. Sides of one object
# that no view shows together touch, but so do neighbours.
TOUCHING_WEIGHT = 1
# Weight of a frame in which the object overlapped both nodes enough for a match. A frame that shows
# two objects, one of them unsure, weighs as much for two.
OVERLAPPING_WEIGHT = 3
# Two nodes are merged at this sum: three frames in which an object overlapped both.
MERGE_THRESHOLD = 9
# A frame that shows both as two objects outweighs ten in which one object overlapped both. A
# detector seldom makes two objects of one, but it often detects only one of two that touch.
SEPARATE_WEIGHT = 30
# A detection with a lower score is unsure. An object lies on a node if at least this fraction of
# its cells does. With NanoDet (scores from 0.2; a rendered room and the shipped recording), 36 % of
# 1253 pairs of one frame and class with an unsure detection were one object if one lay on the
# other's node, and 9 % of 1385 if not. So the former count as touching: a detector often puts a
# second box on an object. Of pairs with two sure detections 3 of 18 were one object, and 0 of 390
# with recorded masks.
SURE_SCORE = 0.45
NESTED_FRACTION = 0.7
# After a step of this length, a frame counts as three: its errors are not those of the last frame.
# In a room at 10 Hz, nine steps of ten are shorter than 0.1 m.
WIDE_STEP_M = 0.2
WIDE_STEP_FACTOR = 3


class JointEvidence:
    """Sums, for pairs of owners, the frames for and against one object.

    A frame that shows two objects counts wherever they are in it. If later a mask covers both, or a
    pose is wrong, they are known to be two.
    """

    def __init__(self) -> None:
        # Evidence for one object minus evidence for two: by the smaller owner, then the greater.
        self._balances: defaultdict[int, dict[int, int]] = defaultdict(dict)
        # The smaller owners that have evidence about a greater one.
        self._smaller: defaultdict[int, set[int]] = defaultdict(set)
        self._due: list[Pair] = []
        self._camera_world = np.full(3, np.nan)

    @property
    def balances(self) -> dict[Pair, int]:
        """Evidence for one object minus evidence for two, of each pair (smaller owner first)."""
        return {(a, b): row[b] for a, row in sorted(self._balances.items()) for b in sorted(row)}

    def restore(self, balances: dict[Pair, int]) -> None:
        """Continue with the `balances` of an earlier run."""
        for (a, b), balance in balances.items():
            self._balances[min(a, b)][max(a, b)] = balance
            self._smaller[max(a, b)].add(min(a, b))

    def add_frame(
        self,
        object_owners: list[int],
        matches: Matches,
        detection_scores: Float64,
        camera_world: Float64,
    ) -> None:
        """Add one frame of n objects that met k owners.

        Args:
            object_owners: owner of each object, matched or new.
            matches: of the objects and the k owners.
            detection_scores: (n,) scores of the objects.
            camera_world: (3,) camera position, metres.
        """
        sure = dict(zip(object_owners, (detection_scores >= SURE_SCORE).tolist()))
        evidence: dict[Pair, int] = {}
        taken = set(matches.columns)
        met = (matches.touching | (matches.scores > 0)).nonzero()
        nested = matches.touching[met] & (matches.on_nodes[met] >= NESTED_FRACTION)
        for row, column, score, is_nested in zip(
            *(places.tolist() for places in met), matches.scores[met].tolist(), nested.tolist()
        ):
            a, b = object_owners[row], matches.owners[column]
            pair = (a, b) if a < b else (b, a)
            if column not in taken:
                if matches.columns[row] >= 0:
                    weight = OVERLAPPING_WEIGHT if score else TOUCHING_WEIGHT
                    evidence[pair] = max(evidence.get(pair, 0), weight)
            elif is_nested and a != b and not (sure[a] and sure[b]):
                evidence[pair] = TOUCHING_WEIGHT
        self._separate(sure, evidence)
        step = camera_world - self._camera_world
        step_m = math.sqrt(step @ step)
        self._camera_world = camera_world.copy()
        factor = WIDE_STEP_FACTOR if step_m > WIDE_STEP_M else 1
        for (a, b), weight in evidence.items():
            self._add(a, b, weight * factor)
            if self._balances[a][b] >= MERGE_THRESHOLD:
                self._due.append((a, b))

    def next_merge(self) -> Pair | None:
        """The next pair that is one object; the caller has to merge it. None = no more."""
        while self._due:
            a, b = self._due.pop()
            # An earlier merge may have changed the evidence since the pair became due.
            if self._balances[a].get(b, 0) >= MERGE_THRESHOLD:
                return a, b
        return None

    def merge(self, kept: int, removed: int) -> None:
        """Combine the evidence against one object of two owners that are one."""
        against = {b: balance for b, balance in self._balances[removed].items() if balance < 0}
        for a in self._smaller[removed]:
            balance = self._balances[a].get(removed, 0)
            if balance < 0:
                against[a] = balance
        self.forget(removed)
        for other, balance in against.items():
            if other != kept:
                self._add(min(kept, other), max(kept, other), balance)

    def forget(self, owner: int) -> None:
        """Drop the evidence of a removed owner."""
        for b in self._balances.pop(owner, ()):
            self._smaller[b].discard(owner)
        for a in self._smaller.pop(owner, ()):
            self._balances[a].pop(owner, None)

    def _add(self, a: int, b: int, balance: int) -> None:
        row = self._balances[a]
        row[b] = row.get(b, 0) + balance
        self._smaller[b].add(a)

    def _separate(self, sure: dict[int, bool], nested: Collection[Pair]) -> None:
        """Count the pairs of a frame as two objects, except some."""
        ascending = sorted(sure.items())
        for position, (a, a_sure) in enumerate(ascending):
            row = self._balances[a]
            for b, b_sure in ascending[position + 1 :]:
                if nested and (a, b) in nested:
                    continue
                balance = row.get(b)
                if balance is None:
                    self._smaller[b].add(a)
                    balance = 0
                weight = SEPARATE_WEIGHT if a_sure and b_sure else OVERLAPPING_WEIGHT
                row[b] = balance - weight
