"""What the physical model says of the geometry of pairs."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.relations.pair_geometry import FEATURES, SHAPE_POINTS, pair_features, upright
from deworldsg_ros.relations.pair_rows import PairRows
from deworldsg_ros.relations.physics_model import PairInputs, PhysicsModel
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.graph import SceneGraph

_GAP, _BOTTOM_STEP = FEATURES.index("gap_m"), FEATURES.index("bottom_over_bottom_m")


class GeometryJudge:
    """Judges pairs of nodes by their surfaces.

    Args:
        graph: of the nodes.
        model: the physical model.
    """

    def __init__(self, graph: SceneGraph, model: PhysicsModel) -> None:
        self._graph = graph
        self._model = model
        self._inputs = PairInputs(graph.vocabulary.classes)

    def __call__(self, table: PairRows, rows: Int64, R_up_world: Float64, floor_m: float) -> None:
        """Judge pairs in reach, and write what follows to their columns.

        Args:
            table: of the pairs.
            rows: (k,) of the pairs.
            R_up_world: (3, 3) rotation from the world frame to the upright frame.
            floor_m: height of the floor in the upright frame.
        """
        if not len(rows):
            return
        used, places = np.unique(table.ends[rows], return_inverse=True)
        first, second = np.ascontiguousarray(places.reshape(-1, 2).T)
        shapes, nodes = table.shapes, self._graph.nodes
        low, high = shapes.low[used], shapes.high[used]
        node_rows = [nodes.row(node_id) for node_id in shapes.ids[used].tolist()]
        points = nodes.surface_points_world[node_rows, :SHAPE_POINTS]
        there, back = pair_features(
            first,
            second,
            low,
            high,
            shapes.means[used],
            shapes.covariances[used],
            shapes.counts[used],
            upright(points, R_up_world),
            floor_m,
        )
        edits, names = self._graph.edits, self._graph.vocabulary
        classes = edits.believed_classes(nodes, names, node_rows)
        known = (classes, nodes.observations[node_rows])
        table.state_logits[rows] = self._model.state_logits(
            self._inputs.make(there, *known, first, second),
            self._inputs.make(back, *known, second, first),
        )
        table.judged[rows] = True
        table.gaps_m[rows] = there[:, _GAP]
        table.bottom_steps_m[rows] = there[:, _BOTTOM_STEP]
        centres = (low[:, :2] + high[:, :2]) / 2.0
        table.centre_steps_m[rows] = np.linalg.norm(centres[first] - centres[second], axis=1)
