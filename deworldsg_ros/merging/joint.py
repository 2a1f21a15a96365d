"""Evidence that two nodes are parts of one object, or two objects."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float64

Pair = tuple[int, int]

# Weight of a frame in which an object that matched one node touched the other. Sides of one object
# that no view shows together touch, but so do neighbours.
TOUCHING_WEIGHT = 1
# Weight of a frame in which the object overlapped both nodes enough for a match.
OVERLAPPING_WEIGHT = 3
# Two nodes are merged at this sum: three frames in which an object overlapped both.
MERGE_THRESHOLD = 9
# A frame that shows both as two objects outweighs ten in which one object overlapped both. A
# detector seldom makes two objects of one, but it often detects only one of two that touch.
SEPARATE_WEIGHT = 30


class JointEvidence:
    """Sums, for pairs of owners, the frames for and against one object.

    A frame that shows two objects counts wherever they are in it. If later a mask covers both, or a
    pose is wrong, they are known to be two.
    """

    def __init__(self) -> None:
        # Sum of the weights for each pair, the smaller owner first.
        self._together: Counter[Pair] = Counter()
        # Number of frames that show both of a pair: by the smaller owner, then by the greater.
        self._separate: defaultdict[int, Counter[int]] = defaultdict(Counter)
        self._due: list[Pair] = []

    @property
    def balances(self) -> dict[Pair, int]:
        """Evidence for one object minus evidence for two, of each pair (smaller owner first)."""
        pairs = {(a, b) for a, others in self._separate.items() for b in others}
        return {pair: self._balance(pair) for pair in sorted(pairs.union(self._together))}

    def restore(self, balances: dict[Pair, int]) -> None:
        """Continue with the `balances` of an earlier run."""
        for pair, balance in balances.items():
            a, b = sorted(pair)
            self._separate[a][b] = max(-(balance // SEPARATE_WEIGHT), 0)
            self._together[a, b] = balance + SEPARATE_WEIGHT * self._separate[a][b]

    def add_frame(
        self,
        object_owners: list[int],
        owners: list[int],
        match_scores: Float64,
        touching: Bool,
        matched: list[int],
    ) -> None:
        """Add one frame of n objects that met k owners.

        Args:
            object_owners: owner of each object, matched or new.
            owners: the k owners.
            match_scores: (n, k) match score of each object and owner; 0 = no match possible.
            touching: (n, k) whether their surfaces touch and their classes agree.
            matched: column of the owner that each object matched; -1 = a new owner.
        """
        ascending = sorted(object_owners)
        for position, owner in enumerate(ascending):
            self._separate[owner].update(ascending[position + 1 :])
        taken = set(matched)
        evidence: dict[Pair, int] = {}
        for row, column in np.argwhere(touching | (match_scores > 0)).tolist():
            if matched[row] >= 0 and column not in taken:
                a, b = owners[matched[row]], owners[column]
                pair = min(a, b), max(a, b)
                weight = OVERLAPPING_WEIGHT if match_scores[row, column] else TOUCHING_WEIGHT
                evidence[pair] = max(evidence.get(pair, 0), weight)
        self._together.update(evidence)
        self._due += [pair for pair in evidence if self._balance(pair) >= MERGE_THRESHOLD]

    def next_merge(self) -> Pair | None:
        """The next pair that is one object; the caller has to merge it. None = no more."""
        while self._due:
            pair = self._due.pop()
            # An earlier merge may have changed the evidence since the pair became due.
            if self._balance(pair) >= MERGE_THRESHOLD:
                return pair
        return None

    def merge(self, kept: int, removed: int) -> None:
        """Combine the evidence of two owners that are one object."""
        separate = self._separate[removed].copy()
        separate.update(
            {a: others[removed] for a, others in self._separate.items() if removed in others}
        )
        for other, frames in separate.items():
            if other != kept:
                self._separate[min(kept, other)][max(kept, other)] += frames
        self.forget(removed)

    def forget(self, owner: int) -> None:
        """Drop the evidence of a removed owner."""
        self._separate.pop(owner, None)
        for others in self._separate.values():
            others.pop(owner, None)
        for pair in [pair for pair in self._together if owner in pair]:
            del self._together[pair]

    def _balance(self, pair: Pair) -> int:
        a, b = pair
        return self._together[pair] - SEPARATE_WEIGHT * self._separate[a][b]
