"""Small scene graphs for the tests of the views."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.wire import messages as wire

STAMP = wire.Stamp(sec=3, nanosec=5)


def make_node(node_id, label, mean=(0.0, 0.0, 0.0), covariance=None, observations=5, points=()):
    covariance = np.diag([0.04, 0.01, 0.0025]) if covariance is None else covariance
    return wire.NodeState(
        id=node_id,
        label=label,
        classes=[wire.Belief(label, 0.9), wire.Belief("other", 0.1)],
        mean_m=list(map(float, mean)),
        covariance_m2=np.asarray(covariance, float).ravel().tolist(),
        observations=observations,
        first_seen=STAMP,
        last_seen=STAMP,
        surface_points_m=[list(map(float, point)) for point in points],
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


def make_graph(nodes=(), edges=(), frame_id="map"):
    return wire.SceneGraphMessage(
        schema=wire.schema_of(wire.SceneGraphMessage),
        stamp=STAMP,
        frame_id=frame_id,
        sequence=1,
        nodes=list(nodes),
        edges=list(edges),
    )


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
