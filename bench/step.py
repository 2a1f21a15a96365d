"""Time of one step without networks: lift, merge, relate, update, encode.

    python bench/step.py [--quick]

The map is synthetic (`synthetic_map.py`). A frame is a whole image of a room: depth with noise of a
millimetre, and masks of 12 objects. The times are processor times of one thread.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from bench.figures import Figure, Setup  # noqa: E402
from bench.integration import ROOMS, STAY  # noqa: E402
from bench.merging import CAMERA, LOCAL_NODES, PREDICATES, VOCABULARY  # noqa: E402
from bench.synthetic_map import OBJECTS_PER_ROOM, RoomMap, publish  # noqa: E402
from deworldsg_ros.config import Config  # noqa: E402
from deworldsg_ros.graph_builder import warm_up  # noqa: E402
from deworldsg_ros.perception.stage import Perceived  # noqa: E402
from deworldsg_ros.pipeline import Pipeline  # noqa: E402
from deworldsg_ros.scene.camera import RgbdFrame  # noqa: E402
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations  # noqa: E402
from deworldsg_ros.wire import messages as wire  # noqa: E402

# Nodes of the map, and the time to reach, milliseconds.
TARGETS_MS = {300: 4.0, 10_000: 5.0}


def frames(world: RoomMap, count: int) -> Iterator[tuple[RgbdFrame, Perceived]]:
    """Frames of random rooms, the camera stays half a second in each, with perfect perception."""
    rng = np.random.default_rng(2)
    rooms = min(ROOMS, len(world.means) // OBJECTS_PER_ROOM)
    rgb = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    pairs = np.array([[0, 1 + index] for index in range(10)])
    for number in range(count):
        if number % STAY == 0:
            room = int(rng.integers(rooms))
        view, stamp_ns = world.view(room, rng), (1 + number) * 33_000_000
        depth_mm, instances = view.render(1)
        depth_m = np.rint(depth_mm + rng.normal(0, 1.0, depth_mm.shape)).astype(np.float32) / 1000
        graph = FrameGraph(
            stamp_ns,
            "camera",
            CAMERA.width,
            CAMERA.height,
            VOCABULARY,
            boxes_of(instances, len(view.rows)),
            world.probabilities(view.rows),
            np.ones(len(view.rows)),
            Relations(pairs, rng.normal(size=(len(pairs), PREDICATES)), np.ones(len(pairs))),
        )
        frame = RgbdFrame(stamp_ns, rgb, depth_m, CAMERA, view.T_world_camera)
        yield frame, Perceived(graph, instances)


def boxes_of(instances: np.ndarray, count: int) -> np.ndarray:
    """Box (x1, y1, x2, y2) of each instance, in pixels; zeros for one that is hidden."""
    boxes = np.zeros((count, 4))
    for index in range(count):
        rows, columns = np.nonzero(instances == index + 1)
        if len(rows):
            boxes[index] = columns.min(), rows.min(), columns.max(), rows.max()
    return boxes


class Known:
    """A perceiver that returns the result that was set."""

    perceived: Perceived

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The result that was set."""
        return self.perceived


def step_ms(count: int, rounds: int) -> tuple[list[float], float]:
    """Milliseconds of each frame in a graph of `count` nodes, ascending; mask pixels of a frame."""
    world, config, perceiver = RoomMap(count), Config(), Known()
    pipeline = Pipeline(config, perceiver)
    builder = world.builder(config)
    pipeline.go_on_with(builder)
    publish(builder)
    times, pixels = [], []
    for frame, perceiver.perceived in frames(world, rounds + ROOMS):
        start = time.thread_time()
        pipeline.process(frame)
        update = builder.update()
        if update is not None:
            wire.encode(update)
        times.append(1e3 * (time.thread_time() - start))
        pixels.append(np.count_nonzero(perceiver.perceived.instances))
    return sorted(times[ROOMS:]), statistics.mean(pixels)


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    Pipeline(Config(), Known()).lifting.warm_up()
    warm_up(Config())
    found = []
    for count in (300,) if setup.quick else TARGETS_MS:
        times, pixels = step_ms(count, 20 if setup.quick else 300)
        found.append(
            Figure(
                f"step_{count}_nodes",
                statistics.median(times),
                "ms",
                target=TARGETS_MS[count],
                note="lift, merge, relate, update and encode a frame of "
                f"{LOCAL_NODES} objects, {pixels / 1e3:.0f} k mask pixels, median; 95 %: "
                f"{times[int(0.95 * len(times))]:.2f} ms; processor time of one thread",
            )
        )
    return found


if __name__ == "__main__":
    for figure in figures(Setup(quick="--quick" in sys.argv)):
        print(f"{figure.name}: {figure.value:.2f} ms ({figure.note})")
