"""The global graph: ids, merges, remembered frames, messages, save and load."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from support.merging import (
    VOCABULARY,
    edit_at_random,
    random_classes,
    random_covariances,
    seeds,
    set_confirmed,
)
from support.node_states import node_states

from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph.pairs import EdgeMap
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.gaussian import fuse, log_determinant
from deworldsg_ros.wire import messages as wire

SURE = np.array([1.0, 0.0, 0.0, 0.0])


def graph_of(count: int, **options: int) -> SceneGraph:
    """Unit spheres 10 m apart, ids 1 to count."""
    graph = SceneGraph(VOCABULARY, "world", **options)
    for index in range(count):
        graph.add_node(np.array([10.0 * index, 0, 0]), np.eye(3), SURE, index)
    return graph


def arrays_of(graph: SceneGraph) -> graph_files.Arrays:
    return graph_files.to_arrays(graph.state())


def equal(a: SceneGraph, b: SceneGraph) -> bool:
    one, other = arrays_of(a), arrays_of(b)
    return one.keys() == other.keys() and all(
        one[name].dtype == other[name].dtype and np.array_equal(one[name], other[name])
        for name in one
    )


def test_an_empty_graph() -> None:
    graph = SceneGraph(VOCABULARY, "world")
    assert len(graph) == 0
    assert graph.nodes.means.shape == (0, 3)
    assert dict(graph.edges) == {}
    assert node_states(graph, 3) == {}
    assert graph.take_removals() == {}
    assert graph.resolve(1) == 0


def test_a_graph_without_predicates_is_saved_and_loaded() -> None:
    graph = SceneGraph(Vocabulary(("cup",), ()), "world")
    graph.add_node(np.zeros(3), np.eye(3), np.ones(1), 1)
    again = graph_files.graph_from_arrays(arrays_of(graph), "saved")
    assert len(again) == 1 and equal(graph, again)


def test_ids_start_at_1_and_are_never_reused() -> None:
    graph = graph_of(3)
    assert list(graph.nodes.slot_of) == [1, 2, 3]
    graph.remove_node(3)
    graph.merge_nodes(2, 1)
    assert graph.add_node(np.zeros(3), np.eye(3), SURE, 0) == 4
    assert list(graph.nodes.slot_of) == [1, 4]
    assert 2 not in graph
    assert 4 in graph


def test_nodes_keep_their_slots_and_free_slots_are_used_again() -> None:
    graph = graph_of(200)
    slots = dict(graph.nodes.slot_of)
    for node_id in range(1, 151):
        graph.remove_node(node_id)
    nodes = graph.nodes
    assert len(graph) == len(nodes.slots) == 50
    free = np.setdiff1d(np.arange(200), nodes.slots)
    assert not nodes.weights[free].any() and not nodes.covariances[free].any()
    for node_id in range(201, 251):
        graph.add_node(np.full(3, 10.0 * (node_id - 1)), np.eye(3), SURE, node_id - 1)
    assert len(nodes.ids) == 200
    for node_id in range(151, 251):
        slot = nodes.slot(node_id)
        assert slot == slots.get(node_id, slot) and nodes.ids[slot] == node_id
        assert nodes.means[slot, 0] == 10 * (node_id - 1)
        assert nodes.first_seen_ns[slot] == node_id - 1


def test_observations_average_with_their_weights() -> None:
    graph = graph_of(1)
    flat = np.full(4, 0.25)
    graph.observe(1, np.array([3.0, 0, 0]), np.eye(3), flat, 7)
    graph.observe(1, np.array([0.0, 0, 0]), np.eye(3), flat, 5)
    assert graph.nodes.weights.tolist() == [3]
    assert graph.nodes.means[0] == pytest.approx([1, 0, 0])
    assert graph.nodes.covariances[0] == pytest.approx(np.diag([3.0, 1, 1]))
    assert graph.nodes.class_probabilities[0] == pytest.approx([0.5, 1 / 6, 1 / 6, 1 / 6])
    assert (graph.nodes.first_seen_ns[0], graph.nodes.last_seen_ns[0]) == (0, 7)


def test_observing_many_is_observing_each() -> None:
    rng = np.random.default_rng(0)
    means, covariances = rng.normal(size=(3, 3)), random_covariances(rng, 3)
    classes, weights = random_classes(rng, 3), rng.uniform(0.1, 3, 3)
    surfaces = rng.normal(size=(3, 5, 3)).astype(np.float32)
    one, many = graph_of(4), graph_of(4)
    many.observe_each([4, 1, 3], means, covariances, classes, 9, surfaces, weights)
    for index, node_id in enumerate([4, 1, 3]):
        one.observe(
            node_id,
            means[index],
            covariances[index],
            classes[index],
            9,
            surfaces[index],
            float(weights[index]),
        )
    assert equal(one, many)
    for index, node_id in enumerate([4, 1, 3]):
        row = many.nodes.slot(node_id)
        known = (1.0, np.array([10.0 * (node_id - 1), 0, 0]), np.eye(3))
        mean, covariance = fuse(*known, weights[index], means[index], covariances[index])
        assert many.nodes.means[row] == pytest.approx(mean, rel=1e-14)
        assert many.nodes.covariances[row] == pytest.approx(covariance, rel=1e-14)
        cached = many.nodes.log_determinants[row]
        assert cached == log_determinant(many.nodes.covariances[row])
    many.observe_each(
        [], *(np.zeros((0, *shape)) for shape in ((3,), (3, 3), (4,))), 9, [], np.zeros(0)
    )
    assert equal(one, many)


def test_a_merge_moves_edges_and_sums_their_evidence() -> None:
    graph = graph_of(4)
    ones = np.ones(3)
    graph.add_visual(1, 3, 1 * ones, 10)
    graph.add_visual(2, 3, 2 * ones, 20)
    graph.add_visual(3, 2, 4 * ones, 30)
    graph.add_visual(1, 2, 8 * ones, 40)
    graph.add_visual(2, 1, 8 * ones, 40)
    graph.add_visual(3, 4, 16 * ones, 50)
    graph.add_neighbours([(1, 3)], 60)
    graph.add_neighbours([(2, 3)], 15)
    graph.add_neighbours([(2, 4)], 70)
    assert graph.merge_nodes(2, 1) == 1
    found = {
        pair: (edge.visual_logits[0], edge.frames, edge.neighbour_frames, edge.last_seen_ns)
        for pair, edge in graph.edges.items()
    }
    assert found == {
        (1, 3): (3, 2, 2, 60),
        (3, 1): (4, 1, 0, 30),
        (3, 4): (16, 1, 0, 50),
        (1, 4): (0, 0, 1, 70),
    }


def test_the_neighbours_of_a_frame_count_once_each() -> None:
    graph = graph_of(3)
    graph.add_visual(1, 2, np.ones(3), 30)
    graph.take_changed_edges()
    revision = graph.revision
    graph.add_neighbours([(1, 2), (2, 1), (0, 3)], 20)
    assert graph.take_changed_edges() == {(1, 2), (2, 1)}
    graph.add_neighbours([(2, 1)], 40)
    assert graph.revision == revision + 3
    found = {pair: edge[1:] for pair, edge in graph.edges.items()}
    assert found == {(1, 2): (1, 30, 1, revision + 1), (2, 1): (0, 40, 2, revision + 3)}
    assert graph.edges[1, 2].visual_logits.tolist() == [1.0] * 3


def test_evidence_for_removed_ids_reaches_their_successors() -> None:
    graph = graph_of(5)
    graph.merge_nodes(3, 4)
    graph.merge_nodes(3, 2)
    graph.remove_node(5)
    assert [graph.resolve(node_id) for node_id in range(7)] == [0, 1, 2, 2, 2, 0, 0]
    assert graph.add_visual(4, 1, np.ones(3), 0)
    assert list(graph.edges) == [(2, 1)]
    revision = graph.revision
    assert not graph.add_visual(4, 3, np.ones(3), 0)  # became one node
    assert not graph.add_visual(1, 5, np.ones(3), 0)
    graph.add_neighbours([(0, 1), (1, 0), (1, 1)], 0)
    assert graph.revision == revision
    assert graph.take_removals() == {4: 2, 3: 2, 5: None}
    assert graph.take_removals() == {}


@given(seeds)
@settings(max_examples=10)
def test_restored_edges_are_in_the_order_in_which_they_came(seed: int) -> None:
    graph = SceneGraph(VOCABULARY, "world")
    edit_at_random(graph, np.random.default_rng(seed), 40)
    one, other = EdgeMap(len(VOCABULARY.predicates)), EdgeMap(len(VOCABULARY.predicates))
    for pair, evidence in graph.edges.items():
        one.add(pair, evidence)
    other.restore(one.arrays())
    assert list(one.evidence) == list(other.evidence)
    assert one.take_changed() == other.take_changed()
    for node_id in list(graph.nodes.slot_of):
        assert list(one.partners(node_id)) == list(other.partners(node_id))


@given(seeds)
@settings(max_examples=20)
def test_restored_edges_change_as_the_others_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = SceneGraph(VOCABULARY, "world")
    edit_at_random(graph, rng, 40)
    again = SceneGraph.from_state(graph.state())
    assert again.take_changed_edges() == graph.edges.keys()
    for one in (graph, again):
        edit_at_random(one, np.random.default_rng(seed), 40)
        if len(one):
            one.remove_node(min(one.nodes.slot_of))
    assert list(again.edges) == list(graph.edges) and len(again.edges) == len(graph.edges)
    for node_id in range(1, 100):
        assert list(again.partners(node_id)) == list(graph.partners(node_id))
    assert equal(again, graph)


def test_removing_a_node_removes_its_edges() -> None:
    graph = graph_of(3)
    for pair in ((1, 2), (2, 1), (2, 3), (1, 3)):
        graph.add_visual(*pair, np.ones(3), 0)
    graph.remove_node(2)
    assert list(graph.edges) == [(1, 3)]
    graph.remove_node(3)
    assert not graph.edges


def test_frames_are_remembered_up_to_a_number() -> None:
    graph = graph_of(3, remembered_frames=2)
    graph.remember_frame(10, [1, 2])
    graph.remember_frame(20, [3])
    graph.merge_nodes(1, 2)
    assert graph.nodes_of_frame(10) == [1, 1]
    graph.remember_frame(30, [])
    assert graph.nodes_of_frame(10) is None
    assert graph.nodes_of_frame(20) == [3]
    graph.remove_node(3)
    assert graph.nodes_of_frame(20) == [0]


def test_invalid_requests_raise_and_change_nothing() -> None:
    graph = graph_of(2)
    graph.take_removals()
    before = arrays_of(graph)
    with pytest.raises(ValueError, match="not positive definite"):
        graph.add_node(np.zeros(3), np.zeros((3, 3)), SURE, 0)
    with pytest.raises(ValueError, match="node 1 cannot be merged with itself"):
        graph.merge_nodes(1, 1)
    with pytest.raises(KeyError, match="node 9 is not in the graph"):
        graph.merge_nodes(1, 9)
    with pytest.raises(KeyError, match="node 9 is not in the graph"):
        graph.remove_node(9)
    with pytest.raises(ValueError, match=r"shape \(2,\): expected \(3,\)"):
        graph.add_visual(1, 2, np.ones(2), 0)
    after = arrays_of(graph)
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_unchanged_nodes_keep_their_message() -> None:
    graph = graph_of(3)
    first = node_states(graph, 2)
    graph.observe(2, np.ones(3), np.eye(3), SURE, 9)
    second = node_states(graph, 2)
    assert [second[node_id] is first[node_id] for node_id in (1, 2, 3)] == [True, False, True]
    graph.merge_nodes(1, 2)
    third = node_states(graph, 2)
    assert list(third) == [1, 3]
    assert third[1].observations == 3
    assert third[3] is first[3]


def test_hidden_nodes_have_no_message() -> None:
    graph = graph_of(1)
    for x in (5.0, 9.0):
        graph.add_node(np.array([x, 0, 0]), np.eye(3), SURE, 3, confirmed=False)
    assert list(node_states(graph, 2)) == [1]
    set_confirmed(graph, 3, True)
    assert list(node_states(graph, 2)) == [1, 3]
    assert node_states(graph, 2)[3].confirmed
    assert graph.merge_nodes(2, 3) == 2  # a confirmed node stays confirmed
    assert list(node_states(graph, 2)) == [1, 2]


def test_the_message_of_a_node() -> None:
    graph = SceneGraph(VOCABULARY, "world", surface_point_capacity=2)
    points = np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0]], np.float32)
    classes = np.array([0.1, 0.4, 0.4, 0.1])
    graph.add_node(np.array([1.0, 2, 3]), np.diag([1.0, 2, 3]), classes, 1_500_000_000, points)
    state = node_states(graph, 3, with_points=True)[1]
    assert state.label == "table"  # of equals the first
    assert [belief.label for belief in state.classes] == ["table", "chair", "cup"]
    assert state.mean_m == [1, 2, 3]
    assert state.covariance_m2 == [1, 0, 0, 0, 2, 0, 0, 0, 3]
    assert state.observations == 1
    assert state.first_seen == state.last_seen == wire.Stamp(1, 500_000_000)
    assert len(surface_points(state)) == 2
    assert len(surface_points(node_states(graph, 3)[1])) == 0


def test_room_for_surface_points_grows_with_the_largest_surface() -> None:
    graph, once = SceneGraph(VOCABULARY, "world"), SceneGraph(VOCABULARY, "world")
    points = np.random.default_rng(0).uniform(size=(700, 3)).astype(np.float32)
    for node_points in (points[:40], points[40:90]):
        graph.add_node(np.zeros(3), np.eye(3), SURE, 0, node_points)
    assert graph.nodes.surface_points_world.shape == (2, 64, 3)
    other = graph.nodes.surface(1).copy()
    graph.observe(1, np.zeros(3), np.eye(3), SURE, 1, points[40:140])
    assert graph.nodes.surface_points_world.shape == (2, 256, 3)
    graph.observe(1, np.zeros(3), np.eye(3), SURE, 2, points)
    once.add_node(np.zeros(3), np.eye(3), SURE, 0, points)
    assert graph.nodes.surface_points_world.shape == (2, 512, 3)
    np.testing.assert_array_equal(graph.nodes.surface(0), once.nodes.surface(0))
    np.testing.assert_array_equal(graph.nodes.surface(1), other)


def test_class_distributions_are_scaled_to_one() -> None:
    graph = SceneGraph(VOCABULARY, "world")
    graph.add_node(np.zeros(3), np.eye(3), np.array([1.000001, 0, 0, 0]), 0)
    assert graph.nodes.class_probabilities[0].sum() == 1


@given(seeds)
@settings(max_examples=40)
def test_invariants_hold_through_any_edits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = SceneGraph(VOCABULARY, "world", surface_point_capacity=6, remembered_frames=3)
    given_ids: set[int] = set()
    gone: set[int] = set()
    for _ in range(15):
        edit_at_random(graph, rng, 5)
        live = set(graph.nodes.slot_of)
        assert not live & gone
        gone |= given_ids - live
        given_ids |= live
        assert all(graph.resolve(node_id) == node_id for node_id in live)
        assert all(graph.resolve(node_id) in live | {0} for node_id in gone)
        for subject, object_ in graph.edges:
            assert subject != object_
            assert {subject, object_} <= live
        assert (graph.nodes.surface_counts <= 6).all()
        assert len(graph.state().ids.frames) <= 3
    for node_id in rng.permutation(list(graph.nodes.slot_of)).tolist():
        graph.remove_node(node_id)
        assert not any(node_id in pair for pair in graph.edges)
    assert not graph.edges


@given(seeds)
@settings(max_examples=25)
def test_save_and_load_lose_nothing(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = SceneGraph(VOCABULARY, "world", surface_point_capacity=6, remembered_frames=3)
    edit_at_random(graph, rng, int(rng.integers(0, 60)))
    path = tmp_path_factory.mktemp("graph") / "graph.npz"
    graph_files.save(graph, path)
    assert [item.name for item in path.parent.iterdir()] == ["graph.npz"]
    loaded = graph_files.load(path)
    assert equal(loaded, graph)
    assert node_states(loaded, 4, with_points=True) == node_states(graph, 4, with_points=True)
    for name in ("log_determinants", "eigenvalue_bounds"):
        values = [
            getattr(one, name)[one.slots_of(sorted(one.slot_of))]
            for one in (loaded.nodes, graph.nodes)
        ]
        np.testing.assert_array_equal(*values)
    # Both go on alike.
    edit_at_random(graph, np.random.default_rng(seed + 1), 20)
    edit_at_random(loaded, np.random.default_rng(seed + 1), 20)
    assert equal(loaded, graph)


@given(seeds)
@settings(max_examples=10)
def test_a_state_does_not_change_with_its_graph(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = SceneGraph(VOCABULARY, "world", surface_point_capacity=6, remembered_frames=3)
    edit_at_random(graph, rng, 30)
    state = graph.state()
    before = graph_files.to_arrays(state)
    again = SceneGraph.from_state(state)
    edit_at_random(graph, rng, 30)
    edit_at_random(again, rng, 30)
    after = graph_files.to_arrays(state)
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_other_files_are_refused(tmp_path: Path) -> None:
    graph_files.save(graph_of(3), tmp_path / "good.npz")
    whole = (tmp_path / "good.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "empty.npz").write_bytes(b"")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.save(tmp_path / "array.npy", np.zeros(3))
    names = ("cut.npz", "text.npz", "empty.npz", "other.npz", "array.npy", "absent.npz")
    for name in names:
        with pytest.raises(RefusedInput, match=name) as refused:
            graph_files.load(tmp_path / name)
        assert refused.value.reason == "invalid_graph_file"


def test_a_file_of_a_later_version_is_refused(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("deworldsg_ros.graph.graph_files.FORMAT_VERSION", 2)
    graph_files.save(graph_of(1), tmp_path / "later.npz")
    monkeypatch.undo()
    with pytest.raises(RefusedInput, match="version 2: expected 1 or older"):
        graph_files.load(tmp_path / "later.npz")


@pytest.mark.parametrize(
    ("classes", "entropy_nats"),
    [([1.0, 0.0, 0.0, 0.0], 0.0), ([0.5, 0.5, 0.0, 0.0], np.log(2)), ([0.25] * 4, np.log(4))],
)
def test_the_entropy_of_a_node_measures_disagreement(classes, entropy_nats) -> None:
    graph = SceneGraph(VOCABULARY, "world")
    graph.add_node(np.zeros(3), np.eye(3), np.array(classes), 1)
    (state,) = node_states(graph, 1).values()
    assert len(state.classes) == 1  # the entropy is of all classes
    assert state.entropy_nats == pytest.approx(entropy_nats, abs=1e-4)
