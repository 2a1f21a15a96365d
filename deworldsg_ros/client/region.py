"""A part of a graph: the objects of some classes around a point, and the relations between them."""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from dataclasses import dataclass

from msgspec import structs

from deworldsg_ros.client.boxes import box_of
from deworldsg_ros.client.meanings import is_class
from deworldsg_ros.client.objects import Point
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import empty_scene_graph


@dataclass(frozen=True)
class Region:
    """Where, how far, and what.

    Attributes:
        center: world frame, metres; None = nowhere.
        radius_m: largest distance of the centre of an object's box.
        classes: names of classes, as in questions; empty = all.
    """

    center: Point | None
    radius_m: float
    classes: tuple[str, ...] = ()

    def contains(self, node: wire.NodeState) -> bool:
        """Whether an object is inside."""
        if self.center is None:
            return False
        x, y, z = (a - b for a, b in zip(box_of(node)[0], self.center))
        if x * x + y * y + z * z > self.radius_m**2:
            return False
        return not self.classes or any(is_class(name, node.label) for name in self.classes)


class RegionPart:
    """Follows a graph and keeps the part of it that is in a region.

    A message of the graph costs as much as it is long, `message` as much as the part is large. Only
    a change of the region looks at the whole graph.

    Args:
        region: may be replaced by `move`.
    """

    def __init__(self, region: Region) -> None:
        self._region = region
        self._begin(empty_scene_graph(""))

    def _begin(self, message: wire.SceneGraphMessage | wire.SceneGraphUpdateMessage) -> None:
        """Forget the graph. Ids of a new session are other objects, so the part begins one too."""
        self._source: wire.SceneGraphMessage = structs.replace(
            empty_scene_graph(message.frame_id), session=message.session, sequence=0
        )
        self._session, self._sequence = secrets.token_hex(8), 0
        self._nodes: dict[int, wire.NodeState] = {}
        self._edges: dict[int, dict[int, wire.EdgeState]] = {}
        self._inside: set[int] = set()
        self._has_changed = message.frame_id != ""

    @property
    def size(self) -> int:
        """Number of objects inside."""
        return len(self._inside)

    def move(self, region: Region) -> None:
        """Change the region."""
        if region != self._region:
            self._region = region
            before = self._inside
            self._inside = {i for i, node in self._nodes.items() if region.contains(node)}
            self._has_changed |= before != self._inside

    def add(self, message: wire.SceneGraphMessage | wire.SceneGraphUpdateMessage) -> None:
        """Follow the next whole graph or update, in the order of `SceneGraphClient.on_message`."""
        update = message if isinstance(message, wire.SceneGraphUpdateMessage) else None
        if update is None or update.since == 0 or update.session != self._source.session:
            self._begin(message)
        if update is not None:
            for removed in update.removed_nodes:
                self._nodes.pop(removed.id, None)
                self._take_out(removed.id)
            for pair in update.removed_edges:
                self._edges.get(pair.subject, {}).pop(pair.object, None)
                self._note({pair.subject, pair.object})
        for node in message.nodes:
            self._nodes[node.id] = node
            if self._region.contains(node):
                self._inside.add(node.id)
                self._has_changed = True
            else:
                self._take_out(node.id)
        for edge in message.edges:
            self._edges.setdefault(edge.subject, {})[edge.object] = edge
            self._note({edge.subject, edge.object})
        self._source = structs.replace(self._source, stamp=message.stamp, up=message.up)

    def message(self) -> wire.SceneGraphMessage | None:
        """The part as a numbered graph of a session of its own; None = as at the last call."""
        if not self._has_changed:
            return None
        self._has_changed = False
        self._sequence += 1
        inside = sorted(self._inside)
        return structs.replace(
            self._source,
            session=self._session,
            sequence=self._sequence,
            nodes=[self._nodes[i] for i in inside],
            edges=[
                edge
                for i in inside
                for other, edge in sorted(self._edges.get(i, {}).items())
                if other in self._inside
            ],
        )

    def _take_out(self, node_id: int) -> None:
        self._has_changed |= node_id in self._inside
        self._inside.discard(node_id)

    def _note(self, ends: Iterable[int]) -> None:
        """Note that the relation of two objects changed."""
        self._has_changed |= self._inside.issuperset(ends)
