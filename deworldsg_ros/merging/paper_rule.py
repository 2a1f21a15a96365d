"""The paper's rule: each object of a local graph joins the global node it is, or founds one."""

from __future__ import annotations

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging.gates import bhattacharyya_bound
from deworldsg_ros.merging.kernel import nearest_row, warm_up
from deworldsg_ros.merging.local import Memory, add_relations, check_fits, warm_up_graph
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.gaussian import eigenvalue_bound, log_determinant
from deworldsg_ros.scene.graph import SceneGraph


class PaperMerging:
    """Merges local graphs into a scene graph by the rule of Eq. 5-7."""

    def __init__(self, config: MergingConfig) -> None:
        self._bound = bhattacharyya_bound(config.hellinger_threshold)
        self._class_threshold = config.class_distance_threshold

    def warm_up(self) -> None:
        """Compile now what would else be compiled during the first frame."""
        warm_up()
        warm_up_graph()

    def merge(self, graph: SceneGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph; see `Merging.merge`.

        Objects are taken in row order, and meet the nodes that earlier rows founded. Relations
        follow when all objects have found their nodes.
        """
        check_fits(graph, local)
        placed = [
            self._place(
                graph,
                local.means_world[row],
                local.covariances_world[row],
                local.class_probabilities[row],
                local.stamp_ns,
                local.surface_points_world[row],
            )
            for row in range(len(local))
        ]
        node_ids = [graph.resolve(node_id) for node_id in placed]
        graph.remember_frame(local.stamp_ns, node_ids)
        add_relations(graph, local, node_ids)
        return node_ids

    def memory(self) -> Memory:
        """Nothing: the graph is all that the rule knows."""
        return {}

    def restore(self, graph: SceneGraph, memory: Memory) -> None:
        """Nothing is needed."""

    def moved(self, graph: SceneGraph, node_ids: list[int], T_correction: Float64) -> None:
        """Nothing is needed."""

    def _place(
        self,
        graph: SceneGraph,
        mean_world: Float64,
        covariance_world: Float64,
        class_probabilities: Float64,
        stamp_ns: int,
        surface_points_world: Float32,
    ) -> int:
        nodes = graph.nodes
        row = nearest_row(
            mean_world,
            covariance_world,
            log_determinant(covariance_world),
            eigenvalue_bound(covariance_world),
            class_probabilities,
            nodes,
            self._bound,
            self._class_threshold,
        )
        if row < 0:
            return graph.add_node(
                mean_world, covariance_world, class_probabilities, stamp_ns, surface_points_world
            )
        node_id = int(nodes.ids[row])
        graph.observe(
            node_id,
            mean_world,
            covariance_world,
            class_probabilities,
            stamp_ns,
            surface_points_world,
        )
        return self._merge_on(graph, node_id)

    def _merge_on(self, graph: SceneGraph, node_id: int) -> int:
        """Merge a node that has changed with what it has come near, until nothing passes."""
        nodes = graph.nodes
        while True:
            row = nodes.row(node_id)
            other = nearest_row(
                nodes.means[row],
                nodes.covariances[row],
                float(nodes.log_determinants[row]),
                float(nodes.eigenvalue_bounds[row]),
                nodes.class_probabilities[row],
                nodes,
                self._bound,
                self._class_threshold,
                skipped_row=row,
            )
            if other < 0:
                return node_id
            node_id = graph.merge_nodes(node_id, int(nodes.ids[other]))
