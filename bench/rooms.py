"""Rooms of simulated homes that are found, and with Hydra's method on the same cells.

    python bench/rooms.py [--homes N] [--first SEED]

A room is found if a found one has an IoU above 0.5 with it, furniture included; precision, recall
and F1 count rooms. Bormann et al. (ICRA 2016) measure areas: for each room the largest part that
one segment covers (recall), and for each segment the largest part that lies in one room
(precision).
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "test"))

from bench.figures import Figure, Setup
from bench.homes import Home, home, nodes_of, poses, see
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph.rooms import CELL_M, LEAST_M2, RoomMap, Storey, interior
from deworldsg_ros.scene.arrays import Bool, Float64, Int64

# The constants of the segmentation were chosen on homes 0 to 11.
FIRST, HOMES = 100, 24
UP = (0.0, 0.0, 1.0)
# Of Hydra's configurations: range of the dilation, and its step here.
HYDRA_RANGES_M = {"0.5-1.2": (0.5, 1.2), "0.1-0.7": (0.1, 0.7)}
STEP_M, PLATEAU = 0.02, 0.25


@dataclass
class Counts:
    """Rooms of homes, and what was found of them."""

    homes: int = 0
    rooms: int = 0
    segments: int = 0
    hits: int = 0
    covered: float = 0.0
    pure: float = 0.0

    def add(self, truth: Int64, found: Int64) -> None:
        """Count a home; 0 = no room, rooms from 1."""
        names, found = np.unique(found, return_inverse=True)
        found = found.reshape(truth.shape) + (names[0] != 0)
        both = np.zeros((truth.max() + 1, found.max() + 1))
        np.add.at(both, (truth.ravel(), found.ravel()), 1)
        inside, rooms, segments = both[1:, 1:], both.sum(axis=1)[1:], both.sum(axis=0)[1:]
        iou = inside / (rooms[:, None] + segments - inside)
        self.homes += 1
        self.rooms, self.segments = self.rooms + len(rooms), self.segments + len(segments)
        self.hits += int((iou > 0.5).sum())
        if len(segments):
            self.covered += float((inside.max(axis=1) / rooms).sum())
            self.pure += float((inside.max(axis=0) / segments).sum())

    @property
    def f1(self) -> float:
        """Of rooms with an IoU above 0.5."""
        return 2 * self.hits / (self.rooms + self.segments)

    @property
    def row(self) -> str:
        """For a table: precision, recall, F1; precision and recall of areas."""
        values = (
            self.hits / max(self.segments, 1), self.hits / self.rooms, self.f1,
            self.pure / max(self.segments, 1), self.covered / self.rooms,
        )  # fmt: skip
        return " | ".join(f"{value:.3f}" for value in values)


def truth_of(made: Home, storey: Storey) -> Int64:
    """The room of each cell of a storey, from 1; 0 = none."""
    rows, columns = storey.free.shape
    x = (storey.corner[0] + np.arange(columns) + 0.5) * CELL_M
    y = (storey.corner[1] + np.arange(rows)[:, None] + 0.5) * CELL_M
    truth = np.zeros((rows, columns), np.int64)
    for room in range(len(made.kinds)):
        truth[made.mask(room, x, y)] = room + 1
    return truth


def hydra(inside: Bool, range_m: tuple[float, float]) -> Int64:
    """Rooms as Hydra finds them, by its description, on cells in place of a graph of places.

    Obstacles are dilated: cells nearer to one than a distance are removed. As the distance grows,
    the number of connected parts changes. Of the spans without a change that last at least a
    quarter of the longest one, that with the most parts is taken, at its smallest distance (Hughes
    et al., RSS 2022 and IJRR 2024; the rule and the ranges are those of its configuration). Its
    parts are the rooms; the other cells go to the part that is nearest along free cells.
    """
    import cv2

    distance = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance = distance * CELL_M
    steps = np.arange(range_m[0], range_m[1] + 1e-9, STEP_M)
    parts = [_large_parts(distance > step) for step in steps]
    counts = np.array([part.max() for part in parts])
    starts = np.flatnonzero(np.append(True, np.diff(counts) != 0))
    lasting = np.diff(np.append(starts, len(counts))) - 1
    may = lasting >= PLATEAU * lasting.max()
    best = starts[may][int(counts[starts[may]].argmax())]
    return _grown(parts[best], inside)


def _large_parts(mask: Bool) -> Int64:
    """Connected parts, from 1; without those below the size of ten places of Hydra."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    kept = np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] * CELL_M**2 >= 0.1) + 1
    numbers = np.zeros(len(stats), np.int64)
    numbers[kept] = np.arange(1, len(kept) + 1)
    return numbers[labels]


def _grown(parts: Int64, inside: Bool) -> Int64:
    """Give every free cell the part that reaches it first."""
    import cv2

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    found = parts.astype(np.float32)
    while True:
        wider = np.where((found == 0) & inside, cv2.dilate(found, cross), found)
        if np.array_equal(wider, found):
            return found.astype(np.int64)
        found = wider


@dataclass
class Result:
    """What was measured.

    Attributes:
        counts: by method.
        named, right: rooms that got a name, and how many of these names are right.
        placed, in_room: objects with a room, and how many of these are in it.
        brier: mean squared error of the probability of a name.
        times_s: processor time of a pass over the views of a home, and of the messages.
    """

    counts: dict[str, Counts]
    named: int = 0
    right: int = 0
    placed: int = 0
    in_room: int = 0
    things: int = 0
    squared: float = 0.0
    compared: int = 0
    times_s: tuple[float, ...] = ()


def measure(seeds: range) -> Result:
    """Find the rooms of homes as a graph does: after each room, with the newest 128 views."""
    result = Result({"ours": Counts(), **{f"Hydra {name} m": Counts() for name in HYDRA_RANGES_M}})
    times_s = []
    for seed in seeds:
        made = home(seed)
        rooms = found_along(made, seed)
        start_s = time.process_time()
        nodes = nodes_of(made, seed)
        states = rooms.states(nodes)
        times_s.append(time.process_time() - start_s)
        (storey,) = rooms.storeys
        truth, inside = truth_of(made, storey), interior(storey)
        result.counts["ours"].add(truth, storey.ids)
        for name, range_m in HYDRA_RANGES_M.items():
            parts = hydra(inside, range_m)
            areas = np.bincount(parts.ravel()) * CELL_M**2
            result.counts[f"Hydra {name} m"].add(truth, np.where(areas[parts] < LEAST_M2, 0, parts))
        true_of = {}
        for room in states:
            mask = storey.ids == room.id
            row = int(np.bincount(truth[mask], minlength=1).argmax()) - 1
            true_of[room.id] = row
            if row >= 0:
                is_kind = [float(kind.label == made.kinds[row]) for kind in room.kinds]
                result.squared += sum(
                    (kind.probability - true) ** 2 for kind, true in zip(room.kinds, is_kind)
                )
                result.compared += len(is_kind)
                result.named += room.named
                result.right += room.named and room.label == made.kinds[row]
        for node, thing in zip(nodes, made.things):
            inside_of = [
                (o.probability, room.id) for room in states for o in room.objects if o.id == node.id
            ]
            result.things += 1
            if inside_of:
                result.placed += 1
                result.in_room += true_of[max(inside_of)[1]] == thing.room
    result.times_s = tuple(times_s)
    return result


def found_along(made: Home, seed: int) -> RoomMap:
    """The rooms after a walk, found anew after every 30 views; a graph forgets the oldest views."""
    space, rooms = SeenSpace(), RoomMap()
    walk: list[Float64] = poses(made, seed + 1000)
    for first in range(0, len(walk), 30):
        see(space, made.boxes, walk[first : first + 30], seed + first)
        rooms = rooms.found_in(space, UP)
    return rooms


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    count = 2 if setup.quick else 6
    result = measure(range(FIRST, FIRST + count))
    ours, others = result.counts["ours"], list(result.counts.values())[1:]
    return [
        Figure(
            "rooms_f1",
            ours.f1,
            "F1",
            target=0.9,
            more_is_better=True,
            reference="Hydra's method on the same cells, the better of two ranges",
            reference_value=max(counts.f1 for counts in others),
            note=f"{count} simulated homes, {ours.rooms} rooms; IoU above 0.5",
        )
    ]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--homes", type=int, default=HOMES)
    parser.add_argument("--first", type=int, default=FIRST, help="seed of the first home")
    options = parser.parse_args()
    result = measure(range(options.first, options.first + options.homes))
    ours = result.counts["ours"]
    print(f"{ours.homes} homes, {ours.rooms} rooms")
    print("| | precision | recall | F1 | area precision | area recall |\n|---|---|---|---|---|---|")
    for name, counts in result.counts.items():
        print(f"| {name} | {counts.row} |")
    print(
        f"names: {result.named} of {ours.segments} rooms named, {result.right} right; Brier score "
        f"{result.squared / result.compared:.3f} of {result.compared} kinds"
    )
    print(f"objects: {result.placed} of {result.things} placed, {result.in_room} in their room")
    print(f"messages: {1e3 * np.median(result.times_s):.0f} ms")


if __name__ == "__main__":
    main()
