"""A graph that is saved and read is the same, and goes on alike; other files are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from support.merging import VOCABULARY, edit_at_random, node_states, seeds

from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.scene.frame_graph import Vocabulary


def random_graph(rng: np.random.Generator, edits: int = 40) -> GlobalGraph:
    graph = GlobalGraph(VOCABULARY, "world", surface_point_capacity=6, remembered_frames=3)
    edit_at_random(graph, rng, edits)
    return graph


def assert_equal(one: graph_files.Arrays, other: graph_files.Arrays) -> None:
    assert one.keys() == other.keys()
    for name, values in one.items():
        assert values.dtype == other[name].dtype
        np.testing.assert_array_equal(values, other[name], err_msg=name)


def arrays_of(graph: GlobalGraph) -> graph_files.Arrays:
    return graph_files.to_arrays(graph.state())


@given(seeds)
def test_save_and_load_lose_nothing(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, int(rng.integers(0, 60)))
    path = tmp_path_factory.mktemp("graph") / "graph.npz"
    graph_files.save(graph, path)
    assert [item.name for item in path.parent.iterdir()] == ["graph.npz"]
    loaded = graph_files.load(path)
    assert_equal(arrays_of(loaded), arrays_of(graph))
    assert node_states(loaded, 4, with_points=True) == node_states(graph, 4, with_points=True)
    for name in ("log_determinants", "eigenvalue_bounds"):
        values = [
            getattr(one, name)[one.slots_of(sorted(one.slot_of))]
            for one in (loaded.nodes, graph.nodes)
        ]
        np.testing.assert_array_equal(*values)
    # Both go on alike.
    for one in (graph, loaded):
        edit_at_random(one, np.random.default_rng(seed + 1), 20)
    assert_equal(arrays_of(loaded), arrays_of(graph))


@given(seeds)
@settings(max_examples=10)
def test_a_state_does_not_change_with_its_graph(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = random_graph(rng)
    state = graph.state()
    before = {name: values.copy() for name, values in graph_files.to_arrays(state).items()}
    for one in (graph, GlobalGraph.from_state(state)):
        edit_at_random(one, rng, 30)
        assert_equal(graph_files.to_arrays(state), before)


def test_a_graph_without_predicates_is_saved_and_loaded() -> None:
    graph = GlobalGraph(Vocabulary(("cup",), ()), "world")
    graph.add_node(np.zeros(3), np.eye(3), np.ones(1), 1)
    again = graph_files.graph_from_arrays(arrays_of(graph), "saved")
    assert len(again) == 1
    assert_equal(arrays_of(again), arrays_of(graph))
