"""Time of pairing and fusion, and of plain loops; time per frame without a world model.

    python bench/relations.py

The two sides of a comparison alternate within one run. The ratio is the median of paired ratios.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from deworldsg_ros.config import Config, RelationsConfig
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.relations import (
    ClassPairPrior,
    EdgeBeliefs,
    RelationReasoner,
    build_world_model,
    fuse_edges,
    neighbour_pairs,
)
from deworldsg_ros.scene.frame_graph import LocalGraph, Relations, Vocabulary
from deworldsg_ros.scene.vocabulary import COCO_CLASSES, REPLICA_SSG_PREDICATES

WIDTH, HEIGHT = 640, 480
CLASSES, PREDICATES = 80, 50
ALPHA, ENTROPY_THRESHOLD_NATS, GEO_COST_THRESHOLD = 0.5, 1.0, 0.45


def pairs_by_loop(boxes, depths):
    """Neighbour pairs of Eq. 8 in a loop over pairs."""
    found = []
    for i in range(len(boxes)):
        for j in range(len(boxes)):
            if i == j:
                continue
            dx = (boxes[i, 0] + boxes[i, 2] - boxes[j, 0] - boxes[j, 2]) / 2
            dy = (boxes[i, 1] + boxes[i, 3] - boxes[j, 1] - boxes[j, 3]) / 2
            cost = 0.5 * math.hypot(dx, dy) / math.hypot(WIDTH, HEIGHT)
            cost += abs(depths[i] - depths[j])
            if cost < GEO_COST_THRESHOLD:
                found.append((i, j, cost))
    return found


def fuse_by_loop(logits, has_visual, priors, has_prior):
    """Fusion of Eq. 9-10 in a loop over edges, with numpy over the predicates."""
    edges = []
    for row in range(len(logits)):
        summed = logits[row] if has_visual[row] else np.zeros(logits.shape[1])
        weights = np.exp(summed - summed.max())
        visual = weights / weights.sum()
        entropy = -(visual * np.log(np.maximum(visual, 1e-300))).sum()
        if has_prior[row] and entropy > ENTROPY_THRESHOLD_NATS:
            mixed = visual + ALPHA * priors[row]
            edges.append(mixed / mixed.sum())
        else:
            edges.append(visual if has_visual[row] else None)
    return edges


def paired(name: str, ours: Callable[[], object], loop: Callable[[], object], turns: int) -> None:
    """Print the median of each side and the median of the paired ratios."""
    times = np.array([[timed(ours), timed(loop)] for _ in range(turns)])
    ours_ms, loop_ms = 1e3 * np.median(times, axis=0)
    ratio = np.median(times[:, 1] / times[:, 0])
    print(f"{name:34} {ours_ms:8.3f} ms   loop {loop_ms:8.3f} ms   loop / ours {ratio:6.1f}")


def timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def objects(count: int, generator: np.random.Generator):
    corners = generator.uniform(0, (WIDTH, HEIGHT), (count, 2, 2))
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    return boxes, generator.uniform(1.0, 2.0, count)


def local_graph(stamp_ns: int, count: int, generator: np.random.Generator) -> LocalGraph:
    boxes, depths = objects(count, generator)
    return LocalGraph(
        stamp_ns=stamp_ns,
        frame_id="world",
        width=WIDTH,
        height=HEIGHT,
        T_world_camera=np.eye(4),
        vocabulary=Vocabulary(
            tuple(f"class {n}" for n in range(CLASSES)),
            tuple(f"predicate {n}" for n in range(PREDICATES)),
        ),
        instance_ids=np.arange(1, count + 1),
        boxes_xyxy=boxes,
        class_probabilities=generator.dirichlet(np.ones(CLASSES), count),
        scores=np.ones(count),
        means_world=np.zeros((count, 3)),
        covariances_world=np.tile(np.eye(3), (count, 1, 1)),
        depths_m=depths,
        pixel_counts=np.full(count, 100),
        surface_points_world=tuple(np.zeros((0, 3), np.float32) for _ in range(count)),
        relations=Relations.none(PREDICATES),
    )


def frame_costs(count: int, turns: int) -> None:
    """Print the time of `observe` per frame. It queues clips and encodes none."""
    generator = np.random.default_rng(2)
    config = RelationsConfig(world_model="fake")
    reasoner = RelationReasoner(config, build_world_model(config))
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    graphs = [local_graph(stamp, count, generator) for stamp in range(turns)]
    times = [timed(lambda graph=graph: reasoner.observe(graph, image)) for graph in graphs]
    counters = reasoner.counters()
    print(
        f"observe, {count} objects               {1e3 * np.median(times):8.3f} ms   "
        f"{counters.queued / turns:.1f} clips queued per frame"
    )


def belief_costs(objects: int, nodes: int, turns: int) -> None:
    """Processor time of the beliefs of a frame: its votes, and the edges after it."""
    generator = np.random.default_rng(2)
    builder = GraphBuilder(Config(), Vocabulary(COCO_CLASSES, REPLICA_SSG_PREDICATES), "map")
    graph, beliefs = builder.graph, EdgeBeliefs(Config(), builder.graph, builder.prior)

    def cloud(node: int, count: int) -> np.ndarray:
        centre = np.array([0.45 * (node % 20), 0.45 * (node // 20), 0.3 * (node % 3)])
        return (centre + generator.uniform(-0.1, 0.1, (count, 3))).astype(np.float32)

    def vote(seen: list[int], counts: np.ndarray) -> None:
        for a in seen:
            for b in range(a + 1, seen[-1] + 1):
                graph.add_votes(a, b, counts if b == a + 1 else None)

    classes = generator.dirichlet(np.full(len(COCO_CLASSES), 0.05), nodes)
    for node in range(nodes):
        points = cloud(node, 512)
        graph.add_node(points.mean(0).astype(float), np.eye(3) * 0.01, classes[node], 1, points)
    beliefs.refresh()
    votes, states = [], []
    for turn in range(turns):
        first = int(generator.integers(nodes - objects))
        seen = list(range(first + 1, first + objects + 1))
        for node in seen:
            row = graph.nodes.slot(node)
            mean, known = graph.nodes.means[row].copy(), graph.nodes.class_probabilities[row]
            graph.observe(node, mean, np.eye(3) * 0.01, known, turn + 2, cloud(node - 1, 64))
        pair_votes = np.zeros((2, len(REPLICA_SSG_PREDICATES)))
        pair_votes[0, REPLICA_SSG_PREDICATES.index("on")] = 0.9
        votes.append(timed(lambda seen=seen, counts=pair_votes: vote(seen, counts)))
        states.append(timed(lambda: beliefs.refresh(whole=False)))
    size = f"{objects} objects, {nodes} nodes"
    print(f"votes of a frame, {size}        {1e3 * np.median(votes):8.3f} ms")
    print(f"edges after a frame, {size}     {1e3 * np.median(states):8.3f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=12, help="objects per frame")
    parser.add_argument("--edges", type=int, default=5000, help="edges of the graph")
    parser.add_argument("--turns", type=int, default=31, help="number of measurements")
    options = parser.parse_args()
    generator = np.random.default_rng(1)

    boxes, depths = objects(options.objects, generator)
    vectorised = neighbour_pairs(boxes, depths, WIDTH, HEIGHT, GEO_COST_THRESHOLD)
    looped = pairs_by_loop(boxes, depths)
    assert [tuple(pair) for pair in vectorised[0].tolist()] == [pair[:2] for pair in looped]
    paired(
        f"Eq. 8, {options.objects} objects",
        lambda: neighbour_pairs(boxes, depths, WIDTH, HEIGHT, GEO_COST_THRESHOLD),
        lambda: pairs_by_loop(boxes, depths),
        options.turns * 10,
    )

    edges = options.edges
    logits = generator.normal(0, 2, (edges, PREDICATES))
    priors = generator.dirichlet(np.ones(PREDICATES), edges)
    has_visual, has_prior = generator.random((2, edges)) < 0.7
    inputs = (logits, has_visual, priors, has_prior)
    fused = fuse_edges(*inputs, ALPHA, ENTROPY_THRESHOLD_NATS)
    for row, edge in enumerate(fuse_by_loop(*inputs)):
        assert (edge is not None) == fused.known[row]
        assert edge is None or np.allclose(edge, fused.probabilities[row])
    paired(
        f"Eq. 9-10, {edges} edges",
        lambda: fuse_edges(*inputs, ALPHA, ENTROPY_THRESHOLD_NATS),
        lambda: fuse_by_loop(*inputs),
        options.turns,
    )

    prior = ClassPairPrior(CLASSES, PREDICATES)
    classes = generator.integers(0, CLASSES, (edges, 2))
    prior.update(classes, priors)
    paired(
        f"prior of {edges} edges",
        lambda: prior.lookup(classes),
        lambda: [prior.lookup(pair[None]) for pair in classes],
        options.turns,
    )
    frame_costs(options.objects, 10 * options.turns)
    belief_costs(options.objects, 300, options.turns)


if __name__ == "__main__":
    main()
