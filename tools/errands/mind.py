"""What the robot knows and decides: the graph of its frames, questions to it, and goals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from home import RADIUS_M, ROBOT_M, Home
from robot import CAMERA_M, TILT_RAD, Planner, plan_pose

from deworldsg_ros.client.goals import Goal
from deworldsg_ros.client.goals import Robot as Footprint
from deworldsg_ros.client.grammar import Pattern, parse
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.client.questions import ask
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
DISTANCES_M = (0.7, 1.0, 1.3)
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
    try:
        found = [one for one in ask(graph, words).found if one.probability >= LEAST]
    except ClientError:  # a name that the graph has not
        return None
    if not found or _is_ordered(words):
        return found[0].item if found else None
    return _nearest([i.item for i in found if i.probability >= EQUAL * found[0].probability], at)


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
    """A goal that can be reached, and the path (n, 2) to it, in the frame of the robot's poses."""

    goal: Goal
    pose: np.ndarray
    path: np.ndarray


def way_to(
    graph: SceneGraph,
    target: SceneObject,
    planner: Planner,
    at_graph: np.ndarray,
    at_map: np.ndarray,
    T_graph_map: np.ndarray,
) -> Way | None:
    """The pose of `goal_near` that the planner reaches, of the first distance that has one."""
    footprint = Footprint(RADIUS_M, ROBOT_M)
    least_m = (CAMERA_M - target.height_m) / math.tan(SEES_DOWN_RAD)
    for distance_m in [d for d in DISTANCES_M if d >= least_m] or DISTANCES_M[-1:]:
        try:
            goal = graph.goal_near(
                target, distance_m, robot=footprint, towards=(*at_graph[:2].tolist(), 0.0)
            )
        except ClientError:
            continue
        T_map_graph = invert_pose(T_graph_map)
        place = (T_map_graph @ [*goal.position_m, 1.0])[:2]
        ahead = np.array(target.position_m) - goal.position_m
        ahead = T_map_graph[:3, :3] @ ahead
        path = planner.path(at_map[:2], place)
        if path is not None:
            return Way(goal, np.array([*place, np.arctan2(ahead[1], ahead[0])]), path)
    return None
