"""The objects and relations of a graph at one moment."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cached_property

import numpy as np

from deworldsg_ros.client.boxes import footprint, gap_m
from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.index import GraphIndex
from deworldsg_ros.client.objects import (
    HiddenObject,
    Point,
    Relation,
    SceneObject,
    hidden_object,
    relation,
    scene_object,
)
from deworldsg_ros.client.words import is_class, predicate_names
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.extent import DEFAULT_UP
from deworldsg_ros.scene.predicates import SYMMETRIC, plain
from deworldsg_ros.scene.seen_frames import SeenFrames
from deworldsg_ros.scene.seen_space import SeenSpace
from deworldsg_ros.words import counted

# What an argument of a question may be: an object, its id, or the name of a class.
Which = SceneObject | int | str


class GraphContent:
    """Finds objects and relations; see `SceneGraph`."""

    def __init__(self, message: wire.SceneGraphMessage, seen: Iterable[SeenFrames] = ()) -> None:
        self.message = message
        self._seen = {(item.node, item.other): item for item in seen}
        self.space: SeenSpace | None = None
        self.frame_id = message.frame_id
        self.stamp_ns = wire.ns_from_stamp(message.stamp)
        self.sequence = message.sequence
        up = message.up if isinstance(message.up, list) else DEFAULT_UP
        self.up: Point = (up[0], up[1], up[2])
        self._nodes = {node.id: node for node in message.nodes}
        self._edges = {(edge.subject, edge.object): edge for edge in message.edges}
        self._made: dict[int, SceneObject] = {}

    def __len__(self) -> int:
        return len(self._nodes)

    def __repr__(self) -> str:
        return (
            f"SceneGraph({counted(len(self), 'object')}, {counted(len(self._edges), 'relation')})"
        )

    def __getitem__(self, node_id: int) -> SceneObject:
        """The object with an id; raises ClientError if it is not in the graph."""
        if node_id not in self._nodes:
            raise ClientError(f"object {node_id} is not in the graph of {len(self)} objects")
        if node_id not in self._made:
            self._made[node_id] = scene_object(self._nodes[node_id], self.frame_id, self.up)
        return self._made[node_id]

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._nodes

    def __iter__(self) -> Iterator[SceneObject]:
        return (self[node_id] for node_id in self._nodes)

    @property
    def labels(self) -> list[str]:
        """The classes of the objects, sorted."""
        return sorted({node.label for node in self._nodes.values()})

    @property
    def hidden(self) -> list[HiddenObject] | None:
        """Objects that were detected and are not in the graph; None = the message has no list."""
        hidden = self.message.hidden
        return [hidden_object(node) for node in hidden] if isinstance(hidden, list) else None

    def objects(
        self,
        label: str | None = None,
        *,
        near: Point | SceneObject | None = None,
        within: float | None = None,
        min_probability: float | None = None,
    ) -> list[SceneObject]:
        """Objects, the most probable first; with `near`, the nearest first.

        Args:
            label: class, e.g. "cup"; "table" includes "dining table".
            near: a point, or an object, which is not part of the answer.
            within: largest distance of the box from `near`, metres.
            min_probability: least probability of being an object of the class. By default an object
                is of its most probable class.
        """
        if near is None and within is not None:
            raise ClientError("within needs near: a point or an object")
        items = map(self.__getitem__, self._candidates(label, near, within, min_probability))
        found = [item for item in items if _fits(item, label, min_probability)]
        if near is None:
            key = (lambda item: item.probability) if label is None else _chance(label)
            return sorted(found, key=lambda item: (-key(item), item.id))
        origin = near.id if isinstance(near, SceneObject) else None
        ranked = sorted((distance_m(item, near), item.id) for item in found if item.id != origin)
        return [self[i] for gap, i in ranked if within is None or gap <= within]

    def relations(
        self,
        subject: Which | None = None,
        predicate: str | None = None,
        object: Which | None = None,
        *,
        min_probability: float = 0.0,
    ) -> list[Relation]:
        """Relations, the most probable first.

        A symmetric relation such as *near* is found from both ends, and counts once.

        Args:
            subject: an object, its id, or a class; None = any.
            object: as subject.
            predicate: its name; "on" includes "standing on"; None = the most probable one.
            min_probability: that it holds.
        """
        is_subject, is_object = self._chooser(subject), self._chooser(object)
        names = None if predicate is None else predicate_names(predicate)
        found = []
        for a_id, b_id in self._pairs(subject, object):
            edge = self._edges[a_id, b_id]
            if a_id not in self._nodes or b_id not in self._nodes:
                continue
            if names is not None and not any(plain(i.label) in names for i in edge.predicates):
                continue
            a, b = self[a_id], self[b_id]
            item = relation(edge, a, b, predicate)
            if is_subject(a) and is_object(b):
                found.append(item)
            elif (
                (edge.mutual is True or plain(item.predicate) in SYMMETRIC)
                and (b_id, a_id) not in self._edges
                and is_subject(b)
                and is_object(a)
            ):
                found.append(relation(edge, b, a, predicate))
        found = [item for item in found if item.probability >= max(min_probability, 1e-9)]
        return sorted(found, key=lambda i: (-i.probability, i.subject.id, i.object.id))

    def relations_of(self, which: Which) -> list[Relation]:
        """All relations from and to an object, each once, the most probable first."""
        item = self.one(which)
        found = self.relations(item)
        known = {(i.object.id, i.predicate) for i in found if plain(i.predicate) in SYMMETRIC}
        found += [
            relation
            for relation in self.relations(None, None, item)
            if (relation.subject.id, relation.predicate) not in known
        ]
        return sorted(found, key=lambda i: -i.probability)

    def one(self, which: Which) -> SceneObject:
        """The object that is meant; of a class, the most probable one.

        Raises:
            ClientError: if there is none.
        """
        if isinstance(which, SceneObject):
            return self[which.id]
        if isinstance(which, int):
            return self[which]
        found = self.objects(which)
        if not found:
            known = ", ".join(self.labels) or "none"
            raise ClientError(f"no object of class '{which}'; classes of the graph: {known}")
        return found[0]

    def frames(self, subject_id: int, object_id: int = 0) -> SeenFrames | None:
        """The frames of an object, or of a relation; None = not known."""
        pair = (subject_id, object_id)
        return self._seen.get(pair, self._seen.get(pair[::-1]) if object_id else None)

    def edge(self, subject_id: int, object_id: int) -> wire.EdgeState | None:
        """The message of a directed edge; None = there is none."""
        return self._edges.get((subject_id, object_id))

    def _candidates(
        self,
        label: str | None,
        near: Point | SceneObject | None,
        within: float | None,
        min_probability: float | None,
    ) -> Iterable[int]:
        """The ids of all objects that `objects` may find, and of some others."""
        if near is not None and within is not None:
            if not isinstance(near, SceneObject):
                return self._index.around(near, within)
            reach_m = within + float(np.linalg.norm(near.size_m)) / 2 + 1e-6
            return self._index.around(near.position_m, reach_m)
        if label is None:
            return self._nodes
        if min_probability is None:
            return self._index.called(label)
        return self._index.perhaps(label) if min_probability > 0 else self._nodes

    def _pairs(self, subject: Which | None, object: Which | None) -> Iterable[tuple[int, int]]:
        """The relations from or to what is asked for, and some others."""
        which = object if subject is None else subject
        if which is None:
            return self._edges
        if isinstance(which, str):
            return self._index.touching(self._index.called(which))
        return self._index.touching([which if isinstance(which, int) else which.id])

    @cached_property
    def _index(self) -> GraphIndex:
        return GraphIndex(self._nodes, self._edges)

    def _chooser(self, which: Which | None) -> Callable[[SceneObject], bool]:
        if which is None:
            return lambda item: True
        if isinstance(which, str):
            return lambda item: is_class(which, item.label)
        node_id = which if isinstance(which, int) else which.id
        return lambda item: item.id == node_id


def _fits(item: SceneObject, label: str | None, least: float | None) -> bool:
    if label is None:
        return least is None or item.probability >= least
    if least is None:
        return is_class(label, item.label)
    return item.probability_of(label) >= least


def _chance(label: str) -> Callable[[SceneObject], float]:
    return lambda item: item.probability_of(label)


def distance_m(item: SceneObject, near: Point | SceneObject) -> float:
    """Distance of a box from a point, or from another box."""
    if isinstance(near, SceneObject):
        return gap_m(item.footprint, near.footprint)
    point = footprint(near, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), item.up)
    return gap_m(item.footprint, point)
