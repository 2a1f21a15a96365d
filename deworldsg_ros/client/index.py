"""Finds objects and relations of a large graph without a look at each; made when first used."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property

import numpy as np

from deworldsg_ros.client.boxes import Triple, box_of
from deworldsg_ros.client.words import is_class
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64

Pair = tuple[int, int]


class GraphIndex:
    """An index of one graph, which never changes.

    Args:
        nodes: by id.
        edges: by subject and object.
    """

    def __init__(
        self, nodes: Mapping[int, wire.NodeState], edges: Mapping[Pair, wire.EdgeState]
    ) -> None:
        self._nodes, self._edges = nodes, edges

    def called(self, label: str) -> list[int]:
        """The objects whose most probable class is meant by a name."""
        return [i for name, ids in self._by_label.items() if is_class(label, name) for i in ids]

    def perhaps(self, label: str) -> list[int]:
        """The objects that list a class which is meant by a name."""
        known = {belief.label for node in self._nodes.values() for belief in node.classes}
        meant = {name for name in known if is_class(label, name)}
        return [
            i
            for i, node in self._nodes.items()
            if any(belief.label in meant for belief in node.classes)
        ]

    def around(self, point: Triple, reach_m: float) -> list[int]:
        """The objects whose boxes may be in reach of a point: all that are, and a few others."""
        ids, centers, radii = self._spheres
        distances = np.linalg.norm(centers - np.array(point), axis=1)
        return [ids[row] for row in np.flatnonzero(distances - radii <= reach_m)]

    def touching(self, ids: Iterable[int]) -> list[Pair]:
        """The relations from and to some objects, each once."""
        return list(dict.fromkeys(pair for i in ids for pair in self._by_end.get(i, ())))

    @cached_property
    def _by_label(self) -> dict[str, list[int]]:
        found: dict[str, list[int]] = {}
        for i, node in self._nodes.items():
            found.setdefault(node.label, []).append(i)
        return found

    @cached_property
    def _by_end(self) -> dict[int, list[Pair]]:
        found: dict[int, list[Pair]] = {}
        for pair in self._edges:
            for end in pair:
                found.setdefault(end, []).append(pair)
        return found

    @cached_property
    def _spheres(self) -> tuple[list[int], Float64, Float64]:
        centers = [box_of(node)[0] for node in self._nodes.values()]
        radii = [_radius_m(node) for node in self._nodes.values()]
        return list(self._nodes), np.array(centers, np.float64).reshape(-1, 3), np.array(radii)


def _radius_m(node: wire.NodeState) -> float:
    # Of a message without a box, the box depends on the surface or the Gaussian.
    if not isinstance(node.box, wire.GravityBox):
        return np.inf
    a, b, c = node.box.size_m
    # A little more, for the rounding of the exact distance.
    return 0.5 * (a * a + b * b + c * c) ** 0.5 + 1e-6
