"""The global 3D scene graph: Gaussian nodes, sparse directed edges, stable ids."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.words import counted
from deworldsg_ros.graph.edits import Edit, EditLog
from deworldsg_ros.graph.embeddings import NodeEmbeddings
from deworldsg_ros.graph.extent import even_moments
from deworldsg_ros.graph.nodes import SAVED, IdState, NodeIds, NodeTable, Observations
from deworldsg_ros.graph.pairs import (
    EdgeEvidence,
    EdgesByPair,
    Pair,
    PairArrays,
    PairStore,
    PairVotes,
    VotesByPair,
)
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, Vocabulary, derived
from deworldsg_ros.scene.limits import MAX_NAMES
from deworldsg_ros.scene.surface import NO_KEYFRAMES, NO_POINTS

# --- The global 3D scene graph: Gaussian nodes, sparse directed edges, stable ids.


@dataclass(frozen=True)
class GraphState:
    """Everything from which an equal graph can be made.

    Attributes:
        vocabulary, frame_id: of the graph, and
        surface_point_capacity, remembered_frames, even_gaussians: its settings; see `GlobalGraph`.
        nodes: arrays of n rows, by ascending ids, by their names in `NodeTable`.
        surface_points: (m, 3) float32, metres, those of one node after those of another.
        surface_keyframes: (m,) uint16, of each of these points.
        surface_counts: (n,) int64, number of points of each node.
        pairs: evidence of edges, and votes.
        ids: the id memory.
        edits: of an operator, oldest first.
        embeddings: `NodeEmbeddings.arrays`.
    """

    vocabulary: Vocabulary
    frame_id: str
    nodes: Mapping[str, NDArray[Any]]
    surface_points: Float32
    surface_keyframes: UInt16
    surface_counts: Int64
    pairs: PairArrays
    ids: IdState
    surface_point_capacity: int
    remembered_frames: int
    even_gaussians: bool
    edits: Sequence[Edit] = ()
    embeddings: Mapping[str, NDArray[Any]] = field(default_factory=dict)


class GlobalGraph:
    """The state of the map: nodes and directed edges between them.

    Stages change it only through its methods. Ids start at 1 and are never reused. When two nodes
    merge, the older id stays; `resolve` follows merges.

    Attributes:
        vocabulary: names of classes and predicates; frames bring new classes, at the end.
        frame_id: world frame.
        surface_point_capacity: maximum number of surface points of a node.
        remembered_frames: number of newest frames that `nodes_of_frame` knows.
        nodes: the nodes as parallel arrays; read only.
        pairs: what is known about pairs of nodes, by slots.
        edits: what an operator has said about nodes; read only.
        embeddings: what some of the nodes look like; read only.
        up_world: (3,) unit vector against gravity, as far as the poses so far tell.
        even_gaussians: messages show the `even_moments` of a node's surface instead of the pooled
            Gaussian.
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
        self.edits = EditLog()
        # The newest vocabulary of a frame, the graph's at that time, and its columns there.
        self._translated: tuple[Vocabulary, Vocabulary, Int64 | None]
        self._translated = (vocabulary, vocabulary, None)
        self.embeddings = NodeEmbeddings()
        self.up_world = np.array([0.0, 0.0, 1.0])
        self._ids = NodeIds(self.nodes, remembered_frames)
        self._watchers: list[dict[int, int]] = []
        self.pairs = PairStore(self.nodes, len(vocabulary.predicates))

    @classmethod
    def from_state(cls, state: GraphState) -> GlobalGraph:
        """The graph of a state; ValueError or KeyError if its parts do not fit together."""
        graph = cls(
            state.vocabulary,
            state.frame_id,
            state.surface_point_capacity,
            state.remembered_frames,
            state.even_gaussians,
        )
        surfaces = state.surface_points, state.surface_keyframes, state.surface_counts
        graph.nodes.restore(state.nodes, *surfaces)
        graph.pairs.restore(state.pairs)
        graph._ids = NodeIds(graph.nodes, state.remembered_frames, state.ids)
        graph.edits = EditLog(state.edits)
        graph.embeddings.restore(state.embeddings, graph.nodes.ids)
        return graph

    def state(self) -> GraphState:
        """A copy of everything from which `from_state` makes an equal graph."""
        nodes = self.nodes
        slots = nodes.slots_of(sorted(nodes.slot_of))
        return GraphState(
            vocabulary=self.vocabulary,
            frame_id=self.frame_id,
            nodes={name: getattr(nodes, name)[slots] for name in SAVED},
            surface_points=np.concatenate([NO_POINTS, *map(nodes.surface, slots.tolist())]),
            surface_keyframes=np.concatenate([NO_KEYFRAMES, *map(nodes.keyframes, slots.tolist())]),
            surface_counts=nodes.surface_counts[slots],
            pairs=self.pairs.arrays(),
            ids=self._ids.state(),
            surface_point_capacity=self.surface_point_capacity,
            remembered_frames=self.remembered_frames,
            even_gaussians=self.even_gaussians,
            edits=list(self.edits.edits),
            embeddings=self.embeddings.arrays(),
        )

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
            RefusedInput: ``no_ids_left``.
        """
        nodes, node_id = self.nodes, self._ids.take()
        slot = nodes.add(node_id)
        try:
            classes = class_probabilities / class_probabilities.sum()
            nodes.put(slot, mean_world, covariance_world, classes, weight, observations=1)
        except ValueError:
            nodes.remove(node_id)
            self._ids.give_back()
            raise
        nodes.confirmed[slot], nodes.existence[slot] = confirmed, -1.0
        nodes.set_surface(slot, surface_points_world)
        nodes.first_seen_ns[slot] = nodes.last_seen_ns[slot] = stamp_ns
        self._changed([slot])
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
        classes_after: Float64 | None = None,
    ) -> None:
        """Fuse one more observation into each of n different live nodes, as `observe` does.

        With `classes_after` (n, C), as `set_classes` with these afterwards.
        """
        slots = self.nodes.slots_of(node_ids)
        classes = class_probabilities / class_probabilities.sum(axis=1, keepdims=True)
        gaussians, counts = (means_world, covariances_world), np.ones(len(slots), np.int64)
        seen = Observations(*gaussians, classes, weights, counts, surfaces, stamp_ns, stamp_ns)
        self.nodes.fuse(slots, seen)
        if classes_after is not None:
            self.nodes.class_probabilities[slots] = classes_after
        self._changed(slots)

    def add_colours(self, local: LocalGraph, node_ids: Sequence[int]) -> None:
        """Add the colours of a frame, weighted by pixels, to its nodes (0 = none)."""
        if local.colours_lab is None:
            return
        slot_of = self.nodes.slot_of
        slots = np.array([slot_of.get(node_id, -1) for node_id in node_ids], np.int64)
        known = (slots >= 0) & ~np.isnan(local.colours_lab).any(axis=1)
        weights = local.pixel_counts[known, None].astype(np.float64)
        # Two rows of a frame may be one node.
        seen = np.concatenate([weights * local.colours_lab[known], weights], axis=1)
        np.add.at(self.nodes.colours, slots[known], seen)
        self._changed(slots[known])

    def add_embeddings(self, local: LocalGraph, node_ids: Sequence[int]) -> None:
        """Add the embeddings of a frame to its nodes (0 = none).

        Raises:
            RefusedInput: ``embedding_model_mismatch``; nothing is added then.
        """
        seen = local.embeddings
        if seen is None:
            return
        self.embeddings.check_fits(seen)
        for row, vector in zip(seen.rows.tolist(), seen.vectors):
            slot = self.nodes.slot_of.get(node_ids[row])
            if slot is not None:
                direction = local.T_world_camera[:3, 3] - self.nodes.means[slot]
                self.embeddings.add(node_ids[row], direction, vector, seen.model)

    def drop_points(self, node_ids: Sequence[int], dropped: Bool) -> None:
        """Remove some of the surface points of n live nodes; see `NodeTable.drop_points`."""
        self._changed(self.nodes.drop_points(self.nodes.slots_of(node_ids), dropped))

    def set_classes(self, node_ids: Sequence[int], class_probabilities: Float64) -> None:
        """Replace the class distributions of n live nodes, (n, C)."""
        slots = self.nodes.slots_of(node_ids)
        self.nodes.class_probabilities[slots] = class_probabilities
        self._changed(slots)

    def set_existence(
        self, node_ids: Sequence[int], existence: Float64, minimum: float
    ) -> list[int]:
        """Set the probabilities (n,) that n live nodes are objects, to two decimals.

        A node is confirmed if it has at least the minimum, and no edit hides it.

        Returns:
            The ids of the nodes that were not confirmed before, and are now.
        """
        nodes = self.nodes
        slots = nodes.slots_of(node_ids)
        existence = existence.round(2)
        confirmed = existence >= minimum
        if self.edits:
            shown = (not self.edits.hides(node_id) for node_id in node_ids)
            confirmed &= np.fromiter(shown, np.bool_, len(node_ids))
        known = nodes.confirmed[slots]
        differs = (nodes.existence[slots] != existence) | (known != confirmed)
        nodes.existence[slots], nodes.confirmed[slots] = existence, confirmed
        self._changed(slots[differs])
        return list(itertools.compress(node_ids, (confirmed & ~known).tolist()))

    def move_nodes(self, slots: Int64, T_new_old: Float64) -> Float64:
        """Move nodes as the keyframes that saw them have moved; see `NodeTable.move`."""
        main = self.nodes.move(slots, T_new_old)
        if self.embeddings.views:
            for node_id, T in zip(self.nodes.ids[slots].tolist(), main):
                self.embeddings.turn(node_id, T[:3, :3])
        self._changed(slots)
        return main

    @property
    def next_id(self) -> int:
        """Id of the next node."""
        return self._ids.next_id

    def skip_to(self, next_id: int) -> None:
        """Give out no id below this one: those may be known for other nodes."""
        self._ids.skip_to(next_id)

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

    def watch_nodes(self) -> dict[int, int]:
        """All nodes that change, come or go from now on: the slot of each id.

        It starts with all nodes. The caller empties it.
        """
        watcher = dict(self.nodes.slot_of)
        self._watchers.append(watcher)
        return watcher

    def _changed(self, slots: Sequence[int] | Int64) -> None:
        """Tell those who watch that nodes have changed."""
        ids, known = self.nodes.ids[slots].tolist(), self.nodes.slot_of
        for watcher in self._watchers:
            watcher.update((node_id, known[node_id]) for node_id in ids)

    def copy_relations(self, node_id: int, new_id: int, without: Collection[int]) -> None:
        """Give a node the edges and votes of another one, except those with some nodes."""
        slot, to = self.nodes.slot(node_id), self.nodes.slot(new_id)
        self.pairs.copy(slot, to, self.nodes.slots_of(list(without)).tolist())

    def add_edit(self, edit: Edit) -> Edit:
        """Note an operator's edit, with a new number; the nodes that it replaces are hidden."""
        edit, lost = self.edits.add(edit)
        slots = self.nodes.slots_of([*edit.nodes, *edit.replaced])
        self.nodes.confirmed[slots] &= [not self.edits.hides(i) for i in self.nodes.ids[slots]]
        self._changed(slots)
        self._drop(lost)
        return edit

    def merge_nodes(self, a_id: int, b_id: int) -> int:
        """Merge two live nodes (Eq. 7) and return the id that stays, the older one.

        The edges of the other node are re-pointed and their evidence is summed. An edge between the
        two is dropped.
        """
        if a_id == b_id:
            raise ValueError(f"node {a_id} cannot be merged with itself")
        kept_id, removed_id = min(a_id, b_id), max(a_id, b_id)
        slot, removed = self.nodes.slot(kept_id), self.nodes.slot(removed_id)
        self.nodes.merge(slot, removed)
        if self.embeddings.views:
            self.embeddings.merge(kept_id, removed_id)
        self._changed([slot])
        self.pairs.merge(removed, slot)
        self._remove(removed_id, kept_id)
        return kept_id

    def take_over(self, old_id: int, new_id: int) -> None:
        """Give a newer node an older node's id: the object was moved and detected again.

        Gaussian, surface and edges are the newer node's. Class distributions average with the
        numbers of observations.
        """
        slot, new = self.nodes.slot(old_id), self.nodes.slot(new_id)
        self.nodes.take_over(slot, new)
        if self.embeddings.views:
            self.embeddings.merge(old_id, new_id)
        self._changed([slot])
        self.pairs.drop(slot)
        self.pairs.merge(new, slot)
        self._remove(new_id, old_id)

    def remove_node(self, node_id: int) -> None:
        """Remove a live node and its edges."""
        self.pairs.drop(self.nodes.slot(node_id))
        self._remove(node_id, 0)

    @property
    def edges(self) -> Mapping[Pair, EdgeEvidence]:
        """Evidence of each directed pair (subject id, object id); read only."""
        return EdgesByPair(self.nodes, self.pairs)

    @property
    def votes(self) -> Mapping[Pair, PairVotes]:
        """Votes on each unordered pair (smaller id, larger id) seen together; read only."""
        return VotesByPair(self.nodes, self.pairs)

    def admit(self, local: LocalGraph) -> LocalGraph:
        """A frame's local graph with the classes of this graph, which learns those that are new.

        Raises:
            RefusedInput: ``vocabulary_mismatch`` for other predicates, ``too_many_names`` or
                ``wrong_frame``; the graph is unchanged.
        """
        if local.frame_id != self.frame_id:
            raise RefusedInput(
                "wrong_frame",
                f"local graph is in frame {local.frame_id!r}: expected {self.frame_id!r}",
            )
        seen = local.vocabulary
        if seen is self.vocabulary:
            return local
        columns = self.class_columns(seen, learn=True)
        if columns is None:
            return derived(local, vocabulary=self.vocabulary)
        classes = np.zeros((len(local), len(self.vocabulary.classes)))
        # A name may be there twice.
        np.add.at(classes.T, columns, local.class_probabilities.T)
        return derived(local, vocabulary=self.vocabulary, class_probabilities=classes)

    def class_columns(self, seen: Vocabulary, learn: bool = False) -> Int64 | None:
        """The index (C,) here of each class of another vocabulary; None = the same indices.

        Args:
            seen: its predicates have to be those of the graph.
            learn: add classes that are new, at the end; else they are a ``vocabulary_mismatch``.

        Raises:
            RefusedInput: ``vocabulary_mismatch`` or ``too_many_names``; the graph is unchanged.
        """
        # By identity: to compare all names takes long, and every frame has the same ones.
        if seen is self._translated[0] and self.vocabulary is self._translated[1]:
            return self._translated[2]
        known = self.vocabulary
        if seen.predicates != known.predicates:
            raise RefusedInput(
                "vocabulary_mismatch",
                f"a message has {len(seen.predicates)} predicates that are not the scene graph's "
                f"{len(known.predicates)}: do all nodes run with one configuration?",
            )
        new = set(seen.classes).difference(known.classes)
        if new and not learn:
            raise RefusedInput(
                "vocabulary_mismatch",
                f"a message has {counted(len(new), 'name')} of classes that the scene graph does "
                f"not know, such as {min(new)!r}",
            )
        if len(known.classes) + len(new) > MAX_NAMES:
            raise RefusedInput(
                "too_many_names",
                f"a frame brings {counted(len(new), 'new name')} of classes to the "
                f"{len(known.classes)} of the scene graph: expected at most {MAX_NAMES} in all",
            )
        if new:
            classes = tuple(dict.fromkeys((*known.classes, *seen.classes)))
            self.vocabulary = known = Vocabulary(classes, known.predicates)
            self.nodes.widen(len(classes))
        index_of = {name: index for index, name in enumerate(known.classes)}
        columns = np.array([index_of[name] for name in seen.classes], np.int64)
        same = seen.classes == known.classes
        self._translated = (seen, known, None if same else columns)
        return self._translated[2]

    def add_relations(self, local: LocalGraph, node_ids: Sequence[int]) -> None:
        """Add the visual relation logits of a frame to the edges of its nodes (Eq. 9).

        Args:
            local: the frame.
            node_ids: the live node of each row of the frame; 0 = none.
        """
        # Summed by pair first: a frame counts once even if two of its rows are one node.
        sums: dict[Pair, Float64] = {}
        relations = local.relations
        for (subject, object_), logits in zip(relations.pairs.tolist(), relations.logits):
            pair = (node_ids[subject], node_ids[object_])
            sums[pair] = sums[pair] + logits if pair in sums else logits
        live = [pair for pair in sums if 0 not in pair and pair[0] != pair[1]]
        if live:
            slots = [[self.nodes.slot_of[node_id] for node_id in pair] for pair in live]
            logits = np.array([sums[pair] for pair in live])
            self.pairs.add_visual(np.array(slots, np.int64), logits, local.stamp_ns)

    def add_votes(self, a_id: int, b_id: int, counts: Float64 | None) -> None:
        """Count a frame that showed two live nodes; votes (2, R) or None, first row: a to b."""
        pair = self.nodes.slots_of([a_id, b_id])[None]
        votes = np.zeros((0, self.pairs.predicate_count)) if counts is None else counts
        self.pairs.add_frame(pair, np.concatenate([pair, pair[:, ::-1]])[: len(votes)], votes)

    def add_visual(self, subject_id: int, object_id: int, logits: Float64, stamp_ns: int) -> bool:
        """Sum a frame's visual logits (R,) into an edge (Eq. 9); False if it has no two nodes."""
        pair = [self.resolve(subject_id), self.resolve(object_id)]
        if 0 in pair or pair[0] == pair[1]:
            return False
        self.pairs.add_visual(self.nodes.slots_of(pair)[None], logits[None], stamp_ns)
        return True

    def add_neighbours(self, pairs: Iterable[Pair], stamp_ns: int) -> None:
        """Count a frame in which pairs of nodes (0 = removed) were geometric neighbours (Eq. 8).

        Pairs without two different nodes are left out.
        """
        slot_of = self.nodes.slot_of
        live = [(slot_of[a], slot_of[b]) for a, b in pairs if a and b and a != b]
        if live:
            self.pairs.add_neighbours(np.array(live, np.int64), stamp_ns)

    def _remove(self, node_id: int, successor: int) -> None:
        for watcher in self._watchers:
            watcher[node_id] = self.nodes.slot(node_id)
        self.nodes.remove(node_id)
        if self.embeddings.views:
            self.embeddings.remove(node_id)
        self._ids.retire(node_id, successor)
        if self.edits:
            self._drop(self.edits.removed(node_id, successor))

    def _drop(self, successors: Mapping[int, int]) -> None:
        for node_id, successor in successors.items():
            self.pairs.drop(self.nodes.slot(node_id))
            self._remove(node_id, successor)


# --- Copies of nodes, for edits that an operator may undo.


def copy_node(
    graph: GlobalGraph,
    node_id: int,
    without: Collection[int] = (),
    part: Bool | None = None,
) -> int:
    """Add a copy of a live node, with its edges and votes; returns its id.

    Args:
        graph: changed.
        node_id: of the node.
        without: nodes to which the copy has no edges.
        part: (k,) which of the node's surface points the copy gets, with the Gaussian of these
            points; None = everything.
    """
    nodes, slot = graph.nodes, graph.nodes.slot(node_id)
    mean, covariance = nodes.means[slot].copy(), nodes.covariances[slot].copy()
    surface, weight = nodes.surface(slot).copy(), float(nodes.weights[slot])
    keyframes = nodes.keyframes(slot).copy()
    if part is not None:
        surface, keyframes = surface[part], keyframes[part]
        mean, covariance = even_moments(surface)
        weight = weight * len(surface) / len(part)
    classes, first_ns = nodes.class_probabilities[slot].copy(), int(nodes.first_seen_ns[slot])
    confirmed = bool(nodes.confirmed[slot])
    new_id = graph.add_node(mean, covariance, classes, first_ns, surface, weight, confirmed)
    new = nodes.slot(new_id)
    nodes.set_surface(new, surface, keyframes)
    for name in ("class_probabilities", "observations", "existence", "last_seen_ns", "colours"):
        getattr(nodes, name)[new] = getattr(nodes, name)[slot]
    graph.copy_relations(node_id, new_id, without)
    graph.embeddings.copy(node_id, new_id)
    return new_id
