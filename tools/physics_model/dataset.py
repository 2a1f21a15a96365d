"""Pairs of nodes of mapped rooms, with their true states."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.relations.geometry import (
    MIN_SHAPE_POINTS,
    measure,
    pair_features,
    pairs_in_reach,
)
from deworldsg_ros.relations.pairs import floor_height
from deworldsg_ros.relations.physics import PairInputs, relation_counts
from deworldsg_ros.relations.states import (
    DIRECTED,
    RELATIONS,
    SHAPE,
    relation_of_predicates,
)

# A node is in the box of an object if its mean is; the box is this much larger on every side.
BOX_MARGIN_M = 0.05

Array = NDArray[np.float64]
Truth = dict[tuple[int, int], str]


@dataclass(frozen=True)
class Room:
    """The m pairs in reach of one room whose nodes are matched to two objects.

    Attributes:
        classes: names.
        class_probabilities: (n, C) of the nodes.
        observations: (n,) number of frames that showed each node.
        pairs: (m, 2) rows of the nodes.
        features: (2, m, F) of first and second, and of second and first.
        states: (m,) true state.
        counts: (m, 2, NONE) votes by relation, in both directions.
        frames: (m,) number of frames that showed both.
        bottoms_m, heights_m: (n,) of the nodes: bottom over the floor, and height.
        on_floor: (n,) 1 = stands on the floor, 0 = does not, -1 = unknown.
    """

    classes: tuple[str, ...]
    class_probabilities: NDArray[np.float64]
    observations: NDArray[np.int64]
    pairs: NDArray[np.int64]
    features: NDArray[np.float64]
    states: NDArray[np.int64]
    counts: NDArray[np.float64]
    frames: NDArray[np.int64]
    bottoms_m: NDArray[np.float64]
    heights_m: NDArray[np.float64]
    on_floor: NDArray[np.int64]


def load_room(map_path: Path, content: dict[str, Any]) -> Room:
    """The pairs of a map (collect.py), with the content of the gt.json of its room."""
    objects = [item for item in content["objects"] if item.get("detectable") and item.get("vg")]
    truth = {(s, o): name for s, o, _, name in content["relationships"]}
    graph = graph_files.load(map_path)
    for node_id in list(graph.nodes.slot_of):
        if graph.nodes.confirmed[graph.nodes.slot(node_id)]:
            continue
        graph.remove_node(node_id)
    nodes, slots = graph.nodes, graph.nodes.slots
    places = np.arange(len(slots))
    shapes = np.zeros(len(slots), SHAPE)
    points = nodes.surface_points_world[slots]
    measure(shapes, places, points, nodes.surface_counts[slots], np.eye(3))
    at = _match(graph, slots, objects)
    solid = shapes["count"] >= MIN_SHAPE_POINTS
    floor_m = floor_height(np.sort(shapes["low"][solid, 2]).tolist())
    pairs = pairs_in_reach(shapes)
    pairs = pairs[(at[pairs] >= 0).all(axis=1) & (at[pairs[:, 0]] != at[pairs[:, 1]])]
    # Two people may judge these differently.
    unclear = {tuple(ids) for ids in content.get("unclear", ())}
    ids = [(objects[at[a]]["id"], objects[at[b]]["id"]) for a, b in pairs.tolist()]
    pairs = pairs[[not {(a, b), (b, a)} & unclear for a, b in ids]]
    first, second = np.ascontiguousarray(pairs.T)
    features = pair_features(first, second, shapes, points, floor_m)
    ids = [(objects[at[a]]["id"], objects[at[b]]["id"]) for a, b in pairs.tolist()]
    states = np.array([_state(truth, a, b) for a, b in ids], np.int64)
    counts, frames = _votes(graph, slots[pairs])
    return Room(
        classes=graph.vocabulary.classes,
        class_probabilities=nodes.class_probabilities[slots],
        observations=nodes.observations[slots],
        pairs=pairs,
        features=features,
        states=states,
        counts=counts,
        frames=frames,
        bottoms_m=shapes["low"][:, 2] - floor_m,
        heights_m=(shapes["high"] - shapes["low"])[:, 2],
        on_floor=np.array([_stands_on_floor(objects[k]) if k >= 0 else -1 for k in at], np.int64),
    )


def _match(
    graph: GlobalGraph, slots: NDArray[np.int64], objects: list[dict[str, Any]]
) -> NDArray[np.int64]:
    """Index of the object of each node, -1 = none: its class, and its box around the mean."""
    low = np.array([item["aabb"][0] for item in objects]) - BOX_MARGIN_M
    high = np.array([item["aabb"][1] for item in objects]) + BOX_MARGIN_M
    seen = np.array([item["visible_centroid"] for item in objects])
    names = np.array([item["vg"] for item in objects])
    nodes = graph.nodes
    result = np.full(len(slots), -1, np.int64)
    for place, slot in enumerate(slots.tolist()):
        surface = nodes.surface(slot)
        mean = surface.mean(axis=0) if len(surface) else nodes.means[slot]
        label = graph.vocabulary.classes[int(nodes.class_probabilities[slot].argmax())]
        inside = ((mean >= low) & (mean <= high)).all(axis=1) & (names == label)
        candidates = np.flatnonzero(inside)
        if len(candidates):
            nearest = np.linalg.norm(seen[candidates] - mean, axis=1).argmin()
            result[place] = candidates[nearest]
    return result


def _state(truth: Truth, a: int, b: int) -> int:
    """True state of a pair of object ids."""
    for first, second, offset in ((a, b, 1), (b, a, 2)):
        name = truth.get((first, second))
        if name in RELATIONS and RELATIONS.index(name) in DIRECTED:
            return offset + 2 * DIRECTED.index(RELATIONS.index(name))
    return 0


def _votes(
    graph: GlobalGraph, slots: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Votes by relation (m, 2, NONE) of pairs of slots (m, 2), and numbers of frames (m,)."""
    relation_of = relation_of_predicates(graph.vocabulary.predicates)
    votes = np.zeros((len(slots), 2, len(relation_of)), np.float32)
    frames = np.zeros(len(slots), np.int64)
    for place, (a, b) in enumerate(graph.nodes.ids[slots].tolist()):
        known = graph.votes.get((min(a, b), max(a, b)))
        if known is not None:
            frames[place] = known.frames
            if known.counts is not None:
                votes[place] = known.counts if a < b else known.counts[::-1]
    return relation_counts(votes, relation_of)[0], frames


def _stands_on_floor(item: dict[str, Any]) -> bool:
    """Physics knows it; other rooms list nothing that carries it, and its bottom."""
    if "physics" in item:
        return bool(item["physics"]["on_floor"])
    return item.get("parent") is None and abs(item["aabb"][0][2]) < 0.01


def rooms_of(folders: list[list[Path]]) -> list[Room]:
    """All rooms of pairs of a folder of maps and the data set of these rooms."""
    return [
        load_room(path, json.loads((root / "data" / path.stem / "gt.json").read_text()))
        for maps, root in folders
        for path in sorted(maps.glob("*.npz"))
    ]


def inputs_of(rooms: list[Room], classes: list[Array] | None = None) -> tuple[Array, Array]:
    """Inputs of the network for first and second, and for second and first.

    Args:
        rooms: their pairs.
        classes: class distributions of the nodes of each room; None = those of the maps.
    """
    both: list[list[Array]] = [[], []]
    for index, room in enumerate(rooms):
        known = (room.class_probabilities if classes is None else classes[index], room.observations)
        make = PairInputs(room.classes).make
        for end, pairs in enumerate((room.pairs, room.pairs[:, ::-1])):
            both[end].append(make(room.features[end], *known, pairs[:, 0], pairs[:, 1]))
    return np.concatenate(both[0]), np.concatenate(both[1])


def states_of(rooms: list[Room]) -> NDArray[np.int64]:
    """True states of all pairs."""
    return np.concatenate([room.states for room in rooms])


def nodes_of(rooms: list[Room]) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64]]:
    """Pairs as rows of the nodes of all rooms; rise, log height and floor of these nodes."""
    starts = np.cumsum([0, *(len(room.bottoms_m) for room in rooms)])
    pairs = np.concatenate([room.pairs + start for room, start in zip(rooms, starts)])
    rise = np.abs(np.concatenate([room.bottoms_m for room in rooms]))
    height = np.log(np.concatenate([room.heights_m for room in rooms]) + 0.01)
    return pairs, rise, height, np.concatenate([room.on_floor for room in rooms])
