"""A graph as large as a building: its file, questions to it, and its map.

    python bench/building.py [--quick]

10^5 objects in a grid, 0.5 m apart, each related to five of the next ones. A question is asked of a
graph that was asked once before. The map has other objects, with surface points and cells
(`synthetic_map.py`).
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.figures import Figure, Setup
from bench.synthetic_map import POINTS, RoomMap
from deworldsg_ros.base.files import paused_collector
from deworldsg_ros.client import SceneGraph
from deworldsg_ros.config import Config
from deworldsg_ros.graph.graph_files import write_graph
from deworldsg_ros.graph_builder import GraphBuilder, warm_up
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.wire import messages as wire

NODES, EDGES_PER_NODE = 100_000, 5
LABELS = ["cup", "dining table", *(f"class {number}" for number in range(78))]
STAMP = wire.stamp_from_ns(1_700_000_000 * 10**9)
SPACING_M = 0.5


def building(count: int) -> wire.SceneGraphMessage:
    """The graph; object i is in row (i - 1) // side of a square grid."""
    rng = random.Random(0)
    with paused_collector():
        nodes = [_node(number, count, rng) for number in range(1, count + 1)]
        pairs = (
            (number, 1 + (number - 1 + step) % count)
            for number in range(1, count + 1)
            for step in rng.sample(range(1, 60), EDGES_PER_NODE)
        )
        beliefs = [wire.Belief("on", 0.7), wire.Belief("near", 0.1), wire.Belief("under", 0.05)]
        edges = [
            wire.EdgeState(a, b, "on", 0.7, beliefs, "visual", 0.3, 9, remainder=0.02, shown=20)
            for a, b in pairs
        ]
    return wire.SceneGraphMessage(
        schema=wire.schema_of(wire.SceneGraphMessage),
        stamp=STAMP,
        frame_id="map",
        session="bench",
        sequence=1,
        nodes=nodes,
        edges=edges,
        up=[0.0, 0.0, 1.0],
    )


def _node(number: int, count: int, rng: random.Random) -> wire.NodeState:
    side = int(count**0.5)
    row, column = divmod(number - 1, side)
    where = [column * SPACING_M, row * SPACING_M, rng.random()]
    label, second = LABELS[number % len(LABELS)], LABELS[(number + 1) % len(LABELS)]
    return wire.NodeState(
        id=number,
        label=label,
        classes=[wire.Belief(label, 0.8), wire.Belief(second, 0.1), wire.Belief("thing", 0.05)],
        mean_m=where,
        covariance_m2=[0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01],
        observations=rng.randint(1, 99),
        first_seen=STAMP,
        last_seen=STAMP,
        existence=0.95,
        entropy_nats=0.7,
        remainder=0.05,
        box=wire.GravityBox(where, [0.2, 0.3, 0.4], [0.0, 0.0, 0.0, 1.0]),
    )


def fastest_ms(function: Callable[[], object], rounds: int = 5) -> float:
    """The shortest of several times."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    count = 2000 if setup.quick else NODES
    note = f"{count} nodes, {EDGES_PER_NODE * count} edges; by the clock"
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        message = building(count)
        start = time.perf_counter()
        path = write_graph(Path(folder), message)
        save_s = time.perf_counter() - start
        size = path.stat().st_size / count
        del message
        start = time.perf_counter()
        graph = SceneGraph.load(path)
        load_s = time.perf_counter() - start
    centre = graph[count // 2].position_m
    start = time.perf_counter()
    graph.objects(near=centre, within=2.0)
    graph.relations(subject=count // 2)
    first_s = time.perf_counter() - start
    near = fastest_ms(lambda: graph.objects(near=centre, within=2.0))
    of = fastest_ms(lambda: graph.relations(subject=count // 2))
    on = fastest_ms(lambda: graph.on(count // 2 + 5))
    cups = fastest_ms(lambda: graph.objects("cup"))
    return [
        Figure("building_save_json", save_s, "s", note=f"{note}; {size / 1e3:.1f} kB a node"),
        Figure("building_load_json", load_s, "s", target=3, note=note),
        Figure("building_first_question", first_s, "s", note="makes the index"),
        Figure("building_objects_near", near, "ms", note="a point, within 2 m"),
        Figure("building_relations_of", of, "ms", note="of one object"),
        Figure("building_on", on, "ms", note="what is on one object"),
        Figure("building_objects_of_class", cups, "ms", note=f"{count // len(LABELS)} objects"),
        *map_figures(count),
    ]


def map_figures(count: int) -> list[Figure]:
    """Seconds to write and to read the map file of a graph, and to go on with it."""
    config = Config()
    warm_up(config)
    rooms = RoomMap(count)
    (frame,) = rooms.frames(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "building.map"
        builder = rooms.builder(config, EDGES_PER_NODE)
        start = time.perf_counter()
        write_map(builder, path)
        save_s = time.perf_counter() - start
        del builder
        start = time.perf_counter()
        builder = read_map(config, path)
        load_s = time.perf_counter() - start
        size = path.stat().st_size / count
    start = time.perf_counter()
    builder.integrate(frame)
    first_frame_s = time.perf_counter() - start
    calls_s = [update_s(builder)]
    while builder.waiting:
        calls_s.append(update_s(builder))
    note = f"{count} nodes with {POINTS} surface points, {EDGES_PER_NODE * count} edges"
    return [
        Figure("building_save_map", save_s, "s", note=f"{note}; {size / 1e3:.1f} kB a node"),
        Figure("building_load_map", load_s, "s", target=3, note=note),
        Figure("building_first_frame", 1e3 * first_frame_s, "ms", note="merged into the map"),
        Figure(
            *("building_first_update", sum(calls_s), "s"),
            note=f"all objects of the map, prepared in {len(calls_s)} calls between frames",
        ),
        Figure(
            *("building_longest_call", 1e3 * max(calls_s), "ms"),
            note="the longest that a frame waits meanwhile",
        ),
    ]


def update_s(builder: GraphBuilder) -> float:
    """Seconds of one call of `update`."""
    start = time.perf_counter()
    builder.update()
    return time.perf_counter() - start


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    for figure in figures(Setup(quick=parser.parse_args().quick)):
        print(f"{figure.name}: {figure.value:.3g} {figure.unit} ({figure.note})")
