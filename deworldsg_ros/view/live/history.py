"""What was recorded: the graph after each numbered update, for the time slider."""

from __future__ import annotations

import zlib
from typing import NamedTuple

from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

# Moments of a block: its snapshot, and the updates after it, which are applied in turn.
BLOCK = 100
# The oldest moments are forgotten beyond so many bytes, packed: minutes of a busy room at 30 Hz,
# hours of a quiet one.
MOST_BYTES = 64_000_000
# So large a part of them begins a new block, whose moments are forgotten together.
BLOCK_PART = 16


class Recipe(NamedTuple):
    """How to make the graph of a moment: a snapshot, and the updates after it; JSON, packed."""

    start: bytes
    updates: tuple[bytes, ...]

    def replica(self) -> GraphReplica:
        """The graph."""
        replica = GraphReplica()
        replica.reset(wire.decode(zlib.decompress(self.start), wire.SceneGraphMessage))
        for packed in self.updates:
            replica.apply(wire.decode(zlib.decompress(packed), wire.SceneGraphUpdateMessage))
        return replica


class _Block:
    """A snapshot, the first moment of the block, and the updates after it; JSON, packed."""

    def __init__(self, start: wire.SceneGraphMessage) -> None:
        self._start, self._updates = _packed(start), list[bytes]()
        self.updates_bytes = 0

    def __len__(self) -> int:
        return 1 + len(self._updates)

    def add(self, update: wire.SceneGraphUpdateMessage) -> None:
        """Add the next moment."""
        packed = _packed(update)
        self._updates.append(packed)
        self.updates_bytes += len(packed)

    @property
    def size_bytes(self) -> int:
        """Of all."""
        return len(self._start) + self.updates_bytes

    def at(self, moment: int) -> Recipe:
        """The graph at a moment of the block."""
        return Recipe(self._start, tuple(self._updates[:moment]))


def _packed(message: wire.Message) -> bytes:
    return zlib.compress(wire.encode(message).encode(), 1)


class History:
    """The graph after each update. Moments are numbered from 0; the oldest are forgotten.

    Args:
        most_bytes: that the moments take, about.

    Attributes:
        newest: the graph now.
        first: number of the oldest moment that is kept.
    """

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self.newest = GraphReplica()
        self.first = 0
        self._most_bytes = most_bytes
        self._blocks: list[_Block] = []

    @property
    def size_bytes(self) -> int:
        """That the moments take."""
        return sum(block.size_bytes for block in self._blocks)

    @property
    def session(self) -> str | None:
        """The session of the graph."""
        return self.newest.session

    @property
    def sequence(self) -> int:
        """Number of the newest update."""
        return self.newest.sequence

    @property
    def last(self) -> int:
        """Number of the newest moment; `first` - 1 if there is none."""
        return self.first + sum(map(len, self._blocks)) - 1

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Continue with a snapshot: of a file, or after lost updates."""
        self.newest.reset(snapshot)
        self._begin(snapshot)

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; False for one that is known.

        Raises:
            RefusedInput: ``lost_updates`` or ``other_session``, as `GraphReplica.apply`.
        """
        if not self.newest.apply(update):
            return False
        # The first update of a session replaces the graph, so it begins a block too.
        if not self._blocks or update.sequence == 1 or self._is_full(self._blocks[-1]):
            self._begin(self.newest.message())
        else:
            self._blocks[-1].add(update)
            self._forget()
        return True

    def at(self, moment: int) -> Recipe | None:
        """The graph at a moment, the nearest one that is kept; None = there is none."""
        left = min(max(moment, self.first), self.last) - self.first
        for block in self._blocks:
            if left < len(block):
                return block.at(left)
            left -= len(block)
        return None

    def _is_full(self, block: _Block) -> bool:
        return len(block) >= BLOCK or block.updates_bytes * BLOCK_PART >= self._most_bytes

    def _begin(self, snapshot: wire.SceneGraphMessage) -> None:
        self._blocks.append(_Block(snapshot))
        self._forget()

    def _forget(self) -> None:
        while len(self._blocks) > 1 and self.size_bytes > self._most_bytes:
            self.first += len(self._blocks.pop(0))
