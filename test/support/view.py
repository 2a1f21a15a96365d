"""Small scene graphs, and sessions of random ones."""

import math
import random
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from support.reference_updates import diff

from deworldsg_ros.wire import messages as wire

STAMP = wire.Stamp(sec=3, nanosec=5)
# The graph of the shipped recording, as an earlier release saved it.
SAVED = Path(__file__).parents[1] / "client" / "saved" / "scene_graph_v1.json"


def box_at(center, size=(0.1, 0.1, 0.1), heading_rad=0.0):
    turn = [0.0, 0.0, math.sin(heading_rad / 2), math.cos(heading_rad / 2)]
    return wire.GravityBox(list(map(float, center)), list(map(float, size)), turn)


def make_node(
    node_id, label, mean=(0.0, 0.0, 0.0), covariance=None, observations=5, points=(), **fields
):
    covariance = np.diag([0.04, 0.01, 0.0025]) if covariance is None else covariance
    values = {
        "classes": [wire.Belief(label, 0.9), wire.Belief("other", 0.1)],
        "mean_m": list(map(float, mean)),
        "covariance_m2": np.asarray(covariance, float).ravel().tolist(),
        "first_seen": STAMP,
        "last_seen": STAMP,
        "surface_points_m": [list(map(float, point)) for point in points],
    }
    return wire.NodeState(
        id=node_id, label=label, observations=observations, **{**values, **fields}
    )


def make_edge(subject, object_, predicate="on", probability=0.8, provenance="visual"):
    return wire.EdgeState(
        subject=subject,
        object=object_,
        predicate=predicate,
        probability=probability,
        predicates=[wire.Belief(predicate, probability)],
        provenance=provenance,
        entropy_nats=0.5,
        observations=4,
    )


def make_graph(nodes=(), edges=(), frame_id="map", **fields):
    return wire.SceneGraphMessage(
        schema=wire.schema_of(wire.SceneGraphMessage),
        frame_id=frame_id,
        nodes=list(nodes),
        edges=list(edges),
        **{"stamp": STAMP, "sequence": 1, **fields},
    )


def random_graphs(
    seed: int, count: int, labels: Sequence[str], places_m: Sequence[float], session: str = "s"
) -> list[wire.SceneGraphMessage]:
    """Graphs of a session, from the empty one on: objects and relations come, change and go."""
    rng = random.Random(seed)
    nodes: dict[int, wire.NodeState] = {}
    edges: dict[tuple[int, int], wire.EdgeState] = {}
    graphs = [make_graph(sequence=0, stamp=wire.Stamp(0, 0), session=session)]
    for sequence in range(1, count + 1):
        for i in rng.choices(range(1, 13), k=rng.randint(0, 5)):
            at = (rng.choice(places_m), 0.0, 0.0)
            seen = {"observations": sequence, "existence": 0.5, "box": box_at(at)}
            nodes[i] = make_node(i, rng.choice(labels), at, **seen)
        for i in rng.sample(sorted(nodes), min(len(nodes), rng.randint(0, 2))):
            del nodes[i]
        edges = {pair: edge for pair, edge in edges.items() if set(pair) <= nodes.keys()}
        for _ in range(rng.randint(0, 4) if len(nodes) > 1 else 0):
            a, b = rng.sample(sorted(nodes), 2)
            edges[a, b] = make_edge(a, b, rng.choice(labels), rng.random())
        for pair in rng.sample(sorted(edges), min(len(edges), rng.randint(0, 2))):
            del edges[pair]
        content = ([nodes[i] for i in sorted(nodes)], [edges[pair] for pair in sorted(edges)])
        stamp = wire.stamp_from_ns(sequence * 10**9)
        graphs.append(make_graph(*content, sequence=sequence, stamp=stamp, session=session))
    return graphs


def updates_of(graphs: list[wire.SceneGraphMessage]) -> list[wire.SceneGraphUpdateMessage]:
    """The updates between graphs that follow one another."""
    return [
        msgspec.structs.replace(diff(a, b), session=b.session) for a, b in zip(graphs, graphs[1:])
    ]


def make_room(count=25, points=40, spread=1.0):
    """A graph of large and small objects with three predicates; of a wide floor with `spread`."""
    rng = np.random.default_rng(0)
    labels = ["cup", "table", "chair", "book", "lamp", "<shelf>", "plant & pot"]
    nodes = []
    for index in range(count):
        shape = rng.normal(size=(3, 3)) * rng.uniform(0.03, 0.25)
        mean = rng.normal(size=3) * [1.5 * spread, 1.5 * spread, 0.4]
        cloud = mean + rng.normal(size=(points, 3)) @ shape
        nodes.append(
            make_node(
                index + 1,
                labels[index % len(labels)],
                mean,
                shape.T @ shape + 1e-6 * np.eye(3),
                int(rng.integers(1, 60)),
                cloud,
            )
        )
    edges = [
        make_edge(
            int(subject) + 1,
            int(object_) + 1,
            ["on", "near", "under"][int(rng.integers(3))],
            float(rng.uniform(0.05, 1)),
            ["visual", "prior", "fused"][int(rng.integers(3))],
        )
        for subject, object_ in {
            tuple(rng.choice(count, 2, replace=False).tolist()) for _ in range(2 * count)
        }
    ]
    return make_graph(nodes, edges)
