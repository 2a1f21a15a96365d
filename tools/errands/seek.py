"""How the robot fulfils an errand: it goes to an answer, looks whether it is right, and seeks."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from mind import LEAST, Mind, Way, answers_to, bearers_asked, like, way_to
from robot import Robot

from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SceneObject

# Places that the robot goes to in one errand, at most.
MOST_PLACES = 16
# Something so near is looked at from where the robot is, if it is seen from there.
NEAR_ENOUGH_M = 1.4
# A node is the same one if it is as near to where it was.
SAME_M = 0.4
# A surface is looked at if it was seen from so near, and in this many checks.
LOOKED_M, CHECK_FRAMES = 2.5, 4
# From near, a thing is what it was asked for if the answer is as probable.
SURE = 0.25
# Before the robot says that a thing is not there, it looks at what may be it.
DOUBTFUL = 0.05
# What never was in the graph is not sought farther than that.
MOST_SEEK_M = 16.0
# Where a thing may have been put.
SURFACES = ("dining table", "desk", "counter", "cabinet", "stand", "couch", "bed")


class Seeker:
    """A robot that is asked for things.

    Args:
        robot: that drives.
        mind: its graph.
        frame: takes a frame, and adds it to the graph.
    """

    def __init__(self, robot: Robot, mind: Mind, frame: Callable[[], None]) -> None:
        self.robot, self.mind, self.frame = robot, mind, frame
        self.told: list[str] = []

    def follow(
        self, path: np.ndarray, *, true: bool = False, until: Callable[[], bool] | None = None
    ) -> bool:
        """Drive along a path (n, 2); false if something is in the way for long, or `until` holds.

        Args:
            path: in the frame of the robot's poses.
            true: whether somebody steers by what is true.
            until: asked every `CHECK_FRAMES` frames.
        """
        stuck = 0
        for point in path[1:]:
            for _ in range(400):
                at = self.robot.pose if true else self.robot.believed
                if np.linalg.norm(point - at[:2]) < 0.06:
                    break
                target = point - at[:2] + self.robot.believed[:2] if true else point
                stuck = 0 if self.robot.step(target) else stuck + 1
                self.frame()
                if stuck > 3:
                    return False
                if until is not None and self.robot.frames % CHECK_FRAMES == 0 and until():
                    return False
        return True

    def turn_round(self) -> None:
        """Look in all directions."""
        start = self.robot.believed[2]
        for part in range(1, 19):
            self.robot.turn(start + part * 2 * math.pi / 18)
            self.frame()

    def _look_at(self, yaw: float, frames: int = 4) -> int:
        """Turn to a heading and look; returns the stamp before what is seen there."""
        for _ in range(20):
            reached = self.robot.turn(yaw)
            since_ns = self.robot.stamp_ns
            self.frame()
            if reached:
                break
        for _ in range(frames):
            self.frame()
        return since_ns

    @property
    def at(self) -> np.ndarray:
        """x, y and yaw (3,) of the robot in the frame of the graph."""
        return self.mind.believed(self.robot.T_map_camera)

    def _way(self, target: SceneObject, avoid: list[np.ndarray]) -> Way | None:
        return way_to(self.mind.graph(), target, self.robot, self.at, self.mind.T_graph_map, avoid)

    # --- A look at one thing.

    def visit(self, target: SceneObject) -> tuple[SceneObject | None, bool]:
        """Go before a thing and look; the node that is in view there, and whether it was reached.

        From where it is not in view, the robot tries one other side.
        """
        away_m = float(np.linalg.norm(np.array(target.position_m[:2]) - self.at[:2]))
        if away_m - max(target.size_m[:2]) / 2 < NEAR_ENOUGH_M:
            way = np.array(target.position_m[:2]) - self.at[:2]
            turn = math.atan2(way[1], way[0]) - self.at[2]
            seen = self._seen(target, self._look_at(turn + float(self.robot.believed[2])))
            if seen is not None:
                return seen, True
        avoid: list[np.ndarray] = []
        for _ in range(3):
            chosen = self._way(target, avoid)
            if chosen is None:
                break
            if self.follow(chosen.path):
                avoid.append(chosen.pose[:2])
                seen = self._seen(target, self._look_at(float(chosen.pose[2])))
                if seen is not None or len(avoid) == 2:
                    return seen, True
                if target.id not in self.mind.graph():
                    return None, True
        return None, bool(avoid)

    def _seen(self, target: SceneObject, since_ns: int) -> SceneObject | None:
        """The node of a target, if it was detected since a time."""
        graph = self.mind.graph()
        near = [item for item in graph if item.last_seen_ns > since_ns and is_same(item, target)]
        near.sort(key=lambda item: item.id != target.id)
        return near[0] if near else None

    # --- An errand.

    def fetch(self, words: str) -> SceneObject | None:
        """The thing that the robot stands before at the end; None = it says that it is not there.

        It goes to the best answer. There, it looks whether the thing is in view and still an
        answer. If it is not, it goes on to what is as sure and as large, then to the furniture that
        it has not looked at since it was asked, the nearest first.
        """
        self.told = []
        since_ns, before_m = self.robot.stamp_ns, self.robot.path_m
        wrong: list[SceneObject] = []
        looked: set[int] = set()
        old: SceneObject | None = None
        first = True

        def next_answer(least: float = LEAST) -> SceneObject | None:
            found = answers_to(self.mind.graph(), words, self.at, least)
            for item in (one.item for one in found):
                if any(is_same(item, other) for other in wrong):
                    continue
                if old is None or like(old, item):
                    return item
            return None

        def look_about() -> bool:
            self._note_looked(looked)
            return next_answer() is not None

        for _ in range(MOST_PLACES):
            target = next_answer()
            if target is None and old is None and first:
                first = False
                target = next_answer(DOUBTFUL)
            if target is not None:
                seen, reached = self.visit(target)
                self._tell("to", target, "seen" if seen else "reached" if reached else "no way")
                if seen is not None and self._is_answer(seen, words, old):
                    return seen
                wrong.append(seen or target)
                if seen is not None:
                    wrong.append(target)
                if old is None and seen is None and target.last_seen_ns <= since_ns:
                    old = target
                    self.turn_round()
                    self._note_looked(looked)
                continue
            place = self._next_place(self.mind.graph(), words, old, looked)
            if old is None and self.robot.path_m - before_m > MOST_SEEK_M:
                place = None
            if place is None:
                break
            self._tell("seek at", place)
            looked.add(place.id)
            way = self._way(place, [])
            if way is not None and self.follow(way.path, until=look_about):
                self._look_at(float(way.pose[2]), 2)
                if next_answer() is None:
                    self.turn_round()
            self._note_looked(looked)
        return None

    def _tell(self, what: str, item: SceneObject, end: str = "") -> None:
        place = " ".join(f"{value:.2f}" for value in item.position_m)
        self.told.append(f"{what} {item.name} ({item.probability:.2f}) at {place} {end}".strip())

    def _is_answer(self, seen: SceneObject, words: str, old: SceneObject | None) -> bool:
        """Whether what is in view is a probable answer to the question."""
        for _ in range(2):
            found = answers_to(self.mind.graph(), words, self.at, LEAST)
            own = [one for one in found if one.item.id == seen.id]
            if own and own[0].probability >= SURE and (old is None or like(old, own[0].item)):
                return True
            for _ in range(4):
                self.frame()
        return False

    def _note_looked(self, looked: set[int]) -> None:
        """Note the furniture that is in view from near."""
        now_ns, at = self.robot.stamp_ns, self.at
        for item in self.mind.graph():
            gap_m = float(np.linalg.norm(np.array(item.position_m[:2]) - at[:2]))
            is_seen = item.last_seen_ns >= now_ns - CHECK_FRAMES * 2 * 10**8
            if item.label in SURFACES and is_seen and gap_m < LOOKED_M:
                looked.add(item.id)

    def _next_place(
        self, graph: SceneGraph, words: str, old: SceneObject | None, looked: set[int]
    ) -> SceneObject | None:
        """The nearest piece of furniture to look at; None = all were looked at.

        What never was in the graph is sought on what it is asked to be on, if that is said.
        """
        asked = [] if old is not None else bearers_asked(graph, words)
        items = asked or [item for item in graph if item.label in SURFACES]
        items = [item for item in items if item.id not in looked]
        if not items:
            return None
        planner = self.robot.planner()
        found = planner.paths(self.robot.believed)
        T_map_graph = np.linalg.inv(self.mind.T_graph_map)

        def way_m(item: SceneObject) -> float:
            place = (T_map_graph @ [*item.position_m, 1.0])[:2]
            cell = planner.near(place, 2.0)
            return math.inf if found is None or cell is None else float(found[0][cell])

        return min(items, key=way_m)


def is_same(a: SceneObject, b: SceneObject) -> bool:
    """Whether nodes of two graphs are one thing at one place."""
    gap_m = float(np.linalg.norm(np.subtract(a.position_m, b.position_m)))
    return gap_m < SAME_M if a.id == b.id else gap_m < SAME_M / 2 and a.label == b.label
