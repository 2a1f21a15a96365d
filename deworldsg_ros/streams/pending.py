"""Relation evidence that arrives before its local graph."""

from __future__ import annotations

from collections import deque

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import RelationEvidence


class PendingEvidence:
    """A bounded buffer of relation evidence; the oldest is dropped first.

    Args:
        capacity: maximum number of messages.
        most_bytes: of the predictions of all messages, when there are two or more.
    """

    def __init__(self, capacity: int = 256, most_bytes: int = 1 << 26) -> None:
        self._capacity, self._most_bytes = capacity, most_bytes
        self._waiting: deque[RelationEvidence] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, evidence: RelationEvidence) -> None:
        """Keep a message until `take`.

        Raises:
            RefusedInput: ``unmatched_evidence`` for the oldest message, if the buffer is full.
        """
        self._waiting.append(evidence)
        size = sum(item.predictions.nbytes for item in self._waiting)
        many = len(self._waiting) > self._capacity
        if many or (size > self._most_bytes and len(self._waiting) > 1):
            oldest = self._waiting.popleft()
            raise RefusedInput(
                "unmatched_evidence",
                f"relation evidence at {oldest.stamp_ns / 1e9:.3f} s: no local graph of this "
                f"stamp arrived during {len(self._waiting)} later messages. Check lifting_node",
            )

    def clear(self) -> int:
        """Drop all messages, after a jump of the clock; returns their number."""
        count = len(self._waiting)
        self._waiting.clear()
        return count

    def take(self, stamp_ns: int) -> list[RelationEvidence]:
        """Remove and return the messages with this stamp, in order of arrival; drop older ones."""
        taken = [evidence for evidence in self._waiting if evidence.stamp_ns == stamp_ns]
        self._waiting = deque(item for item in self._waiting if item.stamp_ns > stamp_ns)
        return taken
