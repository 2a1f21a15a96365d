"""Time of GraphBuilder.integrate: correction of drift, merging, votes; for graphs of any size.

    python bench/integration.py [--quick]

The map is synthetic (`synthetic_map.py`): rooms with 40 objects each. A frame shows 12 objects of
one room. Frames stay in the first 25 rooms, whatever the size of the map: the camera does not jump
through a building. The times are processor times of one thread, of frames after the first tour.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from bench.figures import Figure, Setup  # noqa: E402
from bench.merging import LOCAL_NODES  # noqa: E402
from bench.synthetic_map import RoomMap  # noqa: E402
from deworldsg_ros.config import Config  # noqa: E402
from deworldsg_ros.graph_builder import warm_up  # noqa: E402

# Nodes of the map, and the time to reach, milliseconds.
TARGETS_MS = {1_000: 0.6, 10_000: 0.8, 100_000: 1.0}
ROOMS = 25


def integrate_ms(count: int, rounds: int) -> list[float]:
    """Milliseconds of each of `rounds` frames in a graph of `count` nodes, ascending."""
    world = RoomMap(count)
    builder = world.builder(Config())
    frames = world.frames(rounds + ROOMS, ROOMS)
    times = []
    for local in frames:
        start = time.thread_time()
        builder.integrate(local)
        times.append(1e3 * (time.thread_time() - start))
    return sorted(times[ROOMS:])


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    warm_up(Config())
    found = []
    for count in (1_000,) if setup.quick else TARGETS_MS:
        times = integrate_ms(count, 20 if setup.quick else 300)
        found.append(
            Figure(
                f"integrate_{count}_nodes",
                statistics.median(times),
                "ms",
                target=TARGETS_MS[count],
                note=f"synthetic rooms, a frame of {LOCAL_NODES} objects, median; 95 %: "
                f"{times[int(0.95 * len(times))]:.2f} ms; processor time of one thread",
            )
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small map and few frames")
    for figure in figures(Setup(quick=parser.parse_args().quick)):
        print(f"{figure.name}: {figure.value:.2f} ms ({figure.note})")


if __name__ == "__main__":
    main()
