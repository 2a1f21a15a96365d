"""Random Gaussians, poses and local graphs for the tests of scene and merging."""

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import NodeStates
from deworldsg_ros.scene.frame_graph import Embeddings, LocalGraph, Relations, Vocabulary
from deworldsg_ros.wire import messages as wire

VOCABULARY = Vocabulary(("cup", "table", "chair", "book"), ("on", "near", "under"))

seeds = st.integers(0, 2**32 - 1)
EDITS = ["add", "observe", "confirm", "merge", "remove", "visual", "neighbour", "votes", "frame"]


def set_confirmed(graph: GlobalGraph, node_id: int, confirmed: bool) -> None:
    """Publish a node, or hide it."""
    graph.set_existence([node_id], np.array([float(confirmed)]), 0.5)


def move_node(graph: GlobalGraph, node_id: int, T: NDArray[np.float64]) -> None:
    """Move a node by one rigid transform (4, 4), from wherever it was seen."""
    keyframes = int(graph.nodes.surface_keyframes.max(initial=0)) + 1
    graph.move_nodes(graph.nodes.slots_of([node_id]), np.broadcast_to(T, (keyframes, 4, 4)))


def node_states(
    graph: GlobalGraph, top_k: int, with_points: bool = False
) -> dict[int, wire.NodeState]:
    """Messages of the confirmed nodes by ascending id, as a publication makes them."""
    states = NodeStates(graph, top_k, 0.0)
    states.refresh()
    known = dict(sorted(states.states.items()))
    return {i: states.with_points(known[i]) for i in known} if with_points else known


def moments(points_xyz: np.ndarray, ridge_m2: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample mean (3,) and covariance (3, 3) of points (N, 3), N >= 2, with a ridge."""
    mean = points_xyz.mean(axis=0, dtype=np.float64)
    centred = points_xyz - mean
    return mean, centred.T @ centred / (len(points_xyz) - 1) + ridge_m2 * np.eye(3)


def random_covariances(
    rng: np.random.Generator, count: int, thinnest_m: float = 1e-3, largest_m: float = 1.0
) -> NDArray[np.float64]:
    """Covariances (n, 3, 3). The logarithms of their standard deviations are uniform."""
    bases = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    deviations = np.exp(rng.uniform(np.log(thinnest_m), np.log(largest_m), (count, 1, 3)))
    covariances = bases * deviations**2 @ bases.swapaxes(1, 2)
    return (covariances + covariances.swapaxes(1, 2)) / 2


def random_pose(rng: np.random.Generator) -> NDArray[np.float64]:
    """A rigid transform (4, 4)."""
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = rng.normal(0, 3, 3)
    return pose


def random_classes(rng: np.random.Generator, count: int, classes: int = 4) -> NDArray[np.float64]:
    """Class distributions (n, C), from uniform to nearly certain."""
    logits = rng.normal(0, 3.0, (count, classes))
    powers = np.exp(logits - logits.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def random_colours(objects: NDArray[np.int64], stamp_ns: int) -> NDArray[np.float32] | None:
    """CIELAB colours (n, 3) of objects, with noise; unknown in some frames and of some objects."""
    rng = np.random.default_rng(stamp_ns)
    colours = rng.normal(0, 2, (len(objects), 3)) + [50, 0, 0] + 5 * objects[:, None]
    colours[rng.random(len(objects)) < 0.2] = np.nan
    return None if stamp_ns % 5 == 0 or np.isnan(colours).all() else colours.astype(np.float32)


def random_embeddings(count: int, seed: int) -> Embeddings | None:
    """Embeddings of some of the objects of a frame; None of none."""
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(rng.random(count) < 0.6)
    vectors = rng.normal(size=(len(rows), 4))
    unit = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16)
    return Embeddings(rows, unit, "tiny") if len(rows) else None


def local_graph(
    stamp_ns: int,
    means: NDArray[np.float64],
    covariances: NDArray[np.float64],
    classes: NDArray[np.float64],
    /,
    *,
    points: tuple[NDArray[np.float32], ...] | None = None,
    pairs: list[tuple[int, int]] | None = None,
    logits: NDArray[np.float64] | None = None,
    vocabulary: Vocabulary = VOCABULARY,
    **changes: object,
) -> LocalGraph:
    """A local graph of these Gaussians and class distributions."""
    count, predicates = len(means), len(vocabulary.predicates)
    pair_array = np.array(pairs or [], np.int64).reshape(-1, 2)
    logits = np.zeros((len(pair_array), predicates)) if logits is None else logits
    fields = {
        "stamp_ns": stamp_ns,
        "frame_id": "world",
        "width": 640,
        "height": 480,
        "T_world_camera": np.eye(4),
        "vocabulary": vocabulary,
        "instance_ids": np.arange(1, count + 1),
        "boxes_xyxy": np.tile([10.0, 10, 100, 100], (count, 1)),
        "class_probabilities": classes,
        "scores": np.full(count, 0.9),
        "means_world": means,
        "covariances_world": covariances,
        "depths_m": np.full(count, 2.0),
        "pixel_counts": np.full(count, 100),
        "surface_points_world": points or (np.zeros((0, 3), np.float32),) * count,
        "relations": Relations(pair_array, logits, np.ones(len(pair_array))),
    }
    return LocalGraph(**{**fields, **changes})


def random_local_graphs(rng: np.random.Generator, frames: int) -> list[LocalGraph]:
    """Noisy observations of a few objects. Nodes merge, also in chains, and separate."""
    objects = int(rng.integers(2, 9))
    means = rng.uniform(-1, 1, (objects, 3))
    covariances = random_covariances(rng, objects, 0.02, 0.6)
    classes = random_classes(rng, objects)
    graphs = []
    for stamp_ns in range(1, frames + 1):
        seen = rng.integers(0, objects, int(rng.integers(0, 7)))
        count = len(seen)
        pairs = [
            (subject, object_)
            for subject in range(count)
            for object_ in range(count)
            if subject != object_ and rng.random() < 0.3
        ]
        noise = rng.normal(size=(count, 3)) * 10 ** rng.uniform(-3, -0.5)
        scale = np.exp(rng.normal(0, 0.3, (count, 1, 1)))
        flat = rng.dirichlet(np.ones(4), count).reshape(count, 4)
        graphs.append(
            local_graph(
                stamp_ns,
                means[seen] + noise,
                covariances[seen] * scale,
                0.8 * classes[seen] + 0.2 * flat,
                points=tuple(
                    rng.normal(means[row], 0.1, (5, 3)).astype(np.float32) for row in seen
                ),
                pairs=pairs,
                logits=rng.normal(0, 2, (len(pairs), 3)),
                colours_lab=random_colours(seen, stamp_ns),
                embeddings=random_embeddings(count, stamp_ns),
            )
        )
    return graphs


def edit_at_random(graph: GlobalGraph, rng: np.random.Generator, edits: int) -> None:
    """Apply all edits that stages make to a graph, in random order."""
    for _ in range(edits):
        stamp_ns = int(rng.integers(0, 10**12))
        live = sorted(graph.nodes.slot_of)
        ever = int(max([*live, 1]))
        gaussian = (rng.normal(size=3), random_covariances(rng, 1)[0], random_classes(rng, 1)[0])
        points = rng.normal(size=(4, 3)).astype(np.float32)
        action = rng.choice(EDITS)
        if action == "add" or len(live) < 2:
            graph.add_node(*gaussian, stamp_ns, points, confirmed=bool(rng.integers(2)))
        elif action == "observe":
            graph.observe(int(rng.choice(live)), *gaussian, stamp_ns, points)
        elif action == "confirm":
            set_confirmed(graph, int(rng.choice(live)), True)
        elif action == "merge":
            graph.merge_nodes(*rng.choice(live, 2, replace=False).tolist())
        elif action == "remove" and rng.random() < 0.5:
            graph.remove_node(int(rng.choice(live)))
        elif action == "visual":
            pair = rng.integers(1, ever + 1, 2).tolist()
            graph.add_visual(*pair, rng.normal(size=3), stamp_ns)
        elif action == "neighbour":
            first, second = map(graph.resolve, rng.integers(1, ever + 1, 2).tolist())
            graph.add_neighbours([(first, second)], stamp_ns)
        elif action == "votes":
            counts = rng.uniform(0, 1, (2, 3)) if rng.integers(2) else None
            graph.add_votes(*rng.choice(live, 2, replace=False).tolist(), counts)
        elif action == "frame":
            graph.remember_frame(stamp_ns, rng.choice(live, 3).tolist())
