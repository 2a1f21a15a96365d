"""The paper's rule: an object matches the nearest node that passes Eq. 5-6, or creates a node."""

from __future__ import annotations

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging.common import Memory, add_relations, check_fits, warm_up_graph
from deworldsg_ros.merging.edited_frames import may_merge
from deworldsg_ros.merging.editing import Editor, EditReply
from deworldsg_ros.merging.life_cycle import DELETED
from deworldsg_ros.merging.nearest import (
    Observed,
    bhattacharyya_bound,
    nearest_row,
    observed,
    warm_up,
)
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.edits import EditRequest
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.graph import SceneGraph


class PaperMerging:
    """Merges local graphs into a scene graph by the rule of Eq. 5-7."""

    def __init__(self, config: MergingConfig) -> None:
        self.configure(config)

    def configure(self, config: MergingConfig) -> None:
        """Use other thresholds from the next frame on."""
        self._bound = bhattacharyya_bound(config.hellinger_threshold)
        self._class_threshold = config.class_distance_threshold

    def warm_up(self) -> None:
        """Compile the kernels before the first frame."""
        warm_up()
        warm_up_graph()

    def merge(self, graph: SceneGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph; see `Merging.merge`.

        Objects are processed in row order. An object may match a node that an earlier row of the
        same frame created. Relations are added when all objects have a node.
        """
        check_fits(graph, local)
        assigned = [self._assign(graph, local, row) for row in range(len(local))]
        node_ids = [graph.resolve(node_id) for node_id in assigned]
        graph.remember_frame(local.stamp_ns, node_ids)
        add_relations(graph, local, node_ids)
        return node_ids

    def hidden(self, graph: SceneGraph) -> dict[int, str]:
        """The deleted nodes; all others are published."""
        return dict.fromkeys(sorted(graph.edits.deleted), DELETED)

    def edit(self, graph: SceneGraph, request: EditRequest, stamp_ns: int) -> EditReply:
        """See `Merging.edit`."""
        return Editor().apply(graph, request, stamp_ns)

    def memory(self) -> Memory:
        """Empty: the rule has no state besides the graph."""
        return {}

    def restore(self, graph: SceneGraph, memory: Memory) -> None:
        """Does nothing: the rule has no state besides the graph."""

    def moved(self, graph: SceneGraph, node_ids: list[int], T_correction: Float64) -> None:
        """Does nothing: the rule has no state besides the graph."""

    def _assign(self, graph: SceneGraph, local: LocalGraph, row: int) -> int:
        """Fuse an object into its node, or create a node; returns the node's id."""
        observation = (
            local.means_world[row],
            local.covariances_world[row],
            local.class_probabilities[row],
        )
        seen = (local.stamp_ns, local.surface_points_world[row])
        match = self._nearest(graph, observed(*observation))
        if match is None:
            return graph.add_node(*observation, *seen)
        graph.observe(match, *observation, *seen)
        return self._merge_repeatedly(graph, match)

    def _merge_repeatedly(self, graph: SceneGraph, node_id: int) -> int:
        """Merge a changed node with its nearest match until no node matches (Eq. 6)."""
        nodes = graph.nodes
        while True:
            row = nodes.row(node_id)
            node = Observed(
                nodes.means[row],
                nodes.covariances[row],
                float(nodes.log_determinants[row]),
                float(nodes.eigenvalue_bounds[row]),
                nodes.class_probabilities[row],
            )
            other_id = self._nearest(graph, node, skipped_row=row)
            if other_id is None or (graph.edits and not may_merge(graph, node_id, other_id)):
                return node_id
            node_id = graph.merge_nodes(node_id, other_id)

    def _nearest(self, graph: SceneGraph, item: Observed, skipped_row: int = -1) -> int | None:
        """Id of the nearest node that passes Eq. 6; None if there is none."""
        row = nearest_row(item, graph.nodes, self._bound, self._class_threshold, skipped_row)
        return None if row < 0 else int(graph.nodes.ids[row])
