"""The objects of the graph as arrays. Only objects whose message changed are computed again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from deworldsg_ros.client.objects import SURE, Point, SceneObject, scene_object
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.columns import Columns
from deworldsg_ros.view.geometry import SIGMAS, principal_axes

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
