"""The global 3D scene graph: Gaussian nodes, sparse directed edges, stable ids."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from deworldsg_ros.scene import graph_io as storage
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.scene.edges import EdgeEvidence, EdgeMap, Pair
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.gaussian import transform
from deworldsg_ros.scene.node_states import NodeStateCache
from deworldsg_ros.scene.nodes import NodeTable
from deworldsg_ros.scene.surface import NO_POINTS


class SceneGraph:
    """The state of the map; stages change it through the methods below and nothing else.

    Ids start at 1, are never reused, and survive `save` and `load`. When two nodes are merged the
    older id lives on, and `resolve` follows the one that went. `revision` increases with every
    change; nodes and edges carry the revision at which they last changed, so that whoever keeps
    something derived from them rebuilds only that much.

    Attributes:
        vocabulary: names of classes and predicates.
        frame_id: world frame.
        surface_point_capacity: most surface points kept a node.
        remembered_frames: number of newest frames that `nodes_of_frame` knows.
        even_gaussians: messages show the `even_moments` of a node's surface instead of the pooled
            Gaussian.
        nodes: the nodes as parallel arrays; read only.
        revision: number of changes so far.
    """

    def __init__(
        self,
        vocabulary: Vocabulary,
        frame_id: str,
        surface_point_capacity: int = 512,
        remembered_frames: int = 1024,
        even_gaussians: bool = False,
    ) -> None:
        self.vocabulary = vocabulary
        self.frame_id = frame_id
        self.surface_point_capacity = surface_point_capacity
        self.remembered_frames = remembered_frames
        self.even_gaussians = even_gaussians
        self.nodes = NodeTable(len(vocabulary.classes), surface_point_capacity)
        self.revision = 0
        self._edges = EdgeMap(len(vocabulary.predicates))
        self._next_id = 1
        # Where each id that is gone went; 0 = nowhere. Two integers an id for the graph's life.
        self._successors: dict[int, int] = {}
        self._removals: list[int] = []
        self._frames: dict[int, tuple[int, ...]] = {}
        self._states = NodeStateCache(even_gaussians)

    def __len__(self) -> int:
        return len(self.nodes)

    def __contains__(self, node_id: object) -> bool:
        return node_id in self.nodes

    # Nodes ------------------------------------------------------------------------------------

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
            weight: w of Eq. 7, by which its Gaussian counts.
            confirmed: whether it is sure to be an object; otherwise it is tentative.

        Raises:
            ValueError: where the covariance is not positive definite.
        """
        node_id = self._next_id
        row = self.nodes.append(node_id)
        try:
            self.nodes.put(
                row,
                mean_world,
                covariance_world,
                class_probabilities / class_probabilities.sum(),
                weight,
                observations=1,
            )
        except ValueError:
            self.nodes.remove(node_id)
            raise
        self._next_id += 1
        self.nodes.confirmed[row] = confirmed
        self.nodes.set_surface(row, surface_points_world)
        self.nodes.first_seen_ns[row] = self.nodes.last_seen_ns[row] = stamp_ns
        self.nodes.revisions[row] = self._changed()
        return node_id

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
    ) -> None:
        """Fuse one more observation into each of n different live nodes, as `observe` does."""
        self._fuse_into(
            [self.nodes.row(node_id) for node_id in node_ids],
            means_world,
            covariances_world,
            class_probabilities / class_probabilities.sum(axis=1, keepdims=True),
            weights,
            np.ones(len(node_ids), np.int64),
            surfaces,
            stamp_ns,
            stamp_ns,
        )

    def merge_nodes(self, a_id: int, b_id: int) -> int:
        """Merge two live nodes (Eq. 7) and return the id that lives on, the older one.

        Edges of the other are re-pointed and their evidence summed; an edge between the two is
        dropped.
        """
        if a_id == b_id:
            raise ValueError(f"node {a_id} cannot be merged with itself")
        keep_id, gone_id = min(a_id, b_id), max(a_id, b_id)
        nodes, gone = self.nodes, self.nodes.row(gone_id)
        self._fuse_into(
            [nodes.row(keep_id)],
            nodes.means[[gone]],
            nodes.covariances[[gone]],
            nodes.class_probabilities[[gone]],
            nodes.weights[[gone]],
            nodes.observations[[gone]],
            [nodes.surface(gone)],
            int(nodes.first_seen_ns[gone]),
            int(nodes.last_seen_ns[gone]),
        )
        nodes.confirmed[nodes.row(keep_id)] |= nodes.confirmed[gone]
        self._edges.repoint(gone_id, keep_id, self.revision)
        self._forget(gone_id, keep_id)
        return keep_id

    def correct(self, node_id: int, factor: float, points_world: Float32) -> None:
        """Take from a live node what was another's.

        Args:
            node_id: of the node.
            factor: how much less its Gaussian counts beside those to come.
            points_world: (k, 3) those points of its surface that stay.
        """
        row = self.nodes.row(node_id)
        self.nodes.weights[row] *= factor
        self.nodes.set_surface(row, points_world)
        self.nodes.revisions[row] = self._changed()

    def set_confirmed(self, node_id: int, confirmed: bool) -> None:
        """Note that a node is sure to be an object, or no longer sure."""
        row = self.nodes.row(node_id)
        if self.nodes.confirmed[row] != confirmed:
            self.nodes.confirmed[row] = confirmed
            self.nodes.revisions[row] = self._changed()

    def take_over(self, old_id: int, new_id: int) -> None:
        """Let an older node's id stand for a newer node: its object was moved, and found again.

        Place, shape, surface and edges are the newer node's; class distributions average by their
        numbers of observations.
        """
        nodes = self.nodes
        old, new = nodes.row(old_id), nodes.row(new_id)
        seen = nodes.observations[[old, new]]
        classes = seen @ nodes.class_probabilities[[old, new]] / seen.sum()
        nodes.put(
            old,
            nodes.means[new].copy(),
            nodes.covariances[new].copy(),
            classes,
            float(nodes.weights[new]),
            int(seen.sum()),
        )
        nodes.set_surface(old, nodes.surface(new))
        nodes.confirmed[old] = nodes.confirmed[new]
        nodes.last_seen_ns[old] = nodes.last_seen_ns[new]
        nodes.revisions[old] = self._changed()
        self._edges.drop(old_id)
        self._edges.repoint(new_id, old_id, self.revision)
        self._forget(new_id, old_id)

    def move_node(self, node_id: int, T_correction: Float64) -> None:
        """Move a live node with its surface: its pose was wrong by a rigid transform (4, 4).

        The transform takes points of the world as it was into the world as it is.
        """
        nodes, row = self.nodes, self.nodes.row(node_id)
        nodes.put(
            row,
            *transform(nodes.means[row], nodes.covariances[row], T_correction),
            nodes.class_probabilities[row].copy(),
            float(nodes.weights[row]),
            int(nodes.observations[row]),
        )
        points = nodes.surface(row).astype(np.float64) @ T_correction[:3, :3].T
        points += T_correction[:3, 3]
        nodes.set_surface(row, points.astype(np.float32))
        nodes.revisions[row] = self._changed()

    def remove_node(self, node_id: int) -> None:
        """Remove a live node and its edges; nothing takes its place."""
        self.nodes.row(node_id)
        self._changed()
        self._edges.drop(node_id)
        self._forget(node_id, 0)

    def resolve(self, node_id: int) -> int:
        """The live node that stands for an id today, following merges; 0 = none."""
        path = []
        while node_id in self._successors:
            path.append(node_id)
            node_id = self._successors[node_id]
        for passed in path[:-1]:
            self._successors[passed] = node_id
        return node_id if node_id in self.nodes else 0

    def take_removals(self) -> dict[int, int | None]:
        """Ids gone since this was last called, each with the live node it was merged into."""
        removals = {gone: self.resolve(gone) or None for gone in self._removals}
        self._removals.clear()
        return removals

    # Frames -----------------------------------------------------------------------------------

    def remember_frame(self, stamp_ns: int, node_ids: Iterable[int]) -> None:
        """Keep which node each row of a frame's local graph became."""
        self._frames.pop(stamp_ns, None)
        self._frames[stamp_ns] = tuple(node_ids)
        if len(self._frames) > self.remembered_frames:
            del self._frames[next(iter(self._frames))]

    def nodes_of_frame(self, stamp_ns: int) -> list[int] | None:
        """The live node of each row of a frame's local graph (0 = gone); None = not remembered."""
        node_ids = self._frames.get(stamp_ns)
        return None if node_ids is None else [self.resolve(node_id) for node_id in node_ids]

    # Edges ------------------------------------------------------------------------------------

    @property
    def edges(self) -> Mapping[Pair, EdgeEvidence]:
        """Evidence of each directed pair (subject id, object id); read only.

        Pairs with `frames == 0` are geometric neighbours without visual evidence.
        """
        return self._edges.evidence

    def add_visual(
        self, subject_id: int, object_id: int, logits: Float64, stamp_ns: int, frames: int = 1
    ) -> bool:
        """Sum a frame's visual relation logits (R,) into an edge (Eq. 9).

        Ids are resolved first; returns False, and does nothing, where one of them is gone or both
        have become one node.
        """
        return self._add_evidence(subject_id, object_id, logits, frames, 0, stamp_ns)

    def add_neighbour(self, subject_id: int, object_id: int, stamp_ns: int) -> bool:
        """Count a frame in which the pair was a geometric neighbour (Eq. 8); as `add_visual`."""
        return self._add_evidence(subject_id, object_id, None, 0, 1, stamp_ns)

    # Snapshots --------------------------------------------------------------------------------

    def node_states(
        self, top_k: int, tentative: bool = False, with_points: bool = False
    ) -> dict[int, wire.NodeState]:
        """Messages of the confirmed nodes, or of all, by ascending id.

        Those that did not change are the same objects.
        """
        return self._states.states(
            self.nodes, self.vocabulary.classes, top_k, tentative, with_points
        )

    def save(self, path: str | Path) -> None:
        """Write the whole state, without loss."""
        storage.write(path, storage.state_of(self))

    @staticmethod
    def load(path: str | Path) -> SceneGraph:
        """Read what `save` wrote; raises RefusedInput ``invalid_graph_file``."""
        return storage.graph_of(storage.read(path), str(path))

    # ------------------------------------------------------------------------------------------

    def _changed(self) -> int:
        self.revision += 1
        return self.revision

    def _fuse_into(
        self,
        rows: list[int],
        means_world: Float64,
        covariances_world: Float64,
        class_probabilities: Float64,
        weights: Float64,
        observations: Int64,
        surfaces: Sequence[Float32],
        first_seen_ns: int,
        last_seen_ns: int,
    ) -> None:
        """Fuse something into each of n different rows."""
        nodes = self.nodes
        nodes.fuse(rows, means_world, covariances_world, class_probabilities, weights, observations)
        nodes.add_surfaces(rows, surfaces)
        nodes.revisions[rows] = self.revision + 1 + np.arange(len(rows))
        self.revision += len(rows)
        nodes.first_seen_ns[rows] = np.minimum(nodes.first_seen_ns[rows], first_seen_ns)
        nodes.last_seen_ns[rows] = np.maximum(nodes.last_seen_ns[rows], last_seen_ns)

    def _forget(self, node_id: int, successor: int) -> None:
        self.nodes.remove(node_id)
        self._states.forget(node_id)
        self._successors[node_id] = successor
        self._removals.append(node_id)

    def _add_evidence(
        self,
        subject_id: int,
        object_id: int,
        logits: Float64 | None,
        frames: int,
        neighbour_frames: int,
        stamp_ns: int,
    ) -> bool:
        pair = (self.resolve(subject_id), self.resolve(object_id))
        if 0 in pair or pair[0] == pair[1]:
            return False
        if logits is not None and logits.shape != (len(self.vocabulary.predicates),):
            raise ValueError(
                f"relation logits have shape {logits.shape}: "
                f"wanted ({len(self.vocabulary.predicates)},)"
            )
        self._edges.add(
            pair,
            logits=logits,
            frames=frames,
            neighbour_frames=neighbour_frames,
            stamp_ns=stamp_ns,
            revision=self._changed(),
        )
        return True
