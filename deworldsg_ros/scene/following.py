"""Following a graph from its topics: the latched snapshot, the numbered updates, and gaps."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import RefusedInput

# Updates that wait for a snapshot; graph_node's publisher keeps as many.
MOST_WAITING = 50


class Copy(Protocol):
    """A copy of a graph, such as `GraphReplica`."""

    @property
    def session(self) -> str | None:
        """The session of the graph."""
        ...

    @property
    def sequence(self) -> int:
        """Number of the last update in the copy."""
        ...

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Replace the copy by a snapshot."""
        ...

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; raises RefusedInput if others are missing before it."""
        ...


class GraphFollower:
    """Keeps a copy up to date. After a gap it waits for the next snapshot, about a second.

    Args:
        copy: an empty copy.

    Attributes:
        gaps: number of times that updates were lost.
        has_graph: whether the copy has a graph.
    """

    def __init__(self, copy: Copy) -> None:
        self.gaps = 0
        self.has_graph = False
        self._copy = copy
        self._waiting: deque[wire.SceneGraphUpdateMessage] = deque(maxlen=MOST_WAITING)

    def snapshot(self, snapshot: wire.SceneGraphMessage) -> bool:
        """Take a message of `/scene_graph`; returns whether the copy has changed."""
        same = self.has_graph and (snapshot.session or None) == self._copy.session
        if same and snapshot.sequence <= self._copy.sequence:
            return False
        self._copy.reset(snapshot)
        self.has_graph = True
        # Updates that came during the gap, and are newer than the snapshot.
        waiting, self._waiting = self._waiting, deque(maxlen=MOST_WAITING)
        for update in waiting:
            self.update(update)
        return True

    def update(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Take a message of `/scene_graph/updates`; returns whether the copy has changed."""
        try:
            applied = self._copy.apply(update)
        except RefusedInput:
            self.gaps += self.has_graph and not self._waiting
            self._waiting.append(update)
            return False
        self.has_graph |= applied
        return applied
