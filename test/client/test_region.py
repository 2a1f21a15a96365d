"""The part of a graph in a region is what a filter by hand gives."""

from __future__ import annotations

import random
from collections.abc import Iterator

import msgspec
import pytest
from support.reference_updates import diff
from support.view import make_graph, make_node

from deworldsg_ros.client.region import Region, RegionPart
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import ChangeLog, GraphReplica, empty_scene_graph

HERE = Region((0.0, 0.0, 0.0), 2.0)
CUPS = Region((0.0, 0.0, 0.0), 2.0, ("cup", "tables"))


def node(node_id: int, x: float, label: str = "cup") -> wire.NodeState:
    """An object whose box has its centre at (x, 0, 0); its Gaussian is elsewhere."""
    box = wire.GravityBox([x, 0.0, 0.0], [0.1, 0.1, 0.1], [0.0, 0.0, 0.0, 1.0])
    return msgspec.structs.replace(make_node(node_id, label, (99.0, 0.0, 0.0)), box=box)


def edge(a: int, b: int, probability: float = 0.75) -> wire.EdgeState:
    beliefs = [wire.Belief("on", probability)]
    return wire.EdgeState(a, b, "on", probability, beliefs, "visual", 0.1, 3)


def filtered(
    graph: wire.SceneGraphMessage, region: Region
) -> tuple[list[wire.NodeState], list[wire.EdgeState]]:
    """The part of a whole graph, by hand."""
    nodes = []
    for item in graph.nodes:
        assert isinstance(item.box, wire.GravityBox) and region.center is not None
        near = abs(item.box.center_m[0] - region.center[0]) <= region.radius_m
        called = {"cup": ["cup"], "tables": ["table", "dining table"]}
        wanted = [name for asked in region.classes for name in called[asked]]
        if near and (not wanted or item.label in wanted):
            nodes.append(item)
    ids = {item.id for item in nodes}
    return nodes, [item for item in graph.edges if {item.subject, item.object} <= ids]


def sessions(seed: int) -> Iterator[tuple[object, wire.SceneGraphMessage]]:
    """Messages of a graph with the graph after each; objects move, nodes come and go, restarts."""
    rng = random.Random(seed)
    for session in "abc":
        nodes: dict[int, wire.NodeState] = {}
        edges: dict[tuple[int, int], wire.EdgeState] = {}
        before = msgspec.structs.replace(empty_scene_graph("map"), session=session)
        for sequence in range(1, 25):
            for i in rng.sample(range(1, 13), rng.randint(0, 4)):
                label = rng.choice(["cup", "dining table", "chair"])
                nodes[i] = node(i, rng.uniform(-4, 4), label)
            for i in rng.sample(sorted(nodes), min(len(nodes), rng.randint(0, 1))):
                del nodes[i]
            edges = {pair: item for pair, item in edges.items() if set(pair) <= nodes.keys()}
            for _ in range(rng.randint(0, 5)):
                if len(nodes) > 1:
                    a, b = rng.sample(sorted(nodes), 2)
                    edges[a, b] = edge(a, b, rng.random())
            for pair in rng.sample(sorted(edges), min(len(edges), rng.randint(0, 1))):
                del edges[pair]
            now = msgspec.structs.replace(
                before,
                sequence=sequence,
                stamp=wire.stamp_from_ns(sequence * 10**9),
                nodes=[nodes[i] for i in sorted(nodes)],
                edges=[edges[pair] for pair in sorted(edges)],
            )
            if rng.random() < 0.15:
                yield now, now
            else:
                yield msgspec.structs.replace(diff(before, now), session=session), now
            before = now


@pytest.mark.parametrize("region", [HERE, CUPS])
@pytest.mark.parametrize("seed", range(4))
def test_a_client_of_the_part_has_the_filtered_graph(seed: int, region: Region) -> None:
    part, log, client = RegionPart(region), ChangeLog(), GraphReplica()
    rng, published = random.Random(seed), 0
    for message, whole in sessions(seed):
        part.add(message)  # type: ignore[arg-type]
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
        nodes, edges = filtered(whole, region)
        mine = client.message()
        assert (mine.nodes, mine.edges) == (nodes, edges)
        assert part.size == len(nodes)
    assert 20 < published < 72


def test_what_happens_outside_is_not_told() -> None:
    part = RegionPart(HERE)
    part.add(make_graph([node(1, 0.0), node(2, 1.0), node(3, 9.0)], [edge(1, 2), edge(1, 3)]))
    first = part.message()
    assert first is not None and [item.id for item in first.nodes] == [1, 2]
    assert [(item.subject, item.object) for item in first.edges] == [(1, 2)]
    assert part.message() is None

    def update(nodes: list[wire.NodeState], edges: list[wire.EdgeState]) -> None:
        before = make_graph([node(1, 0.0), node(2, 1.0), node(3, 9.0)], [edge(1, 2), edge(1, 3)])
        now = msgspec.structs.replace(before, sequence=before.sequence + 1, nodes=nodes)
        now = msgspec.structs.replace(now, edges=edges)
        part.add(msgspec.structs.replace(diff(before, now), session=before.session))

    update([node(1, 0.0), node(2, 1.0), node(3, 8.0)], [edge(1, 2), edge(1, 3, 0.5)])
    assert part.message() is None
    update([node(1, 0.0), node(2, 1.0), node(3, 1.5)], [edge(1, 2), edge(1, 3)])
    entered = part.message()
    assert entered is not None and len(entered.nodes) == 3 and len(entered.edges) == 2
    assert (entered.session, entered.sequence) == (first.session, 2)


def test_nowhere_and_a_region_without_objects() -> None:
    part = RegionPart(Region(None, 5.0))
    assert part.message() is None
    part.add(make_graph([node(1, 0.0)]))
    empty = part.message()
    assert empty is not None and empty.nodes == [] and empty.frame_id == "map"
    part.move(Region((50.0, 0.0, 0.0), 5.0))
    assert part.message() is None
    part.move(HERE)
    found = part.message()
    assert found is not None and len(found.nodes) == 1
