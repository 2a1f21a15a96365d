"""The ids of nodes over the life of a graph, and the nodes of past frames."""

from __future__ import annotations

import itertools
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field

# With more removed ids than this, those that no remembered frame has are forgotten. An id takes 0.1
# kB.
PRUNE_ABOVE = 512
# The newest removed ids stay in any case: `FrameMemory` follows merges once in 256 frames, in which
# far fewer ids are removed, and names nodes that no remembered frame shows.
NEWEST_KEPT = 128


@dataclass(frozen=True)
class IdState:
    """Everything that `NodeIds` remembers.

    Attributes:
        next_id: id of the next node.
        successors: of each removed id, the id that replaced it; 0 = none.
        removals: ids removed since `NodeIds.take_removals` was last called.
        frames: node id of each row of a frame's local graph, by stamp in nanoseconds.
    """

    next_id: int = 1
    successors: Mapping[int, int] = field(default_factory=dict)
    removals: tuple[int, ...] = ()
    frames: Mapping[int, tuple[int, ...]] = field(default_factory=dict)


class NodeIds:
    """Gives out ids, follows merges, and remembers which node each row of a frame became.

    A removed id is forgotten when no remembered frame has it any more.

    Args:
        live: contains the ids of the live nodes.
        remembered_frames: number of newest frames that are remembered.
        state: from an earlier run.
    """

    def __init__(
        self, live: Container[object], remembered_frames: int, state: IdState | None = None
    ) -> None:
        state = state or IdState()
        self._live = live
        self._remembered_frames = remembered_frames
        self._next_id = state.next_id
        self._successors = dict(state.successors)
        self._removals = list(state.removals)
        self._frames = dict(state.frames)
        self._prune_above = PRUNE_ABOVE

    @property
    def next_id(self) -> int:
        """Id of the next node."""
        return self._next_id

    def state(self) -> IdState:
        """A copy of everything that is remembered."""
        return IdState(
            self._next_id, dict(self._successors), tuple(self._removals), dict(self._frames)
        )

    def take(self) -> int:
        """Take the next id; ids are never reused."""
        self._next_id += 1
        return self._next_id - 1

    def retire(self, node_id: int, successor: int) -> None:
        """Note that a node was removed, and which node replaces it; 0 = none."""
        self._successors[node_id] = successor
        self._removals.append(node_id)

    def resolve(self, node_id: int) -> int:
        """The live node that an id stands for, following merges; 0 = none."""
        if node_id in self._live:
            return node_id
        path = []
        while node_id in self._successors:
            path.append(node_id)
            node_id = self._successors[node_id]
        for passed in path[:-1]:  # later queries take one step
            self._successors[passed] = node_id
        return node_id if node_id in self._live else 0

    def take_removals(self) -> dict[int, int | None]:
        """Ids removed since the last call, each with the live node that it was merged into."""
        removals = {node_id: self.resolve(node_id) or None for node_id in self._removals}
        self._removals.clear()
        return removals

    def remember_frame(self, stamp_ns: int, node_ids: Iterable[int]) -> None:
        """Remember which node each row of a frame's local graph became."""
        self._frames.pop(stamp_ns, None)
        self._frames[stamp_ns] = tuple(node_ids)
        if len(self._frames) > self._remembered_frames:
            del self._frames[next(iter(self._frames))]
        if len(self._successors) > self._prune_above:
            self._prune()

    def _prune(self) -> None:
        """Forget the removed ids that nobody can ask for."""
        kept: set[int] = set()
        newest = list(self._successors)[-NEWEST_KEPT:]
        for node_id in itertools.chain(newest, self._removals, *self._frames.values()):
            while node_id in self._successors and node_id not in kept:
                kept.add(node_id)
                node_id = self._successors[node_id]
        self._successors = {old: new for old, new in self._successors.items() if old in kept}
        self._prune_above = max(PRUNE_ABOVE, 2 * len(kept))

    def nodes_of_frame(self, stamp_ns: int) -> list[int] | None:
        """The live node of each row of a frame (0 = removed); None = the frame is forgotten."""
        node_ids = self._frames.get(stamp_ns)
        return None if node_ids is None else [self.resolve(node_id) for node_id in node_ids]
