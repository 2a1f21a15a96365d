"""The part of a graph in a region is what a filter by hand gives."""

import random
from collections.abc import Iterator
from typing import Any

import pytest
from support.view import box_at, make_edge, make_graph, make_node, random_graphs, updates_of

from deworldsg_ros.client.live import Region, RegionPart
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import ChangeLog, GraphReplica

HERE = Region((0.0, 0.0, 0.0), 2.0)
CUPS = Region((0.0, 0.0, 0.0), 2.0, ("cup", "tables"))
CALLED = {"cup": ["cup"], "tables": ["table", "dining table"]}


def node(node_id: int, x: float, label: str = "cup") -> wire.NodeState:
    """An object whose box has its centre at (x, 0, 0); its Gaussian is elsewhere."""
    return make_node(node_id, label, (99.0, 0.0, 0.0), box=box_at((x, 0, 0)))


def filtered(
    graph: wire.SceneGraphMessage, region: Region
) -> tuple[list[wire.NodeState], list[wire.EdgeState]]:
    """The part of a whole graph, by hand."""
    wanted = [name for asked in region.classes for name in CALLED[asked]]
    assert region.center is not None
    nodes = [
        item
        for item in graph.nodes
        if abs(item.box.center_m[0] - region.center[0]) <= region.radius_m
        and (not wanted or item.label in wanted)
    ]
    ids = {item.id for item in nodes}
    return nodes, [item for item in graph.edges if {item.subject, item.object} <= ids]


def sessions(seed: int) -> Iterator[tuple[Any, wire.SceneGraphMessage]]:
    """Messages of three sessions with the graph after each; some messages are whole graphs."""
    rng = random.Random(seed)
    places_m = [rng.uniform(-4, 4) for _ in range(20)]
    for session in "abc":
        graphs = random_graphs(
            rng.random(), 24, ["cup", "dining table", "chair"], places_m, session
        )
        for update, now in zip(updates_of(graphs), graphs[1:]):
            yield now if rng.random() < 0.15 else update, now


@pytest.mark.parametrize("region", [HERE, CUPS])
@pytest.mark.parametrize("seed", range(4))
def test_a_client_of_the_part_has_the_filtered_graph(seed, region):
    part, log, client = RegionPart(region), ChangeLog(), GraphReplica()
    rng, published = random.Random(seed), 0
    for message, whole in sessions(seed):
        part.add(message)
        if rng.random() < 0.2:
            region = Region((rng.uniform(-3, 3), 0.0, 0.0), rng.uniform(0.5, 4), region.classes)
            part.move(region)
        if rng.random() < 0.3:
            continue  # a client that is told less often
        graph = part.message()
        if graph is not None:
            published += 1
            log.set(graph)
            update = log.since(client.session, client.sequence)
            assert update is not None and client.apply(update)
        mine = client.message()
        assert (mine.nodes, mine.edges) == filtered(whole, region)
        assert part.size == len(mine.nodes)
    assert 20 < published < 72


def test_what_happens_outside_is_not_told():
    def graph(sequence, x, probability):
        nodes = [node(1, 0.0), node(2, 1.0), node(3, x)]
        edges = [make_edge(1, 2), make_edge(1, 3, probability=probability)]
        return make_graph(nodes, edges, sequence=sequence, session="s")

    part, graphs = RegionPart(HERE), [graph(1, 9.0, 0.8), graph(2, 8.0, 0.5), graph(3, 1.5, 0.5)]
    outside, entering = updates_of(graphs)
    part.add(graphs[0])
    first = part.message()
    assert first is not None and [item.id for item in first.nodes] == [1, 2]
    assert [(item.subject, item.object) for item in first.edges] == [(1, 2)]
    assert part.message() is None
    part.add(outside)
    assert part.message() is None
    part.add(entering)
    entered = part.message()
    assert entered is not None and len(entered.nodes) == 3 and len(entered.edges) == 2
    assert (entered.session, entered.sequence) == (first.session, 2)
