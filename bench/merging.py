"""Time and memory of merging (Eq. 5-7).

    python bench/merging.py [--quick]

The kernel and the np.linalg reference alternate within one run. The ratio is the median of the
paired ratios. The times are processor times of one thread.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.figures import Figure, Paired, Setup, in_turn
from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.merging import build_merging
from deworldsg_ros.merging.paper_rule import bhattacharyya_bound, nearest_slot, observed, warm_up
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph, Relations, Vocabulary
from deworldsg_ros.scene.gaussian import hellinger_distance

CLASSES = 80
PREDICATES = 50
VOCABULARY = Vocabulary(
    tuple(f"class_{index}" for index in range(CLASSES)),
    tuple(f"predicate_{index}" for index in range(PREDICATES)),
)
LOCAL_NODES = 12
DENSITY_PER_M2 = 3.0
POINTS = 200  # surface points per object, as from lifting
CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
STRIDE_PX = 8
# Distance of the camera from the middle of the objects that it shows.
DISTANCE_M = 2.5
# A wall behind all objects.
WALL_MM = 60_000


class World:
    """Objects of 5-50 cm at a constant density: the floor grows with their number."""

    def __init__(self, count: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        side_m = (count / DENSITY_PER_M2) ** 0.5
        self.means = rng.uniform((0, 0, 0), (side_m, side_m, 1.5), (count, 3))
        bases = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
        variances = rng.uniform(0.05, 0.5, (count, 1, 3)) ** 2 / 12
        # A visible surface is thin in one direction.
        variances[:, :, 2] = 0.005**2
        self.covariances = bases * variances @ bases.swapaxes(1, 2)
        self.covariances = (self.covariances + self.covariances.swapaxes(1, 2)) / 2
        self.roots = bases * variances**0.5
        self.classes = rng.integers(0, CLASSES, count)

    def surface_points(self, row: int, rng: np.random.Generator) -> np.ndarray:
        """Surface points (POINTS, 3): uniform in a thin slab with the moments of the object."""
        spread = rng.uniform(-(3**0.5), 3**0.5, (POINTS, 3))
        return (self.means[row] + spread @ self.roots[row].T).astype(np.float32)

    def probabilities(self, rows: np.ndarray) -> np.ndarray:
        """Class distributions (n, C) of observations of these objects."""
        probabilities = np.full((len(rows), CLASSES), 0.2 / CLASSES)
        probabilities[np.arange(len(rows)), self.classes[rows]] += 0.8
        return probabilities


def graph_of(world: World) -> GlobalGraph:
    """A graph with one node per object and 5 edges per node."""
    graph = GlobalGraph(VOCABULARY, "world")
    rows = np.arange(len(world.means))
    rng = np.random.default_rng(1)
    surfaces = [world.surface_points(row, rng) for row in rows]
    for row, probabilities in zip(rows, world.probabilities(rows)):
        graph.add_node(world.means[row], world.covariances[row], probabilities, 0, surfaces[row])
    for subject in range(1, len(rows) + 1):
        for object_ in rng.integers(1, len(rows) + 1, 5).tolist():
            graph.add_visual(subject, object_, rng.normal(size=PREDICATES), 0)
    return graph


class Objects(Protocol):
    """Objects of a map: means (n, 3), covariances (n, 3, 3), and class distributions."""

    means: np.ndarray
    covariances: np.ndarray

    def probabilities(self, rows: np.ndarray) -> np.ndarray:
        """Class distributions (k, C) of observations of k objects."""
        ...


def local_graph(
    world: Objects,
    rows: np.ndarray,
    stamp_ns: int,
    T_world_camera: np.ndarray,
    surfaces: Sequence[np.ndarray],
    grid: DepthGrid,
    rng: np.random.Generator,
) -> LocalGraph:
    """A frame of some objects with millimetre noise, and relations of the first with the next 10.

    Args:
        world: the map.
        rows: (n,) of the objects in the map.
        stamp_ns: of the frame.
        T_world_camera: (4, 4).
        surfaces: surface points (k, 3) float32 of each object.
        grid: what the camera shows.
        rng: of the noise.
    """
    n = len(rows)
    pairs = np.array([[0, 1 + index] for index in range(min(10, n - 1))])
    return LocalGraph(
        stamp_ns=stamp_ns,
        frame_id="world",
        width=CAMERA.width,
        height=CAMERA.height,
        T_world_camera=T_world_camera,
        vocabulary=VOCABULARY,
        instance_ids=np.arange(1, n + 1),
        boxes_xyxy=np.zeros((n, 4)),
        class_probabilities=world.probabilities(rows),
        scores=np.ones(n),
        means_world=world.means[rows] + rng.normal(0, 0.002, (n, 3)),
        covariances_world=world.covariances[rows],
        depths_m=np.ones(n),
        pixel_counts=np.full(n, 1000),
        surface_points_world=tuple(surfaces),
        depth_grid=grid,
        relations=Relations(pairs, rng.normal(size=(len(pairs), PREDICATES)), np.ones(len(pairs))),
    )


def frames_of(world: World, count: int, seed: int = 2) -> list[LocalGraph]:
    """Frames of 12 neighbouring objects with millimetre noise."""
    rng = np.random.default_rng(seed)
    frames = []
    for stamp_ns in range(1, count + 1):
        centre = world.means[rng.integers(len(world.means))]
        rows = np.argsort(np.linalg.norm(world.means - centre, axis=1))[:LOCAL_NODES]
        T_world_camera = np.eye(4)
        T_world_camera[:3, 3] = world.means[rows].mean(axis=0) - [0.0, 0.0, DISTANCE_M]
        surfaces = tuple(world.surface_points(row, rng) for row in rows)
        grid = depth_grid(surfaces, T_world_camera[:3, 3])
        frames.append(local_graph(world, rows, stamp_ns, T_world_camera, surfaces, grid, rng))
    return frames


def depth_grid(surfaces: tuple[np.ndarray, ...], camera_world: np.ndarray) -> DepthGrid:
    """What a camera that points along z shows of surfaces (k, 3) and of the wall behind them."""
    shape = (CAMERA.height // STRIDE_PX, CAMERA.width // STRIDE_PX)
    depth_mm, instances = np.full(shape, WALL_MM, np.uint16), np.zeros(shape, np.uint16)
    for index, points in enumerate(surfaces):
        x, y, z = (points - camera_world).T
        columns = np.floor((CAMERA.fx * x / z + CAMERA.cx) / STRIDE_PX).astype(int)
        rows = np.floor((CAMERA.fy * y / z + CAMERA.cy) / STRIDE_PX).astype(int)
        inside = (columns >= 0) & (rows >= 0) & (columns < shape[1]) & (rows < shape[0])
        for row, column, depth in zip(rows[inside], columns[inside], 1000 * z[inside]):
            if depth < depth_mm[row, column]:
                depth_mm[row, column], instances[row, column] = depth, index + 1
    return DepthGrid(depth_mm, STRIDE_PX, CAMERA, instances)


def search_with_kernel(graph: GlobalGraph, local: LocalGraph) -> list[int]:
    bound = bhattacharyya_bound(0.7)
    return [
        nearest_slot(observed(mean, covariance, probabilities), graph.nodes, bound, 0.8)
        for mean, covariance, probabilities in zip(
            local.means_world, local.covariances_world, local.class_probabilities
        )
    ]


def search_with_linalg(graph: GlobalGraph, local: LocalGraph) -> list[int]:
    nodes = graph.nodes
    found = []
    for mean, covariance, probabilities in zip(
        local.means_world, local.covariances_world, local.class_probabilities
    ):
        distances = hellinger_distance(mean, covariance, nodes.means, nodes.covariances)
        passing = (distances < 0.7) & (1 - nodes.class_probabilities @ probabilities < 0.8)
        best = np.where(passing, distances, np.inf).argmin()
        found.append(int(best) if passing[best] else -1)
    return found


def milliseconds(call: Callable[[], object]) -> float:
    # Processor time of this thread; other work on the machine does not count.
    start = time.thread_time()
    call()
    return (time.thread_time() - start) * 1e3


def compare_searches(count: int, rounds: int) -> Paired:
    """Both searches in turn, in graphs of `count` nodes."""
    world = World(count)
    graph = graph_of(world)
    frames = frames_of(world, rounds)
    for local in frames:
        assert search_with_kernel(graph, local) == search_with_linalg(graph, local)
    ours, reference = iter(frames), iter(frames)
    return in_turn(
        lambda: search_with_kernel(graph, next(ours)),
        lambda: search_with_linalg(graph, next(reference)),
        rounds,
        time.thread_time,
    )


def search_figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`: the search of the paper's rule."""
    warm_up()
    found = []
    for count, rounds in ((100, 5),) if setup.quick else ((100, 200), (1000, 40)):
        paired = compare_searches(count, rounds)
        found.append(
            Figure(
                f"search_{count}_nodes",
                paired.ours_ms,
                "ms",
                reference="np.linalg over all nodes (scene/gaussian.py)",
                reference_value=paired.reference_ms,
                ratio=paired.ratio,
                note=f"Eq. 5 and 6 for {LOCAL_NODES} objects, processor time of one thread",
            )
        )
    return found


def bench_search(count: int, rounds: int) -> None:
    paired = compare_searches(count, rounds)
    print(
        f"search of {LOCAL_NODES} objects in {count} nodes: "
        f"kernel {paired.ours_ms:7.3f} ms, "
        f"np.linalg {paired.reference_ms:8.2f} ms, ratio {paired.ratio:6.0f}"
    )


def bench_stage(association: Literal["paper", "surface"], count: int, rounds: int) -> None:
    world = World(count)
    frames = frames_of(world, rounds)
    tracemalloc.start()
    graph = graph_of(world)
    config = MergingConfig(association=association)
    merging = build_merging(config, min_existence=0.5)
    merging.restore(graph, {})
    for local in frames:
        merging.merge(graph, local)
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    graph = graph_of(world)
    before = len(graph)
    merging = build_merging(config, min_existence=0.5)
    merging.restore(graph, {})
    times = [milliseconds(lambda frame=local: merging.merge(graph, frame)) for local in frames]
    after = len(graph)
    dense = count**2 * PREDICATES * 8
    print(
        f"{association} rule, {LOCAL_NODES} objects, {before} nodes ({after} at the end), "
        f"{len(graph.edges)} edges: "
        f"median {statistics.median(times):6.3f} ms, 95 % {sorted(times)[int(0.95 * rounds)]:6.3f} "
        f"ms per frame; memory of the graph {held / 1e6:.1f} MB, peak {peak / 1e6:.1f} MB "
        f"(with a dense relation array {dense / 1e6:.0f} MB more)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small graphs and few frames")
    quick = parser.parse_args().quick
    warm_up()
    for count, rounds in ((100, 20),) if quick else ((100, 200), (1000, 40), (10_000, 8)):
        bench_search(count, rounds)
    for association in ("paper", "surface"):
        build_merging(MergingConfig(association=association), min_existence=0.5).warm_up()
        for count in (100,) if quick else (300, 1000):
            bench_stage(association, count, rounds=20 if quick else 300)


if __name__ == "__main__":
    main()
