"""The paper's rule against a plain reference, and its invariants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from support.gaussians import moments
from support.merging import (
    VOCABULARY,
    local_graph,
    random_local_graphs,
    random_pose,
    seeds,
)
from support.reference_merging import ReferenceMerging

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.merging import PaperMerging
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.gaussian import transform

CERTAIN = np.array([0.97, 0.01, 0.01, 0.01])


def merge_all(frames: list[LocalGraph]) -> tuple[SceneGraph, list[list[int]]]:
    graph = SceneGraph(VOCABULARY, "world")
    merging = PaperMerging(MergingConfig())
    return graph, [merging.merge(graph, local) for local in frames]


def gaussian(mean: tuple[float, float, float], deviation_m: float = 0.1) -> tuple:
    return np.array(mean), deviation_m**2 * np.eye(3)


def frame_of(stamp_ns: int, *gaussians: tuple, classes: np.ndarray = CERTAIN, **more) -> LocalGraph:
    means = np.array([mean for mean, _ in gaussians]).reshape(-1, 3)
    covariances = np.array([covariance for _, covariance in gaussians]).reshape(-1, 3, 3)
    return local_graph(stamp_ns, means, covariances, np.tile(classes, (len(means), 1)), **more)


@given(seeds)
@settings(max_examples=80)
def test_the_rule_equals_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = random_local_graphs(rng, 12)
    config = MergingConfig()
    reference = ReferenceMerging(config.hellinger_threshold, config.class_distance_threshold)
    expected = [reference.merge(local) for local in frames]
    # A decision within rounding of its threshold may fall either way.
    assume(reference.smallest_margin > 1e-9)
    graph, ids = merge_all(frames)
    assert ids == expected
    assert sorted(list(graph.nodes.slot_of)) == sorted(reference.nodes)
    for node_id, node in reference.nodes.items():
        row = graph.nodes.slot(node_id)
        np.testing.assert_allclose(graph.nodes.means[row], node["mean"], rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            graph.nodes.covariances[row], node["covariance"], rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(
            graph.nodes.class_probabilities[row], node["classes"], rtol=0, atol=1e-12
        )
        assert graph.nodes.weights[row] == node["weight"]
        points = graph.nodes.surface(row).tolist()
        assert {tuple(point) for point in points} == node["points"]
    assert set(graph.edges) == set(reference.edges)
    for pair, edge in reference.edges.items():
        np.testing.assert_allclose(graph.edges[pair].visual_logits, edge["logits"], atol=1e-9)
        assert graph.edges[pair].frames == edge["frames"]
    for gone, kept in graph.take_removals().items():
        assert kept == reference.resolve(gone)


@given(seeds)
@settings(max_examples=30)
def test_the_result_does_not_depend_on_the_world_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = random_local_graphs(rng, 8)
    reference = ReferenceMerging(0.7, 0.8)
    for local in frames:
        reference.merge(local)
    assume(reference.smallest_margin > 1e-6)
    T_other_world = random_pose(rng)
    moved_frames = []
    for local in frames:
        means, covariances = transform(local.means_world, local.covariances_world, T_other_world)
        moved_frames.append(
            local_graph(local.stamp_ns, means, covariances, local.class_probabilities)
        )
    graph, ids = merge_all(frames)
    moved, moved_ids = merge_all(moved_frames)
    assert moved_ids == ids
    nodes, slots = graph.nodes, graph.nodes.slots
    assert moved.nodes.slot_of == nodes.slot_of
    means, covariances = transform(nodes.means[slots], nodes.covariances[slots], T_other_world)
    np.testing.assert_allclose(moved.nodes.means[slots], means, atol=1e-9)
    np.testing.assert_allclose(moved.nodes.covariances[slots], covariances, atol=1e-9)


@given(seeds)
@settings(max_examples=30)
def test_invariants_of_the_graph(seed: int) -> None:
    frames = random_local_graphs(np.random.default_rng(seed), 15)
    graph, ids = merge_all(frames)
    nodes, slots = graph.nodes, graph.nodes.slots
    assert nodes.weights.sum() == sum(len(local) for local in frames)
    assert (np.linalg.eigvalsh(nodes.covariances[slots]) > 0).all()
    assert (nodes.covariances == nodes.covariances.swapaxes(1, 2)).all()
    np.testing.assert_allclose(nodes.class_probabilities[slots].sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(
        nodes.log_determinants[slots], np.linalg.slogdet(nodes.covariances[slots])[1], atol=1e-9
    )
    largest = np.linalg.eigvalsh(nodes.covariances).max(axis=1, initial=0)
    assert (nodes.eigenvalue_bounds >= largest * (1 - 1e-12)).all()
    assert (nodes.first_seen_ns <= nodes.last_seen_ns).all()
    for local, row_ids in zip(frames, ids):
        assert graph.nodes_of_frame(local.stamp_ns) == [graph.resolve(item) for item in row_ids]
        assert 0 not in graph.nodes_of_frame(local.stamp_ns)


def test_a_still_camera_gives_one_node_for_each_object() -> None:
    rng = np.random.default_rng(7)
    objects = 12
    centres = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0), [0.5]), -1).reshape(-1, 3)
    extents = rng.uniform(0.05, 0.3, (objects, 3))
    extents[:, 2] = 1e-4  # a flat visible surface
    surfaces = [
        centre + rng.uniform(-1, 1, (400, 3)) * extent for centre, extent in zip(centres, extents)
    ]
    classes = np.tile(0.1 * np.ones(4) / 4, (objects, 1))
    classes[np.arange(objects), np.arange(objects) % 4] += 0.9
    graph = SceneGraph(VOCABULARY, "world", surface_point_capacity=100)
    merging = PaperMerging(MergingConfig())
    for stamp_ns in range(200):
        seen = [surface + rng.normal(0, 0.002, surface.shape) for surface in surfaces]
        gaussians = [moments(points, 1e-6) for points in seen]
        local = local_graph(
            stamp_ns,
            np.array([mean for mean, _ in gaussians]),
            np.array([covariance for _, covariance in gaussians]),
            classes,
            points=tuple(points[:64].astype(np.float32) for points in seen),
        )
        assert merging.merge(graph, local) == list(range(1, objects + 1))
    assert graph.nodes.weights.tolist() == [200.0] * objects
    np.testing.assert_allclose(
        graph.nodes.means, [surface.mean(axis=0) for surface in surfaces], atol=1e-3
    )
    assert graph.nodes.surface_counts.tolist() == [100] * objects


def test_exactly_equal_observations_merge() -> None:
    frames = [frame_of(stamp_ns, gaussian((0, 0, 1))) for stamp_ns in range(5)]
    graph, ids = merge_all(frames)
    assert ids == [[1]] * 5
    assert graph.nodes.covariances[0] == pytest.approx(frames[0].covariances_world[0], rel=1e-14)


@pytest.mark.parametrize(
    ("offset_m", "merges"),
    # Equal spheres: BD = |d|²/8σ², and HD < 0.7 where |d| < σ √(8 · 0.67334) = 2.3209 σ.
    [(0.0, True), (0.2320, True), (0.2322, False), (5.0, False)],
)
def test_the_geometric_gate(offset_m: float, merges: bool) -> None:
    graph, _ = merge_all(
        [frame_of(1, gaussian((0, 0, 0))), frame_of(2, gaussian((offset_m, 0, 0)))]
    )
    assert len(graph) == (1 if merges else 2)


@pytest.mark.parametrize(
    ("classes", "merges"),
    [
        ([1.0, 0.0, 0.0, 0.0], True),
        ([0.25, 0.25, 0.25, 0.25], True),
        ([0.21, 0.79, 0.0, 0.0], True),
        ([0.19, 0.81, 0.0, 0.0], False),
        ([0.0, 1.0, 0.0, 0.0], False),
    ],
)
def test_the_class_gate(classes: list[float], merges: bool) -> None:
    graph, _ = merge_all(
        [
            frame_of(1, gaussian((0, 0, 0)), classes=np.array([1.0, 0, 0, 0])),
            frame_of(2, gaussian((0, 0, 0)), classes=np.array(classes)),
        ]
    )
    assert len(graph) == (1 if merges else 2)


def test_the_nearest_node_wins_and_of_equals_the_oldest() -> None:
    graph = SceneGraph(VOCABULARY, "world")
    for x in (0.3, -0.3, 0.3 + 1.0):
        graph.add_node(*gaussian((x, 0, 0), 0.12), CERTAIN, 0)
    merging = PaperMerging(MergingConfig())
    assert merging.merge(graph, frame_of(1, gaussian((-0.05, 0, 0), 0.2))) == [2]
    graph = SceneGraph(VOCABULARY, "world")
    for x in (5.0, 0.3, -0.3):
        graph.add_node(*gaussian((x, 0, 0), 0.12), CERTAIN, 0)
    graph.remove_node(1)  # its slot is free
    assert merging.merge(graph, frame_of(1, gaussian((0, 0, 0), 0.2))) == [2]


def test_an_object_between_two_nodes_merges_them_into_the_older_id() -> None:
    graph = SceneGraph(VOCABULARY, "world")
    merging = PaperMerging(MergingConfig())
    apart = frame_of(1, gaussian((0, 0, 0)), gaussian((0.25, 0, 0)), gaussian((3, 0, 0)))
    assert merging.merge(graph, apart) == [1, 2, 3]
    graph.add_visual(2, 3, np.array([1.0, 0, 0]), 1)
    graph.add_visual(1, 3, np.array([0, 2.0, 0]), 1)
    graph.add_visual(1, 2, np.ones(3), 1)
    bridge = frame_of(
        2,
        gaussian((3, 0, 0)),
        gaussian((0.12, 0, 0), 0.12),
        pairs=[(0, 1)],
        logits=np.array([[4.0, 5, 6]]),
    )
    assert merging.merge(graph, bridge) == [3, 1]
    assert graph.nodes_of_frame(1) == [1, 1, 3]
    assert graph.take_removals() == {2: 1}
    assert graph.nodes.weights[graph.nodes.slot(1)] == 3
    assert sorted(graph.edges) == [(1, 3), (3, 1)]
    assert graph.edges[1, 3].visual_logits.tolist() == [1.0, 2.0, 0.0]
    assert graph.edges[3, 1].visual_logits.tolist() == [4.0, 5.0, 6.0]


def test_relations_of_rows_that_become_one_node_are_summed() -> None:
    local = frame_of(
        1,
        gaussian((0, 0, 0)),
        gaussian((0.01, 0, 0)),
        gaussian((3, 0, 0)),
        pairs=[(0, 1), (0, 2), (1, 2)],
        logits=np.array([[9.0, 9, 9], [1, 0, 0], [0, 2, 0]]),
    )
    graph, ids = merge_all([local])
    assert ids == [[1, 1, 2]]
    assert list(graph.edges) == [(1, 2)]
    assert graph.edges[1, 2].visual_logits.tolist() == [1.0, 2.0, 0.0]
    assert graph.edges[1, 2].frames == 1


def test_an_empty_frame_is_remembered() -> None:
    graph, ids = merge_all([frame_of(5)])
    assert ids == [[]]
    assert graph.nodes_of_frame(5) == []
    assert graph.nodes_of_frame(6) is None
