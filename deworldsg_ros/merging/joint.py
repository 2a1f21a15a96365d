"""Evidence that two nodes are parts of one object, or that they are two."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float64

Pair = tuple[int, int]

# A frame in which an object that became one of two nodes touched the other, as sides of one thing
# do that no view shows together, but neighbours, too; and one in which it lay on both.
TOUCHED = 1
LAY_ON_BOTH = 3
# So much makes the two one: three frames in which an object lay on both.
ENOUGH = 9
# One frame that shows them as two objects outweighs ten in which an object lay on both: a detector
# seldom makes two of one, but of two that touch it often sees one alone.
APART = 30


class JointEvidence:
    """Weighs, for pairs of owners, the frames for and against their unity.

    That one frame showed both counts wherever they were in it: when a mask later takes in both,
    or a pose is wrong, they are known to be two.
    """

    def __init__(self) -> None:
        # What speaks for each pair, the smaller owner first.
        self._together: Counter[Pair] = Counter()
        # Frames that showed both of a pair: by the smaller owner, then by the greater.
        self._apart: defaultdict[int, Counter[int]] = defaultdict(Counter)
        self._due: list[Pair] = []

    @property
    def counts(self) -> dict[Pair, int]:
        """What speaks for, less what speaks against, the unity of each pair (smaller first)."""
        pairs = {(a, b) for a, others in self._apart.items() for b in others}
        return {pair: self._balance(pair) for pair in sorted(pairs.union(self._together))}

    def restore(self, counts: dict[Pair, int]) -> None:
        """Go on from the `counts` of an earlier run."""
        for pair, count in counts.items():
            a, b = sorted(pair)
            self._apart[a][b] = max(-(count // APART), 0)
            self._together[a, b] = count + APART * self._apart[a][b]

    def note(
        self,
        places: list[int],
        owners: list[int],
        values: Float64,
        touching: Bool,
        matched: list[int],
    ) -> None:
        """Take in one frame of n objects that met k owners.

        Args:
            places: the owner that each object became, of those met or a new one.
            owners: the k owners.
            values: (n, k) how well each object fits each of them; 0 where it cannot be the same.
            touching: (n, k) whether its surface touches theirs and their classes agree.
            matched: column of the owner that each object became; -1 = a new one.
        """
        ascending = sorted(places)
        for place, owner in enumerate(ascending):
            self._apart[owner].update(ascending[place + 1 :])
        taken = set(matched)
        evidence: dict[Pair, int] = {}
        for row, column in np.argwhere(touching | (values > 0)).tolist():
            if matched[row] >= 0 and column not in taken:
                a, b = owners[matched[row]], owners[column]
                pair = min(a, b), max(a, b)
                weight = LAY_ON_BOTH if values[row, column] else TOUCHED
                evidence[pair] = max(evidence.get(pair, 0), weight)
        self._together.update(evidence)
        self._due += [pair for pair in evidence if self._balance(pair) >= ENOUGH]

    def take(self) -> Pair | None:
        """The next pair that is one object, after which the two have to be merged."""
        while self._due:
            pair = self._due.pop()
            # Since it was due, one of the two may have become a part of what the other is not.
            if self._balance(pair) >= ENOUGH:
                return pair
        return None

    def merge(self, kept: int, gone: int) -> None:
        """Count two owners, which are one object, as one."""
        beside = self._apart[gone].copy()
        beside.update({a: others[gone] for a, others in self._apart.items() if gone in others})
        for other, frames in beside.items():
            if other != kept:
                self._apart[min(kept, other)][max(kept, other)] += frames
        self.forget(gone)

    def forget(self, owner: int) -> None:
        """Drop what is known of an owner that is gone."""
        self._apart.pop(owner, None)
        for others in self._apart.values():
            others.pop(owner, None)
        for pair in [pair for pair in self._together if owner in pair]:
            del self._together[pair]

    def _balance(self, pair: Pair) -> int:
        a, b = pair
        return self._together[pair] - APART * self._apart[a][b]
