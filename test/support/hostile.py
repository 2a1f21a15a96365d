"""Local graphs and evidence that fulfil their schema, with the worst values that it allows."""

import base64
import pickle
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from support.merging import VOCABULARY, local_graph, random_covariances, random_pose

from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene import limits
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph, RelationEvidence
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

PLACES_M = [0.0, 1e-9, 0.01, 0.5, 1.0, 31.0, 1e3, limits.MAX_COORDINATE_M]
LOGITS = [0.0, 1e-300, 5.0, -5.0, 745.0, 1e4, limits.MAX_LOGIT, -limits.MAX_LOGIT]
PROBABILITIES = [0.0, 1e-300, 1e-9, 0.2, 0.45, 0.5, 1.0 - 1e-9, 1.0]
STEPS_NS = [1, 10**3, 10**8, 10**8, 10**9, 3600 * 10**9, 10**17]
LABELS = ["cup", "table", "", "[bold]", "<b>&amp;", "$x_1$", "\U0001f600", "x" * 256, "a/b\\c", '"']
COUNTS = [1, 2, 2**31, 2**63 - 1]
PIXELS = [1, 2, 50, 1000, limits.MAX_SIDE_PX**2]


def hostile_covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    """Covariances (n, 3, 3) from the smallest to the largest, and from round to needles."""
    scales = 10.0 ** rng.uniform(0, 8, (count, 1, 1))
    return np.clip(random_covariances(rng, count, 1.5e-6) * scales, -2e8, 2e8)


def hostile_distributions(rng: np.random.Generator, count: int, width: int) -> np.ndarray:
    """Distributions (n, C), from certain to uniform."""
    rows = rng.dirichlet(np.full(width, rng.choice([1e-3, 0.1, 1.0, 100.0])), count)
    certain = rng.random(count) < 0.3
    rows[certain] = np.eye(width)[rng.integers(0, width, int(certain.sum()))]
    return rows / rows.sum(axis=1, keepdims=True)


def hostile_pose(rng: np.random.Generator) -> np.ndarray:
    """A rigid transform (4, 4), near the origin or far away."""
    pose = random_pose(rng)
    pose[:3, 3] = rng.choice(PLACES_M, 3) * rng.choice([-1, 1], 3)
    return pose


def hostile_grid(rng: np.random.Generator, width: int, height: int) -> DepthGrid | None:
    """A depth grid of random or constant depth; None in a third of the cases."""
    if rng.random() < 0.33:
        return None
    stride_px = int(rng.choice([1, 8, 100]))
    shape = [len(range(stride_px // 2, size, stride_px)) for size in (height, width)]
    depth_mm = rng.integers(0, 2**16, shape).astype(np.uint16)
    if rng.random() < 0.5:
        depth_mm[:] = rng.choice([0, 1, 1000, 2**16 - 1])
    instances = rng.choice([0, 1, 2, 3, 2**16 - 1], shape).astype(np.uint16)
    focal = float(rng.choice([limits.MIN_FOCAL_PX, 1.0, 500.0, limits.MAX_FOCAL_PX]))
    centre = float(rng.choice([0.0, 320.0, -limits.MAX_FOCAL_PX, limits.MAX_FOCAL_PX]))
    camera = Intrinsics(focal, focal, centre, centre, width, height)
    return DepthGrid(depth_mm, stride_px, camera, instances if rng.random() < 0.7 else None)


def hostile_local_graph(rng: np.random.Generator, stamp_ns: int) -> LocalGraph:
    count = int(rng.integers(0, 7))
    width, height = int(rng.choice([1, 64, 640])), int(rng.choice([1, 48, 480]))
    means = rng.choice(PLACES_M, (count, 3)) * rng.choice([-1, 1], (count, 3))
    if rng.random() < 0.5:
        means = means[:1].repeat(count, axis=0) if count else means
    spread = float(rng.choice([0.0, 0.01, 0.2, 100.0]))
    points = tuple(
        np.clip(mean + rng.normal(0, 1, (int(rng.choice([0, 1, 5, 60])), 3)) * spread, -1e4, 1e4)
        .astype(np.float32)
        for mean in means
    )  # fmt: skip
    pairs = [(a, b) for a in range(count) for b in range(count) if a != b and rng.random() < 0.5]
    corners = np.sort(rng.choice([-32768, 0, 1, 9.5, 639, 32768], (count, 2, 2)), axis=1)
    graph = local_graph(
        stamp_ns,
        means,
        hostile_covariances(rng, count),
        hostile_distributions(rng, count, 4),
        points=points,
        pairs=pairs,
        logits=rng.choice(LOGITS, (len(pairs), 3)),
        frame_id="map",
    )
    relations = replace(graph.relations, scores=rng.choice(PROBABILITIES, len(pairs)))
    return replace(
        graph,
        width=width,
        height=height,
        T_world_camera=hostile_pose(rng),
        instance_ids=rng.choice([1, 2, 3, 4, 5, 2**16 - 2, 2**16 - 1], count, replace=False),
        boxes_xyxy=corners.reshape(count, 4).astype(np.float64),
        scores=rng.choice(PROBABILITIES, count),
        depths_m=np.abs(rng.choice(PLACES_M, count)),
        pixel_counts=rng.choice(PIXELS, count),
        relations=relations,
        depth_grid=hostile_grid(rng, width, height),
    )


def hostile_evidence(rng: np.random.Generator, local: LocalGraph) -> RelationEvidence:
    """Evidence for pairs of a local graph, some of which it does not contain."""
    count = int(rng.integers(0, 4))
    predictions = hostile_distributions(rng, count, 3)
    predictions[rng.random(count) < 0.5] = np.nan
    first = rng.integers(0, max(len(local) - 1, 1), (count, 1))
    return RelationEvidence(
        stamp_ns=local.stamp_ns,
        vocabulary=VOCABULARY,
        pairs=np.concatenate([first, first + 1], axis=1),
        pair_classes=rng.integers(0, 4, (count, 2)),
        geo_costs=rng.choice([0.0, 1e-300, 0.4, limits.MAX_COST], count),
        predictions=predictions,
        source="fake",
    )


def hostile_scene_graph(rng: np.random.Generator) -> wire.SceneGraphMessage:
    count = int(rng.integers(0, 9))
    ids = rng.choice([1, 2, 3, 4, 5, 7, 2**31, 2**53 + 1, 2**63 - 1], count, replace=False)
    pairs = [(a, b) for a in [*ids, 6] for b in [*ids, 8] if a != b and rng.random() < 0.2]
    message = {
        "schema": {"name": "scene_graph", "version": 2},
        "stamp": _hostile_stamp(rng),
        "frame_id": str(rng.choice(["map", "", "x" * 256])),
        "sequence": int(rng.choice([0, 1, 2**63 - 1])),
        "nodes": [_hostile_node(rng, int(node_id)) for node_id in ids],
        "edges": [_hostile_edge(rng, int(a), int(b)) for a, b in pairs],
        "up": _unit(rng, 3),
        "hidden": [
            {
                "label": str(rng.choice(LABELS)),
                "mean_m": _place(rng),
                "existence": float(rng.choice(PROBABILITIES)),
                "observations": int(rng.choice(COUNTS)),
                "reason": str(rng.choice(["", "seen once", "[bold]"])),
            }
        ],
    }
    content = msgspec.json.encode(_without_some(rng, message, "up", "hidden"))
    return wire.decode(content, wire.SceneGraphMessage)


def _hostile_node(rng: np.random.Generator, node_id: int) -> dict[str, Any]:
    kinds = ["zero", "ball", "needle", "largest", "negative", "any"]
    variance = {
        "zero": np.zeros((3, 3)),
        "ball": np.eye(3) * rng.choice([1e-300, 1e-12, 0.01, 1e16]),
        "needle": np.diag([1e16, 1e-300, 0.0]),
        "largest": np.full((3, 3), 1e16),
        "negative": -np.eye(3),
        "any": rng.normal(size=(3, 3)) * rng.choice([1e-9, 1.0, 1e15]),
    }[str(rng.choice(kinds))]
    node: dict[str, Any] = {
        "id": node_id,
        "label": str(rng.choice(LABELS)),
        "classes": [_belief(rng) for _ in range(int(rng.integers(0, 3)))],
        "mean_m": _place(rng),
        "covariance_m2": np.clip(variance, -1e16, 1e16).ravel().tolist(),
        "observations": int(rng.choice(COUNTS)),
        "first_seen": _hostile_stamp(rng),
        "last_seen": _hostile_stamp(rng),
        "confirmed": bool(rng.random() < 0.9),
        "existence": float(rng.choice(PROBABILITIES)),
        "remainder": float(rng.choice(PROBABILITIES)),
        "entropy_nats": float(rng.choice([-1e308, 0.0, 0.3, 1e308])),
        "box": {
            "center_m": _place(rng),
            "size_m": rng.choice([0.0, 1e-300, 0.2, 2e8], 3).tolist(),
            "orientation_xyzw": _unit(rng, 4),
        },
        "surface_points_m": [_place(rng) for _ in range(int(rng.integers(0, 9)))],
        "surface_mm": base64.b64encode(rng.bytes(int(rng.integers(0, 60)))).decode(),
        "label_provenance": "operator",
    }
    optional = ("existence", "remainder", "entropy_nats", "box", "surface_points_m", "surface_mm")
    return _without_some(rng, node, *optional, "label_provenance")


def _hostile_edge(rng: np.random.Generator, subject: int, object_: int) -> dict[str, Any]:
    edge = {
        "subject": subject,
        "object": object_,
        "predicate": str(rng.choice(LABELS)),
        "probability": float(rng.choice(PROBABILITIES)),
        "predicates": [_belief(rng) for _ in range(int(rng.integers(0, 3)))],
        "provenance": str(rng.choice(["visual", "prior", "fused"])),
        "entropy_nats": float(rng.choice([0.0, 0.3, 1e308])),
        "observations": int(rng.choice([0, 1, 2**63 - 1])),
        "remainder": float(rng.choice(PROBABILITIES)),
        "mutual": bool(rng.random() < 0.5),
        "shown": int(rng.choice([0, 1, 2**63 - 1])),
    }
    return _without_some(rng, edge, "remainder", "mutual", "shown")


def _without_some(rng: np.random.Generator, content: dict[str, Any], *names: str) -> dict[str, Any]:
    return {k: value for k, value in content.items() if k not in names or rng.random() < 0.5}


def _belief(rng: np.random.Generator) -> dict[str, Any]:
    return {"label": str(rng.choice(LABELS)), "probability": float(rng.choice(PROBABILITIES))}


def _place(rng: np.random.Generator) -> list[float]:
    sign = rng.choice([-1, 1], 3)
    return (rng.choice([0.0, 5e-324, 1e-9, 0.3, 1.0, 1e4, 1e8], 3) * sign).tolist()


def _unit(rng: np.random.Generator, size: int) -> list[float]:
    values = rng.normal(size=size) if rng.random() < 0.5 else np.eye(size)[rng.integers(size)]
    scale = rng.choice([0.995, 1.0, 1.005]) * rng.choice([-1, 1])
    return (values / np.linalg.norm(values) * scale).tolist()


def _hostile_stamp(rng: np.random.Generator) -> dict[str, int]:
    sec, nanosec = rng.choice([0, 1, 2**31 - 1]), rng.choice([0, 10**9 - 1])
    return {"sec": int(sec), "nanosec": int(nanosec)}


def state_of(builder: GraphBuilder) -> bytes:
    memory = builder.merging.memory()
    return pickle.dumps(
        (builder.graph.state(), memory, builder.prior.to_state(), builder.up.state().tobytes())
    )


def check_published(builder: GraphBuilder, replica: GraphReplica) -> None:
    """Publish; the update has to be valid JSON that keeps a replica equal to the graph."""
    update = builder.update()
    if update is not None:
        text = wire.encode(update)
        replica.apply(wire.decode(text, wire.SceneGraphUpdateMessage))
    snapshot: Any = wire.decode(wire.encode(builder.snapshot()), wire.SceneGraphMessage)
    assert (replica.message().nodes, replica.message().edges) == (snapshot.nodes, snapshot.edges)
    for node in snapshot.nodes:
        assert np.isfinite([*node.mean_m, *node.covariance_m2]).all()
        assert 0.0 <= node.classes[0].probability <= 1.0 + 1e-9
