"""How the robot fulfils an errand: it goes to an answer, looks whether it is right, and seeks."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from look import (
    IN_VIEW_M,
    IN_VIEW_PX,
    LOOKED_M,
    NEARER_M,
    SURFACES,
    Looked,
    gap_m,
    pixels_of,
    views,
    way_before,
)
from mind import LEAST, Mind, Way, answers_to, bearers_asked, like, way_to
from robot import Robot

from deworldsg_ros.client.grammar import Pattern, parse
from deworldsg_ros.client.objects import SceneObject

# Places that the robot goes to in one errand, at most.
MOST_PLACES = 16
# Something so near is looked at from where the robot is, if it is seen from there.
NEAR_ENOUGH_M = 1.35
# A node is the same one if it is as near to where it was.
SAME_M = 0.4
# On the way, it asks the graph again after so many frames.
CHECK_FRAMES = 4
# From near, a thing is what it was asked for if the answer is as probable.
SURE = 0.25
# Before the robot says that a thing is not there, it looks at what may be it.
DOUBTFUL = 0.05
# What never was in the graph is not sought farther than that.
MOST_SEEK_M = 24.0
# What was as probable was there before; what it was like tells what it may be now.
KNOWN = 0.5


class Seeker:
    """A robot that is asked for things.

    Args:
        robot: that drives.
        mind: its graph.
        frame: takes a frame, and adds it to the graph.
    """

    def __init__(self, robot: Robot, mind: Mind, frame: Callable[[], None]) -> None:
        self.robot, self.mind, self._take = robot, mind, frame
        self.told: list[str] = []
        self._looked = Looked(robot)
        self._surfaces: list[SceneObject] = []
        self._known: dict[str, SceneObject] = {}

    def _frame(self) -> None:
        """Take a frame, and note what it shows of the furniture."""
        self._take()
        self._looked.note(self._surfaces, self.mind.T_graph_map)

    def _remember(self) -> None:
        """Note what is in the graph, by name: it may be gone from there when it is asked for."""
        for item in self.mind.graph():
            known = self._known.get(item.label)
            if item.probability >= max(KNOWN, known.probability if known else 0.0):
                self._known[item.label] = item

    def _note_surfaces(self) -> None:
        self._surfaces = [item for item in self.mind.graph() if item.label in SURFACES]

    def follow(
        self, path: np.ndarray, *, true: bool = False, until: Callable[[], bool] | None = None
    ) -> bool:
        """Drive along a path (n, 2); false if something is in the way for long, or `until` holds.

        Args:
            path: in the frame of the robot's poses.
            true: whether somebody steers by what is true.
            until: asked after every frame.
        """
        stuck = 0
        for point in path[1:]:
            for _ in range(400):
                at = self.robot.pose if true else self.robot.believed
                if np.linalg.norm(point - at[:2]) < 0.06:
                    break
                target = point - at[:2] + self.robot.believed[:2] if true else point
                stuck = 0 if self.robot.step(target) else stuck + 1
                self._frame()
                if stuck > 3 or (until is not None and until()):
                    return False
        return True

    def turn_round(self) -> None:
        """Look in all directions."""
        start = self.robot.believed[2]
        for part in range(1, 19):
            self.robot.turn(start + part * 2 * math.pi / 18)
            self._frame()

    def _look_at(self, yaw: float, frames: int = 4) -> int:
        """Turn to a heading and look; returns the stamp before what is seen there."""
        for _ in range(20):
            reached = self.robot.turn(yaw)
            since_ns = self.robot.stamp_ns
            self._frame()
            if reached:
                break
        for _ in range(frames):
            self._frame()
        return since_ns

    @property
    def at(self) -> np.ndarray:
        """x, y and yaw (3,) of the robot in the frame of the graph."""
        return self.mind.believed(self.robot.T_map_camera)

    def _way(self, target: SceneObject, avoid: list[np.ndarray]) -> Way | None:
        T = self.mind.T_graph_map
        way = way_to(self.mind.graph(), target, self.robot, self.at, T, avoid)
        if way is None and not avoid:
            path = way_before(target, self.robot, np.linalg.inv(T))
            way = None if path is None else Way(np.array([*path[-1], 0.0]), path)
        return way

    # --- A look at one thing.

    def visit(self, target: SceneObject) -> tuple[SceneObject | None, bool]:
        """Go before a thing and look; the node that is in view there, and whether it was reached.

        It stops as soon as the thing is in view from near. From where it is not in view, the robot
        tries one other side.
        """
        looked = False
        avoid: list[np.ndarray] = []
        for trial in range(4):
            if trial or not self._may_see(target):
                way = self._way(target, avoid)
                if way is None:
                    break
                until = None if trial else partial(self._may_see, target)
                if self.follow(way.path, until=until):
                    avoid.append(way.pose[:2])
                elif trial or not self._may_see(target):
                    continue
            looked = True
            seen = self._seen(target, self.turn_to(target))
            if seen is not None and self._is_in_view(seen):
                return seen, True
            if len(avoid) == 2 or target.id not in self.mind.graph():
                break
        return None, looked

    def turn_to(self, target: SceneObject, frames: int = 4) -> int:
        """Turn to a thing and look; returns the stamp before what is seen there."""
        return self._look_at(self.turn_of(target) + float(self.robot.believed[2]), frames)

    def turn_of(self, target: SceneObject) -> float:
        """By how much a thing is beside where the robot looks, radian, from -pi to pi."""
        x, y, yaw = self.at
        ahead = math.atan2(target.position_m[1] - y, target.position_m[0] - x)
        return math.remainder(ahead - yaw, math.tau)

    def _may_see(self, item: SceneObject) -> bool:
        """Whether a thing is near, and nothing tall before it."""
        if gap_m(item, self.at) > NEAR_ENOUGH_M:
            return False
        point = (np.linalg.inv(self.mind.T_graph_map) @ [*item.position_m, 1.0])[:3]
        return bool(views(self.robot, self.robot.believed[None, :2], point[None], LOOKED_M)[0, 0])

    def _is_in_view(self, item: SceneObject) -> bool:
        near = gap_m(item, self.at) < IN_VIEW_M
        return near and pixels_of(item, self.robot, self.mind.T_graph_map) > IN_VIEW_PX

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
        answer. If it is not, it goes on to the next one, then to places from which it sees
        furniture that it has not looked at since it was asked. If the thing was elsewhere before,
        only what is as large counts.
        """
        self.told = []
        since_ns, before_m = self.robot.stamp_ns, self.robot.path_m
        asked = parse(words)
        # Only what has no other mark than its name is still the same thing elsewhere.
        may_move = isinstance(asked, Pattern) and not asked.conditions and asked.rank is None
        wrong: list[SceneObject] = []
        self._looked = Looked(self.robot)
        self._note_surfaces()
        self._remember()
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
            if self.robot.frames % CHECK_FRAMES:
                return False
            self._note_surfaces()
            return next_answer() is not None

        for _ in range(MOST_PLACES):
            target = next_answer()
            if target is None and old is None and first:
                first = False
                old = self._known.get(str(asked.thing)) if may_move else None
                target = next_answer(DOUBTFUL)
            if target is not None:
                if target.first_seen_ns > since_ns and gap_m(target, self.at) > NEAR_ENOUGH_M:
                    # What is new is looked at from here, before it is gone to.
                    self.turn_to(target, 6)
                    again = next_answer()
                    if again is None or again.id != target.id:
                        self._tell("no longer", target)
                        continue
                seen, reached = self.visit(target)
                self._tell("to", target, "seen" if seen else "reached" if reached else "no way")
                if seen is not None and self._is_answer(seen, words, old):
                    return seen
                wrong += [target] if seen is None else [target, seen]
                was_there = target.last_seen_ns <= since_ns and target.probability >= KNOWN
                if old is None and may_move and was_there and reached and seen is None:
                    old = target
                    self.turn_round()
                continue
            if old is None and self.robot.path_m - before_m > MOST_SEEK_M:
                break
            if not self._seek(words, old, look_about):
                break
        return None

    def _seek(self, words: str, old: SceneObject | None, until: Callable[[], bool]) -> bool:
        """Look at furniture that was not looked at; false if there is none.

        What never was in the graph is sought on what it is asked to be on, if that is said.
        """
        self._note_surfaces()
        asked = [] if old is not None else bearers_asked(self.mind.graph(), words)
        items = asked or self._surfaces
        if asked and self._looked.reach_m > NEARER_M:
            # The graph knows these, and what is on them as seen from far.
            self._looked = Looked(self.robot, NEARER_M)
        T_map_graph = np.linalg.inv(self.mind.T_graph_map)
        path = self._looked.next_view(items, T_map_graph)
        if path is None and self._looked.reach_m > NEARER_M:
            self._looked = Looked(self.robot, NEARER_M)
            path = self._looked.next_view(items, T_map_graph)
        if path is None:
            return False
        self.told.append(f"seek at {path[-1].round(2)}")
        if self.follow(path, until=until):
            self.turn_round()
        elif until():
            return True
        self._looked.give_up(items, path[-1], T_map_graph)
        return True

    def _tell(self, what: str, item: SceneObject, end: str = "") -> None:
        place = " ".join(f"{value:.2f}" for value in item.position_m)
        self.told.append(f"{what} {item.name} ({item.probability:.2f}) at {place} {end}".strip())

    def _is_answer(self, seen: SceneObject, words: str, old: SceneObject | None) -> bool:
        """Whether what is in view is a probable answer to the question."""
        for _ in range(2):
            found = answers_to(self.mind.graph(), words, self.at, LEAST)
            own = [one for one in found if one.item.id == seen.id]
            best = ", ".join(f"#{one.item.id} {one.probability:.0%}" for one in found[:4])
            self.told.append(f"answers there: {best or 'none'}")
            if own and own[0].probability >= SURE and (old is None or like(old, own[0].item)):
                return True
            for _ in range(4):
                self._frame()
        return False


def is_same(a: SceneObject, b: SceneObject) -> bool:
    """Whether nodes of two graphs are one thing at one place."""
    gap_m = float(np.linalg.norm(np.subtract(a.position_m, b.position_m)))
    return gap_m < SAME_M if a.id == b.id else gap_m < SAME_M / 2 and a.label == b.label
