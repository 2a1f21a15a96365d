"""A scene graph to ask: from a file, or as a client copied it from the topics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from deworldsg_ros.client.boxes import gap_m
from deworldsg_ros.client.changes import Changes, changes_by_id, changes_by_place
from deworldsg_ros.client.content import GraphContent, Which
from deworldsg_ros.client.explain import (
    Explanation,
    explain_absence,
    explain_no_relation,
    explain_object,
    explain_relation,
)
from deworldsg_ros.client.goals import ROBOT_RADIUS_M, Goal, free_direction, goal_near
from deworldsg_ros.client.networks import to_networkx
from deworldsg_ros.client.objects import Point, Relation, SceneObject, relation
from deworldsg_ros.client.paths import cheapest_chain
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.graph_file import GRAPH_FILE, read_graph
from deworldsg_ros.scene.seen_frames import read_seen
from deworldsg_ros.scene.seen_space import SeenSpace, read_space


class SceneGraph(GraphContent):
    """A graph at one moment, for questions. It never changes.

    All positions are in the world frame `frame_id`, in metres.

    Args:
        message: of `/scene_graph`, or of a file.
        seen: from which frames its objects and relations come, for `explain`.

    Attributes:
        message: the message.
        frame_id: the world frame.
        stamp_ns: time of the newest frame.
        sequence: number of the update.
        up: unit vector against gravity; +z if the message does not tell it.
        space: the space that the camera has seen as free, for `goal_near`; None = not known.
    """

    @classmethod
    def load(cls, path: str | Path) -> SceneGraph:
        """The graph of a file, or of the folder of a run, with its frames and its seen space if
        they are beside it.

        Raises:
            RefusedInput: if the file is missing or contains no scene graph.
        """
        file = Path(path) / GRAPH_FILE if Path(path).is_dir() else Path(path)
        message = read_graph(file)
        graph = cls(message, read_seen(file, wire.ns_from_stamp(message.stamp)))
        graph.space = read_space(file)
        return graph

    def on(self, support: Which, label: str | None = None) -> list[SceneObject]:
        """Objects that are on another one with a probability of at least one half."""
        found = self.relations(label, "on", support, min_probability=0.5)
        return list(dict.fromkeys(item.subject for item in found))

    def neighbours(self, of: Which, within: float = 1.0) -> list[tuple[SceneObject, float]]:
        """The other objects in reach of one, with the gap of the boxes in metres, nearest first."""
        center = self.one(of)
        found = self.objects(near=center, within=within)
        return [(item, gap_m(center.footprint, item.footprint)) for item in found]

    def path(self, start: Which, end: Which) -> list[Relation]:
        """The most probable chain of relations from one object to another; empty if there is none.

        Directions do not count: each relation is given as the graph has it.
        """
        chain = cheapest_chain(self._edges, self.one(start).id, self.one(end).id)
        return [relation(edge, self[edge.subject], self[edge.object], None) for edge in chain]

    def free_direction(self, of: Which, towards: Point | None = None, room: float = 1.0) -> Point:
        """A horizontal direction in which an object has room; see `goals.free_direction`."""
        return free_direction(self.one(of), self, towards, room)

    def goal_near(
        self,
        of: Which,
        distance: float = 1.0,
        *,
        radius: float = ROBOT_RADIUS_M,
        towards: Point | None = None,
        space: SeenSpace | None = None,
    ) -> Goal:
        """A pose from which an object is in view; see `goals.goal_near`."""
        target, seen = self.one(of), space or self.space
        return goal_near(
            target, self, distance, self.stamp_ns, radius=radius, towards=towards, space=seen
        )

    def explain(self, what: Which | Relation | tuple[Which, Which]) -> Explanation:
        """Why something is in the graph, or is not: an object, a relation, a pair, or a class."""
        if isinstance(what, tuple):
            a, b = self.one(what[0]), self.one(what[1])
            found = self.relations(a, None, b) or self.relations(b, None, a)
            if not found:
                return explain_no_relation(a, b)
            what = found[0]
        if isinstance(what, Relation):
            return explain_relation(what, self.frames(what.subject.id, what.object.id))
        if isinstance(what, str) and not self.objects(what):
            return explain_absence(what, self.hidden, list(self))
        item = self.one(what)
        return explain_object(item, self.relations_of(item), self.frames(item.id))

    def changes_since(self, before: SceneGraph) -> Changes:
        """What differs from an earlier graph, in the same world frame.

        Ids are compared if the earlier graph is of the same session. Otherwise objects are
        recognised by place and class.
        """
        if self.is_later_than(before):
            mine, theirs = ({i.id: i for i in graph} for graph in (self, before))
            return changes_by_id(theirs, mine)
        return changes_by_place(before, self)

    def to_networkx(self) -> Any:
        """The graph as a networkx.MultiDiGraph; needs the package networkx."""
        return to_networkx(self, self.relations())

    def is_later_than(self, other: SceneGraph) -> bool:
        """Whether both graphs are of one session, and this one is not the earlier one."""
        mine, theirs = (getattr(graph.message, "session", None) for graph in (self, other))
        if isinstance(mine, str) and isinstance(theirs, str):
            return mine == theirs and self.sequence >= other.sequence
        return False
