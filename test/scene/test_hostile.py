"""Local graphs of the worst values that the schema allows leave a graph whole, and publishable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.hostile import (
    STEPS_NS,
    VOCABULARY,
    check_published,
    hostile_evidence,
    hostile_local_graph,
    state_of,
)

from deworldsg_ros.config import Config, MergingConfig, RelationsConfig
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, Relations, Vocabulary
from deworldsg_ros.scene.limits import MAX_LOGIT
from deworldsg_ros.wire.follow import GraphReplica

PAPER = Config(
    merging=MergingConfig(association="paper"),
    relations=RelationsConfig(edge_belief="paper", world_model="none"),
)
CONFIGS = {"paper": PAPER, "default": Config()}
seeds = st.integers(0, 2**32 - 1)


def fields_of(local: LocalGraph) -> dict:
    return {name: getattr(local, name) for name in local.__dataclass_fields__}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=list(CONFIGS))
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_hostile_graphs_are_merged_and_published(config: Config, seed: int) -> None:
    rng = np.random.default_rng(seed)
    builder, replica = GraphBuilder(config, VOCABULARY, "map"), GraphReplica()
    stamp_ns = 0
    for _ in range(8):
        stamp_ns = min(stamp_ns + int(rng.choice(STEPS_NS)), 2**31 * 10**9 - 1)
        local = hostile_local_graph(rng, stamp_ns)
        try:
            builder.integrate(local)
            builder.add_evidence(hostile_evidence(rng, local))
        except RefusedInput as refusal:
            assert refusal.reason in ("out_of_order", "unknown_frame")
        check_published(builder, replica)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=list(CONFIGS))
def test_a_refused_local_graph_leaves_the_graph_as_it_was(config: Config) -> None:
    rng = np.random.default_rng(7)
    builder = GraphBuilder(config, VOCABULARY, "map")
    for frame in range(1, 6):
        builder.integrate(hostile_local_graph(rng, frame * 10**8))
    builder.update()
    good, before = hostile_local_graph(rng, 6 * 10**8), state_of(builder)
    other = Vocabulary(("a", "b", "c", "d"), VOCABULARY.predicates)
    for change, reason in (
        ({"stamp_ns": 5 * 10**8}, "out_of_order"),
        ({"stamp_ns": 4 * 10**8}, "out_of_order"),
        ({"frame_id": "odom"}, "wrong_frame"),
        ({"vocabulary": other}, "vocabulary_mismatch"),
    ):
        with pytest.raises(RefusedInput) as refused:
            builder.integrate(replace(good, **change))
        assert refused.value.reason == reason
        assert state_of(builder) == before
        assert builder.update() is None


HOSTILE_VALUES = [
    ("pixel_counts", lambda local: local.pixel_counts * 0),
    ("covariances_world", lambda local: local.covariances_world * 1e300),
    ("covariances_world", lambda local: local.covariances_world * 0),
    ("means_world", lambda local: local.means_world + np.nan),
    ("scores", lambda local: local.scores + 2),
    ("class_probabilities", lambda local: local.class_probabilities * 2),
    ("boxes_xyxy", lambda local: local.boxes_xyxy[:, [2, 3, 0, 1]] - [0, 0, 1, 1]),
    ("instance_ids", lambda local: local.instance_ids * 0 + 1),
    ("T_world_camera", lambda local: np.diag([2.0, 2.0, 2.0, 1.0])),
]


@pytest.mark.parametrize(("name", "change"), HOSTILE_VALUES)
def test_a_local_graph_that_the_schema_excludes_does_not_exist(name, change) -> None:
    rng = np.random.default_rng(1)
    local = next(g for g in (hostile_local_graph(rng, 1) for _ in range(50)) if len(g) > 2)
    with pytest.raises(ValueError):
        LocalGraph(**{**fields_of(local), name: change(local)})


@pytest.mark.parametrize("config", CONFIGS.values(), ids=list(CONFIGS))
def test_the_largest_logits_stay_numbers(config: Config) -> None:
    rng = np.random.default_rng(3)
    local = next(g for g in (hostile_local_graph(rng, 1) for _ in range(50)) if len(g) > 1)
    logits = np.array([[MAX_LOGIT, -MAX_LOGIT, MAX_LOGIT]])
    relations = Relations(np.array([[0, 1]]), logits, np.ones(1))
    builder, replica = GraphBuilder(config, VOCABULARY, "map"), GraphReplica()
    for stamp_ns in range(1, 30):
        builder.integrate(replace(local, stamp_ns=stamp_ns * 10**8, relations=relations))
        check_published(builder, replica)
    with pytest.raises(ValueError, match="logits"):
        Relations(np.array([[0, 1]]), logits * 1e300, np.ones(1))
