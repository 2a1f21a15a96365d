"""What the physical model says of the geometry of pairs."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.relations.pair_geometry import (
    FEATURES,
    SHAPE_POINTS,
    centre_steps,
    pair_features,
    upright,
)
from deworldsg_ros.relations.pair_links import joined
from deworldsg_ros.relations.pair_rows import PairRows
from deworldsg_ros.relations.physics_model import PairInputs, PhysicsModel
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.graph import SceneGraph

_GAP, _BOTTOM_STEP = FEATURES.index("gap_m"), FEATURES.index("bottom_over_bottom_m")

# Pairs in arrays at once, so that a whole map needs no large ones.
AT_ONCE = 1024


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
        for start in range(0, len(rows), AT_ONCE):
            self._judge(table, rows[start : start + AT_ONCE], R_up_world, floor_m)

    def _judge(self, table: PairRows, rows: Int64, R_up_world: Float64, floor_m: float) -> None:
        shapes, nodes = table.shapes, self._graph.nodes
        ends = table.ends[rows]
        used = joined(ends, [])
        first, second = np.searchsorted(used, ends.T)
        low, high = shapes.low[used], shapes.high[used]
        node_rows = nodes.rows_at(shapes.ids[used].tolist())
        features = pair_features(
            first,
            second,
            low,
            high,
            shapes.means[used],
            shapes.covariances[used],
            shapes.counts[used],
            upright(nodes.surface_points_world[node_rows, :SHAPE_POINTS], R_up_world),
            floor_m,
        )
        edits, names = self._graph.edits, self._graph.vocabulary
        known = edits.believed_classes(nodes, names, node_rows), nodes.observations[node_rows]
        both = np.concatenate((first, second)), np.concatenate((second, first))
        inputs = self._inputs.make(features.reshape(2 * len(rows), -1), *known, *both)
        table.state_logits[rows] = self._model.states_of(inputs)
        table.judged[rows] = True
        table.gaps_m[rows] = features[0, :, _GAP]
        table.bottom_steps_m[rows] = features[0, :, _BOTTOM_STEP]
        table.centre_steps_m[rows] = centre_steps(first, second, low, high)
