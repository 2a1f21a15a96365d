"""What was recorded: the graph after each numbered update, for the time slider."""

from __future__ import annotations

from dataclasses import dataclass, field

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.replica import GraphReplica

# A moment is found by applying at most so many updates to a snapshot.
BLOCK = 100
# The oldest updates are forgotten beyond this number: ten minutes at 30 Hz.
MOST_UPDATES = 18_000


@dataclass
class _Block:
    """A snapshot, the first moment of the block, and the updates after it."""

    start: wire.SceneGraphMessage
    updates: list[wire.SceneGraphUpdateMessage] = field(default_factory=list)

    def __len__(self) -> int:
        return 1 + len(self.updates)


class History:
    """The graph after each update. Moments are numbered from 0; the oldest are forgotten.

    Args:
        most_updates: number of moments that are kept, about.

    Attributes:
        newest: the graph now.
        first: number of the oldest moment that is kept.
    """

    def __init__(self, most_updates: int = MOST_UPDATES) -> None:
        self.newest = GraphReplica()
        self.first = 0
        self._most_blocks = max(most_updates // BLOCK, 1)
        self._blocks: list[_Block] = []

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
        if not self._blocks or update.sequence == 1 or len(self._blocks[-1]) >= BLOCK:
            self._begin(self.newest.message())
        else:
            self._blocks[-1].updates.append(update)
        return True

    def at(self, moment: int) -> GraphReplica:
        """The graph at a moment; the nearest one that is kept."""
        left = min(max(moment, self.first), self.last) - self.first
        replica = GraphReplica()
        for block in self._blocks:
            if left < len(block):
                replica.reset(block.start)
                for update in block.updates[:left]:
                    replica.apply(update)
                break
            left -= len(block)
        return replica

    def _begin(self, snapshot: wire.SceneGraphMessage) -> None:
        self._blocks.append(_Block(snapshot))
        if len(self._blocks) > self._most_blocks:
            self.first += len(self._blocks.pop(0))
