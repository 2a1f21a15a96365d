"""Evidence that two nodes are parts of one object, or that they are two."""

from __future__ import annotations

from collections import Counter

import numpy as np

from deworldsg_ros.scene.gaussian import Float64

Pair = tuple[int, int]

# Two nodes are one when in this many frames an object lay on both, and they were not seen apart.
ENOUGH_FRAMES = 3
# One frame that shows them as two objects outweighs so many in which an object lay on both: a
# detector seldom makes two of one, but of two that touch it often sees one alone.
APART_FRAMES = 10


class JointEvidence:
    """Counts, for pairs of owners, the frames for and against their unity.

    That one frame showed both counts wherever they were in it: when a mask later takes in both,
    or a pose is wrong, they are known to be two.
    """

    def __init__(self) -> None:
        # Frames in which an object lay on both of a pair, the smaller owner first.
        self._together: Counter[Pair] = Counter()
        # By owner, the frames that showed it (under itself), and it and each other.
        self._apart: dict[int, Counter[int]] = {}
        self._due: list[Pair] = []

    @property
    def counts(self) -> dict[Pair, int]:
        """Frames for, less those against, the unity of each pair of owners (smaller first)."""
        pairs = {(a, b) for a, others in self._apart.items() for b in others if a < b}
        return {pair: self._balance(pair) for pair in sorted(pairs.union(self._together))}

    def restore(self, counts: dict[Pair, int]) -> None:
        """Go on from the `counts` of an earlier run."""
        for (a, b), count in counts.items():
            frames = max(-(count // APART_FRAMES), 0)
            self._add_apart(a, b, frames)
            self._together[min(a, b), max(a, b)] = count + APART_FRAMES * frames

    def note(
        self, places: list[int], owners: list[int], values: Float64, matched: list[int]
    ) -> None:
        """Take in one frame of n objects that met k owners.

        Args:
            places: the owner that each object became, of those met or a new one.
            owners: the k owners.
            values: (n, k) how well each object fits each of them; 0 where it cannot be the same.
            matched: column of the owner that each object became; -1 = a new one.
        """
        for owner in places:
            self._apart.setdefault(owner, Counter()).update(places)
        taken = set(matched)
        pairs = set()
        for row, column in zip(*(ends.tolist() for ends in np.nonzero(values))):
            if matched[row] >= 0 and column not in taken:
                a, b = owners[matched[row]], owners[column]
                pairs.add((min(a, b), max(a, b)))
        self._together.update(pairs)
        self._due += [pair for pair in sorted(pairs) if self._balance(pair) >= ENOUGH_FRAMES]

    def take(self) -> Pair | None:
        """The next pair that is one object, after which the two have to be merged."""
        while self._due:
            pair = self._due.pop()
            if pair in self._together:
                return pair
        return None

    def merge(self, kept: int, gone: int) -> None:
        """Count two owners, which are one object, as one."""
        for other, frames in self._apart.get(gone, Counter()).items():
            if other not in (kept, gone):
                self._add_apart(kept, other, frames)
        self.forget(gone)

    def forget(self, owner: int) -> None:
        """Drop what is known of an owner that is gone."""
        for other in self._apart.pop(owner, ()):
            if other != owner:
                del self._apart[other][owner]
        for pair in [pair for pair in self._together if owner in pair]:
            del self._together[pair]

    def _balance(self, pair: Pair) -> int:
        a, b = pair
        apart = self._apart[a][b] if a in self._apart else 0
        return self._together[pair] - APART_FRAMES * apart

    def _add_apart(self, a: int, b: int, frames: int) -> None:
        for one, other in ((a, b), (b, a)):
            self._apart.setdefault(one, Counter())[other] += frames
