"""Nodes of a small room, with surfaces sampled from boxes, and the edges that a graph says.

All lengths are metres; z points up and the floor is at 0.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from support.merging import move_node, set_confirmed

from deworldsg_ros.config import Config
from deworldsg_ros.graph.pairs import frame_votes
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.relations.geometry import MIN_SHAPE_POINTS
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.vocabulary import COCO_CLASSES, REPLICA_SSG_PREDICATES

VOCABULARY = Vocabulary(COCO_CLASSES, REPLICA_SSG_PREDICATES)
# Depth noise of a surface that was seen many times.
NOISE_M = 0.003
# Frames in which each object was seen.
FRAMES = 20

Corner = tuple[float, float, float]


class Box(NamedTuple):
    """An upright box from its low corner to its high corner."""

    low: Corner
    high: Corner


class Thing(NamedTuple):
    """An object: its class, and the boxes that it consists of."""

    label: str
    parts: Sequence[Box]


def box(x: float, y: float, z: float, width: float, depth: float, height: float) -> Box:
    """A box over the point (x, y, z), the middle of its bottom."""
    return Box((x - width / 2, y - depth / 2, z), (x + width / 2, y + depth / 2, z + height))


def thing(label: str, *at_and_size: float) -> Thing:
    """An object that is one box; see `box`."""
    return Thing(label, [box(*at_and_size)])


def legs(low: Corner, high: Corner, thick: float = 0.05) -> list[Box]:
    """Four legs in the corners of a box."""
    half = thick / 2
    return [
        box(x, y, low[2], thick, thick, high[2] - low[2])
        for x in (low[0] + half, high[0] - half)
        for y in (low[1] + half, high[1] - half)
    ]


def table(
    x: float, y: float, width: float = 1.4, depth: float = 0.8, height: float = 0.74
) -> Thing:
    """A dining table: a top of 4 cm and four legs."""
    whole = box(x, y, 0.0, width, depth, height)
    top = Box((whole.low[0], whole.low[1], height - 0.04), whole.high)
    return Thing("dining table", [top, *legs(whole.low, (*whole.high[:2], height - 0.04))])


def chair(x: float, y: float, back: int = 1) -> Thing:
    """A chair of 0.44 m whose back is at y + 0.2 m, or at y - 0.2 m if `back` is -1."""
    whole = box(x, y, 0.0, 0.44, 0.44, 0.9)
    seat = box(x, y, 0.42, 0.44, 0.44, 0.04)
    rest = box(x, y + 0.2 * back, 0.46, 0.44, 0.04, 0.44)
    return Thing("chair", [seat, rest, *legs(whole.low, (*whole.high[:2], 0.42), 0.04)])


def bowl(x: float, y: float, z: float, size: float = 0.26, height: float = 0.08) -> Thing:
    """A bowl: four walls around a bottom."""
    half, wall = size / 2, 0.01
    return Thing(
        "bowl",
        [
            box(x, y, z, size, size, wall),
            box(x - half, y, z, wall, size, height),
            box(x + half, y, z, wall, size, height),
            box(x, y - half, z, size, wall, height),
            box(x, y + half, z, size, wall, height),
        ],
    )


def plant(x: float, y: float, z: float, size: float = 0.25, height: float = 0.43) -> Thing:
    """A potted plant: leaves over a pot of 0.14 m."""
    pot = box(x, y, z, 0.14, 0.14, 0.13)
    return Thing("potted plant", [pot, box(x, y, z + 0.13, size, size, height - 0.13)])


DESK = {"table": table(0, 0), "cup": thing("cup", 0.3, 0.1, 0.74, 0.09, 0.09, 0.1)}
DINNER = {
    **DESK,
    "chair": chair(0, 0.5),
    "bowl": bowl(-0.2, 0, 0.74),
    "book": thing("book", 0.1, -0.1, 0.74, 0.2, 0.28, 0.03),
    "plant": plant(-0.6, 0.2, 0.74),
    "fridge": thing("refrigerator", 1.3, 0, 0, 0.6, 0.6, 1.7),
}


def surface(parts: Sequence[Box], rng: np.random.Generator, count: int = 2000) -> np.ndarray:
    """Points (count, 3) float32 on the tops and sides of boxes, evenly."""
    low, high = (np.array([part[end] for part in parts]) for end in (0, 1))
    areas = np.array(
        [[np.prod(np.delete(size, axis)) for axis, _ in _FACES] for size in high - low]
    )
    chosen = rng.choice(areas.size, count, p=areas.ravel() / areas.sum())
    part, face = np.divmod(chosen, len(_FACES))
    points = rng.uniform(low[part], high[part])
    axis, end = np.array(_FACES)[face].T
    rows = np.arange(count)
    points[rows, axis] = np.where(end, high[part, axis], low[part, axis])
    return (points + rng.normal(0, NOISE_M, points.shape)).astype(np.float32)


def room(
    things: Mapping[str, Thing], config: Config | None = None, seed: int = 0
) -> tuple[GraphBuilder, dict[str, int]]:
    """A graph with one node for each object, and their ids by name."""
    config = Config() if config is None else config
    rng = np.random.default_rng(seed)
    builder = GraphBuilder(config, VOCABULARY, "map")
    ids = {name: add_node(builder, item, rng) for name, item in things.items()}
    return builder, ids


def add_node(
    builder: GraphBuilder, item: Thing, rng: np.random.Generator, frames: int = FRAMES
) -> int:
    """Add a node that was seen in a number of frames; returns its id."""
    points = surface(item.parts, rng)
    classes = np.full(len(VOCABULARY.classes), 0.1 / (len(VOCABULARY.classes) - 1))
    classes[VOCABULARY.classes.index(item.label)] = 0.9
    seen = (points.mean(axis=0).astype(float), np.cov(points.T) + 1e-6 * np.eye(3), classes)
    node_id = builder.graph.add_node(*seen, 1, points)
    for stamp_ns in range(2, frames + 1):
        builder.graph.observe(node_id, *seen, stamp_ns)
    return node_id


def vote(
    builder: GraphBuilder,
    subject: int,
    object_: int,
    predicate: str | None,
    frames: int,
    converse: str | None = None,
    share: float = 0.9,
) -> None:
    """Frames that showed two nodes, and gave a predicate this probability; None = no relation.

    `converse` is the predicate of the other direction.
    """
    counts = None
    if predicate is not None:
        counts = np.zeros((2, len(VOCABULARY.predicates)))
        counts[0, VOCABULARY.predicates.index(predicate)] = share
        if converse is not None:
            counts[1, VOCABULARY.predicates.index(converse)] = share
    for _ in range(frames):
        builder.graph.add_votes(subject, object_, counts)


def said(builder: GraphBuilder, ids: Mapping[str, int]) -> dict[tuple[str, str, str], float]:
    """The probability of each (subject, predicate, object) among the published edges, by name."""
    names = {node_id: name for name, node_id in ids.items()}
    return {
        (names[edge.subject], belief.label, names[edge.object]): belief.probability
        for edge in builder.full().edges
        for belief in edge.predicates
    }


def change(builder: GraphBuilder, rng: np.random.Generator) -> None:
    """Anything that may change a node or a pair, at random."""
    graph = builder.graph
    one, other = rng.choice(list(graph.nodes.slot_of), 2, replace=False).tolist()
    kinds = ["votes"] * 4 + ["see", "near", "predict"] * 3 + ["observe", "move"] * 2
    kind = rng.choice([*kinds, "confirm", "merge", "remove", "take over", "add"])
    item = list(DINNER.values())[rng.integers(len(DINNER))]
    labels = [VOCABULARY.classes.index(name) for name in ("dining table", "chair", "cup", "bowl")]
    width = len(VOCABULARY.predicates)
    if kind == "votes":
        logits = rng.normal(-1, 4, (2, width))
        graph.add_votes(one, other, frame_votes(logits) if rng.integers(3) else None)
    elif kind == "see":
        graph.add_visual(one, other, rng.normal(0, 3, width), 1)
    elif kind == "near":
        graph.add_neighbours([(one, other), (other, one)], 1)
    elif kind == "predict":
        builder.prior.update(rng.choice(labels, (1, 2)), rng.dirichlet(np.ones(width), 1))
    elif kind == "observe":
        classes = np.zeros(len(VOCABULARY.classes))
        classes[labels] = rng.dirichlet(np.ones(len(labels)))
        points = surface(item.parts, rng, int(rng.integers(60)))
        graph.observe(one, np.zeros(3), np.eye(3), classes, 2, points)
    elif kind == "move":
        T = np.eye(4)
        T[:3, 3] = rng.normal(0, 0.4, 3)
        move_node(graph, one, T)
    elif kind == "confirm":
        set_confirmed(graph, one, bool(rng.integers(2)))
    elif kind == "add" or len(graph) < 5:
        node_id = add_node(builder, item, rng, frames=1)
        if rng.integers(2):  # too few points, or just enough
            slot, count = graph.nodes.slot(node_id), int(rng.integers(2 * MIN_SHAPE_POINTS))
            graph.nodes.set_surface(slot, graph.nodes.surface(slot)[:count].copy())
        set_confirmed(graph, node_id, bool(rng.integers(4)))
    elif kind == "merge":
        graph.merge_nodes(one, other)
    elif kind == "remove":
        graph.remove_node(one)
    else:
        graph.take_over(*sorted((one, other)))


# Axis and end of the faces that cameras see: all but the bottom.
_FACES = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1))
