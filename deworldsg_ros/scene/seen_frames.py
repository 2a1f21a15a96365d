"""Which frames an object or a relation comes from: the first, the last, and the clearest few.

They are not in the messages. A saved graph has them in a second file beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec

from deworldsg_ros.files import read_regular, write_atomically
from deworldsg_ros.parsing import parse_json
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.limits import MAX_INT

# Clearest frames that are kept of a node, and of a directed pair of nodes.
CLEAREST = 3
# Entries of removed nodes are dropped after so many frames.
PRUNE_FRAMES = 256
# A fainter vote for a relation is not noted.
MIN_VOTE = 0.05
# Decimals of how clear a frame is. What exceeds a number by less is rounded to it, or below it.
DECIMALS, _ROUNDED_OFF = 3, 0.0004
# 10^5 nodes and their pairs have 100 MB.
MAX_BYTES = 1 << 30

Stamp = Annotated[int, msgspec.Meta(ge=-MAX_INT, le=MAX_INT)]
Key = tuple[int, int]


class SeenFrame(msgspec.Struct, frozen=True, array_like=True, order=True):
    """What one frame said: how clearly (0 to 1), when, and which class or predicate."""

    strength: Annotated[float, msgspec.Meta(ge=0.0, le=1.0 + 1e-9)]
    stamp_ns: Stamp
    name: str


class SeenFrames(msgspec.Struct, array_like=True):
    """The frames of a node, or of a directed pair (subject, object).

    Attributes:
        node, other: ids; other is 0 for a node.
        first_ns, last_ns: stamps of the first and the last frame.
        clearest: the clearest frames, the clearest first.
    """

    node: Annotated[int, msgspec.Meta(ge=1, le=MAX_INT)]
    other: Annotated[int, msgspec.Meta(ge=0, le=MAX_INT)]
    first_ns: Stamp
    last_ns: Stamp
    clearest: Annotated[list[SeenFrame], msgspec.Meta(max_length=CLEAREST)]


class SeenFramesFile(msgspec.Struct):
    """All frames of a graph; the stamp is that of the graph that they belong to."""

    stamp_ns: Stamp
    seen: list[SeenFrames]


class FrameMemory:
    """Notes the frames of all nodes and pairs of a graph.

    Args:
        seen: of an earlier run.
    """

    def __init__(self, seen: Sequence[SeenFrames] = ()) -> None:
        self._seen: dict[Key, SeenFrames] = {(item.node, item.other): item for item in seen}
        self._frames = 0

    def note(
        self, graph: SceneGraph, local: LocalGraph, node_ids: Sequence[int], votes: Float64
    ) -> None:
        """Note a merged frame, the node of each of its rows, and its `frame_votes`."""
        names, stamp_ns = graph.vocabulary, local.stamp_ns
        classes = local.class_probabilities
        strengths = (local.scores * classes.max(axis=1, initial=0.0)).tolist()
        for node_id, label, strength in zip(node_ids, _best(classes), strengths):
            if node_id:  # 0 = this frame removed it
                self._add((node_id, 0), strength, stamp_ns, names.classes[label])
        pairs, values = local.relations.pairs.tolist(), votes.max(axis=1, initial=0.0).tolist()
        for (subject, object_), label, vote in zip(pairs, _best(votes), values):
            pair = node_ids[subject], node_ids[object_]
            if vote >= MIN_VOTE and 0 not in pair and pair[0] != pair[1]:
                self._add(pair, vote, stamp_ns, names.predicates[label])
        self._frames += 1
        if self._frames % PRUNE_FRAMES == 0:
            self._follow(graph)

    def all(self, graph: SceneGraph) -> list[SeenFrames]:
        """The frames of the live nodes and their pairs, by ids."""
        self._follow(graph)
        return [self._seen[key] for key in sorted(self._seen)]

    def copy(self, node_id: int, new_id: int) -> None:
        """Give a node the frames of another one that was edited."""
        seen = self._seen.get((node_id, 0))
        for frame in () if seen is None else seen.clearest:
            self._add((new_id, 0), frame.strength, frame.stamp_ns, frame.name)

    def _add(self, key: Key, strength: float, stamp_ns: int, name: str) -> None:
        seen = self._seen.get(key)
        if seen is None:
            seen = self._seen[key] = SeenFrames(*key, stamp_ns, stamp_ns, [])
        if stamp_ns < seen.first_ns:
            seen.first_ns = stamp_ns
        if stamp_ns > seen.last_ns:
            seen.last_ns = stamp_ns
        clearest = seen.clearest
        # Most frames are not among the clearest; to round takes longer than this.
        if len(clearest) == CLEAREST and strength <= clearest[-1].strength + _ROUNDED_OFF:
            return
        strength = round(strength, DECIMALS)
        if len(clearest) < CLEAREST or strength > clearest[-1].strength:
            _insert(seen, SeenFrame(strength, stamp_ns, name))

    def _follow(self, graph: SceneGraph) -> None:
        """Follow merges, and forget removed nodes."""
        known, self._seen = self._seen, {}
        for (node_id, other_id), seen in known.items():
            key = graph.resolve(node_id), graph.resolve(other_id) if other_id else 0
            if not key[0] or (other_id and not key[1]) or key[0] == key[1]:
                continue
            present = self._seen.get(key)
            if present is None:
                seen.node, seen.other = key
                self._seen[key] = seen
                continue
            present.first_ns = min(present.first_ns, seen.first_ns)
            present.last_ns = max(present.last_ns, seen.last_ns)
            for frame in seen.clearest:
                _insert(present, frame)


def _insert(seen: SeenFrames, frame: SeenFrame) -> None:
    """Keep a frame if it is one of the clearest; of equally clear ones, the earlier."""
    frames = sorted([*seen.clearest, frame], key=lambda item: (-item.strength, item.stamp_ns))
    seen.clearest = frames[:CLEAREST]


def _best(rows: Float64) -> list[int]:
    """Index of the largest value of each row."""
    return rows.argmax(axis=1).tolist() if rows.size else []


def path_beside(graph_path: Path) -> Path:
    """The file with the frames of a saved graph: ``scene_graph.frames.json``."""
    return graph_path.with_name(f"{graph_path.stem}.frames.json")


def write_seen(graph_path: Path, stamp_ns: int, seen: Sequence[SeenFrames]) -> None:
    """Write the file beside a saved graph. Raises OSError."""
    content = msgspec.json.encode(SeenFramesFile(stamp_ns, list(seen)))
    write_atomically(path_beside(graph_path), content)


def read_seen(graph_path: Path, stamp_ns: int) -> list[SeenFrames]:
    """The frames beside a saved graph; none if there is no such file of this graph."""
    try:
        content = read_regular(path_beside(graph_path), MAX_BYTES)
        found = parse_json(content, SeenFramesFile)
    except (OSError, ValueError):
        return []
    return found.seen if found.stamp_ns == stamp_ns else []
