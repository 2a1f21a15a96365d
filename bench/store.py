"""A graph in the database of `deworldsg store`, compared with its JSON file.

    python bench/store.py [--quick]

The graph is that of `building.py`. A frame changes 12 objects and 60 relations: it moves the
objects by millimetres, and one of them by a metre. `deworldsg store add --live` brings the database
up to date every two seconds: with 60 frames.
"""

from __future__ import annotations

import argparse
import random
import statistics
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import msgspec

from bench.building import EDGES_PER_NODE, NODES, building
from bench.figures import Figure, MissingError, Setup
from deworldsg_ros.graph.graph_files import read_graph, write_graph
from deworldsg_ros.store import Store
from deworldsg_ros.store.store import DATABASE_FILE, StoreWriter
from deworldsg_ros.wire import messages as wire

FRAMES, OBJECTS, RELATIONS = 60, 12, 60
TWO_HOPS = (
    "MATCH (a:Object {id: $id})-[r:Relation]->(b:Object)-[s:Relation]->(c:Object) "
    "RETURN b.label, c.id, c.label, s.predicate, s.probability"
)


def frames(
    message: wire.SceneGraphMessage, first: int, number: int
) -> list[wire.SceneGraphUpdateMessage]:
    """Updates of a camera that looks at the same objects for half a second."""
    rng = random.Random(first)
    found = []
    for sequence in range(first, first + number):
        start = 1 + sequence // 15 * 97 % (len(message.nodes) - OBJECTS)
        nodes = [
            _moved(
                node, 1.0 if node.id == start + 1 and sequence % 15 == 0 else 0.001 * rng.random()
            )
            for node in message.nodes[start : start + OBJECTS]
        ]
        edges = [
            msgspec.structs.replace(edge, probability=rng.random(), observations=sequence)
            for edge in message.edges[EDGES_PER_NODE * start :][:RELATIONS]
        ]
        found.append(
            wire.SceneGraphUpdateMessage(
                schema=wire.schema_of(wire.SceneGraphUpdateMessage),
                stamp=wire.stamp_from_ns(wire.ns_from_stamp(message.stamp) + sequence * 33_000_000),
                frame_id="map",
                session=message.session,
                sequence=sequence,
                removed_nodes=[],
                removed_edges=[],
                nodes=nodes,
                edges=edges,
                associations=[],
            )
        )
    return found


def _moved(node: wire.NodeState, by_m: float) -> wire.NodeState:
    assert isinstance(node.box, wire.GravityBox)
    x, y, z = node.box.center_m
    box = msgspec.structs.replace(node.box, center_m=[x + by_m, y, z])
    return msgspec.structs.replace(node, box=box, observations=node.observations + 1)


def update_ms(folder: Path, updates: list[wire.SceneGraphUpdateMessage]) -> float:
    """Milliseconds of a frame: its line of JSON, and its part of the commit."""
    with StoreWriter(folder) as writer:
        start = time.perf_counter()
        for update in updates:
            writer.add(update)
        writer.commit()
        return 1e3 * (time.perf_counter() - start) / len(updates)


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    try:
        import ladybug  # noqa: F401
    except ImportError as error:
        raise MissingError("the package ladybug is not installed") from error
    count = 2000 if setup.quick else NODES
    rng = random.Random(0)
    size = f"{count} nodes, {EDGES_PER_NODE * count} edges; by the clock"
    with tempfile.TemporaryDirectory() as parent:
        message = building(count)
        path = write_graph(Path(parent), message)
        start = time.perf_counter()
        read_graph(path)
        read_s = time.perf_counter() - start
        folder = Path(parent) / "store"
        start = time.perf_counter()
        with StoreWriter(folder) as writer:
            writer.add_file(path)
        load_s = time.perf_counter() - start
        disk = (folder / DATABASE_FILE).stat().st_size / 1e6
        hops = []
        with Store(folder).opened() as database:
            for _ in range(30):
                start = time.perf_counter()
                database.run(TWO_HOPS, {"id": rng.randint(1, count)})
                hops.append(1e3 * (time.perf_counter() - start))
        start = time.perf_counter()
        Store(folder).at(wire.ns_from_stamp(message.stamp), "cup")
        at_ms = 1e3 * (time.perf_counter() - start)
        update = update_ms(folder, frames(message, 2, FRAMES))
        alone = statistics.median(
            update_ms(folder, frames(message, 2 + FRAMES + number, 1)) for number in range(5)
        )
    hop, json_file = statistics.median(hops), "reading the JSON file with msgspec"
    frame = f"{OBJECTS} objects, {RELATIONS} relations"
    return [
        Figure("store_load", load_s, "s", 5, False, json_file, read_s, read_s / load_s, note=size),
        Figure("store_size", disk, "MB", note="the database"),
        Figure(
            *("store_two_hops", hop, "ms", 10, False),
            *(json_file, 1e3 * read_s, 1e3 * read_s / hop),
            note="from one object over two relations, in an open database",
        ),
        Figure("store_at", at_ms, "ms", note="where every cup was at a time; opens the database"),
        Figure(
            *("store_update", update, "ms", 2),
            note=f"a frame of {frame}, in a commit of {FRAMES} frames; with its line of JSON",
        ),
        Figure("store_update_alone", alone, "ms", note="the same, one frame a commit"),
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    for figure in figures(Setup(quick=parser.parse_args().quick)):
        print(f"{figure.name}: {figure.value:.3g} {figure.unit} ({figure.note})")
