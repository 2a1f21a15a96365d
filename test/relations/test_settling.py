"""Relations settled around what changed, against the rules for all pairs at once."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit
from support.reference_near import near_probabilities

from deworldsg_ros.relations.pairs import link
from deworldsg_ros.relations.rules import (
    CARRIED_FIRST,
    CARRIED_SECOND,
    MOST,
    NEAR_CERTAINTY,
    one_support,
    settle,
)
from deworldsg_ros.relations.states import NEAR, NONE, RELATIONS_OF_STATE, STATE_COUNT

seeds = st.integers(0, 10_000)


class Scene:
    """Random pairs of objects; `settle` follows what changed."""

    def __init__(self, rng: np.random.Generator, count: int) -> None:
        first, second = np.triu_indices(count, 1)
        chosen = rng.random(len(first)) < 0.6
        self.pairs = np.ascontiguousarray(np.column_stack([first, second])[chosen], np.int64)
        m = len(self.pairs)
        self.first_links, self.links = np.zeros(count, np.int64), np.zeros((m, 2), np.int64)
        for row in range(m):
            link(self.first_links, self.links, self.pairs, row)
        self.states, self.gaps_m = np.zeros((m, STATE_COUNT)), np.zeros(m)
        self.bottoms_m, self.centres_m = np.zeros(m), np.zeros(m)
        self.near_votes, self.with_ = np.zeros(m), np.zeros((m, 2), np.bool_)
        self.floor_odds = np.exp(rng.normal(0, 3, count))
        self.carried, self.kept = np.zeros((m, 2)), np.zeros((m, 2))
        self.near, self.relations = np.zeros(m), np.zeros((m, 2, NONE + 1))
        self.eligible, self.close = np.zeros(m, np.bool_), np.zeros((m, 2), np.bool_)
        self.on_floor, self.totals, self.shares = (np.zeros(count) for _ in range(3))
        self.marks, self.live = np.zeros(count, np.bool_), np.ones(m, np.bool_)
        self.circles: list[set[int]] = []

    def change(self, rng: np.random.Generator, rows: np.ndarray) -> None:
        count = len(rows)
        self.states[rows] = rng.dirichlet(np.full(STATE_COUNT, 0.15), count)
        self.gaps_m[rows] = np.where(rng.random(count) < 0.2, np.inf, rng.uniform(0, 0.6, count))
        self.bottoms_m[rows] = rng.normal(0, 0.08, count)
        self.centres_m[rows] = rng.uniform(0, 1, count)
        self.near_votes[rows] = rng.normal(0, 1, count)
        self.with_[rows] = rng.random((count, 2)) < 0.1
        carried = [self.states[rows][:, s].sum(1) for s in (CARRIED_FIRST, CARRIED_SECOND)]
        self.carried[rows] = np.minimum(np.column_stack(carried), MOST)

    def settle(self, rows: np.ndarray) -> np.ndarray:
        """As `RobustBeliefs` does; returns the rows whose relations changed."""
        lists = (self.pairs, self.links, self.first_links)
        objects = np.unique(self.pairs[rows])
        for circle in self.circles:
            if circle & set(objects.tolist()):
                objects = np.union1d(objects, np.array(sorted(circle)))
        cut, changed = settle(
            objects, self.states, self.carried, self.kept, self.floor_odds, self.on_floor,
            self.totals, self.gaps_m, self.bottoms_m, self.centres_m, self.with_, self.near,
            self.eligible, self.shares, self.marks, self.close, self.near_votes, self.live,
            self.relations, *lists,
        )  # fmt: skip
        for place in cut.tolist():
            # More objects than those of the circle do no harm.
            self.circles.append(set(range(len(self.totals))))
            assert self.kept[place >> 1, place & 1] <= 0.5
        assert not self.marks.any() and not self.shares.any()
        assert len(set(changed.tolist())) == len(changed)
        return changed

    def reference(self) -> np.ndarray:
        """The relations of all pairs, by the rules for all pairs at once."""
        states, kept, on_floor = one_support(self.states, self.pairs, self.floor_odds)
        near = near_probabilities(
            self.pairs, kept, on_floor, self.gaps_m, self.bottoms_m, self.centres_m, states[:, 0],
            self.with_.any(axis=1),
        )  # fmt: skip
        near = np.clip(near, 1.0 - NEAR_CERTAINTY, NEAR_CERTAINTY)
        near = expit(logit(near) + self.near_votes)
        relations = np.zeros(self.relations.shape)
        for end in (0, 1):
            for state in range(1, STATE_COUNT):
                relations[:, end, RELATIONS_OF_STATE[state, end]] += states[:, state]
            relations[:, end, NEAR] = states[:, 0] * near
            relations[:, end, NONE] += states[:, 0] * (1.0 - near)
        return relations


@settings(max_examples=60, deadline=None)
@given(seed=seeds, count=st.integers(2, 9))
def test_relations_that_follow_are_those_of_all_pairs_at_once(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    scene = Scene(rng, count)
    every = np.arange(len(scene.pairs))
    scene.change(rng, every)
    scene.settle(every)
    np.testing.assert_allclose(scene.relations, scene.reference(), atol=1e-9)
    for _ in range(8):
        rows = every[rng.random(len(every)) < 0.2]
        if not len(rows):
            continue
        before = scene.relations.copy()
        scene.change(rng, rows)
        changed = scene.settle(rows)
        np.testing.assert_allclose(scene.relations, scene.reference(), atol=1e-9)
        differs = (scene.relations != before).any(axis=(1, 2))
        assert set(np.flatnonzero(differs).tolist()) <= set(changed.tolist())
