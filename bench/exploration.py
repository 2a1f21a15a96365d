#!/usr/bin/env python3
"""How far a robot drives until it has found the objects of a home: next views, and frontiers.

    python bench/exploration.py [--homes N] [--first SEED] [--uncorrected] [--plot FOLDER]

Simulated homes (`bench.homes`) with small things on the furniture. A disc robot begins somewhere in
the corridor with the same heading for all methods. Its camera, depth noise, detector and the graph
(`GraphBuilder`) are the same, and so are the map of free space, the planner and the moments at
which a method is asked again. Only the choice of the next pose differs:

- next view: `deworldsg_ros.client.next_view`;
- frontier: the nearest frontier (B. Yamauchi, "A frontier-based approach for autonomous
  exploration", CIRA 1997), where it turns round once; also without turning.

An object is found if a confirmed node has its name, and the mean of its surface is in its box or
5 cm beside it. Poses are exact. Turning is no path. The paths are compared to 90 % of the objects;
if a method ends before, or has driven 60 m, to what the worse of both has found.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "test"))

from bench.figures import Figure, Setup
from bench.furnished import ALIKE, CAMERA, SMALL, STRIDE_PX, cast, local_graph, pose
from bench.homes import CEILING_M, Home, graph_of, home, nodes_of, poses, see
from deworldsg_ros.client import Robot, SceneGraph
from deworldsg_ros.client.next_view import next_view
from deworldsg_ros.config import Config
from deworldsg_ros.graph.provenance import MAX_VIEWS, SeenSpace
from deworldsg_ros.graph.rooms import RoomMap
from deworldsg_ros.graph.seen_cells import CELL_M, OCCUPIED, Reach, SeenCells, reach
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.wire import messages as wire

# Constants were chosen on homes 0 to 11. Reported before: 100 to 111, 200 to 211, 300 to
# 304, 312 to 323.
FIRST, HOMES = 324, 12
ROBOT = Robot(radius_m=0.25, height_m=1.3)
CAMERA_M, DOWN_RAD, FAR_M = 1.2, 0.3, 4.5
# A frame after so much way, or turn.
STEP_M, TURN_RAD = 0.3, math.radians(22.5)
# A method is asked again after so much way, or where it wanted to be.
AGAIN_M, MOST_M = 1.5, 60.0
# As `evaluation.graph_measures`: the mean of a node is in the box of an object of its name.
MARGIN_M, WANTED = 0.05, 0.9
# Frontiers with fewer cells are too small for a robot.
LEAST_FRONTIER = 4
UP = (0.0, 0.0, 1.0)
BEARING = ("counter", "dining table", "coffee table", "desk", "nightstand", "bed", "couch", "oven")
_LARGE = [
    "refrigerator", "oven", "sink", "microwave", "counter", "toilet", "bathtub", "towel", "bed",
    "wardrobe", "nightstand", "lamp", "couch", "tv", "bookshelf", "potted plant", "chair", "desk",
    "laptop", "keyboard", "shoe", "dining table", "coffee table",
]  # fmt: skip
_SMALL = ("book", "cup", "bottle", "vase", "bowl", "teddy bear", "box")
_NAMES = {*_LARGE, *_SMALL}
CLASSES = tuple(sorted(_NAMES | {ALIKE.get(name, "box") for name in _NAMES}))
VOCABULARY = Vocabulary(CLASSES, ("on", "near"))
# A detector sees this share of large near things in a frame, and is wrong from this share of sides.
# The share falls from 3 m on, to none at the other distance.
BEST, WRONG, LARGE_PX, DIM_M = 0.9, 0.12, 500.0, 6.0


@dataclass
class World:
    """A home with its things, and a robot in it.

    Attributes:
        labels, things, centers: names, boxes (n, 2, 3) and their centres (n, 3).
        boxes: (m, 8) of all that rays meet, things last, as `cast` wants them.
    """

    made: Home
    labels: list[str]
    things: np.ndarray
    centers: np.ndarray
    boxes: np.ndarray
    start: np.ndarray

    @classmethod
    def of(cls, seed: int) -> World:
        """A home with a start."""
        rng = np.random.default_rng(seed + 7_000)
        made = home(seed)
        solid = made.boxes[: len(made.boxes) - len(made.things)]
        things = [(thing.label, thing.box) for thing in made.things]
        bearing = [box for label, box in things if label in BEARING]
        for box in bearing:
            for _ in range(int(rng.integers(0, 3))):
                label = str(rng.choice(_SMALL))
                size = np.array(SMALL[label])
                low, high = box[0, :2] + size[:2] / 2, box[1, :2] - size[:2] / 2
                if (high < low).any():
                    continue
                x, y = rng.uniform(low, high)
                z = box[1, 2]
                new = np.array([[x, y, z], [x, y, z + 2 * size[2] / 2]])
                new[:, :2] += np.outer([-0.5, 0.5], size[:2])
                if all((new[0] >= b[1]).any() or (new[1] <= b[0]).any() for _, b in things):
                    things.append((label, new))
        boxes = np.concatenate([solid, np.array([box for _, box in things])])
        values = np.concatenate([boxes.mean(axis=1), boxes[:, 1] - boxes[:, 0]], axis=1)
        values = np.column_stack([values, np.ones(len(values)), np.zeros(len(values))])
        x0, y0, x1, y1 = made.rects[0][0]
        start = np.array([rng.uniform(x0 + 0.8, x1 - 0.8), (y0 + y1) / 2, rng.uniform(-3.1, 3.1)])
        names = [label for label, _ in things]
        return cls(made, names, boxes[len(solid) :], values[len(solid) :, :3], values, start)


@dataclass
class Run:
    """What one method did in a home.

    Attributes:
        way_m: driven; views: frames; curve: way and share of the objects that were found, in turn.
        places: (x, y, yaw) of the frames; reasons: of the poses; calls_s: time of each choice.
        shifted_m: by which the correction of drift moved a frame, at most. Poses are exact.
    """

    way_m: float = 0.0
    shifted_m: float = 0.0
    turned_rad: float = 0.0
    curve: list[tuple[float, float]] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    calls_s: list[float] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)

    @property
    def found(self) -> float:
        """The greatest share of the objects that was known at a time."""
        return max((share for _, share in self.curve), default=0.0)

    def way_to(self, share: float) -> float | None:
        """The way until a share was found; None = never."""
        return next((way for way, found in self.curve if found >= share), None)


class Explorer:
    """A robot in a world, with its graph.

    Args:
        world: where it is.
        seed: of noise and detections.
        corrected: whether the graph corrects drift. Poses are exact, so that this only harms.
    """

    def __init__(self, world: World, seed: int, corrected: bool = True) -> None:
        self.world, self.rng = world, np.random.default_rng(seed)
        self.at, self.yaw = world.start[:2].copy(), float(world.start[2])
        self.builder = GraphBuilder(Config(), VOCABULARY, "map")
        if not corrected:
            self.builder._drift = None
        self.cells = SeenCells(UP)
        self.run, self.frames = Run(), 0
        self._spells: dict[tuple[int, int], bool] = {}
        first, step = STRIDE_PX // 2, STRIDE_PX // 2
        self._v, self._u = np.mgrid[first : CAMERA.height : step, first : CAMERA.width : step]
        u, v = self._u.ravel(), self._v.ravel()
        self._rays = CAMERA.back_project(u, v, np.ones(u.size))
        self._solid = len(world.boxes) - len(world.labels)
        low, high = world.made.boxes[:, 0].min(axis=0), world.made.boxes[:, 1].max(axis=0)
        half = world.boxes[:, 3:6] / 2
        self._corners = world.boxes[:, :3] - half, world.boxes[:, :3] + half
        self._shell = np.stack([low - 1.0, high + 1.0])
        self._shell[:, 2] = 0.0, CEILING_M

    def look(self) -> None:
        """Take a frame into the graph."""
        T = pose(*self.at, CAMERA_M, self.yaw, DOWN_RAD)
        near = self._near(T)
        rays = self._rays @ T[:3, :3].T
        depth, hits = cast(T[:3, 3], rays, self.world.boxes[near], self._shell)
        hits = np.where(hits < 0, hits, near[hits])
        hits = np.where(hits >= self._solid, hits - self._solid, -1)
        sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
        noisy = np.where(depth > FAR_M, 0.0, depth + self.rng.normal(0, 1, len(depth)) * sigma)
        found = list(self._detected(hits, noisy, T))
        points = (noisy[:, None] * self._rays) @ T[:3, :3].T + T[:3, 3]
        stamp_ns = 10**9 + self.frames * 10**8
        self.frames += 1
        self.builder.integrate(
            local_graph(
                found, hits, noisy, points, self._u, self._v, T, "map", stamp_ns, VOCABULARY
            )
        )
        self.run.places.append(np.array([*self.at, self.yaw]))
        moved = self.builder.T_graph_poses[:3] @ np.append(T[:3, 3], 1.0) - T[:3, 3]
        self.run.shifted_m = max(self.run.shifted_m, float(np.linalg.norm(moved)))

    def _near(self, T: np.ndarray) -> np.ndarray:
        """The rows of the boxes that may be in view, nearer than the camera sees."""
        low, high = self._corners
        away = np.linalg.norm(np.maximum(np.maximum(low - T[:3, 3], T[:3, 3] - high), 0.0), axis=1)
        # The corner that is farthest ahead.
        ahead = (np.where(T[:3, 2] > 0, high, low) - T[:3, 3]) @ T[:3, 2]
        return np.flatnonzero((away < 1.4 * FAR_M) & (ahead > 0.0))

    def _detected(self, hits: np.ndarray, depth: np.ndarray, T: np.ndarray) -> Iterator[Any]:
        for row in np.unique(hits[hits >= 0]).tolist():
            at = np.flatnonzero((hits == row) & (depth > 0))
            away = T[:3, 3] - self.world.centers[row]
            far = float(np.clip((DIM_M - np.linalg.norm(away)) / 3.0, 0.0, 1.0))
            chance = BEST * far * (1.0 - math.exp(-16 * len(at) / LARGE_PX))
            if len(at) < 10 or self.rng.random() > chance:
                continue
            side = int(math.atan2(away[1], away[0]) // math.radians(30))
            # A wrong name lasts as long as the thing is seen from there.
            if (row, side) not in self._spells:
                own = np.random.default_rng([row, side + 6])
                self._spells[row, side] = bool(own.random() < WRONG)
            label = self.world.labels[row]
            other = ALIKE.get(label, "box")
            name = other if self._spells[row, side] else label
            top = self.rng.uniform(0.55, 0.95)
            classes = np.full(len(CLASSES), (1 - top) * 0.4 / len(CLASSES))
            classes[CLASSES.index(name)] += top
            classes[CLASSES.index(other if name == label else label)] += (1 - top) * 0.6
            yield row, at, classes / classes.sum(), top

    def graph(self) -> SceneGraph:
        """The graph now, with its views."""
        graph = SceneGraph(self.builder.full())
        graph.space = self.builder.space
        return graph

    def note(self) -> float:
        """Which share of the objects is found."""
        free, missed = list(self.graph()), []
        for label, box in zip(self.world.labels, self.world.things):
            low, high = box + [[-MARGIN_M], [MARGIN_M]]
            near = [
                item
                for item in free
                if item.label == label
                and (low <= item.mean_m).all()
                and (item.mean_m <= high).all()
            ]
            if near:
                free.remove(near[0])
            else:
                missed.append(label)
        share = 1.0 - len(missed) / len(self.world.labels)
        self.run.curve.append((self.run.way_m, share))
        self.run.missed = missed
        return share

    def turn_to(self, yaw: float, around: bool = False) -> None:
        """Turn in place; `around`: once round first."""
        turn = 2.0 * math.pi if around else (yaw - self.yaw + math.pi) % (2.0 * math.pi) - math.pi
        steps = math.ceil(abs(turn) / TURN_RAD - 1e-6)
        for _ in range(steps):
            self.yaw += turn / steps
            self.look()
        self.run.turned_rad += abs(turn)

    def drive(self, path: np.ndarray, most_m: float) -> bool:
        """Follow a path; false if it ends before, after `most_m`."""
        left_m = most_m
        for corner in path:
            while (apart := float(np.linalg.norm(corner - self.at))) > 1e-6:
                if left_m <= 1e-6:
                    return False
                way = corner - self.at
                self.turn_to(math.atan2(way[1], way[0]))
                step = min(apart, STEP_M, left_m)
                self.at = self.at + way * step / apart
                left_m -= step
                self.run.way_m += step
                self.look()
        return True

    def moved(self, places: np.ndarray, to_graph: bool) -> np.ndarray:
        """Places (n, 2) under its camera in the frame of the graph, or back in that of poses.

        The correction of drift moves the graph, as between the frames map and odom of a robot.
        """
        T = self.builder.T_graph_poses if to_graph else invert_pose(self.builder.T_graph_poses)
        points = np.column_stack([places, np.full(len(places), CAMERA_M)])
        return (points @ T[:3, :3].T + T[:3, 3])[:, :2]

    def reach(self) -> tuple[np.ndarray, Reach]:
        """Where it can get now, in the frame of the graph."""
        state = self.cells.add(self.builder.space).state
        at = self.moved(self.at[None], to_graph=True)[0]
        return state, reach(self.cells, state, ROBOT.radius_m, ROBOT.height_m, at)


def straight(path: np.ndarray, reached: Reach) -> np.ndarray:
    """The corners of a path without those that a straight line can leave out."""
    kept, at = [path[0]], 0
    while at < len(path) - 1:
        for end in range(len(path) - 1, at, -1):
            count = max(2, int(np.linalg.norm(path[end] - path[at]) / CELL_M * 3))
            line = path[at] + np.linspace(0, 1, count)[:, None] * (path[end] - path[at])
            cells = np.floor(line / CELL_M).astype(int) - reached.first
            if end == at + 1 or reached.stands[tuple(cells.T)].all():
                break
        kept.append(path[end])
        at = end
    return np.array(kept)


# A method gives a path in the frame of the graph, the yaw at its end (None = as it came), and
# whether to turn round there.
Choice = tuple[np.ndarray, float | None, bool]


def by_next_view(robot: Explorer) -> Choice | None:
    """As the package chooses."""
    x, y = robot.moved(robot.at[None], to_graph=True)[0].tolist()
    at = (x, y, CAMERA_M)
    found = next_view(robot.graph(), robot=ROBOT, start=at, cells=robot.cells)
    if found is None:
        return None
    at = ", ".join(f"{value:.1f}" for value in found.position_m[:2])
    robot.run.reasons.append(f"({at}) {found.reason}: {found.gain_nats:.2f} nats")
    _, reached = robot.reach()
    cell = np.floor(np.array(found.position_m[:2]) / CELL_M).astype(int) - reached.first
    x, y, z, w = found.orientation_xyzw
    return reached.path_to(cell), 2.0 * math.atan2(z, w), False


def by_frontier(around: bool) -> Callable[[Explorer], Choice | None]:
    """The nearest frontier; `around`: where it turns round."""
    import cv2

    tried: list[np.ndarray] = []

    def choose(robot: Explorer) -> Choice | None:
        state, reached = robot.reach()
        floor = robot.cells.floor_m
        band = state[:, :, robot.cells.layers(floor + 0.05, floor + ROBOT.height_m)]
        unknown = ~reached.free & ~(band == OCCUPIED).any(axis=2)
        beside = cv2.dilate(unknown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        _, groups = cv2.connectedComponents(
            (reached.free & beside).astype(np.uint8), connectivity=8
        )
        can = np.argwhere(np.isfinite(reached.way_m))
        best: tuple[float, np.ndarray] | None = None
        for number in range(1, groups.max() + 1):
            cells = np.argwhere(groups == number)
            if len(cells) < LEAST_FRONTIER:
                continue
            # The cell of the frontier in its middle, and where the robot can stand beside it.
            middle = cells[np.linalg.norm(cells - cells.mean(axis=0), axis=1).argmin()]
            goal = can[np.linalg.norm(can - middle, axis=1).argmin()]
            place = reached.centers(goal[None])[0]
            if np.linalg.norm(goal - middle) * CELL_M > 1.0:
                continue
            if any(np.linalg.norm(place - other) < 0.3 for other in tried):
                continue
            way = float(reached.way_m[tuple(goal)])
            if best is None or way < best[0]:
                best = way, goal
        if best is None:
            return None
        if best[0] < AGAIN_M:
            tried.append(reached.centers(best[1][None])[0])
        return reached.path_to(best[1]), None, around

    return choose


OURS, THEIRS = "next view", "frontier, turns round"
METHODS: dict[str, Callable[[], Callable[[Explorer], Choice | None]]] = {
    OURS: lambda: by_next_view,
    THEIRS: lambda: by_frontier(True),
    "frontier": lambda: by_frontier(False),
}


def explore(
    seed: int, method: str, wanted: float = WANTED, most: int = 250, corrected: bool = True
) -> Run:
    """Explore a home until a share of the objects is found, or the method has no more poses.

    `most`: times that it is asked; `corrected`: whether the graph corrects drift.
    """
    robot = Explorer(World.of(seed), seed + 9_000, corrected)
    choose = METHODS[method]()
    robot.look()
    if method != OURS:
        robot.turn_to(robot.yaw, around=True)
    while robot.note() < wanted and robot.run.way_m < MOST_M and len(robot.run.calls_s) < most:
        start_s = time.process_time()
        choice = choose(robot)
        robot.run.calls_s.append(time.process_time() - start_s)
        if choice is None:
            break
        path, yaw, around = choice
        _, reached = robot.reach()
        if robot.drive(robot.moved(straight(path, reached), to_graph=False), AGAIN_M):
            if yaw is not None:
                robot.turn_to(yaw)
            robot.look()
            if around:
                robot.turn_to(robot.yaw, around=True)
    return robot.run


def measure(
    seeds: range, methods: tuple[str, ...] = (OURS, THEIRS), corrected: bool = True
) -> dict[str, list[Run]]:
    """Methods in homes, one after the other."""
    found: dict[str, list[Run]] = {method: [] for method in methods}
    for seed in seeds:
        for method, runs in found.items():
            start_s = time.process_time()
            run = explore(seed, method, corrected=corrected)
            runs.append(run)
            way_m = run.way_to(WANTED)
            print(
                f"home {seed}, {method}: {100 * run.found:.0f} % in {run.way_m:.1f} m"
                f"{'' if way_m is None else f', 90 % in {way_m:.1f} m'}, turned by "
                f"{math.degrees(run.turned_rad):.0f}°, {len(run.places)} frames, moved by up to "
                f"{100 * run.shifted_m:.0f} cm; "
                f"{time.process_time() - start_s:.0f} s",
                file=sys.stderr, flush=True,
            )  # fmt: skip
    return found


@dataclass(frozen=True)
class Compared:
    """One home: the ways of both methods to a share that both have found, at most 90 %."""

    share: float
    ours_m: float
    theirs_m: float


def compare(ours: Run, theirs: Run, wanted: float = WANTED) -> Compared:
    """The ways to a share of the objects, at most what the worse of both methods has found."""
    share = min(wanted, ours.found, theirs.found) - 1e-9
    a, b = ours.way_to(share), theirs.way_to(share)
    assert a is not None and b is not None
    return Compared(share, a, b)


def seconds_of_a_choice(nodes: int = 300) -> float:
    """Processor time of `next_view` in a home of 6 rooms, from 128 views, without a memory."""
    made = home(2)
    space = SeenSpace()
    see(space, made.boxes, poses(made, 3)[:MAX_VIEWS], 4)
    rng = np.random.default_rng(5)
    known = nodes_of(made, 6)
    while len(known) < nodes:
        row = known[int(rng.integers(len(made.things)))]
        shift = np.append(rng.uniform(-1.0, 1.0, 2), rng.uniform(-0.2, 0.4))
        center = (np.array(row.mean_m) + shift).tolist()
        box = wire.GravityBox(center, [0.1, 0.1, 0.1], [0.0, 0.0, 0.0, 1.0])
        known.append(msgspec.structs.replace(row, id=len(known) + 1, mean_m=center, box=box))
    graph = SceneGraph(graph_of(known, RoomMap().found_in(space, UP)))
    graph.space = space
    times_s = []
    for _ in range(5):
        start_s = time.process_time()
        graph.next_view(robot=ROBOT)
        times_s.append(time.process_time() - start_s)
    return float(np.median(times_s))


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    count = 1 if setup.quick else 2
    runs = measure(range(FIRST, FIRST + count))
    pairs = [compare(ours, theirs) for ours, theirs in zip(runs[OURS], runs[THEIRS])]
    path = sum(pair.ours_m for pair in pairs) / max(sum(pair.theirs_m for pair in pairs), 1.0)
    note = f"{count} simulated homes, to the share that both have found, at most 90 %"
    return [
        Figure("exploration_path", 100 * path, "% of frontier exploration", 70.0, note=note),
        Figure("exploration_found", 100 * float(np.mean([run.found for run in runs[OURS]])), "%",
               reference="frontier exploration at its end", more_is_better=True,
               reference_value=100 * float(np.mean([run.found for run in runs[THEIRS]]))),
        Figure("next_view_time", 1e3 * seconds_of_a_choice(), "ms", 500.0,
               note="processor time; 6 rooms, 300 objects, 128 views, nothing remembered"),
    ]  # fmt: skip


def plot(seed: int, runs: dict[str, Run], folder: Path) -> None:
    """The walls, the things and the ways of all methods, and what they found, as a PNG."""
    from matplotlib.figure import Figure as Canvas

    world = World.of(seed)
    canvas = Canvas((6 * len(runs), 9), layout="constrained")
    axes = canvas.subplots(2, len(runs), squeeze=False)
    for column, (method, run) in enumerate(runs.items()):
        plan, share = axes[0, column], axes[1, column]
        for box in world.made.boxes:
            if box[0, 2] < 0.5 < box[1, 2]:
                x, y = box[[0, 1, 1, 0, 0], 0], box[[0, 0, 1, 1, 0], 1]
                plan.fill(x, y, color="0.8")
        plan.plot(*world.centers[:, :2].T, ".", color="0.3", markersize=3)
        places = np.array(run.places)
        plan.plot(places[:, 0], places[:, 1], "-", linewidth=1)
        plan.plot(*places[0, :2], "go")
        plan.set_aspect("equal")
        plan.set_title(f"{method}: {run.way_m:.1f} m, {100 * run.found:.0f} %")
        share.plot(*np.array(run.curve).T)
        share.set(xlabel="path, m", ylabel="found", ylim=(0, 1))
    folder.mkdir(parents=True, exist_ok=True)
    canvas.savefig(folder / f"home_{seed}.png", dpi=80)


def print_compared(seeds: range, ours: list[Run], theirs: list[Run], name: str) -> None:
    """The paths of next views as shares of those of another method, as Markdown."""
    print(f"\n{OURS} / {name}\n\n| share found | total | median | range |\n|---|---|---|---|")
    for wanted in (0.5, 0.7, WANTED):
        pairs = [compare(a, b, wanted) for a, b in zip(ours, theirs)]
        ratios = [100 * pair.ours_m / max(pair.theirs_m, 1.0) for pair in pairs]
        total = sum(pair.ours_m for pair in pairs) / sum(pair.theirs_m for pair in pairs)
        print(
            f"| {100 * wanted:.0f} %, or what both found | {100 * total:.0f} % | "
            f"{np.median(ratios):.0f} % | {min(ratios):.0f}–{max(ratios):.0f} % |"
        )
    print(
        "\n| home | rooms | objects | found | share | path, m | ratio | moved by drift, cm |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    for seed, a, b, pair in zip(seeds, ours, theirs, pairs):
        world = World.of(seed)
        print(
            f"| {seed} | {len(world.made.kinds)} | {len(world.labels)} | "
            f"{100 * a.found:.0f} / {100 * b.found:.0f} % | {100 * pair.share:.0f} % | "
            f"{pair.ours_m:.1f} / {pair.theirs_m:.1f} | "
            f"{100 * pair.ours_m / max(pair.theirs_m, 1.0):.0f} % | "
            f"{100 * a.shifted_m:.0f} / {100 * b.shifted_m:.0f} |"
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--homes", type=int, default=HOMES)
    parser.add_argument("--first", type=int, default=FIRST, help="seed of the first home")
    parser.add_argument("--methods", nargs="+", default=[OURS, THEIRS], choices=METHODS)
    parser.add_argument("--plot", type=Path, help="write a picture of each home there")
    parser.add_argument(
        "--uncorrected", action="store_true", help="without the graph's correction of drift"
    )
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.homes)
    found: dict[str, list[Run]] = {method: [] for method in options.methods}
    for seed in seeds:
        runs = measure(range(seed, seed + 1), tuple(options.methods), not options.uncorrected)
        for method in found:
            found[method] += runs[method]
        if options.plot is not None:
            plot(seed, {method: runs[method][0] for method in runs}, options.plot)
    print("| method | found at its end | 90 % reached | path | turned |\n|---|---|---|---|---|")
    for method, done in found.items():
        shares = [100 * run.found for run in done]
        reached = sum(run.found >= WANTED for run in done)
        print(
            f"| {method} | {np.mean(shares):.0f} % ({min(shares):.0f}–{max(shares):.0f}) | "
            f"{reached} of {len(done)} | {np.mean([run.way_m for run in done]):.1f} m | "
            f"{np.mean([math.degrees(run.turned_rad) for run in done]):.0f}° |"
        )
    for theirs in options.methods:
        if theirs != OURS and OURS in found:
            print_compared(seeds, found[OURS], found[theirs], theirs)


if __name__ == "__main__":
    main()
