"""A synthetic map of rooms of any size, and frames of its rooms.

Rooms of 5 x 2.5 x 4 m with 40 objects each stand in rows on several floors. Axes are those of the
camera: x right, y down, z forward. A frame shows the 12 objects nearest to the middle of a room,
seen from its near side, before its far wall.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bench.merging import (
    CAMERA,
    CLASSES,
    LOCAL_NODES,
    PREDICATES,
    STRIDE_PX,
    VOCABULARY,
    local_graph,
)
from deworldsg_ros.config import Config
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph_builder import GraphBuilder, graph_settings
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

ROOM_M = np.array([5.0, 2.5, 4.0])
# Distance of rooms from one another: a wall, and a corridor along z.
PITCH_M = np.array([5.2, 3.0, 7.0])
OBJECTS_PER_ROOM = 40
POINTS = 60  # surface points of an object
# The camera stands this far before the near side of the room.
BACK_M = 1.5


class RoomMap:
    """Objects of 10 to 50 cm in rooms.

    Args:
        count: number of objects.
        seed: of the random numbers.

    Attributes:
        means: (count, 3) metres.
        covariances: (count, 3, 3) square metres.
    """

    def __init__(self, count: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        rooms = -(-count // OBJECTS_PER_ROOM)
        side = math.ceil((rooms / 3) ** 0.5)  # three floors
        index = np.arange(rooms)
        cells = np.stack([index % side, index // side**2, index // side % side], axis=1)
        self.corners = cells * PITCH_M
        inside = rng.uniform(0.25, ROOM_M - 0.25, (rooms * OBJECTS_PER_ROOM, 3))
        self.means = (np.repeat(self.corners, OBJECTS_PER_ROOM, axis=0) + inside)[:count]
        self.sizes = rng.uniform(0.1, 0.5, (count, 3)) * [1.0, 1.0, 0.1]
        self.covariances = np.zeros((count, 3, 3))
        for axis in range(3):
            self.covariances[:, axis, axis] = self.sizes[:, axis] ** 2 / 12
        self.classes = rng.integers(0, CLASSES, count)

    def surfaces(self, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Points (n, POINTS, 3) float32 of the surfaces of n objects."""
        spread = rng.uniform(-0.5, 0.5, (len(rows), POINTS, 3)) * self.sizes[rows, None]
        return (self.means[rows, None] + spread).astype(np.float32)

    def probabilities(self, rows: np.ndarray) -> np.ndarray:
        """Class distributions (n, C) of observations of n objects."""
        probabilities = np.full((len(rows), CLASSES), 0.2 / CLASSES)
        probabilities[np.arange(len(rows)), self.classes[rows]] += 0.8
        return probabilities

    def builder(self, config: Config, edges_per_node: int = 5) -> GraphBuilder:
        """A graph of all objects, with relations between neighbours in the order of the rooms."""
        count = len(self.means)
        rng = np.random.default_rng(1)
        graph = GlobalGraph(VOCABULARY, "world", **graph_settings(config.merging))
        rows = np.arange(count)
        surfaces, probabilities = self.surfaces(rows, rng), self.probabilities(rows)
        for row in range(count):
            graph.add_node(
                self.means[row], self.covariances[row], probabilities[row], 0, surfaces[row]
            )
        logits = rng.normal(size=(64, PREDICATES))
        for subject in range(1, count + 1):
            for step in range(1, edges_per_node + 1):
                object_ = (subject + step - 1) % count + 1
                if object_ != subject:
                    graph.add_visual(subject, object_, logits[subject % 64], 0)
        builder = GraphBuilder(config, VOCABULARY, "world", graph=graph)
        builder.merging.restore(graph, {})
        builder.up.observe(np.eye(4))  # a map knows up
        return builder

    def frames(
        self, count: int, rooms: int | None = None, seed: int = 2, stay: int = 1
    ) -> list[LocalGraph]:
        """Frames of random rooms, with millimetre noise.

        Args:
            count: number of frames.
            rooms: only the first of all rooms; None = all.
            seed: of the random numbers.
            stay: frames in a row of each room.
        """
        rng = np.random.default_rng(seed)
        # The last room may have fewer objects.
        rooms = rooms or max(1, len(self.means) // OBJECTS_PER_ROOM)
        found = []
        for k in range(1, count + 1):
            if (k - 1) % stay == 0:
                room = int(rng.integers(rooms))
            found.append(self._frame(room, k * 33_000_000, rng))
        return found

    def _frame(self, room: int, stamp_ns: int, rng: np.random.Generator) -> LocalGraph:
        view = self.view(room, rng)
        depth_mm, instances = view.render(STRIDE_PX)
        grid = DepthGrid(depth_mm, STRIDE_PX, CAMERA, instances)
        return local_graph(
            self, view.rows, stamp_ns, view.T_world_camera, tuple(view.surfaces), grid, rng
        )

    def view(self, room: int, rng: np.random.Generator) -> View:
        """The camera before a room, and new surface points of its objects."""
        corner = self.corners[room]
        in_room = np.arange(room * OBJECTS_PER_ROOM, (room + 1) * OBJECTS_PER_ROOM)
        offsets = self.means[in_room] - (corner + ROOM_M / 2)
        rows = in_room[np.argsort(np.linalg.norm(offsets, axis=1))[:LOCAL_NODES]]
        T_world_camera = np.eye(4)
        T_world_camera[:3, 3] = corner + [ROOM_M[0] / 2, ROOM_M[1] / 2, -BACK_M]
        surfaces = self.surfaces(rows, rng)
        others = self.surfaces(np.setdiff1d(in_room, rows), rng)
        return View(rows, T_world_camera, surfaces, others)


def publish(builder: GraphBuilder) -> None:
    """Publish everything that waits: a large map takes several updates."""
    while builder.update() is not None or builder.waiting:
        pass


class View(NamedTuple):
    """A camera, and the objects before it.

    Attributes:
        rows: (n,) of the detected objects in the map.
        T_world_camera: (4, 4).
        surfaces: (n, k, 3) surface points of the detected objects, world frame, metres.
        others: (m, k, 3) of the objects that are not detected.
    """

    rows: np.ndarray
    T_world_camera: np.ndarray
    surfaces: np.ndarray
    others: np.ndarray

    def render(self, stride_px: int) -> tuple[np.ndarray, np.ndarray]:
        """Depth in millimetres and instances on every N-th pixel, both uint16.

        There is a wall, and before it each surface in the box of its points.
        """
        shape = (CAMERA.height // stride_px, CAMERA.width // stride_px)
        depth_mm = np.full(shape, 1000 * (BACK_M + ROOM_M[2]), np.uint16)
        instances = np.zeros(shape, np.uint16)
        surfaces = np.concatenate((self.surfaces, self.others))
        for index in np.argsort(-surfaces[:, :, 2].mean(axis=1)).tolist():  # the nearest last
            x, y, z = (surfaces[index] - self.T_world_camera[:3, 3]).T
            columns = (CAMERA.fx * x / z + CAMERA.cx) / stride_px
            rows = (CAMERA.fy * y / z + CAMERA.cy) / stride_px
            top, bottom = (max(int(end), 0) for end in (rows.min(), rows.max() + 1))
            left, right = (max(int(end), 0) for end in (columns.min(), columns.max() + 1))
            depth_mm[top:bottom, left:right] = 1000 * z.mean()
            instances[top:bottom, left:right] = index + 1 if index < len(self.rows) else 0
        return depth_mm, instances
