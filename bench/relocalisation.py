#!/usr/bin/env python3
"""Is a room found again the next day, and is another room never taken for it?

python bench/relocalisation.py [--rooms 25] [--seed 100] [--maps FOLDER] [--json FILE]

Synthetic rooms (`bench.furnished`). Of each, a map is made in a tour of 25 s. Then somebody stands
elsewhere in it, four times, and turns by 60 degrees a second for 5 s; the odometry begins there
with any heading, and a third of the things have been moved. Each of these runs is also tried in
two other rooms.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.figures import Figure, Setup
from bench.furnished import (
    RATE_HZ,
    Room,
    furnish,
    local_graphs,
    look_around,
    start_frame,
    tour,
    with_moved,
)
from deworldsg_ros.client import SceneGraph
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.relocalisation import Place, Returning
from deworldsg_ros.scene.camera import invert_pose, rotation_angle_deg

RUNS, OTHERS, TOUR_S, LOOK_S = 4, 2, 25.0, 5.0
DAY_NS = 86_400 * 10**9
# A transform with a larger error is wrong.
WRONG_M, WRONG_DEG = 0.1, 2.0


@dataclass(frozen=True)
class Map:
    """A room, its map, and how the map's frame lies in it."""

    room: Room
    path: Path
    T_map_room: np.ndarray


@dataclass
class Try:
    """One run in its own room.

    Attributes:
        found_s: seconds of looking around until it was found; None = never.
        reason: why not.
        error_m, error_deg: of the transform, at the middle of the objects.
        same_ids: share of the map's objects of things that stayed that have their ids and places.
        doubles: nodes more than before inside things that stayed.
        told: how many of the moved things are reported as moved or gone, and how many were moved.
        untrue: how many things are reported as moved or gone although they stayed.
    """

    found_s: float | None = None
    reason: str = ""
    error_m: float = 0.0
    error_deg: float = 0.0
    same_ids: float = 0.0
    doubles: int = 0
    told: tuple[int, int] = (0, 0)
    untrue: int = 0


def make_map(seed: int, folder: Path) -> Map:
    """A room and its map file."""
    room = furnish(seed)
    poses = tour(room, TOUR_S, seed + 10_000)
    T_map_room, path = start_frame(poses, seed + 20_000), folder / f"{seed}.map"
    if path.exists():
        return Map(room, path, T_map_room)
    builder: GraphBuilder | None = None
    for local in local_graphs(room, poses, T_map_room, seed + 30_000):
        builder = builder or GraphBuilder(Config(), local.vocabulary, local.frame_id)
        builder.integrate(local)
        builder.update()
    assert builder is not None
    write_map(builder, path)
    return Map(room, path, T_map_room)


def come_back(own: Map, others: Sequence[Place], seed: int) -> tuple[Try, int]:
    """Come back to a room in which a third of the things was moved, and try other rooms' maps, too.

    The own map is searched as a node does it; the maps of other rooms after 2 and 5 s. The second
    result is the number of other rooms in which the run was found.
    """
    room, moved = with_moved(own.room, 1 / 3, seed + 40_000)
    poses = look_around(room, LOOK_S, seed + 50_000)
    T_odom_room = start_frame(poses, seed + 60_000)
    at_home = Returning(Config(), read_map(Config(), own.path))
    waiting: GraphBuilder | None = None
    continued: GraphBuilder | None = None
    result, first_ns, elsewhere = Try(), DAY_NS, set[int]()
    frames = local_graphs(room, poses, T_odom_room, seed + 70_000, start_ns=first_ns)
    for number, local in enumerate(frames, start=1):
        waiting = waiting or at_home.begin(local.vocabulary, local.frame_id)
        waiting.integrate(local)
        waiting.update()
        if number in (int(2 * RATE_HZ), len(poses)):
            seen = list(SceneGraph(waiting.full()))
            elsewhere |= {i for i, place in enumerate(others) if place.find(seen, waiting.space)}
        if continued is not None:
            continued.integrate(local)
        elif (continued := at_home.note(waiting, local)) is not None:
            result.found_s = (local.stamp_ns - first_ns) / 1e9
    assert waiting is not None
    result.reason = at_home.status
    if at_home.found is not None and continued is not None:
        T_true = own.T_map_room @ invert_pose(T_odom_room)
        error = invert_pose(T_true) @ at_home.found.T_map_world
        middle = np.mean([pose[:3, 3] for pose in poses], axis=0)
        middle = T_odom_room[:3, :3] @ middle + T_odom_room[:3, 3]
        shift = error[:3, :3] @ middle + error[:3, 3] - middle
        result.error_m = float(np.linalg.norm(shift))
        result.error_deg = rotation_angle_deg(error[:3, :3])
        _compare(own, moved, at_home, continued, result)
    return result, len(elsewhere)


def _compare(
    own: Map, moved: list[int], returning: Returning, builder: GraphBuilder, result: Try
) -> None:
    """What became of the map's objects."""
    before = SceneGraph(read_map(Config(), own.path).full())
    after = SceneGraph(builder.full())
    things = {item.id: _thing(own, item.mean_m) for item in before}
    changes = returning.changes(after)
    told = {item.id for item in changes.gone} | {pair.before.id for pair in changes.moved}
    stayed = {i for i, row in things.items() if row is not None and row not in moved}
    went = {i for i, row in things.items() if row in moved}
    kept = [i for i in stayed if i in after and _thing(own, after[i].mean_m) == things[i]]
    result.same_ids = len(kept) / max(1, len(stayed))
    counts = [Counter(_thing(own, item.mean_m) for item in graph) for graph in (before, after)]
    rows = {things[i] for i in stayed}
    result.doubles = sum(max(0, counts[1][row] - counts[0][row]) for row in rows)
    result.told = len(told & went), len(went)
    result.untrue = len(told & stayed)


def _thing(own: Map, mean_m: Sequence[float]) -> int | None:
    """The smallest thing of the room whose box contains a place of the map; None = none."""
    T = invert_pose(own.T_map_room)
    place = T[:3, :3] @ mean_m + T[:3, 3]
    inside = []
    for row, thing in enumerate(own.room.things):
        x, y, z = place - thing.centre
        cos, sin = np.cos(thing.heading), np.sin(thing.heading)
        along = np.abs([cos * x + sin * y, cos * y - sin * x, z])
        if (along <= np.array(thing.size) / 2 + 0.05).all():
            inside.append((float(np.prod(thing.size)), row))
    return min(inside)[1] if inside else None


def _place(item: Map) -> Place:
    builder = read_map(Config(), item.path)
    return Place(list(SceneGraph(builder.full())), builder.space)


def measure(rooms: int, seed: int, runs: int = RUNS, folder: Path | None = None) -> dict[str, Any]:
    """All tries, with maps in a folder, where they may be already; what came of them."""
    tries: list[Try] = []
    strangers = found_elsewhere = 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if folder is None else folder
        maps = [make_map(seed + number, folder) for number in range(rooms)]
        places = [_place(item) for item in maps]
        for number, own in enumerate(maps):
            for run in range(runs):
                steps = [step for step in range(run + 1, 8 * OTHERS, 7) if step % rooms]
                others = [places[(number + step) % rooms] for step in steps[:OTHERS]]
                result, found = come_back(own, others, 1000 * (seed + number) + run)
                tries.append(result)
                strangers, found_elsewhere = strangers + len(others), found_elsewhere + found
                print(number, run, result, found, file=sys.stderr, flush=True)
    found = [item for item in tries if item.found_s is not None]
    times = [item.found_s for item in found]
    right = [i for i in found if i.error_m <= WRONG_M and i.error_deg <= WRONG_DEG]
    told = np.sum([item.told for item in found], axis=0) if found else np.zeros(2)
    return {
        "tries": len(tries),
        "found": len(found),
        "found_right": len(right),
        "found_within_s": {s: sum(t <= s for t in times) for s in (1, 2, 3, 4, 5)},
        "other_rooms": strangers,
        "found_in_other_rooms": found_elsewhere,
        "error_cm_median_95_max": _spread([100 * item.error_m for item in found]),
        "error_deg_median_95_max": _spread([item.error_deg for item in found]),
        "same_ids": float(np.mean([item.same_ids for item in found])) if found else 0.0,
        "doubles_per_run": float(np.mean([item.doubles for item in found])) if found else 0.0,
        "moved_things_told": [int(told[0]), int(told[1])],
        "untrue_per_run": float(np.mean([item.untrue for item in found])) if found else 0.0,
        "not_found": [item.reason for item in tries if item.found_s is None],
    }


def _spread(values: list[float]) -> list[float]:
    return np.percentile(values, [50, 95, 100]).round(3).tolist() if values else []


def figures(setup: Setup) -> list[Figure]:
    """Shares of runs; for `python -m bench`, in small."""
    rooms, runs = (3, 1) if setup.quick else (8, 2)
    got = measure(rooms, 100, runs)
    within = 100 * got["found_within_s"][5] / got["tries"]
    note = f"synthetic rooms, a third moved, 5 s of looking around, {got['tries']} runs"
    return [
        Figure("relocalised", within, "%", 95.0, True, note=note),
        Figure("relocalised_elsewhere", got["found_in_other_rooms"], "runs", 0.0,
               note=f"of {got['other_rooms']} runs in other rooms"),
        Figure("relocalisation_error", got["error_cm_median_95_max"][0], "cm", note="median"),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--rooms", type=int, default=25)
    parser.add_argument("--seed", type=int, default=100, help="of the first room")
    parser.add_argument("--maps", type=Path, help="folder that keeps the maps for another time")
    parser.add_argument("--json", type=Path, help="write the result there")
    options = parser.parse_args()
    text = json.dumps(measure(options.rooms, options.seed, RUNS, options.maps), indent=2)
    print(text)
    if options.json is not None:
        options.json.write_text(text)


if __name__ == "__main__":
    main()
