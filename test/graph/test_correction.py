"""Corrections of poses: the part of the graph that was built on them moves along, and no other."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from support.merging import VOCABULARY, local_graph, random_local_graphs, random_pose, seeds

from deworldsg_ros.config import Config, MergingConfig, OutputConfig
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph.graph import nodes_since
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.wire.messages import NodeState

S = 10**9

# Surface points, and what is published of them, are rounded to float32: a neighbour may be lost.
# Messages have four decimals.
TOLERANCE_M = {"paper": 2e-4, "surface": 1e-3}


def builder_of(association: str) -> GraphBuilder:
    config = Config(
        merging=MergingConfig(association=association), output=OutputConfig(min_existence=0.0)
    )
    return GraphBuilder(config, VOCABULARY, "world")


def states(builder: GraphBuilder) -> dict[int, NodeState]:
    return {node.id: node for node in builder.full().nodes}


def in_any_order(points: list[list[float]]) -> np.ndarray:
    """Points in an order that does not depend on how they were stored."""
    array = np.array(points, np.float64).reshape(-1, 3)
    return array[np.lexsort(array.round(3).T)]


@pytest.mark.parametrize("association", ["paper", "surface"])
@settings(max_examples=15)
@given(seed=seeds)
def test_newer_nodes_move_rigidly_and_the_inverse_restores_them(
    association: str, seed: int
) -> None:
    rng, atol = np.random.default_rng(seed), TOLERANCE_M[association]
    builder = builder_of(association)
    for local in random_local_graphs(rng, 12):
        builder.integrate(local)
    before, evidence = states(builder), pickle.dumps(builder.graph.state().pairs)
    nodes = builder.graph.nodes
    first_ns = {node_id: nodes.first_seen_ns[slot] for node_id, slot in nodes.slot_of.items()}
    T, since_ns = random_pose(rng), int(rng.integers(0, 14))
    moved = builder.apply_correction(T, since_ns)
    assert moved == nodes_since(builder.graph, since_ns)
    for node_id, node in states(builder).items():
        known = before[node_id]
        assert (node_id in moved) == (first_ns[node_id] >= since_ns)
        if node_id not in moved:
            assert node == known
            continue
        sigma = T[:3, :3] @ np.reshape(known.covariance_m2, (3, 3)) @ T[:3, :3].T
        np.testing.assert_allclose(node.mean_m, T[:3, :3] @ known.mean_m + T[:3, 3], atol=atol)
        np.testing.assert_allclose(np.reshape(node.covariance_m2, (3, 3)), sigma, atol=atol)
        assert len(surface_points(node)) == len(surface_points(known))
    # Only beliefs follow the geometry.
    assert pickle.dumps(builder.graph.state().pairs) == evidence
    assert builder.apply_correction(invert_pose(T), since_ns) == moved
    after = states(builder)
    assert list(after) == list(before)
    for node_id, node in before.items():
        restored = after[node_id]
        np.testing.assert_allclose(restored.mean_m, node.mean_m, atol=atol)
        np.testing.assert_allclose(restored.covariance_m2, node.covariance_m2, atol=atol)
        points = (in_any_order(surface_points(one)) for one in (restored, node))
        np.testing.assert_allclose(*points, atol=2e-3)
        assert (restored.label, restored.observations) == (node.label, node.observations)


def slab_at(stamp_ns: int, x_m: float, T: np.ndarray | None = None) -> LocalGraph:
    """A frame that sees one object, a slab of points around (x, 0, 1), moved by T."""
    T = np.eye(4) if T is None else T
    rng = np.random.default_rng(1)
    points = rng.uniform([x_m - 0.3, -0.2, 0.95], [x_m + 0.3, 0.2, 1.05], (200, 3))
    points = points @ T[:3, :3].T + T[:3, 3]
    mean, covariance = points.mean(axis=0)[None], np.cov(points.T)[None]
    classes, surface = np.array([[0.9, 0.05, 0.03, 0.02]]), (points.astype(np.float32),)
    return local_graph(stamp_ns, mean, covariance, classes, points=surface)


def shift(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


@pytest.mark.parametrize("association", ["paper", "surface"])
def test_after_the_correction_the_object_is_matched_at_its_new_position(association: str) -> None:
    builder, T = builder_of(association), shift(2.0)
    builder.integrate(slab_at(1 * S, 0.0))
    T[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    builder.apply_correction(T, 1 * S)
    assert builder.integrate(slab_at(2 * S, 0.0, T)) == [1]
    assert builder.integrate(slab_at(3 * S, 0.0)) == [2]


def test_the_update_contains_only_the_moved_nodes_and_no_scale_is_applied() -> None:
    builder = builder_of("surface")
    builder.integrate(slab_at(1 * S, 0.0))
    builder.integrate(slab_at(2 * S, 3.0))
    builder.update()
    builder.apply_correction(shift(0.25), 2 * S)
    update = builder.update()
    assert update is not None and [node.id for node in update.nodes] == [2]
    assert builder.apply_correction(shift(0.25), 3 * S) == []
    for T in (np.diag([1.0, 1.0, -1.0, 1.0]), 2 * np.eye(4), np.full((4, 4), np.nan)):
        with pytest.raises(RefusedInput) as refused:
            builder.apply_correction(T, 0)
        assert refused.value.reason == "invalid_pose"
    assert builder.update() is None


def test_the_node_applies_corrections_and_refuses_invalid_ones() -> None:
    pytest.importorskip("rclpy")
    from geometry_msgs.msg import PoseStamped
    from std_msgs.msg import String
    from support.nodes_bench import Bench, pose, works
    from support.nodes_bench import local_graph as message_of

    from deworldsg_ros.nodes.graph_node import GraphNode

    topics = {"deworldsg/local_graph": String, "deworldsg/pose_correction": PoseStamped}
    with Bench(GraphNode, topics) as at:

        def correct(*args: object) -> None:
            at.send(deworldsg__pose_correction=pose(at.stamp_ns, *args))

        def see() -> None:
            at.send(deworldsg__local_graph=message_of(at.next_stamp()))

        at.refuses("no_graph", lambda: correct(0.5))
        works(at, see)
        at.refuses("wrong_frame", lambda: correct(0.5, "odom"))
        at.refuses("invalid_pose", lambda: correct(float("nan")))
        correct(0.5)
        at.expect(lambda: at.node.more_values().get("pose corrections") == "1", "the correction")
        assert at.node.more_values()["nodes moved by corrections"] == "1"
        works(at, see)
