"""Errands in simulated homes: a robot looks round, is asked for things, and drives to them.

    python tools/errands/errands.py [--homes N] [--first SEED] [--detections boxes embedded]

README.md says what is simulated, and how an errand is judged.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import multiprocessing
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import cv2
import numpy as np
from home import CELL_M, RADIUS_M, build
from mind import Mind, OtherMind, by_label, by_question, other_minds, perceiver, way_to
from patrol import patrol
from robot import CAMERA, Planner, Robot, length_m, looking
from seek import Seeker
from tasks import Task, absent_tasks, move_things, standing_tasks

from deworldsg_ros.client.grammar import Pattern, parse
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.scene.camera import invert_pose

ROOT = Path(__file__).resolve().parents[2]
# The homes of the reported figures, the first of them with other methods and with the shipped
# detector, too; the constants were chosen on homes below 250.
FIRST, HOMES, COMPARED, EMBEDDED = 250, 10, 5, 1
# An errand is fulfilled if the thing is in view from here, with so many pixels.
IN_VIEW_M, IN_VIEW_PX = 1.5, 100
# A node is an object if it is as near to its box, and no object of the same name is nearer.
SAME_M = 0.4
# Of the shortest path; a metre and a half more is always allowed.
MOST_DETOUR, SPARE_M = 2.0, 1.5
STAGES = (
    "not in the graph", "wrong name", "question", "unreachable", "path too long", "not in view",
    "claimed", "error",
)  # fmt: skip
US, LABEL = "this one", "the nearest with the name"


@dataclass(frozen=True)
class Outcome:
    """How an errand went.

    Attributes:
        method: whose graph, or how the question was answered.
        kind, words: of the task.
        home: its seed.
        failure: the stage that failed; empty = fulfilled.
        path_m, shortest_m: of the robot, and the shortest one; 0 where it stayed.
        said: what the robot made of it.
        steps: what it went to, and what came of that.
    """

    method: str
    kind: str
    words: str
    home: int
    failure: str
    path_m: float = 0.0
    shortest_m: float = 0.0
    said: str = ""
    steps: tuple[str, ...] = ()


class Referee:
    """Knows the truth of a home: shortest paths, and what is in view."""

    def __init__(self, robot: Robot) -> None:
        self.home, self.robot = robot.home, robot

    def planner(self) -> Planner:
        """A planner that knows where everything is."""
        return Planner(*self.home.room_free(), RADIUS_M)

    def shortest_m(self, start: np.ndarray, task: Task, chosen: int | None = None) -> float:
        """The shortest path to a place from which the object may be seen, by its old place."""
        planner = self.planner()
        passed_m = 0.0
        if task.was is not None:
            first = self._nearest(planner, start, np.array([task.was, task.was]))
            if first is not None:
                passed_m, start = first
        right = task.right if chosen is None else (chosen,)
        ends = [self._nearest(planner, start, self.home.bounds(n)) for n in right]
        found = [end[0] for end in ends if end is not None]
        return passed_m + min(found) if found else math.inf

    def _nearest(
        self, planner: Planner, start: np.ndarray, box: np.ndarray
    ) -> tuple[float, np.ndarray] | None:
        found = planner.paths(start)
        if found is None:
            return None
        rows, columns = np.nonzero(planner.free)
        places = planner.corner + CELL_M * (np.stack([columns, rows], axis=1) + 0.5)
        gaps = np.maximum(np.maximum(box[0, :2] - places, places - box[1, :2]), 0.0)
        near = np.flatnonzero(np.linalg.norm(gaps, axis=1) < IN_VIEW_M)
        costs = found[0][rows[near] * planner.free.shape[1] + columns[near]]
        for index in np.argsort(costs):
            place = places[near[index]]
            if np.isfinite(costs[index]) and not self._wall_between(place, box.mean(0)[:2]):
                path = planner.path(start, place, 0.1)
                return length_m(path), place
        return None

    def _wall_between(self, a: np.ndarray, b: np.ndarray) -> bool:
        line = a + np.linspace(0, 1, 60)[:, None] * (b - a)
        walls = np.array([w[:, :2] for w in self.home.walls if w[0, 2] == 0.0])
        inside = (line[:, None] > walls[:, 0]) & (line[:, None] < walls[:, 1])
        return bool(inside.all(axis=2).any())

    def is_in_view(self, pose: np.ndarray, right: tuple[int, ...]) -> bool:
        """Whether one of the right objects is in view and near from a pose (3,)."""
        instances = self.robot.camera.instances(looking(*pose))
        for number in right:
            box = self.home.bounds(number)
            gap = np.maximum(np.maximum(box[0, :2] - pose[:2], pose[:2] - box[1, :2]), 0.0)
            if np.linalg.norm(gap) <= IN_VIEW_M and (instances == number).sum() >= IN_VIEW_PX:
                return True
        return False

    def why_missed(self, task: Task, graph: SceneGraph, T_graph_map: np.ndarray) -> str:
        """The stage that failed for a thing that is there."""
        asked = parse(task.words)
        assert isinstance(asked, Pattern) and asked.thing is not None
        near = []
        for number in task.right:
            box = self.home.bounds(number)
            reach = (box[1] - box[0]) / 2 + 0.2
            middle = (T_graph_map @ [*box.mean(0), 1.0])[:3]
            near += [i for i in graph if (np.abs(i.position_m - middle) < reach).all()]
        if not near:
            return "not in the graph"
        names = [item.label for item in near]
        if not any(self.home.name(n) in names for n in task.right):
            return "wrong name"
        return "question"


class Errands:
    """A robot in a home, its graph, and the errands that it was given.

    Args:
        seed: of the home.
        kind: of the detections: ``boxes`` or ``embedded``.
        others: whether the graphs to compare with are made, too.
        colours: whether MuJoCo renders the images; it does for ``embedded``.
    """

    def __init__(
        self, seed: int, kind: str, *, others: bool = False, colours: bool = False
    ) -> None:
        self.seed, self.home = seed, build(seed)
        self.kind = kind
        self.rng = np.random.default_rng([seed, 3])
        first = self._spots(0)[0]
        self._view = None
        if colours or kind == "embedded":
            from mujoco_view import MujocoView

            self._view = MujocoView(self.home, CAMERA)
        self.robot = Robot(self.home, seed, np.array([*first, 0.0]), self._view)
        self.perception = perceiver(kind, self.home, seed)
        self.mind = Mind(self.perception)
        self.others: dict[str, OtherMind] = other_minds(ROOT) if others else {}
        self.referee = Referee(self.robot)
        self.seeker = Seeker(self.robot, self.mind, self._frame)
        self.on_frame = lambda frame, perceived: None

    def close(self) -> None:
        """Free the renderer."""
        if self._view is not None:
            self._view.close()

    # --- The tour.

    def _spots(self, room: int) -> list[np.ndarray]:
        """Free places of a room: the freest one, and for a wide room one that is far from it."""
        planner = self._tour_planner()
        distance, corner = self.home.room_free()
        x0, y0, x1, y1 = self.home.rects[room]
        rows, columns = np.nonzero(planner.free)
        places = corner + CELL_M * (np.stack([columns, rows], axis=1) + 0.5)
        inside = ((places > [x0, y0]) & (places < [x1, y1])).all(axis=1)
        places, clear = places[inside], distance[rows, columns][inside]
        if room == 0:
            middles = np.array([[x0 + (x1 - x0) * share, (y0 + y1) / 2] for share in (0.25, 0.75)])
            return [places[np.linalg.norm(places - m, axis=1).argmin()] for m in middles]
        first = places[clear.argmax()]
        far = np.linalg.norm(places - first, axis=1)
        second = places[far.argmax()]
        return [first, second] if far.max() > 1.5 else [first]

    def _tour_planner(self) -> Planner:
        return Planner(*self.home.room_free(), RADIUS_M + 0.08)

    def tour(self) -> None:
        """Somebody drives the robot through all rooms; in each it turns round."""
        planner = self._tour_planner()
        for room in range(len(self.home.kinds)):
            for spot in self._spots(room):
                path = planner.path(self.robot.pose, spot, 0.3)
                assert path is not None, (self.seed, room)
                # It is steered by what is true, so the path is moved to where it believes to be.
                self.seeker.follow(path, true=True)
                self.seeker.turn_round()

    def _frame(self) -> None:
        frame = self.robot.look()
        if hasattr(self.perception, "instances"):
            self.perception.instances = self.robot.instances
        perceived = self.mind.see(frame)
        if self.on_tour:
            for other in self.others.values():
                other.add(frame, perceived)
        self.on_frame(frame, perceived)

    on_tour = True

    # --- An errand.

    def is_possible(self, task: Task) -> bool:
        """Whether a robot can stand near the thing at all; what is not there can be said anyway."""
        return not task.right or math.isfinite(self.referee.shortest_m(self.robot.pose, task))

    def run(self, task: Task) -> Outcome:
        """Ask the robot, and judge what it does."""
        start, before_m = self.robot.pose.copy(), self.robot.path_m
        target = self.seeker.fetch(task.words)
        path_m = self.robot.path_m - before_m
        said = "not there" if target is None else f"{target.name} at {target.position_m}"
        T = self.mind.T_graph_map
        chosen = None if target is None else self._right_one(target, task, T)
        shortest_m = self.referee.shortest_m(start, task, chosen) if task.right else 0.0
        failure = self._judge(task, target, chosen)
        if not failure and chosen is not None and _is_long(path_m, shortest_m):
            failure = "path too long"
        return Outcome(
            US, task.kind, task.words, self.seed, failure, path_m, shortest_m, said,
            tuple(self.seeker.told),
        )  # fmt: skip

    def _judge(self, task: Task, target: SceneObject | None, chosen: int | None) -> str:
        """The stage that failed, but for the length of the path."""
        if not task.right:
            return "" if target is None else "claimed"
        if chosen is None:
            return self.referee.why_missed(task, self.mind.graph(), self.mind.T_graph_map)
        return "" if self.referee.is_in_view(self.robot.pose, (chosen,)) else "not in view"

    def _right_one(self, target: SceneObject, task: Task, T_graph_map: np.ndarray) -> int | None:
        """The number of the right object that a node is; None = it is none of them."""
        at = (invert_pose(T_graph_map) @ [*target.position_m, 1.0])[:3]
        gaps = {n: _gap_m(at, self.home.bounds(n)) for n in self.home.alike(task.right)}
        if not gaps:
            return None
        nearest = min(gaps, key=lambda n: gaps[n])
        return nearest if nearest in task.right and gaps[nearest] < SAME_M else None

    def run_other(self, method: str, task: Task) -> Outcome:
        """The same errand with another graph or rule: no frames, the pose is reached exactly."""
        robot = self.robot
        ours = self.mind.graph()
        start = robot.pose.copy()
        is_ours = method == LABEL
        graph = ours if is_ours else self.others[method].graph()
        graph.space = ours.space
        T = self.mind.T_graph_map if is_ours else np.eye(4)
        at = self.mind.believed(robot.T_map_camera) if is_ours else robot.believed
        resolve = by_label if is_ours else by_question
        target = resolve(graph, task.words, at)
        chosen = None if target is None else self._right_one(target, task, T)
        if chosen is None or target is None:
            failure = self.referee.why_missed(task, graph, T) if task.right else ""
            if not task.right and target is not None:
                failure = "claimed"
            return Outcome(method, task.kind, task.words, self.seed, failure)
        way = way_to(graph, target, robot, at, T)
        if way is None:
            return Outcome(method, task.kind, task.words, self.seed, "unreachable")
        shortest_m, path_m = self.referee.shortest_m(start, task, chosen), length_m(way.path)
        failure = ""
        if not self.referee.is_in_view(way.pose, (chosen,)):
            failure = "not in view"
        elif _is_long(path_m, shortest_m):
            failure = "path too long"
        return Outcome(method, task.kind, task.words, self.seed, failure, path_m, shortest_m)


def _is_long(path_m: float, shortest_m: float) -> bool:
    return path_m > max(MOST_DETOUR * shortest_m, shortest_m + SPARE_M)


def _gap_m(point: np.ndarray, box: np.ndarray) -> float:
    return float(np.linalg.norm(np.maximum(np.maximum(box[0] - point, point - box[1]), 0.0)))


def run_home(
    seed: int, kind: str, *, others: bool = False, most: int | None = None
) -> list[Outcome]:
    """All errands of a home, each told when it is done.

    Args:
        seed: of the home.
        kind: of the detections.
        others: whether other methods are compared with.
        most: greatest number of errands; None = all.
    """
    cv2.setNumThreads(1)
    start_s, cpu_s = time.perf_counter(), time.process_time()
    errands = Errands(seed, kind, others=others)
    errands.tour()
    patrol(errands.seeker)
    errands.on_tour = False
    robot, home = errands.robot, errands.home
    found: list[Outcome] = []
    tasks = [*standing_tasks(home, errands.rng), *absent_tasks(home, errands.rng)]
    for task in filter(errands.is_possible, tasks[:most]):
        rivals = (*errands.others, LABEL) if others else ()
        found += [_tried(errands.run_other, method, task, seed) for method in rivals]
        found.append(_tried(lambda _, task: errands.run(task), US, task, seed))
        _tell(found[-1 - len(rivals) :])
    if most is None or most > len(tasks):
        moved = move_things(home, errands.rng)
        robot.camera.move()
        moved = moved[: None if most is None else most - len(tasks)]
        for task in filter(errands.is_possible, moved):
            found.append(_tried(lambda _, task: errands.run(task), US, task, seed))
            _tell(found[-1:])
    errands.close()
    print(
        f"home {seed} ({kind}): {robot.frames} frames, {robot.path_m:.0f} m, {robot.bumps} bumps, "
        f"{len(errands.mind.graph())} nodes for {len(home.present)} objects, "
        f"{time.perf_counter() - start_s:.0f} s, {time.process_time() - cpu_s:.0f} s CPU",
        flush=True,
    )
    return found


def _tried(run: Callable[[str, Task], Outcome], method: str, task: Task, seed: int) -> Outcome:
    """The outcome of an errand; an error is a failure, and the other errands go on."""
    try:
        return run(method, task)
    except Exception as error:
        traceback.print_exc()
        return Outcome(method, task.kind, task.words, seed, "error", said=repr(error))


def _tell(outcomes: list[Outcome]) -> None:
    for one in outcomes:
        print(
            f"{one.home:4} {one.method:24} {one.kind:9} {one.words:28} {one.failure or 'ok':18} "
            f"{one.path_m:5.1f} m, shortest {one.shortest_m:4.1f} m; {one.said}",
            flush=True,
        )
        if one.failure:
            print("".join(f"          {step}\n" for step in one.steps), end="", flush=True)


def run_all(
    first: int, homes: int, compared: int, embedded: int, *, jobs: int = 2, most: int | None = None
) -> dict[str, list[Outcome]]:
    """The errands in all homes, in several processes; outcomes by the kind of the detections.

    Args:
        first: seed of the first home.
        homes: how many have true boxes with faults.
        compared: how many of them are asked of other methods, too.
        embedded: how many have the shipped detector.
        jobs: homes at the same time.
        most: greatest number of errands in a home; None = all.
    """
    # The longest ones come first, so that the processes end at about the same time.
    work = [("embedded", first + k, False) for k in range(embedded)]
    work += [("boxes", first + k, k < compared) for k in range(homes)]
    found: dict[str, list[Outcome]] = {"boxes": [], "embedded": []}
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        outcomes = pool.imap(partial(_run_home, most=most), work, chunksize=1)
        for (kind, _, _), home in zip(work, outcomes):
            found[kind] += home
    return found


def _run_home(home: tuple[str, int, bool], most: int | None) -> list[Outcome]:
    kind, seed, others = home
    return run_home(seed, kind, others=others, most=most)


def shares(outcomes: list[Outcome], method: str, *kinds: str) -> tuple[int, int]:
    """How many errands of these kinds were fulfilled, and how many there were."""
    chosen = [one for one in outcomes if one.method == method and one.kind in kinds]
    return sum(not one.failure for one in chosen), len(chosen)


def table(outcomes: list[Outcome]) -> str:
    """Markdown: methods by kinds of errands, and failures by stage."""
    groups = {
        "by a relation": ("relation",), "by an order": ("order",), "moved since": ("moved",),
        "not there": ("absent", "removed"),
    }  # fmt: skip
    methods = list(dict.fromkeys(one.method for one in outcomes))
    methods.sort(key=lambda name: name != US)
    lines = ["| graph and answer | " + " | ".join(groups) + " | failures |", "|---" * 6 + "|"]
    for method in methods:
        cells = []
        for kinds in groups.values():
            right, count = shares(outcomes, method, *kinds)
            cells.append(f"{right} of {count}" if count else "–")
        why = Counter(one.failure for one in outcomes if one.method == method and one.failure)
        told = ", ".join(f"{stage} {why[stage]}" for stage in STAGES if why[stage])
        lines.append(f"| {method} | " + " | ".join(cells) + f" | {told or 'none'} |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--homes", type=int, default=HOMES)
    parser.add_argument("--first", type=int, default=FIRST, help="seed of the first home")
    parser.add_argument(
        "--embedded", type=int, default=EMBEDDED, help="homes with the shipped detector"
    )
    parser.add_argument("--jobs", type=int, default=2, help="homes at the same time")
    parser.add_argument("--most", type=int, help="errands in a home")
    parser.add_argument("--compared", type=int, default=COMPARED, help="homes with other methods")
    parser.add_argument("--json", type=Path, help="write all outcomes to this file")
    options = parser.parse_args()
    if options.embedded and importlib.util.find_spec("mujoco") is None:
        parser.error("the shipped detector needs pictures: pip install mujoco, or --embedded 0")
    start_s = time.perf_counter()
    found = run_all(
        options.first, options.homes, options.compared, options.embedded,
        jobs=options.jobs, most=options.most,
    )  # fmt: skip
    for kind, outcomes in found.items():
        if outcomes:
            homes = len({one.home for one in outcomes})
            print(f"\n{kind}: {homes} homes\n\n{table(outcomes)}\n", flush=True)
    print(f"{(time.perf_counter() - start_s) / 60:.1f} minutes", flush=True)
    if options.json is not None:
        report = {kind: [asdict(one) for one in outcomes] for kind, outcomes in found.items()}
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
