"""Memory of the graph in graph_node, per node with surface points and edges.

    python bench/memory.py

Nodes stand in rows on the floor, each with its full number of surface points and votes with the
next nodes. The memory is that of the whole process (resident set, without free memory that malloc
keeps), after all nodes were published.
"""

from __future__ import annotations

import ctypes
import gc
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.figures import Figure, Setup
from bench.synthetic_map import publish
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder, warm_up
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.vocabulary import COCO_CLASSES, REPLICA_SSG_PREDICATES

# Votes of each node with this many of the next ones: about what the rooms' graphs have.
PARTNERS = 5
# From here on the tables of the process have their size, and the kernels are loaded.
FIRST_NODES = 1000
POINTS = 512
SPACING_M = 0.45


def resident_bytes() -> int:
    """Resident set of this process, without what malloc keeps for later."""
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096


def grow(builder: GraphBuilder, count: int, rng: np.random.Generator) -> None:
    """Add nodes until there are `count`, with surfaces and votes; publish them."""
    graph = builder.graph
    votes = np.zeros((2, len(REPLICA_SSG_PREDICATES)))
    votes[0, REPLICA_SSG_PREDICATES.index("on")] = 0.9
    side = 60
    for number in range(len(graph.nodes), count):
        centre = SPACING_M * np.array([number % side, number // side, 0.4 * (number % 2)])
        points = (centre + rng.uniform(-0.2, 0.2, (POINTS, 3))).astype(np.float32)
        classes = rng.dirichlet(np.full(len(COCO_CLASSES), 0.05))
        node = graph.add_node(points.mean(0).astype(float), np.eye(3) * 0.01, classes, 1, points)
        graph.nodes.confirmed[graph.nodes.slot(node)] = True
        for other in range(max(1, node - PARTNERS), node):
            graph.add_votes(other, node, votes)
    publish(builder)
    gc.collect()


def bytes_per_node(nodes: int) -> tuple[float, float]:
    """Resident bytes of each node after the first ones, and edges of each node."""
    config = Config()
    warm_up(config)
    builder = GraphBuilder(config, Vocabulary(COCO_CLASSES, REPLICA_SSG_PREDICATES), "map")
    rng = np.random.default_rng(0)
    grow(builder, FIRST_NODES, rng)
    before = resident_bytes()
    grow(builder, FIRST_NODES + nodes, rng)
    edges = len(builder.snapshot().edges)
    return (resident_bytes() - before) / nodes, edges / len(builder.graph.nodes)


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    nodes = 300 if setup.quick else 4000
    size, edges = bytes_per_node(nodes)
    note = f"{POINTS} surface points, {edges:.1f} published edges a node, {nodes} nodes, RSS"
    return [Figure("memory_per_node", size / 1e3, "kB", target=16, note=note)]


if __name__ == "__main__":
    for figure in figures(Setup()):
        print(f"{figure.value:.1f} {figure.unit} a node: {figure.note}")
