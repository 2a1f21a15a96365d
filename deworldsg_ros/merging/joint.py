"""Evidence that two nodes are parts of one object, or that they are two that touch."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.gaussian import Float64

Pair = tuple[int, int]

# Two nodes are one when in this many frames an object lay on both, and they were not seen apart.
ENOUGH_FRAMES = 3
# One frame that shows them as two objects outweighs so many in which an object lay on both: a
# detector seldom makes two of one, but of two that touch it often sees one alone.
APART_FRAMES = 10


class JointEvidence:
    """Counts, for pairs of owners whose surfaces touch, the frames for and against their unity."""

    def __init__(self) -> None:
        self._counts: dict[Pair, int] = {}
        self._due: list[Pair] = []

    @property
    def counts(self) -> dict[Pair, int]:
        """Frames for, less those against, the unity of each pair of owners (smaller first)."""
        return dict(self._counts)

    def restore(self, counts: dict[Pair, int]) -> None:
        """Go on from the `counts` of an earlier run."""
        self._counts = {(min(pair), max(pair)): count for pair, count in counts.items()}

    def note(self, owners: list[int], shares: Float64, values: Float64, matched: list[int]) -> None:
        """Take in one frame of n objects that met k owners.

        Args:
            owners: the k owners.
            shares: (n, k) how far each object lay on each of them.
            values: (n, k) how well it fits; 0 where it cannot be the same.
            matched: column of the owner that each object became; -1 = none of them.
        """
        taken = set(matched)
        changes: dict[Pair, int] = {}
        for row, column in zip(*(places.tolist() for places in np.nonzero(shares))):
            match = matched[row]
            if match < 0 or match == column:
                continue
            a, b = owners[match], owners[column]
            pair = (a, b) if a < b else (b, a)
            if column in taken:
                changes[pair] = -APART_FRAMES
            elif values[row, column] > 0:
                changes[pair] = 1
        for pair, change in changes.items():
            self._counts[pair] = count = self._counts.get(pair, 0) + change
            if count >= ENOUGH_FRAMES:
                self._due.append(pair)

    def take(self) -> Pair | None:
        """The next pair that is one object, after which one of the two has to be forgotten."""
        while self._due:
            pair = self._due.pop()
            if pair in self._counts:
                return pair
        return None

    def forget(self, owner: int) -> None:
        """Drop what is known of an owner that is gone."""
        for pair in [pair for pair in self._counts if owner in pair]:
            del self._counts[pair]
