"""The global graph: ids, nodes in slots, merges, remembered frames, and its messages of nodes."""

import numpy as np
import pytest
from hypothesis import given
from support.merging import (
    VOCABULARY,
    edit_at_random,
    node_states,
    random_classes,
    random_covariances,
    seeds,
)

from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.nodes import PRUNE_ABOVE, NodeIds

SURE = np.array([1.0, 0.0, 0.0, 0.0])


def graph_of(count: int, **options: int) -> GlobalGraph:
    """Unit spheres 10 m apart, ids 1 to count."""
    graph = GlobalGraph(VOCABULARY, "world", **options)
    for index in range(count):
        graph.add_node(np.array([10.0 * index, 0, 0]), np.eye(3), SURE, index)
    return graph


def content(graph: GlobalGraph) -> dict[str, bytes]:
    return {name: values.tobytes() for name, values in graph_files.to_arrays(graph.state()).items()}


def test_an_empty_graph() -> None:
    graph = GlobalGraph(VOCABULARY, "world")
    assert len(graph) == 0 and graph.nodes.means.shape == (0, 3)
    assert dict(graph.edges) == dict(graph.votes) == node_states(graph, 3) == {}
    assert graph.take_removals() == {} and graph.resolve(1) == 0


def test_ids_start_at_1_and_are_never_used_again() -> None:
    graph = graph_of(3)
    assert list(graph.nodes.slot_of) == [1, 2, 3]
    graph.remove_node(3)
    assert graph.merge_nodes(2, 1) == 1
    assert graph.add_node(np.zeros(3), np.eye(3), SURE, 0) == 4
    assert list(graph.nodes.slot_of) == [1, 4]
    assert 2 not in graph and 4 in graph
    assert graph.take_removals() == {3: None, 2: 1}
    assert graph.take_removals() == {}


@given(seeds)
def test_invariants_hold_through_any_edits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = GlobalGraph(VOCABULARY, "world", surface_point_capacity=6, remembered_frames=3)
    given_ids: set[int] = set()
    gone: set[int] = set()
    most = 5
    for _ in range(15):
        edit_at_random(graph, rng, 5)
        live = set(graph.nodes.slot_of)
        most = max(most, len(live) + 5)
        assert len(graph.nodes.ids) <= most, "free slots are used again"
        assert not live & gone
        gone |= given_ids - live
        given_ids |= live
        assert all(graph.resolve(node_id) == node_id for node_id in live)
        assert all(graph.resolve(node_id) in live | {0} for node_id in gone)
        assert {node_id for pair in graph.edges for node_id in pair} <= live
        assert (graph.nodes.surface_counts <= 6).all()
        assert len(graph.state().ids.frames) <= 3


def test_removed_ids_are_forgotten_and_those_of_remembered_frames_are_not() -> None:
    rng, frames = np.random.default_rng(0), 20
    live: set[int] = set()
    ids, everything = NodeIds(live, frames), NodeIds(live, 10**9)
    sizes = []
    for stamp in range(3000):
        rows = [ids.take() for _ in range(10)]
        live.update(rows)
        for node_id in rng.permutation(sorted(live))[:-5].tolist():
            live.discard(node_id)
            successor = int(rng.choice(sorted(live)))
            for one in (ids, everything):
                one.retire(node_id, successor)
        for one in (ids, everything):
            one.remember_frame(stamp, rows)
            one.take_removals()
        for known in range(max(0, stamp - frames + 1), stamp + 1):
            assert ids.nodes_of_frame(known) == everything.nodes_of_frame(known)
        sizes.append(len(ids.state().successors))
    assert len(everything.state().successors) == 29_995
    assert max(sizes) <= PRUNE_ABOVE + 10


def test_a_new_merge_of_a_node_that_no_remembered_frame_shows_is_not_forgotten() -> None:
    live = {1, 2}
    ids = NodeIds(live, 20)
    for node_id in range(3, PRUNE_ABOVE + 3):
        ids.retire(node_id, 0)
    ids.retire(1, 2)
    live.discard(1)
    ids.take_removals()
    ids.remember_frame(0, [2])
    assert len(ids.state().successors) < PRUNE_ABOVE
    assert ids.resolve(1) == 2


def test_observing_many_is_observing_each() -> None:
    rng = np.random.default_rng(0)
    means, covariances = rng.normal(size=(3, 3)), random_covariances(rng, 3)
    classes, weights = random_classes(rng, 3), rng.uniform(0.1, 3, 3)
    surfaces = rng.normal(size=(3, 5, 3)).astype(np.float32)
    one, many, ids = graph_of(4), graph_of(4), [4, 1, 3]
    many.observe_each(ids, means, covariances, classes, 9, surfaces, weights)
    for node_id, *seen, points, weight in zip(ids, means, covariances, classes, surfaces, weights):
        one.observe(node_id, *seen, 9, points, float(weight))
    none = (np.zeros((0, *shape)) for shape in ((3,), (3, 3), (4,)))
    many.observe_each([], *none, 9, [], np.zeros(0))
    assert content(one) == content(many)


def test_invalid_requests_raise_and_change_nothing() -> None:
    graph = graph_of(2)
    graph.take_removals()
    before = content(graph)
    with pytest.raises(ValueError, match="not positive definite"):
        graph.add_node(np.zeros(3), np.zeros((3, 3)), SURE, 0)
    with pytest.raises(ValueError, match="node 1"):
        graph.merge_nodes(1, 1)
    for refused in (lambda: graph.merge_nodes(1, 9), lambda: graph.remove_node(9)):
        with pytest.raises(KeyError, match="node 9"):
            refused()
    assert content(graph) == before
