"""A map of any graph that accepted messages can make is read again, and clients read its graph."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.hostile import STEPS_NS, VOCABULARY, hostile_evidence, hostile_local_graph

from deworldsg_ros.config import Config, MergingConfig, OutputConfig, RelationsConfig
from deworldsg_ros.graph.edits import DeleteNode, EditRequest, MergeNodes, SetLabel, SplitNode, Undo
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.scene import limits
from deworldsg_ros.scene.camera import rigid_motion
from deworldsg_ros.scene.checks import SUM_TOLERANCE
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, Relations
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import local_graph_from_message, local_graph_to_message

ALL = OutputConfig(min_existence=0.0)
CONFIGS = {
    "surface": Config(),
    "all nodes": Config(output=ALL),
    "paper": Config(
        merging=MergingConfig(association="paper"),
        relations=RelationsConfig(edge_belief="paper", world_model="none"),
    ),
}
LATEST_NS = limits.MAX_SECONDS * 10**9 + 10**9 - 1
STEPS = [*STEPS_NS, 2 * 10**8, -(10**10), -LATEST_NS, LATEST_NS]
CASES = 120


def rough(rng: np.random.Generator, local: LocalGraph) -> LocalGraph:
    """A local graph with the largest errors of sums, rotations and scores that are accepted."""
    error = rng.choice([0.0, 1.0, -1.0]) * 0.999 * SUM_TOLERANCE
    pose = local.T_world_camera.copy()
    pose[:3, :3] *= rng.choice([1.0, 1.00049, 0.99951])
    pairs, logits, scores = (
        np.repeat(values, 2, axis=0)
        for values in (local.relations.pairs, local.relations.logits, local.relations.scores)
    )
    return replace(
        local,
        class_probabilities=np.minimum(local.class_probabilities * (1 + error), 1.0 + 1e-9),
        T_world_camera=pose,
        scores=np.where(local.scores == 1.0, 1.0 + 1e-9, local.scores),
        relations=Relations(pairs, logits, scores),
    )


def sent(local: LocalGraph) -> LocalGraph:
    """A local graph as graph_node gets it."""
    text = wire.encode(local_graph_to_message(local))
    return local_graph_from_message(wire.decode(text, wire.LocalGraphMessage))


def hostile_edit(rng: np.random.Generator, builder: GraphBuilder) -> EditRequest:
    ids = list(builder.graph.nodes.slot_of) or [1]
    a, b = (int(rng.choice(ids)) for _ in range(2))
    edits = [SetLabel(a, "é" * 256), DeleteNode(a), MergeNodes([a, b]), SplitNode(a), Undo()]
    return edits[int(rng.integers(len(edits)))]


def hostile_builder(config: Config, rng: np.random.Generator) -> GraphBuilder:
    """A graph of frames, edits and corrections, with a clock that is set back and forth."""
    builder = GraphBuilder(config, VOCABULARY, "map")
    stamp_ns = int(rng.choice([0, 10**9, LATEST_NS]))
    local = rough(rng, hostile_local_graph(rng, stamp_ns))
    for _ in range(int(rng.integers(1, 12))):
        with suppress(RefusedInput):
            builder.integrate(sent(local))
            builder.add_evidence(hostile_evidence(rng, local))
        if rng.random() < 0.3:
            with suppress(RefusedInput):
                builder.edit(hostile_edit(rng, builder))
        if rng.random() < 0.1:
            move = rigid_motion(rng.choice([0.0, 0.5, -9999.0], 3), rng.normal(size=3))
            builder.apply_correction(move, int(rng.choice([0, stamp_ns])))
        stamp_ns = min(max(stamp_ns + int(rng.choice(STEPS)), 0), LATEST_NS)
        # Other objects, or the same ones again.
        local = replace(local, stamp_ns=stamp_ns)
        if rng.random() < 0.3:
            local = rough(rng, hostile_local_graph(rng, stamp_ns))
    return builder


def check_map(builder: GraphBuilder, config: Config, path: Path) -> None:
    write_map(builder, path)
    again = read_map(config, path)
    message = again.full()
    assert wire.decode(wire.encode(message), wire.SceneGraphMessage).nodes == message.nodes
    again.update()
    wire.decode(wire.encode(again.snapshot()), wire.SceneGraphMessage)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=list(CONFIGS))
def test_a_map_of_any_accepted_frames_is_read_again(config: Config, tmp_path: Path) -> None:
    for seed in range(CASES):
        check_map(hostile_builder(config, np.random.default_rng(seed)), config, tmp_path / "a.map")


def test_a_map_has_the_errors_that_frames_may_have(tmp_path: Path) -> None:
    """Poses with a few decimals, and a clock that starts again."""
    config, rng = CONFIGS["all nodes"], np.random.default_rng(0)
    builder = GraphBuilder(config, VOCABULARY, "map")
    first = next(g for g in (hostile_local_graph(rng, 1) for _ in range(50)) if len(g) > 3)
    for stamp_ns in 8 * [1, LATEST_NS]:
        pose = np.diag([1.00049, 1.00049, 1.00049, 1.0])
        builder.integrate(replace(first, stamp_ns=stamp_ns, T_world_camera=pose))
    assert len(builder.graph) >= 3
    check_map(builder, config, tmp_path / "a.map")


def test_a_map_has_the_largest_sums_of_logits(tmp_path: Path) -> None:
    config, rng = CONFIGS["paper"], np.random.default_rng(3)
    builder = GraphBuilder(config, VOCABULARY, "map")
    first = next(g for g in (hostile_local_graph(rng, 1) for _ in range(50)) if len(g) > 1)
    pairs = np.tile([[0, 1]], (limits.MAX_RELATIONS, 1))
    logits = np.full((len(pairs), 3), limits.MAX_LOGIT)
    builder.integrate(replace(first, relations=Relations(pairs, logits, np.ones(len(pairs)))))
    (pair,) = builder.graph.edges
    for _ in range(2000):  # as such frames would
        builder.graph.add_visual(*pair, logits.sum(axis=0), 1)
    check_map(builder, config, tmp_path / "a.map")
