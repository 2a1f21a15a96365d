"""Objects of two graphs that are one: only near pairs are compared, with the same result."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from support.view import make_graph, make_node

from deworldsg_ros.client import SceneGraph, changes, combine
from deworldsg_ros.client.objects import SceneObject


def objects(count: int, seed: int) -> list[SceneObject]:
    rng = np.random.default_rng(seed)
    nodes = [
        make_node(
            number,
            ("cup", "chair", "lamp")[rng.integers(3)],
            tuple(rng.uniform(0.0, 3.0, 3).round(3).tolist()),
            np.diag(rng.uniform(0.001, 0.1, 3)),
        )
        for number in range(1, count + 1)
    ]
    return list(SceneGraph(make_graph(nodes)))


@pytest.mark.parametrize("counts", [(0, 0), (0, 3), (1, 1), (3, 8), (40, 60), (60, 40)])
def test_the_assignment_is_that_of_all_pairs(counts: tuple[int, int]) -> None:
    before, after = objects(counts[0], 1), objects(counts[1], 2)
    table = np.array([[changes._place_cost(a, b) for b in after] for a in before])
    table = table.reshape(len(before), len(after))
    rows, columns = linear_sum_assignment(np.where(np.isfinite(table), table, 1e6))
    expected = [
        (before[a].id, after[b].id) for a, b in zip(rows, columns) if np.isfinite(table[a, b])
    ]
    found = [(pair.before.id, pair.after.id) for pair in changes.matched_by_place(before, after)]
    assert found == expected
    assert len(found) > 5 or min(counts) < 40


@pytest.mark.parametrize("offset_m", [0.0, -1e4, 1e4])
def test_scores_of_a_motion_are_those_of_all_pairs(offset_m: float) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 3, (50, 3)) + offset_m, rng.uniform(0, 3, (40, 3))
    of_a, of_b, rarity = rng.integers(0, 4, 50), rng.integers(0, 5, 40), rng.uniform(0.1, 1, 40)
    scene, others = combine._Scene(a, of_a), combine._Objects(b, of_b, rarity)
    for _ in range(10):
        motion = np.array([rng.uniform(-3, 3), *rng.uniform(-1, 1, 3) + offset_m])
        gaps = np.linalg.norm(a[:, None] - others.moved(motion)[None], axis=2)
        gaps[of_a[:, None] != of_b[None]] = np.inf
        near = np.clip(1.0 - gaps.min(axis=0) / (2 * combine.REACH_M), 0.0, 1.0)
        scores = combine._scores([motion, motion + 100.0, motion], scene, others)
        assert scores == pytest.approx([rarity @ near, 0.0, rarity @ near], abs=1e-9)
        expected = []
        gaps[gaps > combine.REACH_M] = np.inf
        while np.isfinite(gaps.min()):
            row, column = divmod(int(gaps.argmin()), gaps.shape[1])
            expected.append((row, column))
            gaps[row], gaps[:, column] = np.inf, np.inf
        assert combine._matches(motion, scene, others) == expected


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_pairs_of_rare_objects_come_first(count: int) -> None:
    every = [(a, b) for a in range(count) for b in range(a + 1, count)]
    assert list(combine._pairs(count)) == sorted(every, key=sum)
