"""Questions to a graph with the index are answered as by a look at every object and relation."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
import pytest

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.client.boxes import gap_m
from deworldsg_ros.client.graph import _fits, distance_m
from deworldsg_ros.client.questions import ask
from deworldsg_ros.wire import messages as wire

LABELS = ["cup", "table", "dining table", "chair", "mug cup"]


@pytest.fixture(scope="module", params=["boxes", "some boxes"])
def graph(request: pytest.FixtureRequest) -> SceneGraph:
    """120 objects in 6 m x 6 m, 300 relations; some objects without a box, some without a class."""
    rng = np.random.default_rng(3)
    nodes, edges = [], []
    stamp = wire.stamp_from_ns(10**9)
    for number in range(1, 121):
        where = rng.uniform(-3, 3, 3).tolist()
        label, other = rng.choice(LABELS, 2, replace=False).tolist()
        angle = rng.uniform(0, math.pi)
        box = wire.GravityBox(
            where, rng.uniform(0.05, 1.5, 3).tolist(), [0.0, 0.0, math.sin(angle), math.cos(angle)]
        )
        nodes.append(
            wire.NodeState(
                id=number,
                label=label,
                classes=[wire.Belief(label, 0.6), wire.Belief(other, float(rng.uniform(0, 0.4)))],
                mean_m=where,
                covariance_m2=np.diag(rng.uniform(0.001, 0.1, 3)).ravel().tolist(),
                observations=3,
                first_seen=stamp,
                last_seen=stamp,
                existence=float(rng.uniform(0.3, 1.0)),
                box=box if request.param == "boxes" or number % 3 else msgspec.UNSET,
            )
        )
    for a, b in {tuple(rng.integers(1, 125, 2).tolist()) for _ in range(300)}:
        name = str(rng.choice(["on", "near", "under"]))
        p = float(rng.uniform(0.3, 0.9))
        edges.append(wire.EdgeState(a, b, name, p, [wire.Belief(name, p)], "visual", 0.1, 2))
    return SceneGraph(
        wire.SceneGraphMessage(
            schema=wire.schema_of(wire.SceneGraphMessage),
            stamp=stamp,
            frame_id="map",
            sequence=1,
            nodes=nodes,
            edges=edges,
        )
    )


@pytest.mark.parametrize("label", [None, "cup", "tables", "elephant"])
@pytest.mark.parametrize("least", [None, 0.0, 0.2, 0.5])
def test_objects(graph: SceneGraph, label: str | None, least: float | None) -> None:
    expected = {item.id for item in graph if _fits(item, label, least)}
    assert {item.id for item in graph.objects(label, min_probability=least)} == expected
    for near in ((0.5, -1.0, 0.2), graph[7], graph[9]):
        for within in (0.0, 0.3, 1.0, 20.0, None):
            found = graph.objects(label, near=near, within=within, min_probability=least)
            by_hand = sorted(
                (distance_m(graph[i], near), i) for i in expected if graph[i] is not near
            )
            assert [item.id for item in found] == [
                i for gap, i in by_hand if within is None or gap <= within
            ]


def test_neighbours(graph: SceneGraph) -> None:
    for item in list(graph)[:20]:
        gaps = sorted(
            (gap_m(item.footprint, other.footprint), other.id) for other in graph if other != item
        )
        found = [(gap, other.id) for other, gap in graph.neighbours(item, 0.4)]
        assert [i for _, i in found] == [i for gap, i in gaps if gap <= 0.4]
        assert [gap for gap, _ in found] == pytest.approx([gap for gap, _ in gaps if gap <= 0.4])


def test_relations(graph: SceneGraph) -> None:
    ends = [None, "cup", "table", 5, 9, 124]
    for predicate in (None, "on", "near"):
        everything = graph.relations(None, predicate)
        both_ways = everything + [
            relation
            for node_id in range(1, 121)
            for relation in graph.relations(node_id, predicate)
            if relation not in everything
        ]
        for subject, object_ in itertools.product(ends, ends):
            is_subject, is_object = graph._chooser(subject), graph._chooser(object_)
            forward = [r for r in everything if is_subject(r.subject) and is_object(r.object)]
            found = graph.relations(subject, predicate, object_)
            assert all(is_subject(r.subject) and is_object(r.object) for r in found)
            assert all(relation in found for relation in forward)
            assert all(relation in both_ways for relation in found)


@pytest.mark.parametrize(
    "question",
    [
        "cup on table",
        "cup near anything",
        "chair within 0.5 m of table",
        "anything near (0,0,0) within 1 m",
    ],
)
def test_words(graph: SceneGraph, question: str) -> None:
    answers = ask(graph, question).found
    assert answers
    items = {answer.item.id for answer in answers}
    if "(0" in question:
        expected = {item.id for item in graph.objects(near=(0.0, 0.0, 0.0), within=1.0)}
        assert items == {i for i in expected if graph[i].probability >= 0.05}
    elif "within" in question:
        tables = [item for item in graph if item.probability_of("table") >= 0.05]
        expected = {
            item.id
            for item in graph
            if any(
                other != item
                and gap_m(item.footprint, other.footprint) <= 0.5
                and item.probability_of("chair") * other.probability_of("table") >= 0.05
                for other in tables
            )
        }
        assert items == expected
