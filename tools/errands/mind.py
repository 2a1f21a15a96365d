"""What the robot knows and decides: the graph of its frames, questions to it, and goals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from home import RADIUS_M, ROBOT_M, Home
from robot import CAMERA_M, TILT_RAD, Robot, length_m, plan_pose

from deworldsg_ros.client.goals import Robot as Footprint
from deworldsg_ros.client.grammar import Pattern, parse
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.client.questions import Answer, ask
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.baselines import BaselinePipeline, Fross
from deworldsg_ros.evaluation.front_ends import TRUE_PROBABILITY, AnnotatedBoxes
from deworldsg_ros.evaluation.injection import (
    Detection,
    Faults,
    FrameDetections,
    FrameFaults,
    Injection,
    spread,
    visible_box,
)
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.pipeline import Perceiver, Pipeline
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

# Furniture that COCO has no name for.
CLASSES = (*COCO_CLASSES, "cabinet", "counter", "desk", "shelf", "stand", "window")
# Faults of detections: those of the evaluation, and names that are wrong for two seconds on end.
FRAME_FAULTS = FrameFaults(flip=0.1, miss=0.1, jitter_px=2.0)
FAULTS = Faults(label=0.05, false=0.5)
# An answer that is less probable is none; those that are about as probable as the best are equal.
LEAST, EQUAL = 0.15, 0.8
# From the box of a thing. Where it is near already, the robot goes no nearer than it has to; across
# a bed, there is no nearer place.
DISTANCES_M, FAR_M = (1.2, 0.9, 0.7), 1.4
# Another side is tried if the path is so many times longer than the straight line.
DIRECT = 1.5
# Places that are nearer than this see the same.
APART_M = 0.4
# Sides of the same object may be measured as so many times larger from another place.
MOST_LARGER = 2.2
# So far below the horizon does the camera see, with a margin.
SEES_DOWN_RAD = TILT_RAD + math.radians(18)


class TrueBoxes:
    """Perception with true boxes and names, and their faults, instead of a detector.

    Attributes:
        instances: (h, w) uint16, the true objects of the next frame.
    """

    def __init__(self, home: Home, seed: int) -> None:
        self._detector = AnnotatedBoxes(CLASSES)
        config = Config()
        self._perception = build_perception(config.perception, detector=self._detector)
        self.vocabulary: Vocabulary = self._perception.vocabulary
        self._class_of = {i.number: CLASSES.index(home.name(i.number)) for i in home.items}
        self._injection = Injection(
            self.vocabulary, list(self._class_of.values()), FRAME_FAULTS, FAULTS, seed
        )
        self._number = 0
        self.instances = np.zeros((0, 0), np.uint16)

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The objects in view, with faults, in our masks and relations."""
        found = []
        for number in np.unique(self.instances[self.instances > 0]).tolist():
            box = visible_box(self.instances, number)
            if box is not None:
                names = spread({self._class_of[number]: TRUE_PROBABILITY}, len(CLASSES))
                found.append(Detection(box, names, TRUE_PROBABILITY, number))
        self._number += 1
        seen = FrameDetections(found, [], self.instances)
        seen = self._injection.apply(seen, frame, self._number)
        self._detector.detections = list(seen.detections)
        return self._perception.perceive(frame)


class Recalled:
    """Perception that was there before: other graphs are made of the same detections."""

    def __init__(self) -> None:
        self.perceived: Perceived | None = None

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """What was given."""
        assert self.perceived is not None
        return self.perceived


def perceiver(kind: str, home: Home, seed: int) -> Perceiver:
    """Perception: ``boxes`` (true, with faults) or ``embedded``."""
    return TrueBoxes(home, seed) if kind == "boxes" else build_perception(Config().perception)


class Mind:
    """The graph of the frames so far, as `deworldsg_node` makes it.

    Args:
        perception: of the frames.
        config: of the graph.
    """

    def __init__(self, perception: Perceiver, config: Config | None = None) -> None:
        self.pipeline = Pipeline(config or Config(), perception)

    def see(self, frame: RgbdFrame) -> Perceived:
        """Add a frame."""
        return self.pipeline.process(frame).perceived

    def graph(self) -> SceneGraph:
        """The graph as a client has it, with the seen space."""
        graph = SceneGraph(self.pipeline.graph())
        assert self.pipeline.builder is not None
        graph.space = self.pipeline.builder.space
        return graph

    def believed(self, T_map_camera: np.ndarray) -> np.ndarray:
        """x, y and yaw (3,) of the robot in the frame of the graph."""
        return plan_pose(self.T_graph_map @ T_map_camera)

    @property
    def T_graph_map(self) -> np.ndarray:  # noqa: N802
        """From the frame of the robot's poses to that of the graph, (4, 4)."""
        assert self.pipeline.builder is not None
        return self.pipeline.builder.T_graph_poses


class OtherMind(Mind):
    """A graph of another method, from the detections of the first one.

    Args:
        pipeline: of `evaluation.baselines`, or with other rules.
        recalled: its perception.
    """

    def __init__(self, pipeline: Pipeline | BaselinePipeline, recalled: Recalled) -> None:
        self.pipeline, self._recalled = pipeline, recalled

    def add(self, frame: RgbdFrame, perceived: Perceived) -> None:
        """Add a frame with its detections."""
        self._recalled.perceived = perceived
        self.pipeline.process(frame)

    def graph(self) -> SceneGraph:
        """The graph."""
        return SceneGraph(self.pipeline.graph())


def other_minds(root: Path) -> dict[str, OtherMind]:
    """The graphs to compare with: the paper's rules, and FROSS."""
    from deworldsg_ros.config import load_config

    paper, fross = Recalled(), Recalled()
    rules = load_config(root / "config" / "paper_rules.yaml")
    return {
        "the paper's rules": OtherMind(Pipeline(rules, paper), paper),
        "FROSS": OtherMind(BaselinePipeline(Fross(), fross), fross),
    }


Resolve = Callable[[SceneGraph, str, np.ndarray], "SceneObject | None"]


def by_question(graph: SceneGraph, words: str, at: np.ndarray) -> SceneObject | None:
    """The best answer to the question, of equal ones the nearest; None = none can be believed."""
    found = answers_to(graph, words, at, LEAST)
    return found[0].item if found else None


def answers_to(graph: SceneGraph, words: str, at: np.ndarray, least: float) -> list[Answer]:
    """The answers that are as probable; of those about as probable as the best, the nearest first.

    Args:
        graph: that is asked.
        words: the question.
        at: x, y and yaw (3,) of the robot, in the frame of the graph.
        least: the least probability of an answer.
    """
    try:
        found = [one for one in ask(graph, words).found if one.probability >= least]
    except ClientError:  # a name that the graph has not
        return []
    if not found or _is_ordered(words):
        return found
    equal = EQUAL * found[0].probability

    def order(one: Answer) -> tuple[bool, float]:
        gap_m = float(np.linalg.norm(np.array(one.item.position_m[:2]) - at[:2]))
        return one.probability < equal, gap_m if one.probability >= equal else -one.probability

    return sorted(found, key=order)


def like(old: SceneObject, item: SceneObject) -> bool:
    """Whether an object may be one that was elsewhere before: as large, and about as sure."""
    a, b = (np.sort(np.maximum(one.size_m, 0.05)) for one in (old, item))
    ratio = (b / a)[1:]
    return bool((ratio < MOST_LARGER).all() and (ratio > 1 / MOST_LARGER).all())


def bearers_asked(graph: SceneGraph, words: str) -> list[SceneObject]:
    """What a thing is asked to be on: the desks of "cup on the desk"."""
    asked = parse(words)
    assert isinstance(asked, Pattern)
    found: list[SceneObject] = []
    for condition in asked.conditions:
        try:
            found += graph.objects(condition.thing, min_probability=0.3) if condition.thing else []
        except ClientError:
            continue
    return found


def _is_ordered(words: str) -> bool:
    asked = parse(words)
    return isinstance(asked, Pattern) and asked.rank is not None


def _nearest(items: list[SceneObject], at: np.ndarray) -> SceneObject:
    gaps = [float(np.linalg.norm(np.array(item.position_m[:2]) - at[:2])) for item in items]
    return items[int(np.argmin(gaps))]


def by_label(graph: SceneGraph, words: str, at: np.ndarray) -> SceneObject | None:
    """The nearest object of the name; relations and orders do not count."""
    asked = parse(words)
    assert isinstance(asked, Pattern)
    try:
        items = graph.objects(asked.thing)
    except ClientError:
        return None
    return _nearest(items, at) if items else None


@dataclass(frozen=True)
class Way:
    """A pose (3,) to look from, and the path (n, 2) to it, in the frame of the robot's poses."""

    pose: np.ndarray
    path: np.ndarray


def way_to(
    graph: SceneGraph,
    target: SceneObject,
    robot: Robot,
    at_graph: np.ndarray,
    T_graph_map: np.ndarray,
    avoid: Sequence[np.ndarray] = (),
) -> Way | None:
    """The pose of `goal_near` that the planner reaches, of the first distance that has one.

    Of its sides, the first one to which the way is about straight, else that of the shortest way.

    Args:
        graph: with the target.
        target: to look at.
        robot: its floor grid knows ways, and walls that hide the target.
        at_graph: x, y and yaw (3,) of the robot, in the frame of the graph.
        T_graph_map: from the frame of the robot's poses to that of the graph.
        avoid: places (2,) from which the target was not in view.
    """
    footprint, planner = Footprint(RADIUS_M, ROBOT_M), robot.planner()
    T_map_graph = invert_pose(T_graph_map)
    at_map = robot.believed
    own = np.array(target.position_m)
    own_map = (T_map_graph @ [*own, 1.0])[:2]
    angles = np.arange(4) * np.pi / 2
    sides = own[:2] + 4.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    least_m = (CAMERA_M - target.height_m) / math.tan(SEES_DOWN_RAD)
    best: tuple[float, Way] | None = None
    away_m = float(np.linalg.norm(own[:2] - at_graph[:2]))
    distances_m = (FAR_M, *DISTANCES_M) if away_m < 2 * FAR_M else (*DISTANCES_M, FAR_M)
    for distance_m in [d for d in distances_m if d >= least_m] or [FAR_M]:
        for x, y in [at_graph[:2].tolist(), *sides.tolist()]:
            try:
                goal = graph.goal_near(target, distance_m, robot=footprint, towards=(x, y, 0.0))
            except ClientError:
                break
            place = (T_map_graph @ [*goal.position_m, 1.0])[:2]
            path = None
            if not any(np.linalg.norm(place - other) < APART_M for other in avoid):
                hidden = robot.grid.hides(place[None], own_map[None])[0]
                path = None if hidden else planner.path(at_map, place)
            if path is None:
                continue
            ahead, path_m = own_map - place, length_m(path)
            if best is None or path_m < best[0]:
                best = path_m, Way(np.array([*place, np.arctan2(ahead[1], ahead[0])]), path)
            if path_m < DIRECT * float(np.linalg.norm(place - at_map[:2])) + 0.5:
                break
        if best is not None:
            return best[1]
    return None
