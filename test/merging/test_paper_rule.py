"""The paper's rule (Eq. 5 to 7): the search against np.linalg, the rule against a reference."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.merging import (
    VOCABULARY,
    local_graph,
    random_classes,
    random_covariances,
    random_local_graphs,
    seeds,
)
from support.reference_merging import ReferenceMerging

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging import PaperMerging
from deworldsg_ros.merging.paper_rule import (
    bhattacharyya_bound,
    nearest_slot,
    observed,
)
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.gaussian import (
    hellinger_distance,
)

# --- the nearest node (Eq. 5 and 6) --------------------------------------------------------------


def table_of(means, covariances, classes, ids=None) -> NodeTable:
    nodes = NodeTable(classes.shape[1])
    for index in range(len(means)):
        slot = nodes.add(index + 1 if ids is None else int(ids[index]))
        nodes.put(slot, means[index], covariances[index], classes[index], 1.0, 1)
    return nodes


def search(mean, covariance, classes, nodes, delta_g=0.7, delta_c=0.8, skipped=-1) -> int:
    item = observed(mean, covariance, classes)
    return nearest_slot(item, nodes, bhattacharyya_bound(delta_g), delta_c, skipped)


@given(seeds, st.sampled_from([0.05, 0.3, 0.7, 0.95]), st.sampled_from([0.2, 0.8, 1.0]))
def test_the_kernel_equals_linalg(seed: int, delta_g: float, delta_c: float) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 60))
    spread_m = 10 ** rng.uniform(-3, 1)
    means = rng.normal(0, spread_m, (count, 3))
    covariances, classes = random_covariances(rng, count), random_classes(rng, count)
    # Some stand very near the observation, so that there is something to find.
    mean = rng.normal(0, spread_m, 3)
    covariance = random_covariances(rng, 1)[0]
    near = rng.random(count) < 0.3
    means[near] = mean + rng.normal(0, 0.01, (near.sum(), 3))
    covariances[near] = covariance * np.exp(rng.normal(0, 0.5, (near.sum(), 1, 1)))
    probabilities = random_classes(rng, 1)[0]
    skipped = int(rng.integers(-1, max(count, 1)))

    distances = hellinger_distance(mean, covariance, means, covariances)
    passing = (distances < delta_g) & (1 - (probabilities * classes).sum(axis=1) < delta_c)
    passing &= np.arange(count) != skipped
    expected = int(np.where(passing, distances, np.inf).argmin()) if passing.any() else -1

    nodes = table_of(means, covariances, classes)
    found = search(mean, covariance, probabilities, nodes, delta_g, delta_c, skipped)
    if found != expected:
        # Only where rounding decides: at the threshold, or between two equally near.
        values = [distances[row] for row in (found, expected) if row >= 0]
        assert abs(values[0] - (values[1] if len(values) == 2 else delta_g)) < 1e-9


# --- the rule ------------------------------------------------------------------------------------

CERTAIN = np.array([0.97, 0.01, 0.01, 0.01])


def merge_all(frames: list[LocalGraph]) -> tuple[GlobalGraph, list[list[int]]]:
    graph = GlobalGraph(VOCABULARY, "world")
    merging = PaperMerging(MergingConfig())
    return graph, [merging.merge(graph, local) for local in frames]


def frame_of(
    stamp_ns: int, *x_m: float, deviation_m: float = 0.1, classes: np.ndarray = CERTAIN, **more
) -> LocalGraph:
    """Equal spheres on the x axis."""
    means = np.array([[x, 0.0, 0.0] for x in x_m]).reshape(-1, 3)
    covariances = np.tile(deviation_m**2 * np.eye(3), (len(means), 1, 1))
    return local_graph(stamp_ns, means, covariances, np.tile(classes, (len(means), 1)), **more)


def reference_of(frames: list[LocalGraph], margin: float) -> tuple[ReferenceMerging, list]:
    """Decisions within rounding of a threshold, which may fall either way, are left out."""
    config = MergingConfig()
    reference = ReferenceMerging(config.hellinger_threshold, config.class_distance_threshold)
    expected = [reference.merge(local) for local in frames]
    assume(reference.smallest_margin > margin)
    return reference, expected


@given(seeds)
@settings(max_examples=80)
def test_the_rule_equals_the_reference(seed: int) -> None:
    frames = random_local_graphs(np.random.default_rng(seed), 12)
    reference, expected = reference_of(frames, 1e-9)
    graph, ids = merge_all(frames)
    nodes, slots = graph.nodes, graph.nodes.slots
    assert ids == expected
    assert sorted(nodes.slot_of) == sorted(reference.nodes)
    for node_id, node in reference.nodes.items():
        slot = nodes.slot(node_id)
        columns = {
            "mean": nodes.means, "covariance": nodes.covariances,
            "classes": nodes.class_probabilities, "weight": nodes.weights,
        }  # fmt: skip
        for name, values in columns.items():
            np.testing.assert_allclose(values[slot], node[name], rtol=0, atol=1e-12)
        assert set(map(tuple, nodes.surface(slot).tolist())) == node["points"]
    assert set(graph.edges) == set(reference.edges)
    for pair, edge in reference.edges.items():
        np.testing.assert_allclose(graph.edges[pair].visual_logits, edge["logits"], atol=1e-9)
        assert graph.edges[pair].frames == edge["frames"]
    for gone, kept in graph.take_removals().items():
        assert kept == reference.resolve(gone)
    # What else holds of the graph.
    determinants = np.linalg.slogdet(nodes.covariances[slots])[1]
    np.testing.assert_allclose(nodes.log_determinants[slots], determinants, atol=1e-9)
    assert (nodes.covariances == nodes.covariances.swapaxes(1, 2)).all()
    largest = np.linalg.eigvalsh(nodes.covariances).max(axis=1, initial=0)
    assert (nodes.eigenvalue_bounds >= largest * (1 - 1e-12)).all()
    assert (nodes.first_seen_ns <= nodes.last_seen_ns).all()
    for local, row_ids in zip(frames, ids):
        assert graph.nodes_of_frame(local.stamp_ns) == [graph.resolve(item) for item in row_ids]


def test_the_nearest_node_wins_and_of_equals_the_oldest() -> None:
    for x_m, removed, at in (((0.3, -0.3, 1.3), None, -0.05), ((5.0, 0.3, -0.3), 1, 0.0)):
        graph, merging = GlobalGraph(VOCABULARY, "world"), PaperMerging(MergingConfig())
        for x in x_m:
            graph.add_node(np.array([x, 0, 0]), 0.12**2 * np.eye(3), CERTAIN, 0)
        if removed is not None:
            graph.remove_node(removed)  # its slot is free
        assert merging.merge(graph, frame_of(1, at, deviation_m=0.2)) == [2]
