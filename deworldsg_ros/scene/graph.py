"""The global 3D scene graph: Gaussian nodes, sparse directed edges, stable ids."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.scene.edge_map import EdgeMap
from deworldsg_ros.scene.edges import EdgeArrays, EdgeEvidence, Pair
from deworldsg_ros.scene.edits import Edit, EditLog
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.node_ids import IdState, NodeIds
from deworldsg_ros.scene.node_store import NodeStore
from deworldsg_ros.scene.nodes import SAVED_COLUMNS
from deworldsg_ros.scene.votes import PairVotes, VoteMap, VotesByPair


@dataclass(frozen=True)
class GraphState:
    """Everything from which an equal graph can be made.

    Attributes:
        vocabulary, frame_id: of the graph, and
        surface_point_capacity, remembered_frames, even_gaussians: its settings; see `SceneGraph`.
        revision: number of changes so far.
        nodes: arrays of n rows, by their names in `NodeTable`.
        surface_points: (m, 3) float32, metres, those of one node after those of another.
        surface_counts: (n,) int64, number of points of each node.
        edges: evidence of the directed pairs of ids.
        votes: votes of frames on each unordered pair of ids.
        ids: the id memory.
        edits: of an operator, oldest first.
    """

    vocabulary: Vocabulary
    frame_id: str
    nodes: Mapping[str, NDArray[Any]]
    surface_points: Float32
    surface_counts: Int64
    edges: EdgeArrays
    votes: Mapping[Pair, PairVotes]
    ids: IdState
    revision: int
    surface_point_capacity: int
    remembered_frames: int
    even_gaussians: bool
    edits: Sequence[Edit] = ()


class SceneGraph(NodeStore):
    """The state of the map: nodes (see `NodeStore`) and directed edges between them.

    Stages change it only through its methods. When two nodes merge, the older id stays.

    Attributes:
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
        super().__init__(vocabulary, frame_id, surface_point_capacity, remembered_frames)
        self.even_gaussians = even_gaussians
        self._edges = EdgeMap(len(vocabulary.predicates))
        self._votes = VoteMap(len(vocabulary.predicates))

    @classmethod
    def from_state(cls, state: GraphState) -> SceneGraph:
        """The graph of a state; ValueError or KeyError if its parts do not fit together."""
        graph = cls(
            state.vocabulary,
            state.frame_id,
            state.surface_point_capacity,
            state.remembered_frames,
            state.even_gaussians,
        )
        graph.nodes.restore(state.nodes, state.surface_points, state.surface_counts)
        graph._edges.restore(state.edges)
        graph._votes.restore(state.votes)
        graph._ids = NodeIds(graph.nodes, state.remembered_frames, state.ids)
        graph.edits = EditLog(state.edits)
        graph.revision = state.revision
        return graph

    def state(self) -> GraphState:
        """A copy of everything from which `from_state` makes an equal graph."""
        nodes = self.nodes
        return GraphState(
            vocabulary=self.vocabulary,
            frame_id=self.frame_id,
            nodes={name: getattr(nodes, name).copy() for name in SAVED_COLUMNS},
            surface_points=nodes.surface_points(),
            surface_counts=nodes.surface_counts.copy(),
            edges=self._edges.arrays(),
            votes=dict(self.votes),
            ids=self._ids.state(),
            revision=self.revision,
            surface_point_capacity=self.surface_point_capacity,
            remembered_frames=self.remembered_frames,
            even_gaussians=self.even_gaussians,
            edits=list(self.edits.edits),
        )

    def copy_relations(self, node_id: int, new_id: int, without: Collection[int]) -> None:
        """Give a node the edges and votes of another one, except those with some nodes."""
        self._edges.copy(node_id, new_id, without, self.revision)
        self._votes.copy(node_id, new_id, without, self.revision)

    def add_edit(self, edit: Edit) -> Edit:
        """Note an operator's edit, with a new number; the nodes that it replaces are hidden."""
        edit, lost = self.edits.add(edit)
        rows = [self.nodes.row(node_id) for node_id in (*edit.nodes, *edit.replaced)]
        self.nodes.confirmed[rows] &= [not self.edits.hides(i) for i in self.nodes.ids[rows]]
        self._changed(rows)
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
        row = self.nodes.row(kept_id)
        self.nodes.merge(row, self.nodes.row(removed_id))
        self._changed([row])
        self._edges.repoint(removed_id, kept_id, self.revision)
        self._votes.repoint(removed_id, kept_id, self.revision)
        self._remove(removed_id, kept_id)
        return kept_id

    def take_over(self, old_id: int, new_id: int) -> None:
        """Give a newer node an older node's id: the object was moved and detected again.

        Gaussian, surface and edges are the newer node's. Class distributions average with the
        numbers of observations.
        """
        row = self.nodes.row(old_id)
        self.nodes.take_over(row, self.nodes.row(new_id))
        self._changed([row])
        self._edges.drop(old_id)
        self._votes.drop(old_id)
        self._edges.repoint(new_id, old_id, self.revision)
        self._votes.repoint(new_id, old_id, self.revision)
        self._remove(new_id, old_id)

    def remove_node(self, node_id: int) -> None:
        """Remove a live node and its edges."""
        self.nodes.row(node_id)
        self.revision += 1
        self._edges.drop(node_id)
        self._votes.drop(node_id)
        self._remove(node_id, 0)

    @property
    def edges(self) -> Mapping[Pair, EdgeEvidence]:
        """Evidence of each directed pair (subject id, object id); read only."""
        return self._edges.evidence

    @property
    def votes(self) -> VotesByPair:
        """Votes on each unordered pair (smaller id, larger id) seen together; read only."""
        return self._votes.pairs

    def take_changed_votes(self) -> set[int]:
        """Keys of the pairs whose votes changed since the last call; some may be removed."""
        return self._votes.take_changed()

    def seen_together(self, node_id: int) -> set[int]:
        """Ids of the nodes that frames showed together with a node."""
        return self._votes.partners(node_id)

    def add_votes(self, a_id: int, b_id: int, counts: Float64 | None) -> None:
        """Count a frame that showed two live nodes; votes (2, R) or None, first row: a to b."""
        self.revision += 1
        self._votes.add((a_id, b_id), 1, counts, self.revision)

    def add_frame_votes(self, seen: Int64, voted: Int64, votes: Float64) -> None:
        """Count a frame that showed pairs of live nodes; see `VoteMap.add_frame`."""
        self._votes.add_frame(seen, voted, votes, self.revision + 1)
        self.revision += len(seen)

    def add_visual(self, subject_id: int, object_id: int, logits: Float64, stamp_ns: int) -> bool:
        """Sum a frame's visual logits (R,) into an edge (Eq. 9); False if it has no two nodes."""
        pair = (self.resolve(subject_id), self.resolve(object_id))
        if 0 in pair or pair[0] == pair[1]:
            return False
        self.add_frame_visual({pair: logits}, stamp_ns)
        return True

    def add_frame_visual(self, logits: Mapping[Pair, Float64], stamp_ns: int) -> None:
        """As `add_visual`, by pairs of different live nodes."""
        self._edges.add_visual(logits, stamp_ns, self.revision)
        self.revision += len(logits)

    def add_neighbours(self, pairs: Iterable[Pair], stamp_ns: int) -> None:
        """Count a frame in which pairs of nodes (0 = removed) were geometric neighbours (Eq. 8).

        Pairs without two different nodes are left out.
        """
        live = [pair for pair in pairs if pair[0] and pair[1] and pair[0] != pair[1]]
        self._edges.add_neighbours(live, stamp_ns, self.revision)
        self.revision += len(live)

    def partners(self, node_id: int) -> Collection[int]:
        """Ids of the nodes that share an edge with a node; do not change it."""
        return self._edges.partners(node_id)

    def take_changed_edges(self) -> set[Pair]:
        """Pairs whose evidence changed since the last call; some may have been removed."""
        return self._edges.take_changed()

    def _remove(self, node_id: int, successor: int) -> None:
        self.nodes.remove(node_id)
        for watcher in self._watchers:
            watcher.add(node_id)
        self._ids.retire(node_id, successor)
        if self.edits:
            self._drop(self.edits.removed(node_id, successor))

    def _drop(self, successors: Mapping[int, int]) -> None:
        for node_id, successor in successors.items():
            self._edges.drop(node_id)
            self._votes.drop(node_id)
            self._remove(node_id, successor)
