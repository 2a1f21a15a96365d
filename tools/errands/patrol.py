"""What the robot does while nobody asks for anything: it looks again at what its graph doubts."""

from __future__ import annotations

import math

import numpy as np
from look import reachable, views
from seek import Seeker

from deworldsg_ros.client.next_view import binary_nats
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.scene.camera import invert_pose

# It ends after so long a way, and so many places.
MOST_M, MOST_PLACES = 30.0, 24
# An object is doubtful if it is as probable, and was looked at from fewer places. A place is
# another one if it is so far from the others; more frames from one place tell little more.
LEAST, MOST, LOOKS, APART_M = 0.2, 0.8, 2, 0.6
# From so near it looks. Of a place, the doubts in view from there have to be as large, nats. A step
# without way costs as much as so many metres.
REACH_M, LEAST_NATS, STEP_M = 2.0, 0.5, 1.5
# Objects that are so close beside the one it turns to are in view, too.
BESIDE_RAD = math.radians(20)


def patrol(seeker: Seeker) -> None:
    """Look at the doubtful objects of the graph from near, until none is left or the way is long.

    Each time, it goes to the place that has most doubts in view for the way there.
    """
    robot, start_m = seeker.robot, seeker.robot.path_m
    looked: dict[int, list[np.ndarray]] = {}
    for _ in range(MOST_PLACES):
        found = _next_place(seeker, looked)
        if found is None or robot.path_m - start_m > MOST_M:
            break
        path, items = found
        for item in items:
            looked.setdefault(item.id, []).append(path[-1])
        if not seeker.follow(path):
            continue
        while items:
            seeker.turn_to(items[0])
            items = [item for item in items[1:] if abs(seeker.turn_of(item)) > BESIDE_RAD]


def _next_place(
    seeker: Seeker, looked: dict[int, list[np.ndarray]]
) -> tuple[np.ndarray, list[SceneObject]] | None:
    """The path (n, 2) to a place, and the doubtful objects in view there, the next one first.

    Args:
        seeker: the robot and its graph.
        looked: from where (2,) objects were looked at, by id.
    """
    robot = seeker.robot
    planner = robot.planner()
    found = reachable(planner, robot.believed)
    doubts = [item for item in seeker.mind.graph() if LEAST < item.probability < MOST]
    doubts = [item for item in doubts if len(looked.get(item.id, ())) < LOOKS]
    if found is None or not doubts:
        return None
    places, ways_m = found
    T_map_graph = invert_pose(seeker.mind.T_graph_map)
    points = np.array([item.position_m for item in doubts])
    seen = views(robot, places, points @ T_map_graph[:3, :3].T + T_map_graph[:3, 3], REACH_M)
    for column, item in enumerate(doubts):
        for place in looked.get(item.id, ()):
            seen[np.linalg.norm(places - place, axis=1) < APART_M, column] = False
    gains = seen @ np.array([binary_nats(item.probability) for item in doubts])
    gains[gains < LEAST_NATS] = 0.0
    best = int(np.argmax(gains / (ways_m + STEP_M)))
    path = planner.path(robot.believed, places[best]) if gains[best] else None
    if path is None:
        return None
    return path, [item for item, is_seen in zip(doubts, seen[best]) if is_seen]
