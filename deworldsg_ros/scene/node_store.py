"""The nodes of a graph with their ids over time."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.edits import EditLog
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.node_ids import NodeIds
from deworldsg_ros.scene.nodes import NodeTable, Observations
from deworldsg_ros.scene.surface import NO_POINTS


class NodeStore:
    """Nodes that are added, observed and changed; ids and frames are remembered.

    Ids start at 1 and are never reused; `resolve` follows merges. `revision` increases with every
    change. Nodes and edges carry the revision of their last change, so that derived data is rebuilt
    for them only.

    Attributes:
        vocabulary: names of classes and predicates.
        frame_id: world frame.
        surface_point_capacity: maximum number of surface points of a node.
        remembered_frames: number of newest frames that `nodes_of_frame` knows.
        nodes: the nodes as parallel arrays; read only.
        edits: what an operator has said about nodes; read only.
        revision: number of changes so far.
    """

    def __init__(
        self,
        vocabulary: Vocabulary,
        frame_id: str,
        surface_point_capacity: int,
        remembered_frames: int,
    ) -> None:
        self.vocabulary = vocabulary
        self.frame_id = frame_id
        self.surface_point_capacity = surface_point_capacity
        self.remembered_frames = remembered_frames
        self.nodes = NodeTable(len(vocabulary.classes), surface_point_capacity)
        self.edits = EditLog()
        self.revision = 0
        self._ids = NodeIds(self.nodes, remembered_frames)
        self._watchers: list[set[int]] = []

    def __len__(self) -> int:
        return len(self.nodes)

    def __contains__(self, node_id: object) -> bool:
        return node_id in self.nodes

    def add_node(
        self,
        mean_world: Float64,
        covariance_world: Float64,
        class_probabilities: Float64,
        stamp_ns: int,
        surface_points_world: Float32 = NO_POINTS,
        weight: float = 1.0,
        confirmed: bool = True,
    ) -> int:
        """Add a node for a first observation and return its id.

        Args:
            mean_world: (3,) metres.
            covariance_world: (3, 3) square metres, positive definite.
            class_probabilities: (C,), scaled to sum to one.
            stamp_ns: time of the observation.
            surface_points_world: (k, 3) float32 points of its surface, metres.
            weight: w of Eq. 7.
            confirmed: false for a hidden node.

        Raises:
            ValueError: if the covariance is not positive definite.
        """
        nodes, node_id = self.nodes, self._ids.next_id
        row = nodes.append(node_id)
        try:
            classes = class_probabilities / class_probabilities.sum()
            nodes.put(row, mean_world, covariance_world, classes, weight, observations=1)
        except ValueError:
            nodes.remove(node_id)
            raise
        nodes.confirmed[row], nodes.existence[row] = confirmed, -1.0
        nodes.set_surface(row, surface_points_world)
        nodes.first_seen_ns[row] = nodes.last_seen_ns[row] = stamp_ns
        self._changed([row])
        return self._ids.take()

    def observe(
        self,
        node_id: int,
        mean_world: Float64,
        covariance_world: Float64,
        class_probabilities: Float64,
        stamp_ns: int,
        surface_points_world: Float32 = NO_POINTS,
        weight: float = 1.0,
    ) -> None:
        """Fuse one more observation into a live node (Eq. 7); arguments as in `add_node`."""
        self.observe_each(
            [node_id],
            mean_world[None],
            covariance_world[None],
            class_probabilities[None],
            stamp_ns,
            [surface_points_world],
            np.array([weight]),
        )

    def observe_each(
        self,
        node_ids: Sequence[int],
        means_world: Float64,
        covariances_world: Float64,
        class_probabilities: Float64,
        stamp_ns: int,
        surfaces: Sequence[Float32],
        weights: Float64,
        classes_after: Float64 | None = None,
    ) -> None:
        """Fuse one more observation into each of n different live nodes, as `observe` does.

        With `classes_after` (n, C), as `set_classes` with these afterwards.
        """
        rows = self.nodes.rows_at(node_ids)
        classes = class_probabilities / class_probabilities.sum(axis=1, keepdims=True)
        gaussians, counts = (means_world, covariances_world), np.ones(len(rows), np.int64)
        seen = Observations(*gaussians, classes, weights, counts, surfaces, stamp_ns, stamp_ns)
        self.nodes.fuse(rows, seen)
        if classes_after is not None:
            self.nodes.class_probabilities[rows] = classes_after
            self.revision += len(rows)  # each counts as two changes
        self._changed(rows)

    def drop_points(self, node_ids: Sequence[int], dropped: Bool) -> None:
        """Remove some of the surface points of n live nodes; see `NodeTable.drop_points`."""
        self._changed(self.nodes.drop_points(self.nodes.rows_at(node_ids), dropped))

    def set_classes(self, node_ids: Sequence[int], class_probabilities: Float64) -> None:
        """Replace the class distributions of n live nodes, (n, C)."""
        rows = self.nodes.rows_at(node_ids)
        self.nodes.class_probabilities[rows] = class_probabilities
        self._changed(rows)

    def set_existence(
        self, node_ids: Sequence[int], existence: Float64, minimum: float
    ) -> list[int]:
        """Set the probabilities (n,) that n live nodes are objects, to two decimals.

        A node is confirmed if it has at least the minimum, and no edit hides it.

        Returns:
            The ids of the nodes that were not confirmed before, and are now.
        """
        nodes = self.nodes
        rows = nodes.rows_at(node_ids)
        existence = existence.round(2)
        confirmed = existence >= minimum
        if self.edits:
            shown = (not self.edits.hides(node_id) for node_id in node_ids)
            confirmed &= np.fromiter(shown, np.bool_, len(node_ids))
        known = nodes.confirmed[rows]
        differs = (nodes.existence[rows] != existence) | (known != confirmed)
        nodes.existence[rows], nodes.confirmed[rows] = existence, confirmed
        self._changed(rows[differs])
        return list(itertools.compress(node_ids, (confirmed & ~known).tolist()))

    def move_node(self, node_id: int, T_correction: Float64) -> None:
        """Apply a pose correction (4, 4), from the old world frame to the new, to a live node."""
        row = self.nodes.row(node_id)
        self.nodes.move(row, T_correction)
        self._changed([row])

    def resolve(self, node_id: int) -> int:
        """The live node that an id stands for, following merges; 0 = none."""
        return self._ids.resolve(node_id)

    def take_removals(self) -> dict[int, int | None]:
        """Ids removed since the last call, each with the live node that it was merged into."""
        return self._ids.take_removals()

    def remember_frame(self, stamp_ns: int, node_ids: Iterable[int]) -> None:
        """Remember which node each row of a frame's local graph became."""
        self._ids.remember_frame(stamp_ns, node_ids)

    def nodes_of_frame(self, stamp_ns: int) -> list[int] | None:
        """The live node of each row of a frame (0 = removed); None = the frame is forgotten."""
        return self._ids.nodes_of_frame(stamp_ns)

    def watch_nodes(self) -> set[int]:
        """A set that gets the ids of all nodes that change, come or go from now on.

        It starts with all ids. The caller empties it.
        """
        watcher: set[int] = set(self.nodes.ids.tolist())
        self._watchers.append(watcher)
        return watcher

    def _changed(self, rows: Sequence[int] | Int64) -> None:
        """Count one change for each row."""
        first = self.revision + 1
        self.revision += len(rows)
        self.nodes.revisions[rows] = np.arange(first, self.revision + 1)
        ids = self.nodes.ids[rows].tolist()
        for watcher in self._watchers:
            watcher.update(ids)
