"""Match scores against their formulas, the assignment, and the evidence for merging nodes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from support.merging import local_graph, random_classes, random_covariances, seeds

from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging import matching
from deworldsg_ros.scene.gaussian import bhattacharyya_distance

OVERLAP_THRESHOLD = 0.3
CELL_M = 0.03


def deviations(difference: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.sqrt(difference @ np.linalg.solve(covariance, difference)))


@given(seeds)
def test_match_scores_equal_the_formulas(seed: int) -> None:
    rng = np.random.default_rng(seed)
    local = local_graph(
        1, rng.normal(0, 0.3, (4, 3)), random_covariances(rng, 4, 0.01), random_classes(rng, 4)
    )
    nodes = NodeTable(4)
    for index in range(5):
        covariance, classes = random_covariances(rng, 1, 0.01)[0], random_classes(rng, 1)[0]
        nodes.put(nodes.add(index + 1), rng.normal(0, 0.3, 3), covariance, classes, 1.0, 1)
    rows = rng.permutation(5)[:3]
    on_nodes, covered = rng.uniform(0, 1, (2, 4, 3))
    matches = matching.match(local, nodes, rows, on_nodes, covered, OVERLAP_THRESHOLD, CELL_M)
    blur = CELL_M**2 / 12 * np.eye(3)
    for index, column in np.ndindex(4, 3):
        row = rows[column]
        agreement = local.class_probabilities[index] @ nodes.class_probabilities[row]
        same = agreement > matching.CLASS_AGREEMENT
        fractions = on_nodes[index, column], covered[index, column]
        overlap, alike = max(fractions), same or min(fractions) >= matching.MIN_FRACTION_OTHER_CLASS
        threshold = OVERLAP_THRESHOLD if same else matching.OVERLAP_THRESHOLD_OTHER_CLASS
        ours, theirs = local.covariances_world[index] + blur, nodes.covariances[row] + blur
        difference = local.means_world[index] - nodes.means[row]
        apart = min(deviations(difference, ours), deviations(difference, theirs))
        distance = bhattacharyya_distance(local.means_world[index], ours, nodes.means[row], theirs)
        score = (
            overlap
            + matching.CLASS_WEIGHT * agreement
            + matching.GAUSSIAN_WEIGHT * np.exp(-distance)
        )
        possible = overlap >= threshold and alike and apart <= matching.MAX_DEVIATIONS
        assert matches.scores[index, column] == pytest.approx(score if possible else 0.0, abs=1e-9)
        assert matches.touching[index, column] == same
    assert matches.columns == matching.one_to_one(matches.scores)
    assert matches.slots is rows and matches.on_nodes is on_nodes


def test_a_frame_without_objects_has_no_matches() -> None:
    empty = local_graph(1, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 4)))
    none = np.zeros(0, np.int64), np.zeros((0, 0)), np.zeros((0, 0))
    matches = matching.match(empty, NodeTable(4), *none, OVERLAP_THRESHOLD, CELL_M)
    assert matches.scores.shape == matches.touching.shape == (0, 0)
    assert matches.columns == []
    assert matching.one_to_one(np.zeros((2, 0))) == [-1, -1]


@given(seeds, st.integers(0, 9), st.integers(0, 9), st.sampled_from([3, 10**6]))
@settings(max_examples=200)
def test_the_assignment_is_that_of_scipy_ties_too(
    seed: int, count: int, width: int, levels: int
) -> None:
    scores = np.random.default_rng(seed).integers(levels, size=(count, width)) / 7.0
    rows, columns = linear_sum_assignment(scores, maximize=True)
    expected = np.full(count, -1)
    expected[rows] = columns
    assert matching.assign(scores).tolist() == expected.tolist()
    matched = np.array(matching.one_to_one(scores), np.int64)
    taken = matched >= 0
    total = scores[np.flatnonzero(taken), matched[taken]]
    assert (total > 0).all() and total.sum() == pytest.approx(scores[rows, columns].sum())


def add_frame(
    evidence: matching.JointEvidence,
    seen: list[int],
    known: list[int],
    match_scores: ArrayLike,
    touching: ArrayLike | None = None,
    camera_m: float = 0.0,
    on_nodes: float = 0.0,
    boxes: ArrayLike | None = None,
    score: float = 0.9,
) -> None:
    """One frame of objects; unless told, each touches the slots with which it has a score."""
    shape = len(seen), len(known)
    scores = np.array(match_scores, float).reshape(shape)
    touching = scores > 0 if touching is None else np.array(touching, bool).reshape(shape)
    matched = [known.index(slot) if slot in known else -1 for slot in seen]
    on = np.full(shape, on_nodes)
    matches = matching.Matches(np.array(known), on, scores, touching, matched)
    boxes = np.zeros((len(seen), 4)) if boxes is None else np.array(boxes, float)
    camera_world = np.array([camera_m, 0, 0])
    evidence.add_frame(seen, matches, np.full(len(seen), score), boxes, camera_world)


BOTH = ([4], [4, 7], [[1, 1]])
APART = ([4, 7], [4, 7], [[1, 0], [0, 1]])


@pytest.mark.parametrize(
    ("frames", "needed"),
    [
        pytest.param([BOTH] * 3, 3, id="overlaps"),
        pytest.param([([4], [4, 7], [[1, 0]], [[1, 1]])] * 9, 9, id="touching"),
    ],
)
def test_evidence_for_one_object(frames: list[tuple], needed: int) -> None:
    evidence = matching.JointEvidence()
    for number, frame in enumerate(frames, start=1):
        add_frame(evidence, *frame)
        assert evidence.next_merge() == ((4, 7) if number == needed else None)
    evidence.forget(7)
    assert evidence.next_merge() is None and evidence.balances == {}


def test_a_viewpoint_says_once_that_two_objects_are_two_and_once_that_they_are_one() -> None:
    evidence = matching.JointEvidence()
    for frame in [APART] * 3 + [BOTH] * 20:
        add_frame(evidence, *frame)
    assert evidence.balances == {(4, 7): matching.MERGE_THRESHOLD - matching.SEPARATE_WEIGHT}
    # One viewpoint that shows both outweighs three that show one object.
    for number in range(1, 5):
        assert evidence.next_merge() is None
        add_frame(evidence, *BOTH, camera_m=number * 1.5 * matching.WIDE_STEP_M)
    assert evidence.next_merge() == (4, 7)


@pytest.mark.parametrize(
    ("inner", "on_nodes", "score", "balance"),
    [
        pytest.param([2, 2, 9, 9], 0.8, 0.7, 0, id="a second box on an object"),
        pytest.param([2, 2, 25, 9], 0.8, 0.7, -30, id="boxes side by side"),
        pytest.param([2, 2, 9, 9], 0.5, 0.7, -30, id="surfaces side by side"),
        pytest.param([2, 2, 9, 9], 0.8, 0.8, -30, id="two certain objects"),
    ],
)
def test_a_sure_box_within_another_one(
    inner: list[int], on_nodes: float, score: float, balance: int
) -> None:
    evidence = matching.JointEvidence()
    touching, boxes = np.ones((2, 2), bool), [[0, 0, 10, 10], inner]
    add_frame(evidence, *APART, touching, on_nodes=on_nodes, boxes=boxes, score=score)
    assert evidence.balances == {(4, 7): balance}


def test_after_a_wide_step_one_frame_that_overlaps_both_is_enough() -> None:
    evidence = matching.JointEvidence()
    add_frame(evidence, [4], [4], [[1]])
    add_frame(evidence, *BOTH, camera_m=0.9 * matching.WIDE_STEP_M)
    assert evidence.next_merge() is None
    add_frame(evidence, [4], [4, 8], [[1, 1]], camera_m=2 * matching.WIDE_STEP_M)
    assert evidence.next_merge() == (4, 8)


def test_a_merged_node_keeps_the_separations_of_both_parts() -> None:
    evidence = matching.JointEvidence()
    add_frame(evidence, [1, 3], [], [[], []])  # new nodes are separate, too
    add_frame(evidence, [2, 3], [3], [[0], [1]])
    assert evidence.balances == {
        (1, 3): -matching.SEPARATE_WEIGHT,
        (2, 3): -matching.SEPARATE_WEIGHT,
    }
    evidence.merge(1, 2)
    assert evidence.balances == {(1, 3): -2 * matching.SEPARATE_WEIGHT}


def test_a_node_that_overlaps_two_separate_nodes_merges_with_one_only() -> None:
    evidence = matching.JointEvidence()
    add_frame(evidence, [2, 3], [], [[], []])
    for _ in range(3):
        add_frame(evidence, [1], [1, 2, 3], [[1, 1, 1]])
    pair = evidence.next_merge()
    assert pair in {(1, 2), (1, 3)}
    evidence.merge(*pair)
    assert evidence.next_merge() is None
