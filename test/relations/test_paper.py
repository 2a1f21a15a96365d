"""Eq. 8 to 10, the prior of class pairs, and bounded logits, against obvious references."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import merging

from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.config import Config, RelationsConfig, load_config
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.relations import paper
from deworldsg_ros.scene.errors import RefusedInput

seeds = st.integers(0, 10_000)

# --- neighbours (Eq. 8) --------------------------------------------------------------------------

WIDTH, HEIGHT = 640, 480


@given(st.integers(0, 12), seeds)
def test_neighbours_are_those_of_the_loop_over_all_pairs(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, (WIDTH, HEIGHT), (count, 2, 2))
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    depths = rng.uniform(0.5, 2.0, count)
    expected = {}
    for i in range(count):
        for j in range(count):
            centres = [((x1 + x2) / 2, (y1 + y2) / 2) for x1, y1, x2, y2 in boxes[[i, j]].tolist()]
            cost = 0.5 * math.dist(*centres) / math.hypot(WIDTH, HEIGHT)
            cost += abs(depths[i] - depths[j])
            if i != j and cost < 0.45:
                expected[i, j] = cost
    pairs, costs = paper.neighbour_pairs(boxes, depths, WIDTH, HEIGHT, 0.45)
    assert pairs.shape == (len(pairs), 2) and pairs.dtype == np.int64
    assert [tuple(pair) for pair in pairs.tolist()] == sorted(expected)
    np.testing.assert_allclose(costs, [expected[key] for key in sorted(expected)], rtol=1e-12)


def test_costs_of_known_pairs_and_a_strict_threshold() -> None:
    corners = np.array([[0.0, 0, 0, 0], [WIDTH, HEIGHT, WIDTH, HEIGHT]])
    assert paper.geometric_costs(corners, np.array([1.0, 1.0]), WIDTH, HEIGHT)[0, 1] == 0.5
    one_place = np.zeros((2, 4)), np.array([1.0, 1.5]), WIDTH, HEIGHT
    assert len(paper.neighbour_pairs(*one_place, 0.5)[0]) == 0
    assert len(paper.neighbour_pairs(*one_place, np.nextafter(0.5, 1))[0]) == 2


# --- the visual distribution (Eq. 9) and its entropy ---------------------------------------------


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3, 1e6])
def test_visual_distribution_is_stable(scale: float) -> None:
    logits = scale * np.array([[1.0, -1.0, 0.5], [-1.0, -1.0, -1.0]])
    distribution = paper.visual_distribution(logits)
    assert np.isfinite(distribution).all() and (distribution[1] == 1 / 3).all()
    np.testing.assert_allclose(distribution.sum(axis=1), 1.0)
    np.testing.assert_allclose(paper.visual_distribution(logits + 500), distribution, atol=1e-10)


# --- fusion under uncertainty (Eq. 10) -----------------------------------------------------------


def random_edges(seed: int, edges: int = 7, predicates: int = 5):
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 2, (edges, predicates))
    priors = rng.dirichlet(np.ones(predicates), edges)
    return logits, rng.random(edges) < 0.6, priors, rng.random(edges) < 0.6


def reference(logits, prior, alpha: float, threshold: float):
    """Eq. 9 and 10 for one edge, in plain Python; None without an edge."""
    if logits is None and prior is None:
        return None
    width = len(prior if logits is None else logits)
    exponentials = [math.exp(value) for value in ([0.0] * width if logits is None else logits)]
    visual = [value / sum(exponentials) for value in exponentials]
    entropy = -sum(p * math.log(p) for p in visual if p > 0)
    if prior is None or alpha == 0 or not entropy > threshold:
        return None if logits is None else (visual, "visual", entropy)
    mixed = [v + alpha * p for v, p in zip(visual, prior)]
    fused = [value / sum(mixed) for value in mixed]
    return fused, "prior" if logits is None else "fused", entropy


@given(
    seeds,
    st.integers(1, 60),
    st.sampled_from([0.0, 0.5, 3.0]),
    st.sampled_from([0.0, 1.0, 1.5, 5.0]),
)
def test_fused_edges_equal_the_reference(seed, predicates, alpha, threshold) -> None:
    edges = random_edges(seed, predicates=predicates)
    fused = paper.fuse_edges(*edges, alpha, threshold)
    order = np.random.default_rng(seed).permutation(predicates)
    logits, seen, priors, told = edges
    permuted = paper.fuse_edges(logits[:, order], seen, priors[:, order], told, alpha, threshold)
    np.testing.assert_allclose(permuted.probabilities, fused.probabilities[:, order], rtol=1e-9)
    for row in range(len(seen)):
        args = (logits[row] if seen[row] else None, priors[row] if told[row] else None)
        wanted = reference(*args, alpha, threshold)
        assert fused.known[row] == (wanted is not None)
        # Updates and snapshots are computed over different sets of edges and must agree exactly.
        alone = paper.fuse_edges(*(part[row : row + 1] for part in edges), alpha, threshold)
        for name, values in vars(alone).items():
            np.testing.assert_array_equal(values[0], getattr(fused, name)[row])
        if wanted is None:
            continue
        np.testing.assert_allclose(fused.probabilities[row], wanted[0], rtol=1e-11)
        assert paper.PROVENANCES[fused.provenance_codes[row]] == wanted[1]
        assert fused.entropies_nats[row] == pytest.approx(wanted[2], abs=1e-12)


def test_the_gate_is_strict_at_the_threshold() -> None:
    logits, prior = np.array([[0.3, 0.1, -0.2]]), np.array([[0.7, 0.2, 0.1]])
    entropy = float(paper.entropy_nats(paper.visual_distribution(logits))[0])
    for threshold, provenance in ((entropy, "visual"), (math.nextafter(entropy, 0), "fused")):
        both = np.ones(1, bool)
        fused = paper.fuse_edges(logits, both, prior, both, 0.5, threshold)
        assert paper.PROVENANCES[fused.provenance_codes[0]] == provenance


# --- the prior of class pairs --------------------------------------------------------------------

CLASSES, PREDICATES = 4, 3
EVERY = np.argwhere(np.ones((CLASSES, CLASSES)))


def random_predictions(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, CLASSES, (count, 2)), rng.dirichlet(np.ones(PREDICATES), count)


def prior_of(*predictions: tuple[np.ndarray, np.ndarray]) -> paper.ClassPairPrior:
    prior = paper.ClassPairPrior(CLASSES, PREDICATES)
    for classes, values in predictions:
        prior.update(np.array(classes), np.array(values))
    return prior


ONE = ([[0, 1]], [[0.2, 0.3, 0.5]])


@given(st.integers(0, 40), seeds, st.integers(1, 7))
def test_the_prior_is_the_mean_in_any_order_and_any_portions(count, seed, portions) -> None:
    classes, predictions = random_predictions(count, seed)
    predictions[np.random.default_rng(seed).random(count) < 0.2] = np.nan  # no clip was encoded
    order = np.random.default_rng(seed + 1).permutation(count)
    whole = prior_of((classes, predictions))
    parts = prior_of(*((classes[p], predictions[p]) for p in np.array_split(order, portions)))
    np.testing.assert_allclose(whole.lookup(EVERY)[0], parts.lookup(EVERY)[0], rtol=1e-12)
    assert whole.to_state().counts == parts.to_state().counts
    for subject, object_ in EVERY.tolist():
        rows = (classes == [subject, object_]).all(axis=1) & ~np.isnan(predictions).any(axis=1)
        (mean,), (known,) = whole.lookup(np.array([[subject, object_]]))
        assert known == rows.any()
        if known:
            np.testing.assert_allclose(mean, predictions[rows].mean(axis=0), rtol=1e-12)
    assert len(whole) == whole.lookup(EVERY)[1].sum()


def test_saved_and_loaded_the_prior_is_the_same_and_goes_on() -> None:
    prior = prior_of(random_predictions(30, 5))
    saved = msgspec.json.encode(prior.to_state())
    loaded = paper.ClassPairPrior.from_state(msgspec.json.decode(saved, type=paper.PriorState))
    for _ in range(2):
        assert (loaded.lookup(EVERY)[0] == prior.lookup(EVERY)[0]).all()
        assert loaded.to_state() == prior.to_state()
        for one in (prior, loaded):
            one.update(*random_predictions(9, 6))


@pytest.mark.parametrize(
    ("classes", "predictions", "says"),
    [
        ([[0, 9]], ONE[1], "classes 0 to 9"),
        ([[-1, 0]], ONE[1], "classes -1 to 0"),
        ([[0, 1]], [[0.2, 0.3, 0.6]], "sums from 1.1 to 1.1"),
        ([[0, 1]], [[-0.5, 1.0, 0.5]], "minimum of -0.5"),
        ([[0, 1]], [[0.5, 0.5]], r"shape \(1, 2\): expected \(1, 3\)"),
    ],
)
def test_an_invalid_prediction_is_refused_and_changes_nothing(classes, predictions, says) -> None:
    prior = prior_of()
    with pytest.raises(RefusedInput, match=says) as refused:
        prior.update(np.array(classes), np.array(predictions))
    assert refused.value.reason == "invalid_prediction" and len(prior) == 0


@pytest.mark.parametrize(
    "change",
    [
        {"counts": [1, 2]},
        {"counts": [0]},
        {"class_pairs": [[0, 1], [0, 1]]},
        {"class_pairs": [[0, 7]]},
        {"sums": [[5.0, 0.0, 0.0]]},
    ],
)
def test_a_saved_state_that_does_not_fit_is_refused(change: dict[str, list]) -> None:
    with pytest.raises(ValueError):
        paper.ClassPairPrior.from_state(msgspec.structs.replace(prior_of(ONE).to_state(), **change))


def test_sums_that_differ_from_one_by_float32_rounding_are_normalised() -> None:
    prior = prior_of((ONE[0], np.array(ONE[1]) * 1.0005))
    np.testing.assert_allclose(prior.lookup(np.array(ONE[0]))[0], ONE[1], rtol=1e-12)


# --- the bounded evidence of one frame -----------------------------------------------------------


@given(seeds, st.sampled_from([0.01, 0.1, 0.5, 0.9]), st.sampled_from([1.0, 1e3, 1e300]))
def test_bounded_logits_are_those_of_a_mixture(seed: int, rate: float, scale: float) -> None:
    logits = np.random.default_rng(seed).normal(0, 4, (3, 6))
    for row, values in zip(logits.tolist(), paper.bounded_logits(logits, rate).tolist()):
        shares = [math.exp(value) for value in row]
        for value, share in zip(values, shares):
            told = (1 - rate) * share / sum(shares)
            assert value == pytest.approx(math.log(told + rate / 6), abs=1e-12)
    values = paper.bounded_logits(scale * logits[:1], rate)
    bound = math.log(1 + 6 * (1 - rate) / rate)
    assert np.isfinite(values).all() and np.ptp(values) <= bound * (1 + 1e-12)
    for shape in ((0, 5), (3, 0)):
        assert paper.bounded_logits(np.zeros(shape), rate).shape == shape


@pytest.mark.parametrize(("edge_belief", "rate"), [("paper", None), ("robust", paper.OUTLIER_RATE)])
def test_the_option_chooses_the_logits_that_are_summed(edge_belief: str, rate: float) -> None:
    logits = np.random.default_rng(0).normal(0, 5, (2, 3))
    seen = np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), np.full((2, 4), 0.25)
    local = merging.local_graph(1, *seen, pairs=[(0, 1), (1, 0)], logits=logits)
    config = Config(relations=RelationsConfig(edge_belief=edge_belief))
    builder = GraphBuilder(config, merging.VOCABULARY, "world")
    a, b = builder.integrate(local)
    expected = logits if rate is None else paper.bounded_logits(logits, rate)
    assert (builder.graph.edges[a, b].visual_logits == expected[0]).all()
    assert (builder.graph.edges[b, a].visual_logits == expected[1]).all()


@pytest.mark.parametrize("name", ["paper", "paper_rules", "released"])
def test_by_the_papers_text_a_relation_of_no_neighbours_is_no_edge(root_dir, name: str) -> None:
    """Of three objects, the last one is 4 m behind the others."""
    file = root_dir / "config" / f"{name}.yaml"
    builder = GraphBuilder(load_config(file), merging.VOCABULARY, "world")
    means = np.array([[0.0, 0, 2], [0.3, 0, 2], [0, 0, 6]])
    seen = means, np.tile(np.eye(3) * 1e-2, (3, 1, 1)), np.full((3, 4), 0.25)
    pairs, logits = [(0, 1), (0, 2), (2, 1)], np.tile([9.0, 0, 0], (3, 1))
    several = {"pairs": pairs, "logits": logits, "depths_m": means[:, 2]}
    a, b, far = builder.integrate(merging.local_graph(1, *seen, **several))
    frames = {pair: edge.frames for pair, edge in builder.graph.edges.items()}
    only_neighbours = name in ("paper", "paper_rules")
    assert frames == ({(a, b): 1} if only_neighbours else {(a, b): 1, (a, far): 1, (far, b): 1})
    known = {(item.node, item.other) for item in builder.frames.all(builder.graph) if item.other}
    assert known == frames.keys()  # where an edge comes from
    builder.configure(effective_config(file, ["relations.geo_cost_threshold=5"]))
    builder.integrate(merging.local_graph(2, *seen, **several))
    assert builder.graph.edges[a, far].frames == (1 if only_neighbours else 2)
