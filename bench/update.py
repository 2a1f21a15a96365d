"""Time of telling what changed: `GraphBuilder.update` after a frame, by the size of the graph.

    python bench/update.py [--quick]

Synthetic: objects of random classes at a constant density, frames of 12 neighbours at random
places. The times are processor times of one thread.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.merging import VOCABULARY, World, frames_of, graph_of, milliseconds
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder, warm_up

COUNTS = (1000, 10_000, 100_000)
FRAMES = 60


def figures(counts: tuple[int, ...] = COUNTS, frames: int = FRAMES) -> dict[str, float]:
    """Median milliseconds a frame of `integrate` and `update`, by the number of nodes."""
    found = {}
    config = Config()
    warm_up(config)
    for count in counts:
        world = World(count)
        builder = GraphBuilder(config, VOCABULARY, "world", graph=graph_of(world))
        builder.merging.restore(builder.graph, {})
        found[f"first update, {count} nodes"] = milliseconds(builder.update)
        times: dict[str, list[float]] = {"integrate": [], "update": []}
        for local in frames_of(world, frames):
            times["integrate"].append(milliseconds(partial(builder.integrate, local)))
            times["update"].append(milliseconds(builder.update))
        for name, values in times.items():
            found[f"{name}, {count} nodes"] = statistics.median(values)
            found[f"{name}, {count} nodes, 95 %"] = sorted(values)[int(0.95 * len(values))]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small graphs and few frames")
    arguments = parser.parse_args()
    for name, milliseconds_ in (figures((300,), 10) if arguments.quick else figures()).items():
        print(f"{name}: {milliseconds_:.3f} ms")


if __name__ == "__main__":
    main()
