"""`python -m endurance.soak [MINUTES]`: memory and times of long runs."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import theilslopes
from support.merging import VOCABULARY
from support.surfaces import CHAIR, CUP, TABLE, frame, slab

from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene.frame_graph import LocalGraph
from endurance.rig import Rig

# Models, kernels, buffers and the graph of the room are there after two minutes. Then Python still
# fills up its own lists of free tuples (2000 of each length) and of names of attributes (4096).
SETTLE_S = 600.0
SAMPLE_PERIOD_S = 1.0
# A node that waits for a busy machine holds more messages at once, and keeps that memory for the
# next time. So each node stands still once, for so long that its queues are full.
FIRST_PAUSE_S, PAUSE_S = 40.0, 5.0
MAX_SLOPE_MB_PER_H = 1.0
# A slope over less time is noise: one allocation of 0.2 MB in ten minutes is more than the limit.
LEAST_SLOPE_S = 1800.0
# Of the last tenth of the frames, by that of the first, after the graph is complete.
MAX_SLOWER = 1.5
ROOM_FRAMES = 8
# Of the graph, for its clients: three a second at 30 Hz.
FRAMES_PER_UPDATE = 10
ROOM_DISTANCE_M = 20.0


class Series:
    def __init__(self, samples: Iterable[tuple[float, float]] = ()) -> None:
        self.samples = list(samples)  # of the time in seconds, and the value

    def settled(self, settle_s: float) -> Series:
        return Series(sample for sample in self.samples if sample[0] >= settle_s)

    def slope_per_h(self) -> float:
        """Median slope of all pairs of a thousand samples (Theil and Sen)."""
        times_s, values = np.array(self.samples[:: len(self.samples) // 1000 + 1]).T
        return 3600 * float(theilslopes(values, times_s).slope)

    def ends(self) -> tuple[float, float]:
        values = [value for _, value in self.samples]
        third = max(1, len(values) // 3)
        return float(np.median(values[:third])), float(np.median(values[-third:]))


@dataclass(frozen=True)
class Costs:
    """Cost per frame of the first and the last tenth, by a clock, and the growth of the memory."""

    frames: int
    first: float
    last: float
    grown_mb: float

    @property
    def slower(self) -> float:
        return self.last / self.first


def allocated_mb(pid: int | str = "self") -> float:
    """Resident memory that a process allocated, in megabytes.

    Pages of files (libraries) are left out: the kernel drops and reads them as other processes
    need memory, and that looks like a leak of 10 MB an hour.
    """
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) / 1024
    return 0.0


def replay(minutes: float, folder: Path) -> tuple[dict[str, Series], Series]:
    """Memory of each process during an endless replay, and latency of graph_node as a series."""
    rig = Rig(folder)
    memory, latencies = defaultdict(Series), Series()
    try:
        rig.start_all()
        rig.start_others()
        started_s = time.monotonic()
        rig.run(FIRST_PAUSE_S)
        for process in rig.processes.values():
            os.kill(process.pid, signal.SIGSTOP)
            try:
                rig.run(PAUSE_S)
            finally:
                os.kill(process.pid, signal.SIGCONT)
        while (now_s := time.monotonic() - started_s) < 60 * minutes:
            for name, process in rig.processes.items():
                assert process.alive, process.log[-500:]
                memory[name].samples.append((now_s, allocated_mb(process.pid)))
            if rig.client is not None:
                assert rig.client.poll() is None
                memory["a Python client"].samples.append((now_s, allocated_mb(rig.client.pid)))
            latency_ms = rig.values.get("graph_node", {}).get("latency mean ms")
            if latency_ms is not None:
                latencies.samples.append((now_s, float(latency_ms)))
            rig.run(SAMPLE_PERIOD_S)
    finally:
        rig.close()
    return memory, latencies


def rooms(count: int, frames: int = ROOM_FRAMES) -> Iterator[LocalGraph]:
    """Frames of a camera that goes from room to room: a table, a mug on it and a chair in each."""
    shapes = [
        (slab((0.0, 0.0, 1.0), (1.2, 0.8, 0.04)), TABLE),
        (slab((0.2, 0.1, 0.95), (0.08, 0.08, 0.08)), CUP),
        (slab((1.2, 0.0, 1.0), (0.4, 0.5, 0.4)), CHAIR),
    ]
    for number in range(count):
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = ROOM_DISTANCE_M * number
        shift = T_world_camera[:3, 3].astype(np.float32)
        objects = [(points + shift, kind) for points, kind in shapes]
        for stamp in range(number * frames, (number + 1) * frames):
            yield frame(stamp + 1, *objects, T_world_camera=T_world_camera)


def merge(
    frames: Iterator[LocalGraph], settle: int, clock: Callable[[], float] = time.thread_time
) -> Costs:
    """Merge frames and make updates of the graph; `settle` frames are not measured."""
    builder = GraphBuilder(Config(), VOCABULARY, "world")
    costs, before_mb = [], 0.0
    for index, local in enumerate(frames):
        if index == settle:
            before_mb = allocated_mb()
        started = clock()
        builder.integrate(local)
        if index % FRAMES_PER_UPDATE == 0:
            builder.update()
        costs.append(clock() - started)
    measured = np.array(costs[settle:])
    tenth = max(1, len(measured) // 10)
    first, last = np.median(measured[:tenth]), np.median(measured[-tenth:])
    return Costs(len(measured), float(first), float(last), allocated_mb() - before_mb)


def problems_of_merging(name: str, costs: Costs) -> Iterator[str]:
    print(
        f"{name}: {costs.frames} frames, {1e3 * costs.first:.2f} ms a frame at first, "
        f"{1e3 * costs.last:.2f} ms at the end; memory grew by {costs.grown_mb:.1f} MB",
        flush=True,
    )
    if costs.slower > MAX_SLOWER:
        yield f"{name}: {costs.slower:.1f} times slower"


def problems_of_replay(minutes: float) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as folder:
        memory, latencies = replay(minutes, Path(folder))
    settle_s = min(SETTLE_S, 12 * minutes)
    for name, series in memory.items():
        settled = series.settled(settle_s)
        slope = settled.slope_per_h()
        print(f"{name}: {settled.samples[-1][1]:.0f} MB, {slope:+.2f} MB an hour")
        if 60 * minutes >= LEAST_SLOPE_S and slope > MAX_SLOPE_MB_PER_H:
            yield f"{name} grows by {slope:.2f} MB an hour"
    first_ms, last_ms = latencies.settled(settle_s).ends()
    print(f"graph_node: latency {first_ms:.1f} ms at first, {last_ms:.1f} ms at the end")
    if last_ms > MAX_SLOWER * first_ms + 1.0:
        yield "the latency of graph_node grows"


def main() -> int:
    """Returns 1 if the memory or the times grow."""
    parser = argparse.ArgumentParser(prog="scripts/soak", description=__doc__)
    parser.add_argument("minutes", nargs="?", type=float, default=60.0, help="of replay; 0 = none")
    parser.add_argument("--frames", type=int, default=100_000, help="of the still camera")
    parser.add_argument("--rooms", type=int, default=300)
    options = parser.parse_args()
    still, many = rooms(1, options.frames), rooms(options.rooms)
    problems = [
        *problems_of_merging("still camera", merge(still, settle=1000)),
        *problems_of_merging("rooms", merge(many, settle=10 * ROOM_FRAMES)),
        *(problems_of_replay(options.minutes) if options.minutes else ()),
    ]
    for problem in problems:
        print("problem:", problem)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
