"""Evidence that came before the local graph it speaks of."""

from __future__ import annotations

from collections import deque

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import RelationEvidence


class PendingEvidence:
    """A bounded waiting room, oldest out first.

    Args:
        capacity: messages that may wait.
    """

    def __init__(self, capacity: int = 256) -> None:
        self._capacity = capacity
        self._waiting: deque[RelationEvidence] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, evidence: RelationEvidence) -> None:
        """Let a message wait.

        Raises:
            RefusedInput: ``unmatched_evidence`` for the oldest, where there is no room for it.
        """
        self._waiting.append(evidence)
        if len(self._waiting) > self._capacity:
            oldest = self._waiting.popleft()
            raise RefusedInput(
                "unmatched_evidence",
                f"relation evidence of {oldest.stamp_ns / 1e9:.3f} s: its local graph did not come "
                f"while {self._capacity} other messages did",
            )

    def take(self, stamp_ns: int) -> list[RelationEvidence]:
        """Messages of this frame, in the order in which they came, and of none before it."""
        taken = [evidence for evidence in self._waiting if evidence.stamp_ns == stamp_ns]
        self._waiting = deque(item for item in self._waiting if item.stamp_ns > stamp_ns)
        return taken
