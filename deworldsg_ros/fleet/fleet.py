"""The graphs of several robots as one; the transforms between their worlds are found from them."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from deworldsg_ros.client.combine import MIN_CONFIDENCE, Alignment, Known, align, combine
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.errors import DeWorldSGError
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import empty_scene_graph

FRAME_ID = "fleet"
# Two objects of one graph lie on two of another one in many wrong ways. Four do not.
MIN_MATCHED = 4
# A transform is looked for again when there are this many times more objects.
GROWTH = 1.2
# Objects of others this close to an object of a robot concern it.
NEARBY_M = 10.0


@dataclass
class Member:
    """One robot of the fleet.

    Attributes:
        graph: its newest graph, in its own world frame.
        T_fleet_world: (4, 4), from its world frame to the fleet's; None = not found yet.
        confidence: of the transform, from 0 to 1; see `client.combine`.
        matched: number of its objects that the transform puts onto objects of others.
        reason: why there is no transform, in words.
    """

    graph: SceneGraph
    T_fleet_world: Float64 | None = None
    confidence: float = 0.0
    matched: int = 0
    reason: str = "no objects"
    tried: int = 0
    ids: dict[int, int] = field(default_factory=dict)
    # Of its objects in the fleet, and of those of the fleet near it.
    known: Known = field(default_factory=Known)
    near: Known = field(default_factory=Known)


class Fleet:
    """Combines the graphs of robots into one graph.

    The world frame of the first robot with objects is the frame `FRAME_ID`. Each other robot joins
    when its transform is found with confidence; until then its graph waits. Ids of the fleet stay
    as long as one robot keeps the object.

    Attributes:
        members: the robots, by name.
    """

    def __init__(self) -> None:
        self.members: dict[str, Member] = {}
        self._session = secrets.token_hex(8)
        self._sequence = 0
        self._next_id = 1
        self._objects: dict[int, SceneObject] = {}
        self._owners: dict[int, frozenset[str]] = {}
        self._edges: list[wire.EdgeState] = []
        self._stamp = wire.stamp_from_ns(0)

    def update(self, name: str, message: wire.SceneGraphMessage) -> None:
        """Take the newest graph of a robot.

        A graph of another session may have another world frame: it is located anew.
        """
        graph = SceneGraph(message)
        member = self.members.get(name)
        if member is None or member.graph.message.session != message.session:
            self.members[name] = Member(graph)
        else:
            member.graph = graph

    def combine(self) -> wire.SceneGraphMessage:
        """The graphs of all robots that are located, as one."""
        whole: SceneGraph | None = None
        of: dict[int, list[tuple[Member, int]]] = {}
        owners: dict[int, set[str]] = {}
        # Those that are located first: they define the frame, and the others are found from them.
        order = sorted(self.members, key=lambda name: self.members[name].T_fleet_world is None)
        for name in order:
            member = self.members[name]
            if whole is None:
                whole, ids = _first(member)
            else:
                whole, ids = _joined(whole, member)
            for node_id, new_id in ids.items():
                of.setdefault(new_id, []).append((member, node_id))
                owners.setdefault(new_id, set()).add(name)
        stable = self._stable_ids(of)
        self._owners = {stable[new]: frozenset(names) for new, names in owners.items()}
        self._sequence += 1
        message = empty_scene_graph(FRAME_ID) if whole is None else _renamed(whole.message, stable)
        message.session, message.sequence = self._session, self._sequence
        self._objects = {item.id: item for item in SceneGraph(message)}
        self._edges, self._stamp = message.edges, message.stamp
        return message

    def part_for(self, name: str) -> wire.SceneGraphMessage | None:
        """The part for a robot: objects near its own that only others have, in its world frame.

        Returns:
            A graph with the ids of the fleet; None while the robot is not located.
        """
        member = self.members.get(name)
        if member is None or member.T_fleet_world is None:
            return None
        T_world_fleet = invert_pose(member.T_fleet_world)
        graph = member.graph
        own = np.array([item.position_m for item in graph], np.float64).reshape(-1, 3)
        others = [item for item in self._objects.values() if name not in self._owners[item.id]]
        places = np.array([item.position_m for item in others], np.float64).reshape(-1, 3)
        gaps_m = _gaps_m(places @ T_world_fleet[:3, :3].T + T_world_fleet[:3, 3], own)
        near = [item for item, gap_m in zip(others, gaps_m.tolist()) if gap_m <= NEARBY_M]
        moved = member.near.moved(near, T_world_fleet, graph.frame_id, graph.up)
        nodes = {node_id: item.state for node_id, item in moved.items()}
        return msgspec.structs.replace(
            empty_scene_graph(FRAME_ID),
            stamp=self._stamp,
            frame_id=graph.frame_id,
            session=self._session,
            sequence=self._sequence,
            nodes=[nodes[node_id] for node_id in sorted(nodes)],
            edges=[e for e in self._edges if e.subject in nodes and e.object in nodes],
            up=list(graph.up),
        )

    def status(self) -> list[dict[str, Any]]:
        """The robots, as plain values for JSON."""
        return [
            {
                "name": name,
                "located": member.T_fleet_world is not None,
                "reason": member.reason,
                "confidence": round(member.confidence, 3),
                "matched": member.matched,
                "objects": len(member.graph),
                "T_fleet_world": None
                if member.T_fleet_world is None
                else member.T_fleet_world.ravel().tolist(),
            }
            for name, member in sorted(self.members.items())
        ]

    def _stable_ids(self, of: dict[int, list[tuple[Member, int]]]) -> dict[int, int]:
        """The fleet's id of each object: the smallest that one of its members had before."""
        stable: dict[int, int] = {}
        taken: set[int] = set()
        for new_id, parts in of.items():
            known = {member.ids[i] for member, i in parts if i in member.ids} - taken
            if known:
                stable[new_id] = min(known)
            else:
                stable[new_id], self._next_id = self._next_id, self._next_id + 1
            taken.add(stable[new_id])
        for member in self.members.values():
            member.ids = {}
        for new_id, parts in of.items():
            for member, i in parts:
                member.ids[i] = stable[new_id]
        return stable


def _first(member: Member) -> tuple[SceneGraph | None, dict[int, int]]:
    """The graph that the others join."""
    if not len(member.graph):
        return None, {}
    if member.T_fleet_world is None:
        member.T_fleet_world, member.confidence, member.reason = np.eye(4), 1.0, ""
    empty = SceneGraph(
        msgspec.structs.replace(empty_scene_graph(FRAME_ID), up=_up_in_fleet(member))
    )
    return _added(empty, member)


def _joined(whole: SceneGraph, member: Member) -> tuple[SceneGraph, dict[int, int]]:
    _locate(whole, member)
    return (whole, {}) if member.T_fleet_world is None else _added(whole, member)


def _added(whole: SceneGraph, member: Member) -> tuple[SceneGraph, dict[int, int]]:
    try:
        combined = combine(whole, member.graph, member.T_fleet_world, member.known)
        joined = SceneGraph(combined.message)
    except Exception as error:  # of one robot, whose graph may be anything: the others go on
        member.T_fleet_world, member.reason = None, f"{type(error).__name__}: {error}"
        return whole, {}
    return joined, combined.ids


def _locate(whole: SceneGraph, member: Member) -> None:
    """Look for the transform if the graphs grew since the last time."""
    size = min(len(whole), len(member.graph))
    if size < max(MIN_MATCHED, GROWTH * member.tried):
        return
    member.tried = size
    try:
        found = align(list(whole), list(member.graph))
    except (DeWorldSGError, ValueError) as error:
        member.reason = str(error)
        return
    if found.matched < MIN_MATCHED or found.confidence < MIN_CONFIDENCE:
        member.reason = (
            f"ambiguous: {found.matched} objects in common, confidence {found.confidence:.2f}; "
            f"expected {MIN_MATCHED} and {MIN_CONFIDENCE:g}"
        )
        return
    _take(member, found)


def _take(member: Member, found: Alignment) -> None:
    member.T_fleet_world, member.reason = found.T_a_b, ""
    member.confidence, member.matched = found.confidence, found.matched


def _gaps_m(places: Float64, others: Float64) -> Float64:
    """Distance (n,) of each place (n, 3) from the nearest of others (m, 3)."""
    from scipy.spatial import cKDTree  # slow to import

    if not len(places) or not len(others):
        return np.full(len(places), np.inf)
    gaps: Float64 = cKDTree(others).query(places)[0]
    return gaps


def _up_in_fleet(member: Member) -> list[float]:
    assert member.T_fleet_world is not None
    up: list[float] = (member.T_fleet_world[:3, :3] @ member.graph.up).tolist()
    return up


def _renamed(message: wire.SceneGraphMessage, ids: dict[int, int]) -> wire.SceneGraphMessage:
    replace = msgspec.structs.replace
    nodes = [replace(node, id=ids[node.id]) for node in message.nodes]
    edges = [replace(e, subject=ids[e.subject], object=ids[e.object]) for e in message.edges]
    return replace(
        message,
        frame_id=FRAME_ID,
        nodes=sorted(nodes, key=lambda node: node.id),
        edges=sorted(edges, key=lambda edge: (edge.subject, edge.object)),
    )
