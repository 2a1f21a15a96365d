"""The messages of nodes: what version 2 adds."""

from __future__ import annotations

import numpy as np
import pytest
from support.merging import VOCABULARY
from support.node_states import node_states
from support.room_nodes import room, table, thing

from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph.messages import NodeStates
from deworldsg_ros.wire import messages as wire


def graph_of_one(points: np.ndarray) -> SceneGraph:
    graph = SceneGraph(VOCABULARY, "world")
    classes = np.array([0.5, 0.3, 0.15, 0.05])
    graph.add_node(points.mean(axis=0), np.cov(points.T), classes, 0, points.astype(np.float32))
    return graph


@pytest.fixture
def points() -> np.ndarray:
    """A slab: 0.6 x 0.4 x 0.1 m."""
    return np.random.default_rng(0).uniform(-0.5, 0.5, (300, 3)) * [0.6, 0.4, 0.1] + 1.0


def test_a_message_has_a_box_and_the_rest_of_its_classes(points: np.ndarray) -> None:
    (state,) = node_states(graph_of_one(points), 2, with_points=True).values()
    assert sum(belief.probability for belief in state.classes) == pytest.approx(0.8)
    assert state.remainder == pytest.approx(0.2)
    assert isinstance(state.box, wire.GravityBox)
    assert sorted(state.box.size_m) == pytest.approx([0.1, 0.4, 0.6], abs=0.04)
    assert len(surface_points(state)) == 300
    assert [len(str(value).split(".")[1]) <= 4 for value in state.mean_m] == [True] * 3
    assert np.linalg.eigvalsh(np.reshape(state.covariance_m2, (3, 3))).min() > 0
    sent = wire.msgspec.json.encode(state)
    assert b"surface_points_m" not in sent


def test_only_a_real_turn_of_up_makes_new_boxes(points: np.ndarray) -> None:
    states = NodeStates(graph_of_one(points), 2, even_gaussians=False)
    assert states.refresh() == [1]
    before = states.states[1]
    states.set_up(np.array([0.0, 0.01, 0.99995]))
    assert states.refresh() == []
    states.set_up(np.array([0.0, 1.0, 0.0]))
    assert states.refresh() == [1]
    after = states.states[1]
    assert (before.box.size_m[2], after.box.size_m[2]) == pytest.approx((0.1, 0.4), abs=0.04)


def test_extents_of_known_nodes_may_wait(points: np.ndarray) -> None:
    graph = SceneGraph(VOCABULARY, "world")
    classes, other = np.array([0.5, 0.3, 0.15, 0.05]), np.array([0.1, 0.8, 0.05, 0.05])
    for _ in range(3):
        graph.add_node(points.mean(axis=0), np.eye(3), classes, 1, points.astype(np.float32))
    states = NodeStates(graph, 2, even_gaussians=True)
    assert states.refresh(at_most=1) == [1, 2, 3]  # new nodes do not wait
    before = dict(states.states)
    T = np.eye(4)
    T[0, 3] = 1.0
    for node_id in (3, 1, 2):
        graph.move_node(node_id, T)
        graph.set_classes([node_id], other[None])
    assert states.refresh(at_most=1) == [1, 2, 3] and states.waiting == 2
    assert [state.label for state in states.states.values()] == ["table"] * 3
    moved = [states.states[i].mean_m[0] - before[i].mean_m[0] for i in (1, 2, 3)]
    assert moved == pytest.approx([1.0, 0.0, 0.0])
    assert states.states[2].box is before[2].box
    graph.observe(1, np.zeros(3), np.eye(3), classes, 2)  # no new points: nothing to measure
    assert states.refresh(at_most=1) == [1, 2] and states.waiting == 1
    graph.remove_node(3)
    assert states.refresh(at_most=1) == [3] and states.waiting == 0
    assert states.refresh() == []
    assert all(state.mean_m[0] > before[i].mean_m[0] + 0.9 for i, state in states.states.items())


def test_a_symmetric_relation_is_sent_once() -> None:
    builder, ids = room(
        {
            "table": table(0.0, 0.0),
            "cup": thing("cup", -0.05, 0.0, 0.74, 0.08, 0.08, 0.1),
            "bowl": thing("bowl", 0.1, 0.0, 0.74, 0.1, 0.1, 0.08),
        }
    )
    near = [edge for edge in builder.full().edges if edge.predicate == "near"]
    assert [(edge.subject, edge.object) for edge in near] == [(ids["cup"], ids["bowl"])]
    assert near[0].mutual is True
    on = [edge for edge in builder.full().edges if edge.predicate == "on"]
    assert {edge.subject for edge in on} == {ids["cup"], ids["bowl"]}
    assert all(edge.mutual is wire.msgspec.UNSET for edge in on)
    assert all(
        sum(belief.probability for belief in edge.predicates) + edge.remainder <= 1.001
        for edge in near + on
    )
