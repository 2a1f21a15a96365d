"""Time of GraphBuilder.integrate and update, for graphs of any size.

    python bench/integration.py [--quick]

`integrate` corrects drift, merges and counts votes; `update` tells what changed: beliefs, messages,
and their JSON. The map is synthetic (`synthetic_map.py`): rooms with 40 objects each. A frame shows
12 objects of one room. The camera stays half a second in a room, and in the first 25 rooms,
whatever the size of the map. The times are processor times of one thread, after the first frames.
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
from bench.synthetic_map import RoomMap, publish  # noqa: E402
from deworldsg_ros.config import Config  # noqa: E402
from deworldsg_ros.graph_builder import warm_up  # noqa: E402
from deworldsg_ros.wire import messages as wire  # noqa: E402

# Nodes of the map, and the times to reach, milliseconds.
TARGETS_MS = {
    1_000: {"integrate": 0.6, "update": 0.5},
    10_000: {"integrate": 0.8, "update": 0.5},
    100_000: {"integrate": 1.0, "update": 0.5},
}
ROOMS = 25
# Frames in a row of one room: half a second at 30 Hz.
STAY = 15


def frame_ms(count: int, rounds: int) -> dict[str, list[float]]:
    """Milliseconds of each part of `rounds` frames in a graph of `count` nodes, ascending."""
    world = RoomMap(count)
    builder = world.builder(Config())
    publish(builder)
    times: dict[str, list[float]] = {"integrate": [], "update": []}
    for local in world.frames(rounds + ROOMS, ROOMS, stay=STAY):
        start = time.thread_time()
        builder.integrate(local)
        merged = time.thread_time()
        update = builder.update()
        if update is not None:
            wire.encode(update)
        times["integrate"].append(1e3 * (merged - start))
        times["update"].append(1e3 * (time.thread_time() - merged))
    return {part: sorted(values[ROOMS:]) for part, values in times.items()}


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    warm_up(Config())
    found = []
    for count in (1_000,) if setup.quick else TARGETS_MS:
        for part, times in frame_ms(count, 20 if setup.quick else 300).items():
            found.append(
                Figure(
                    f"{part}_{count}_nodes",
                    statistics.median(times),
                    "ms",
                    target=TARGETS_MS[count][part],
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
