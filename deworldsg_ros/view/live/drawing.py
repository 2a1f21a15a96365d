"""The content of the scene as arrays: boxes or ellipsoids, outlines, relations, labels."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from deworldsg_ros.client.objects import SURE, Point, SceneObject, scene_object
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.scene.arrays import Float64, Int64, UInt8
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.view.colours import (
    GREY,
    MUTUAL,
    QUIET,
    SIGMAS,
    class_colours,
    predicate_colours,
    principal_axes,
    to_rgb,
)
from deworldsg_ros.wire import messages as wire

# --- Which objects and relations are shown.


@dataclass(frozen=True)
class Filter:
    """The user's choice; the default hides the relations that hide everything else.

    Attributes:
        hidden_classes, hidden_predicates: names that are not shown.
        min_probability: of an object, that it exists and is of its class.
        min_relation: of a relation.
    """

    hidden_classes: frozenset[str] = frozenset()
    hidden_predicates: frozenset[str] = QUIET
    min_probability: float = 0.0
    min_relation: float = 0.0


# --- The objects of the graph as parallel arrays with compact rows. Only objects whose message
# changed are computed again.

# Thinner ellipsoids are invisible from the side.
LEAST_DIAMETER_M = 0.012


class Label(NamedTuple):
    """A text in the scene.

    Attributes:
        key: stable identity.
        text: what it says.
        position: (3,) world, metres.
        weight: labels of more weight are placed first.
    """

    key: str
    text: str
    position: Float64
    weight: float


class Columns:
    """n rows of several arrays. Row r of every array belongs to the id `ids[r]`.

    Rows are compact: if a row is removed, the last row takes its place. So rows move and ids do
    not. Each array is an attribute: a view of the live rows. Adding or removing a row replaces the
    views, so do not keep them.

    Args:
        layout: dtype and shape of a row of each array, by name; ``ids`` is added.

    Attributes:
        ids: (n,) int64.
    """

    ids: Int64

    def __init__(self, layout: Mapping[str, tuple[DTypeLike, tuple[int, ...]]]) -> None:
        self._rows: dict[int, int] = {}
        self._storage: dict[str, NDArray[Any]] = {
            name: np.zeros((64, *shape), dtype)
            for name, (dtype, shape) in {"ids": (np.int64, ()), **layout}.items()
        }
        self._show(0)

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._rows

    def row(self, node_id: int) -> int:
        """The present row of an id; KeyError if there is none."""
        try:
            return self._rows[node_id]
        except KeyError:
            raise KeyError(f"node {node_id} is not in the graph") from None

    def extend(self, ids: Sequence[int]) -> None:
        """Add a row of zeros for each of these new ids, in their order."""
        if not ids:
            return
        first, count = len(self._rows), len(self._rows) + len(ids)
        capacity = known = len(self._storage["ids"])
        while count > capacity:
            capacity *= 2
        for name, column in self._storage.items() if capacity > known else ():
            # Zeros that were never written take no memory; a copy of zeros would.
            larger = np.zeros((capacity, *column.shape[1:]), column.dtype)
            larger[:first] = column[:first]
            self._storage[name] = larger
        self._rows.update(zip(ids, range(first, count)))
        self._show(count)
        self.ids[first:] = ids

    def remove(self, node_id: int) -> None:
        """Remove a row; the last row takes its place."""
        row, last = self.row(node_id), len(self._rows) - 1
        moved = int(self.ids[last])
        for column in self._storage.values():
            column[row] = column[last]
            column[last] = 0  # free rows are zeros
        self._rows[moved] = row
        del self._rows[node_id]
        self._show(last)

    def _show(self, count: int) -> None:
        for name, column in self._storage.items():
            setattr(self, name, column[:count])


class ObjectTable(Columns):
    """The boxes and ellipsoids of n objects.

    Attributes:
        centres: (n, 3) of the boxes, metres, world.
        wxyzs: (n, 4) axes of the boxes to world.
        sizes: (n, 3) of the boxes along their axes, metres.
        means, ellipsoid_wxyzs, diameters: the same of the ellipsoids (2σ).
        probabilities: (n,) that it exists and is of its class.
        objects: each object by its id.
        texts: the label of each object by its id.
    """

    centres: Float64
    wxyzs: Float64
    sizes: Float64
    means: Float64
    ellipsoid_wxyzs: Float64
    diameters: Float64
    probabilities: Float64

    def __init__(self) -> None:
        super().__init__(
            {
                **dict.fromkeys(("centres", "sizes", "means", "diameters"), (np.float64, (3,))),
                **dict.fromkeys(("wxyzs", "ellipsoid_wxyzs"), (np.float64, (4,))),
                "probabilities": (np.float64, ()),
            }
        )
        self.objects: dict[int, SceneObject] = {}
        self.texts: dict[int, Label] = {}

    @property
    def labels(self) -> list[str]:
        """Class of each row."""
        return [self.objects[node_id].label for node_id in self.ids.tolist()]

    def sync(self, nodes: Mapping[int, wire.NodeState], frame_id: str, up: Point) -> bool:
        """Make the rows equal to these nodes; returns whether anything changed."""
        gone = [node_id for node_id in self.objects if node_id not in nodes]
        for node_id in gone:
            self.remove(node_id)
            del self.objects[node_id], self.texts[node_id]
        changed = [
            node
            for node_id, node in nodes.items()
            if node_id not in self.objects or self.objects[node_id].state is not node
        ]
        self.extend([node.id for node in changed if node.id not in self.objects])
        for node in changed:
            self._put(scene_object(node, frame_id, up))
        return bool(gone or changed)

    def _put(self, item: SceneObject) -> None:
        row = self.row(item.id)
        self.objects[item.id] = item
        self.centres[row], self.sizes[row] = item.position_m, item.size_m
        x, y, z, w = item.orientation_xyzw
        self.wxyzs[row] = w, x, y, z
        deviations, axes = principal_axes(np.array(item.covariance_m2))
        self.means[row] = item.mean_m
        self.ellipsoid_wxyzs[row] = np.roll(quaternion_from_rotation(axes), 1)
        self.diameters[row] = np.maximum(2 * SIGMAS * deviations, LEAST_DIAMETER_M)
        self.probabilities[row] = probability = item.probability
        top = np.array(item.position_m) + item.size_m[2] / 2 * np.array(item.up)
        text = f"{item.label}{'' if probability >= SURE else '?'} {item.id}"
        self.texts[item.id] = Label(f"object {item.id}", text, top, math.prod(item.size_m))


# --- What the scene shows, as arrays: boxes or ellipsoids, outlines, relations, labels.

Shape = Literal["boxes", "ellipsoids"]

# Unsure objects are fainter.
OPACITIES = (0.16, 0.42, 0.7)  # not sure, sure, selected
# Arrows end where the box of the object begins, but are not shorter than this fraction.
SHORTEST_ARROW = 0.7
# Two relations in opposite directions are drawn so far apart, metres.
APART_M = 0.03
# Labels of relations are shown if there are not more.
MOST_PREDICATE_LABELS = 120

# Of the unit cube, and pairs of corners that share a side.
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_SIDES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1])


@dataclass(frozen=True)
class Drawing:
    """Everything that depends on the graph; n objects, of which some may be filtered out.

    Attributes:
        ids: (n,) of the shown objects.
        positions, wxyzs, scales: (n, 3), (n, 4), (n, 3) of unit cubes or unit spheres.
        colours: (n, 3) uint8.
        opacities: (n,).
        outlines, outline_colours: (12 n, 2, 3) edges of the boxes; none for ellipsoids.
        arrows, arrow_colours: (a, 2, 3) directed relations, tail and tip.
        lines, line_colours: (l, 2, 3) symmetric relations.
        labels: of objects and relations.
    """

    ids: Int64
    positions: Float64
    wxyzs: Float64
    scales: Float64
    colours: UInt8
    opacities: Float64
    outlines: Float64
    outline_colours: UInt8
    arrows: Float64
    arrow_colours: UInt8
    lines: Float64
    line_colours: UInt8
    labels: tuple[Label, ...]


def node_colours(table: ObjectTable) -> dict[int, str]:
    """#rrggbb of each object, by its class."""
    labels = {node_id: table.objects[node_id].label for node_id in sorted(table.objects)}
    colours = class_colours(labels.values())
    return {node_id: colours[label] for node_id, label in labels.items()}


def draw(
    table: ObjectTable,
    edges: Mapping[Pair, wire.EdgeState],
    chosen: Filter,
    shape: Shape = "boxes",
    selected: int | None = None,
) -> Drawing:
    """The drawing of a graph.

    Args:
        table: its objects.
        edges: its relations.
        chosen: what is shown.
        shape: of the objects.
        selected: id of the object that is emphasised; relations of others are grey.
    """
    rows = _shown(table, chosen)
    ids = table.ids[rows].tolist()
    by_id = node_colours(table)
    colours = rgb_of([by_id[node_id] for node_id in ids])
    centres, sizes, wxyzs = table.centres[rows], table.sizes[rows], table.wxyzs[rows]
    outlines = np.zeros((0, 2, 3)) if shape == "ellipsoids" else outlines_of(centres, sizes, wxyzs)
    shown_edges = _edges_between(set(ids), edges, chosen)
    counts = Counter(edge.predicate for edge in shown_edges)
    tints = predicate_colours(counts)
    edge_colours = rgb_of(
        [
            tints[edge.predicate]
            if selected is None or selected in (edge.subject, edge.object)
            else GREY
            for edge in shown_edges
        ]
    )
    segments = _segments(table, shown_edges)
    both_ways = np.array([_is_mutual(edge) for edge in shown_edges], bool)
    return Drawing(
        ids=table.ids[rows],
        positions=table.means[rows] if shape == "ellipsoids" else centres,
        wxyzs=table.ellipsoid_wxyzs[rows] if shape == "ellipsoids" else wxyzs,
        scales=table.diameters[rows] if shape == "ellipsoids" else sizes,
        colours=colours,
        opacities=_opacities(table, rows, selected),
        outlines=outlines,
        outline_colours=np.repeat(colours, len(outlines) // max(len(rows), 1), axis=0),
        arrows=segments[~both_ways],
        arrow_colours=edge_colours[~both_ways],
        lines=segments[both_ways],
        line_colours=edge_colours[both_ways],
        labels=(*_object_labels(table, ids, selected), *_edge_labels(shown_edges, segments)),
    )


def rotations(wxyzs: Float64) -> Float64:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4)."""
    w, x, y, z = wxyzs.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)


def outlines_of(centres: Float64, sizes: Float64, wxyzs: Float64) -> Float64:
    """The 12 edges of each of n boxes, (12 n, 2, 3)."""
    corners = (CORNERS * sizes[:, None]) @ rotations(wxyzs).transpose(0, 2, 1) + centres[:, None]
    return corners[:, _SIDES].reshape(-1, 2, 3)


def _shown(table: ObjectTable, chosen: Filter) -> Int64:
    visible = table.probabilities >= chosen.min_probability
    if chosen.hidden_classes:
        visible &= np.array([label not in chosen.hidden_classes for label in table.labels], bool)
    return np.flatnonzero(visible)


def _is_mutual(edge: wire.EdgeState) -> bool:
    return edge.mutual is True or edge.predicate in MUTUAL


def _edges_between(
    shown: Collection[int], edges: Mapping[Pair, wire.EdgeState], chosen: Filter
) -> list[wire.EdgeState]:
    """Relations between shown objects; of two opposite symmetric ones the first."""
    found: dict[tuple[int, int, str], wire.EdgeState] = {}
    for edge in edges.values():
        if (
            edge.predicate in chosen.hidden_predicates
            or edge.probability < chosen.min_relation
            or edge.subject not in shown
            or edge.object not in shown
        ):
            continue
        ends = edge.subject, edge.object
        if _is_mutual(edge):
            ends = min(ends), max(ends)
        found.setdefault((*ends, edge.predicate), edge)
    return list(found.values())


def _segments(table: ObjectTable, edges: list[wire.EdgeState]) -> Float64:
    """Tail and tip of each relation (m, 2, 3): from the centre to the box of the other object."""
    if not edges:
        return np.zeros((0, 2, 3))
    subjects = [table.row(edge.subject) for edge in edges]
    objects = [table.row(edge.object) for edge in edges]
    tails, tips = table.centres[subjects], table.centres[objects]
    along = tips - tails
    in_box = np.abs(np.einsum("nij,ni->nj", rotations(table.wxyzs[objects]), along))
    exits = (table.sizes[objects] / 2 / np.maximum(in_box, 1e-9)).min(axis=1)
    tips = tips - along * np.minimum(exits, 1 - SHORTEST_ARROW)[:, None]
    pairs = {(edge.subject, edge.object) for edge in edges}
    both = np.array([(edge.object, edge.subject) in pairs for edge in edges])
    aside = np.cross(along, [0.0, 0.0, 1.0])
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
    shift = APART_M * both[:, None] * aside
    return np.stack([tails + shift, tips + shift], axis=1)


def _opacities(table: ObjectTable, rows: Int64, selected: int | None) -> Float64:
    faint, usual, strong = OPACITIES
    opacities = np.where(table.probabilities[rows] >= SURE, usual, faint)
    opacities[table.ids[rows] == selected] = strong
    return opacities


def _object_labels(table: ObjectTable, ids: list[int], selected: int | None) -> list[Label]:
    labels = [table.texts[node_id] for node_id in ids]
    if selected in ids:
        at = ids.index(selected)
        labels[at] = labels[at]._replace(weight=math.inf)
    return labels


def _edge_labels(edges: list[wire.EdgeState], segments: Float64) -> list[Label]:
    """After all objects, the most probable first."""
    if len(edges) > MOST_PREDICATE_LABELS:
        return []
    return [
        Label(
            f"relation {edge.subject} {edge.object}",
            edge.predicate,
            segment.mean(axis=0),
            edge.probability - 2.0,
        )
        for edge, segment in zip(edges, segments)
    ]


def rgb_of(colours: list[str]) -> UInt8:
    """(n, 3) uint8 of n #rrggbb."""
    known = {colour: [round(255 * value) for value in to_rgb(colour)] for colour in set(colours)}
    return np.array([known[colour] for colour in colours], np.uint8).reshape(-1, 3)
