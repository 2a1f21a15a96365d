"""Steps that both association rules share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph.messages import NodeStates
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, Vocabulary

# State of a rule besides the graph, as arrays by name.
Memory = dict[str, NDArray[Any]]


def warm_up_graph() -> None:
    """Compile the kernels of the scene graph, or load them from the cache."""
    graph = SceneGraph(Vocabulary(("class",), ("predicate",)), "world")
    observation = (np.zeros(3), np.eye(3), np.ones(1), 1, np.zeros((1, 3), np.float32))
    graph.observe(graph.add_node(*observation), *observation)
    NodeStates(graph, 1, graph.even_gaussians).refresh()


def check_fits(graph: SceneGraph, local: LocalGraph) -> None:
    """Raise RefusedInput: ``vocabulary_mismatch`` or ``wrong_frame`` if a local graph differs."""
    # Identity first: to compare all names takes long.
    if local.vocabulary is not graph.vocabulary and local.vocabulary != graph.vocabulary:
        raise RefusedInput(
            "vocabulary_mismatch",
            f"local graph has {len(local.vocabulary.classes)} classes and "
            f"{len(local.vocabulary.predicates)} predicates that are not the scene graph's "
            f"{len(graph.vocabulary.classes)} and {len(graph.vocabulary.predicates)}",
        )
    if local.frame_id != graph.frame_id:
        raise RefusedInput(
            "wrong_frame",
            f"local graph is in frame {local.frame_id!r}: expected {graph.frame_id!r}",
        )


def add_relations(graph: SceneGraph, local: LocalGraph, node_ids: list[int]) -> None:
    """Add the visual relation logits of a frame to the edges of its nodes (Eq. 9).

    Args:
        graph: changed.
        local: the frame.
        node_ids: the live node of each row of the frame; 0 = none.
    """
    # Summed by pair first: a frame counts once even if two of its rows are one node.
    sums: dict[tuple[int, int], Float64] = {}
    for (subject, object_), logits in zip(local.relations.pairs.tolist(), local.relations.logits):
        pair = (node_ids[subject], node_ids[object_])
        sums[pair] = sums[pair] + logits if pair in sums else logits
    live = [pair for pair in sums if 0 not in pair and pair[0] != pair[1]]
    if live:
        slots = [[graph.nodes.slot_of[node_id] for node_id in pair] for pair in live]
        logits = np.array([sums[pair] for pair in live])
        graph.pairs.add_visual(np.array(slots, np.int64), logits, local.stamp_ns)
