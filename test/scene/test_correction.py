"""Corrections of poses: the part of the graph that was built on them moves along, and no other."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from support.merging import local_graph, random_local_graphs, random_pose, seeds

from deworldsg_ros.config import Config, MergingConfig, OutputConfig
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph.graph import nodes_since
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire.messages import NodeState, SceneGraphMessage

S = 10**9

# Surface points, and what is published of them, are rounded to float32: a neighbour may be lost.
# Messages have four decimals.
TOLERANCE_M = {"paper": 2e-4, "surface": 1e-3}


def config(association: str) -> Config:
    return Config(
        merging=MergingConfig(association=association),
        output=OutputConfig(min_existence=0.0),
    )


def built(rng: np.random.Generator, association: str, frames: int = 12) -> GraphBuilder:
    graphs = random_local_graphs(rng, frames)
    builder = GraphBuilder(config(association), graphs[0].vocabulary, graphs[0].frame_id)
    for graph in graphs:
        builder.integrate(graph)
    builder.update()
    return builder


def states(message: SceneGraphMessage) -> dict[int, NodeState]:
    return {node.id: node for node in message.nodes}


def by_hash(points: list[list[float]]) -> np.ndarray:
    """Points in an order that does not depend on how they were stored."""
    array = np.array(points, np.float64).reshape(-1, 3)
    return array[np.lexsort(array.round(3).T)]


@pytest.mark.parametrize("association", ["paper", "surface"])
@settings(max_examples=15)
@given(seed=seeds)
def test_a_correction_and_its_inverse_restore_the_graph(association: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    builder = built(rng, association)
    before = states(builder.full())
    T, since_ns = random_pose(rng), int(rng.integers(0, 14))
    moved = builder.apply_correction(T, since_ns)
    assert moved == nodes_since(builder.graph, since_ns)
    assert builder.apply_correction(invert_pose(T), since_ns) == moved
    after = states(builder.full())
    assert list(after) == list(before)
    for node_id, node in before.items():
        restored = after[node_id]
        np.testing.assert_allclose(restored.mean_m, node.mean_m, atol=TOLERANCE_M[association])
        np.testing.assert_allclose(
            restored.covariance_m2, node.covariance_m2, atol=TOLERANCE_M[association]
        )
        np.testing.assert_allclose(
            by_hash(surface_points(restored)), by_hash(surface_points(node)), atol=2e-3
        )
        assert (restored.label, restored.observations) == (node.label, node.observations)


@pytest.mark.parametrize("association", ["paper", "surface"])
@settings(max_examples=15)
@given(seed=seeds)
def test_older_nodes_stay_and_newer_ones_move_rigidly(association: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    builder = built(rng, association)
    nodes = builder.graph.nodes
    first = {node_id: nodes.first_seen_ns[slot] for node_id, slot in nodes.slot_of.items()}
    before, evidence = states(builder.full()), pickle.dumps(builder.graph.state().pairs)
    T, since_ns = random_pose(rng), int(rng.integers(0, 14))
    moved = set(builder.apply_correction(T, since_ns))
    for node_id, node in states(builder.full()).items():
        known = before[node_id]
        assert (node_id in moved) == (first[node_id] >= since_ns)
        if node_id not in moved:
            assert node == known
            continue
        np.testing.assert_allclose(
            node.mean_m, T[:3, :3] @ known.mean_m + T[:3, 3], atol=TOLERANCE_M[association]
        )
        sigma = np.reshape(known.covariance_m2, (3, 3))
        expected = T[:3, :3] @ sigma @ T[:3, :3].T
        np.testing.assert_allclose(
            np.reshape(node.covariance_m2, (3, 3)), expected, atol=TOLERANCE_M[association]
        )
        assert len(surface_points(node)) == len(surface_points(known))
    # Only beliefs follow the geometry.
    assert pickle.dumps(builder.graph.state().pairs) == evidence


def test_a_node_seen_before_and_after_stays() -> None:
    builder = GraphBuilder(config("paper"), *_world())
    for stamp_ns in (1 * S, 5 * S):
        builder.integrate(_box(stamp_ns, 0.0))
    builder.integrate(_box(6 * S, 3.0))
    T = np.eye(4)
    T[0, 3] = 0.5
    assert builder.apply_correction(T, 4 * S) == [2]
    means = {node.id: node.mean_m[0] for node in builder.full().nodes}
    assert means[1] == pytest.approx(0.0, abs=0.05)
    assert means[2] == pytest.approx(means[1] + 3.5)


@pytest.mark.parametrize("association", ["paper", "surface"])
def test_after_the_correction_the_object_is_matched_at_its_new_position(association: str) -> None:
    builder = GraphBuilder(config(association), *_world())
    builder.integrate(_box(1 * S, 0.0))
    T = np.eye(4)
    T[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    T[0, 3] = 2.0
    builder.apply_correction(T, 1 * S)
    assert builder.integrate(_box(2 * S, 0.0, T)) == [1]
    assert builder.integrate(_box(3 * S, 0.0)) == [2]


def test_the_update_contains_only_the_moved_nodes() -> None:
    builder = GraphBuilder(config("surface"), *_world())
    builder.integrate(_box(1 * S, 0.0))
    builder.integrate(_box(2 * S, 3.0))
    builder.update()
    T = np.eye(4)
    T[2, 3] = 0.25
    builder.apply_correction(T, 2 * S)
    update = builder.update()
    assert update is not None
    assert [node.id for node in update.nodes] == [2]
    assert builder.apply_correction(T, 3 * S) == []
    assert builder.update() is None


def test_a_transform_that_is_not_rigid_is_refused_and_changes_nothing() -> None:
    builder = GraphBuilder(config("surface"), *_world())
    builder.integrate(_box(1 * S, 0.0))
    before = builder.full()
    for T in (np.diag([1.0, 1.0, -1.0, 1.0]), 2 * np.eye(4), np.full((4, 4), np.nan)):
        with pytest.raises(RefusedInput, match="pose") as refused:
            builder.apply_correction(T, 0)
        assert refused.value.reason == "invalid_pose"
    assert builder.full() == before


def _world() -> tuple[object, str]:
    graph = _box(0, 0.0)
    return graph.vocabulary, graph.frame_id


def _box(stamp_ns: int, x_m: float, T: np.ndarray | None = None):  # type: ignore[no-untyped-def]
    """A frame that sees one object, a slab of points around (x, 0, 1), moved by T."""
    rng = np.random.default_rng(1)
    T = np.eye(4) if T is None else T
    points = rng.uniform([x_m - 0.3, -0.2, 0.95], [x_m + 0.3, 0.2, 1.05], (200, 3))
    points = points @ T[:3, :3].T + T[:3, 3]
    return local_graph(
        stamp_ns,
        points.mean(axis=0)[None],
        np.cov(points.T)[None],
        np.array([[0.9, 0.05, 0.03, 0.02]]),
        points=(points.astype(np.float32),),
    )


@pytest.fixture(scope="module")
def graph_bench() -> Iterator[object]:
    rclpy = pytest.importorskip("rclpy")
    assert rclpy
    from geometry_msgs.msg import PoseStamped
    from std_msgs.msg import String
    from support.nodes_bench import bench

    from deworldsg_ros.nodes.graph_node import GraphNode

    topics = {"deworldsg/local_graph": String, "deworldsg/pose_correction": PoseStamped}
    yield from bench(GraphNode, topics)


def test_the_node_applies_corrections_and_refuses_invalid_ones(graph_bench) -> None:  # type: ignore[no-untyped-def]
    from support.nodes_bench import local_graph as message_of
    from support.nodes_bench import pose, works

    at = graph_bench

    def send(make: Callable[[int], object]) -> None:
        at.send(deworldsg__pose_correction=make(at.stamp_ns))

    at.refuses("no_graph", lambda: send(lambda stamp_ns: pose(stamp_ns, 0.5)))
    works(at, lambda: at.send(deworldsg__local_graph=message_of(at.next_stamp())))
    at.refuses("wrong_frame", lambda: send(lambda stamp_ns: pose(stamp_ns, 0.5, "odom")))
    at.refuses("invalid_pose", lambda: send(lambda stamp_ns: pose(stamp_ns, float("nan"))))
    send(lambda stamp_ns: pose(stamp_ns, 0.5))
    at.expect(lambda: at.node.more_values().get("pose corrections") == "1", "the correction")
    assert at.node.more_values()["nodes moved by corrections"] == "1"
    works(at, lambda: at.send(deworldsg__local_graph=message_of(at.next_stamp())))
