#!/usr/bin/env python3
"""What falls if something is taken: `SceneGraph.if_removed` against simulated rooms and piles.

python bench/falls.py [--rooms 3] [--piles 12] [--seed 37]

The rooms are those of tools/physics_rooms (synthetic), without pictures; the truth is what their
simulator moves when it takes an object out. The graph has the true boxes and the true supports, or
both with errors. Its shapes are its own: boards where things rest. The piles are blocks, planks
across two of them, and things on these: there the supports alone do not tell what falls.
Furniture does not move in these rooms, so pairs of furniture are left out, and so is furniture that
carries furniture. Tuned on seed 36.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools" / "physics_rooms"))

from bench.figures import Figure, MissingError, Setup
from deworldsg_ros.client import SceneGraph
from deworldsg_ros.client.boxes import gap_m
from deworldsg_ros.client.removal import Order, carriers_of
from deworldsg_ros.graph.extent import box_of, even_moments
from deworldsg_ros.scene.arrays import Bool, Float64
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import empty_scene_graph

# Pairs whose boxes are farther apart count only if one falls, or is said to: the rest is too easy.
REACH_M = 0.3
# Where the graph has errors: of each face of a box, and the share of wrong supports.
BOX_ERROR_M, WRONG_SUPPORTS = 0.01, 0.1
SURE = 0.95
# Of what is reported; 36 is for tuning.
SEED = 37


@dataclass
class Scene:
    """Things at rest, and what the simulator knows of them.

    Attributes:
        items: of tools/physics_rooms.
        supports: of each item: the relation with what carries it, by number.
        outcome: what the simulator measured.
        world: the simulation, at rest.
    """

    items: list[Any]
    supports: dict[int, dict[int, str]]
    outcome: Any
    world: Any
    _moved: dict[frozenset[int], set[int]] = field(default_factory=dict)

    def falls(self, taken: set[int], number: int) -> set[int]:
        """What the simulator moves when it takes an item out, after others."""
        items, touches = self.by_number, self.outcome.touches
        touching = {b for a, b in touches if a == number and b > 0 and items[b].anchor != "world"}
        if items[number].anchor != "free" or touching <= taken:
            return set()
        for gone in (frozenset(taken), frozenset({*taken, number})):
            if gone not in self._moved:
                self._moved[gone] = self.world.moved(set(gone))
        moved = self._moved[frozenset({*taken, number})] - self._moved[frozenset(taken)]
        return moved - taken - {number}

    @property
    def by_number(self) -> dict[int, Any]:
        """The items by number."""
        return {item.number: item for item in self.items}


def rooms(seed: int, count: int) -> Iterator[Scene]:
    """Furnished rooms at rest."""
    from physics_room.simulate import settled_room

    for index in range(count):
        room, outcome = settled_room(index, seed)
        yield _scene([item for item in room.items if item.kind != "flat"], outcome, room.size)


def piles(seed: int, count: int) -> Iterator[Scene]:
    """Blocks on the floor, planks across them, and things on these; those that rest level."""
    from physics_room.simulate import simulate

    size = (8.0, 8.0, 3.0)
    for index in range(count):
        items = _pile(np.random.default_rng([seed, index]))
        outcome = simulate(items, size)
        if outcome.resting and all(item.rotation[2, 2] > 0.999 for item in items):
            yield _scene(items, outcome, size)


def _pile(rng: np.random.Generator) -> list[Any]:
    """A block on a block, twice, a plank across both, and two things on it at most."""
    from physics_room.shapes import Item, box

    high, reach = rng.uniform(0.08, 0.2), rng.uniform(0.15, 0.3)
    level, shift = high + 0.102, rng.uniform(-0.6, 0.6) * reach
    # Along the plank, above the floor, wide, high.
    blocks = [(side * reach, 0.0, 0.1, high) for side in (-1, 1)]
    blocks += [(side * reach, high + 0.001, 0.1, 0.1) for side in (-1, 1)]
    blocks += [(shift, level, rng.uniform(2.1, 3.2) * reach, 0.02)]
    for side in rng.permutation([-1.0, 1.0])[: rng.integers(0, 3)]:
        blocks.append((shift + side * rng.uniform(0.3, 0.9) * reach, level + 0.021, 0.1, 0.1))
    items = []
    for number, (x, z, wide, tall) in enumerate(blocks, start=1):
        part = box((-wide / 2, -0.05, 0.0), (wide / 2, 0.05, tall))
        items.append(Item("box", "small", [part], [], 50.0 * wide * tall, number=number))
        items[-1].position = np.array([x, 0.0, z])
    return items


def _scene(items: list[Any], outcome: Any, size: tuple[float, float, float]) -> Scene:
    from physics_room.simulate import World
    from physics_room.truth import Judge

    supports: dict[int, dict[int, str]] = {item.number: {} for item in items}
    for (a, b), name in Judge(items, outcome, set()).judge().relations.items():
        if name in ("on", "in", "attached to"):
            supports[a][b] = name
    return Scene(items, supports, outcome, World(items, size))


def graph_of(scene: Scene, seed: int, *, with_errors: bool) -> SceneGraph:
    """The graph of a scene: true boxes and supports, or both with errors."""
    rng = np.random.default_rng(seed)
    nodes = [_node(item, rng, BOX_ERROR_M if with_errors else 0.0) for item in scene.items]
    graph = SceneGraph(_message(nodes, []))
    edges = []
    for number, below in scene.supports.items():
        sure = 1.0 - WRONG_SUPPORTS if with_errors else SURE
        shares = dict.fromkeys(below, sure / max(len(below), 1))
        if with_errors and below and rng.random() < WRONG_SUPPORTS:
            near = [other.id for other in graph.objects(near=graph[number], within=REACH_M)]
            shares = {int(rng.choice(near)): sure} if near else {}
        for other, share in shares.items():
            name = below.get(other, "on")
            edges.append(
                wire.EdgeState(
                    subject=number,
                    object=other,
                    predicate=name,
                    probability=share,
                    predicates=[wire.Belief(name, share)],
                    provenance="visual",
                    entropy_nats=0.1,
                    observations=9,
                )
            )
    return SceneGraph(_message(nodes, edges))


def _message(nodes: list[wire.NodeState], edges: list[wire.EdgeState]) -> wire.SceneGraphMessage:
    return replace(empty_scene_graph("map"), nodes=nodes, edges=edges, up=[0.0, 0.0, 1.0])


def _node(item: Any, rng: np.random.Generator, error_m: float) -> wire.NodeState:
    """An object with the box and the covariance of the item's surface."""
    corners = item.vertices()
    heights = corners[:, 2]
    flat = box_of(np.column_stack([corners[:, :2], 0.0 * heights]), (0.0, 0.0, 1.0))
    center: Float64 = np.array([*flat.center_m[:2], (heights.min() + heights.max()) / 2])
    size = np.array([*flat.size_m[:2], np.ptp(heights)])
    low, high = rng.normal(0.0, error_m, (2, 3)) if error_m else np.zeros((2, 3))
    center, size = center + (low + high) / 2, np.maximum(size + high - low, 0.005)
    points = _surface(item)
    mean, covariance = even_moments(points.astype(np.float32))
    stamp = wire.stamp_from_ns(10**9)
    return wire.NodeState(
        id=item.number,
        label=item.label,
        classes=[wire.Belief(item.label, 0.9)],
        mean_m=mean.tolist(),
        covariance_m2=covariance.ravel().tolist(),
        observations=9,
        first_seen=stamp,
        last_seen=stamp,
        existence=1.0,
        box=wire.GravityBox(center.tolist(), size.tolist(), flat.orientation_xyzw),
    )


def _surface(item: Any) -> Float64:
    """Points (n, 3) evenly over the visible surface."""
    rng = np.random.default_rng(item.number)
    found = []
    for part in item.parts:
        if part.visible:
            a, b, c = (part.mesh.vertices[part.mesh.faces[:, k]] for k in range(3))
            areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
            face = rng.choice(len(areas), max(4, int(areas.sum() / 4e-4)), p=areas / areas.sum())
            u, v = rng.random((2, len(face), 1))
            u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
            found.append(a[face] + u * (b - a)[face] + v * (c - a)[face])
    points = np.concatenate(found)
    return np.asarray(rng.permutation(points)[:400] @ item.rotation.T + item.position)


@dataclass
class Score:
    """What was said of pairs of objects, and what is true.

    Attributes:
        said, symbolic: probabilities that the second object moves without the first: settled, and
            of the graph's supports alone.
        true: whether it does.
        seconds: of each question.
        orders, steps, false_safe, needless: of orders: their number, their steps, safe steps at
            which something falls, and steps that are called unsafe and are not.
    """

    said: list[float] = field(default_factory=list)
    symbolic: list[float] = field(default_factory=list)
    true: list[bool] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    orders: int = 0
    steps: int = 0
    false_safe: int = 0
    needless: int = 0
    wrong: list[str] = field(default_factory=list)

    def add_pairs(self, scene: Scene, graph: SceneGraph) -> None:
        """Take each object out, and compare."""
        items = scene.by_number
        fixed = {i for i, item in items.items() if item.anchor == "world"}
        carriers = {i: carriers_of(graph, graph[i]) for i in items}
        bases = {b for a in fixed for b in scene.supports[a]}
        # Furniture stands on furniture here by construction: a counter on its cabinet.
        bases |= {i for i in fixed if items[i].label == "base-cabinet"}
        for i in items.keys() - bases:
            start = time.process_time()
            moves = {other.id: chance for other, chance in graph.if_removed(i).moves}
            self.seconds.append(time.process_time() - start)
            for other in items.keys() - fixed - {i}:
                true = i in scene.outcome.falls_without.get(other, ())
                far = gap_m(graph[i].footprint, graph[other].footprint) > REACH_M
                if far and not true and other not in moves:
                    continue
                self.said.append(moves.get(other, 0.0))
                self.symbolic.append(carriers[other].get(i, 0.0))
                self.true.append(true)
                if (self.said[-1] >= 0.5) != true:
                    names = f"{items[other].label} {other} without {items[i].label} {i}"
                    self.wrong.append(f"{names}: said {self.said[-1]:.2f}, true {true}")

    def add_order(self, scene: Scene, order: Order) -> None:
        """Follow an order in the simulator."""
        self.orders += 1
        taken = set[int]()
        for step in order.steps:
            falls = scene.falls(taken, step.item.id)
            self.steps += 1
            self.needless += not step.is_safe and not falls
            if step.is_safe and falls:
                self.false_safe += 1
                labels = ", ".join(scene.by_number[i].label for i in falls)
                self.wrong.append(f"{step.item.label} was called safe: {labels} moves")
            taken.add(step.item.id)

    def rates(self, said: list[float]) -> tuple[float, float, float]:
        """Precision and recall from one half on, and the expected calibration error in points."""
        chances, true = np.array(said), np.array(self.true)
        yes: Bool = chances >= 0.5
        bins = np.minimum((10 * chances).astype(int), 9)
        parts = [bins == k for k in range(10)]
        error = sum(p.mean() * abs(chances[p].mean() - true[p].mean()) for p in parts if p.any())
        hits = float((yes & true).sum())
        return hits / max(yes.sum(), 1), hits / max(true.sum(), 1), 100.0 * error


def measure(kind: str, seed: int, count: int, *, with_errors: bool = False) -> Score:
    """Score graphs of rooms or piles."""
    score = Score()
    for index, scene in enumerate((rooms if kind == "rooms" else piles)(seed, count)):
        graph = graph_of(scene, index, with_errors=with_errors)
        score.add_pairs(scene, graph)
        if with_errors:
            continue
        for item in scene.items:
            if item.anchor == "free":
                score.add_order(scene, graph.order_to_take(item.number))
            elif item.tops and kind == "rooms":
                score.add_order(scene, graph.order_to_clear(item.number))
    return score


def figures(setup: Setup) -> list[Figure]:
    """The figures of `python -m bench`."""
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise MissingError("no package mujoco (extra physics)") from error
    found = []
    for kind, count in (("rooms", 1 if setup.quick else 3), ("piles", 3 if setup.quick else 12)):
        score = measure(kind, SEED, count)
        precision, recall, error = score.rates(score.said)
        _, alone, _ = score.rates(score.symbolic)
        of = f"{len(score.true)} pairs, {sum(score.true)} fall"
        steps = f"of {score.steps} steps"
        found += [
            Figure(f"falls_precision_{kind}", precision, "", 0.9, True, note=of),
            Figure(f"falls_recall_{kind}", recall, "", 0.9, True, note=of),
            Figure(f"falls_calibration_error_{kind}", error, "points", 5.0, note=of),
            Figure(f"falls_recall_of_supports_{kind}", alone, "", more_is_better=True, note=of),
            Figure(f"falls_false_safe_{kind}", score.false_safe, "steps", 0.0, note=steps),
            Figure(f"falls_slowest_{kind}", max(score.seconds), "s", 2.0, note="processor time"),
        ]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", type=int, default=3)
    parser.add_argument("--piles", type=int, default=12)
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args()
    for kind, count in (("rooms", options.rooms), ("piles", options.piles)):
        for with_errors in (False, True):
            score = measure(kind, options.seed, count, with_errors=with_errors)
            if not score.true:
                continue
            print(f"{kind}{', with errors' * with_errors}: {len(score.true)} pairs, ", end="")
            print(f"{sum(score.true)} fall; slowest {max(score.seconds):.2f} s", flush=True)
            for name, said in (("settled", score.said), ("supports alone", score.symbolic)):
                precision, recall, error = score.rates(said)
                print(f"  {name}: precision {precision:.3f}, recall {recall:.3f}, ECE {error:.2f}")
            if score.orders:
                print(f"  {score.orders} orders of {score.steps} steps: ", end="")
                print(f"{score.false_safe} false safe, {score.needless} needlessly unsafe")
            print(*(f"    {line}" for line in score.wrong[:25]), sep="\n", flush=True)


if __name__ == "__main__":
    main()
