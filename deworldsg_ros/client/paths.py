"""The most probable chain of relations between two objects."""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping

from deworldsg_ros.scene import wire


def cheapest_chain(
    edges: Mapping[tuple[int, int], wire.EdgeState], first: int, last: int
) -> list[wire.EdgeState]:
    """The edges of the chain with the largest product of probabilities; [] if there is none.

    Edges are used in both directions.
    """
    links: dict[int, list[tuple[float, int, wire.EdgeState]]] = {}
    for (a, b), edge in edges.items():
        # Of two equal chains, the shorter one.
        cost = 1e-6 - math.log(min(max(edge.probability, 1e-9), 1.0))
        links.setdefault(a, []).append((cost, b, edge))
        links.setdefault(b, []).append((cost, a, edge))
    costs = {first: 0.0}
    came: dict[int, tuple[int, wire.EdgeState]] = {}
    waiting = [(0.0, first)]
    while waiting:
        cost, node = heapq.heappop(waiting)
        for step, other, edge in links.get(node, ()):
            if cost + step < costs.get(other, math.inf):
                costs[other], came[other] = cost + step, (node, edge)
                heapq.heappush(waiting, (cost + step, other))
    chain: list[wire.EdgeState] = []
    while last != first and last in came:
        last, edge = came[last]
        chain.insert(0, edge)
    return chain
