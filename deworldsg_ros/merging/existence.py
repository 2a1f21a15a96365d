"""Evidence that a node is an object: how often it was detected when it could have been."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.kernels import kernel
from deworldsg_ros.merging.absence import VIEWS, WHOLE
from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.scene.arrays import Float64, Int64

# Another look comes soon where the camera moves, and is waited for this long, so that what it sees
# is found well within two seconds. A camera that stands gives none, and is not waited for.
WAIT_NS = 500_000_000
STILL_M = 0.001
# From further away than a node was ever detected from, by this factor, it need not be.
REACH = 1.1
# Detections that are all as likely wrong as right have to be so many times as frequent.
UNSURE_TIMES = 4
# Errors may last, but for a moment: a reflection, a shadow. What was found for no longer is taken
# for one where the chance that an object was missed ever since is less than this.
MOMENT_NS = 1_000_000_000
ERROR_CHANCE = 0.05
# How often objects are found is learned; at first, so many looks have found one in two.
PRIOR_LOOKS = 10.0

RECORD = np.dtype(
    [
        ("detections", np.int64),
        # Furthest distance of a detection, and its best score.
        ("reach_m", np.float64),
        ("best_score", np.float64),
        ("first_ns", np.int64),
        ("last_ns", np.int64),
        # Looks that are over, and those of them that found the node.
        ("looks", np.int64),
        ("found", np.int64),
        # Whether the present look found it, where and when it began, and the best view it had.
        ("finds", np.bool_),
        ("camera_world", np.float64, 3),
        ("look_ns", np.int64),
        ("best_view", np.int64),
        # That an object is missed in all looks between the last that found it and the present one.
        ("chance", np.float64),
        # Whether the camera has moved since the first detection.
        ("moving", np.bool_),
    ],
    align=True,
)


class Existence:
    """Counts, by owner, the looks at a node and those in which it was detected.

    Frames from one place show one picture, and the detector's errors in them are one error. A look
    is all that was seen of a node from about one place; it found the node if any of its frames did.

    Args:
        confirm_observations: detections that confirm a node.
        limits: further conditions.
    """

    def __init__(self, confirm_observations: int, limits: LifeCycleLimits) -> None:
        self._confirm_observations = confirm_observations
        self._limits = limits
        self._baseline_rad = math.radians(limits.baseline_deg)
        self._nodes = np.zeros(0, RECORD)
        # By view: looks at nodes known for longer than a moment, and those of them that found one.
        self.by_view = np.full((len(VIEWS), 2), (PRIOR_LOOKS, PRIOR_LOOKS / 2))

    def warm_up(self) -> None:
        """Compile now what would else be compiled during the first frame."""
        place = np.zeros((1, 3))
        spare = Existence(self._confirm_observations, self._limits)
        spare.detected([0], place, np.ones(1), place[0], 0)
        spare.viewed([0], np.ones(1, np.int64))
        spare.missed([0], np.ones(1, np.int64), place, place[0], 0)

    def detected(
        self,
        owners: list[int],
        means_world: Float64,
        scores: Float64,
        camera_world: Float64,
        stamp_ns: int,
    ) -> None:
        """Take in the objects (n) of a frame, by owner, seen from a camera position (3,)."""
        if owners:
            self._make_room(max(owners) + 1)
            _detected(
                self._nodes,
                self.by_view,
                np.array(owners, np.int64),
                means_world,
                scores,
                np.ascontiguousarray(camera_world),
                stamp_ns,
                self._baseline_rad,
            )

    def viewed(self, owners: list[int], views: Int64) -> None:
        """Take in how much of nodes (n) was in view that were detected."""
        known = self._nodes["best_view"]
        known[owners] = np.maximum(known[owners], views)

    def missed(
        self,
        owners: list[int],
        views: Int64,
        means_world: Float64,
        camera_world: Float64,
        stamp_ns: int,
    ) -> list[int]:
        """Take in nodes (n) that were in view but not detected; returns those now in doubt."""
        if not owners:
            return []
        doubted: list[int] = _missed(
            self._nodes,
            self.by_view,
            np.array(owners, np.int64),
            views,
            means_world,
            np.ascontiguousarray(camera_world),
            stamp_ns,
            self._baseline_rad,
            self._limits.min_detection_rate,
        ).tolist()
        return doubted

    def sure(self, owner: int) -> bool:
        """Whether a node was detected often and surely enough, and in more than one look."""
        node = self._nodes[owner]
        surely = node["best_score"] >= self._limits.confirm_score
        wanted = self._confirm_observations * (1 if surely else UNSURE_TIMES)
        waited = node["last_ns"] - node["first_ns"] >= WAIT_NS
        again = node["looks"] or not node["moving"] or waited
        return bool(again and node["detections"] >= wanted and not self._doubtful(owner))

    def records(self, owners: list[int]) -> NDArray[np.void]:
        """What is known of owners (n), as plain values for `restore`."""
        return self._nodes[owners]

    def restore(self, owners: list[int], records: NDArray[np.void], by_view: Float64) -> None:
        """Go on from the `records` of an earlier run, and its looks `by_view`."""
        self._make_room(max(owners, default=-1) + 1)
        self._nodes[owners] = records
        self.by_view[:] = by_view

    def presume(self, owner: int, detections: int) -> None:
        """Take in a confirmed node of which only the number of detections is known."""
        self._make_room(owner + 1)
        node = self._nodes[owner]
        node["detections"], node["best_score"] = detections, 1.0
        node["first_ns"], node["chance"] = -MOMENT_NS, 1.0
        # What found it was a look from somewhere else.
        node["finds"] = True
        node["camera_world"] = np.inf

    def merge(self, kept: int, gone: int) -> None:
        """Count two owners, which are one object, as one."""
        node, other = self._nodes[kept], self._nodes[gone]
        node["detections"] += other["detections"]
        for name in ("reach_m", "best_score", "last_ns", "chance"):
            node[name] = max(node[name], other[name])
        node["first_ns"] = min(node["first_ns"], other["first_ns"])
        # What one of them missed the other may have found: looks at the same place are not added.
        if other["found"] * node["looks"] > node["found"] * other["looks"]:
            node["looks"], node["found"] = other["looks"], other["found"]

    def forget(self, owner: int) -> None:
        """Drop what is known of an owner that is gone."""
        if owner < len(self._nodes):
            self._nodes[owner] = np.zeros((), RECORD)

    def _doubtful(self, owner: int) -> bool:
        rate = self._limits.min_detection_rate
        return bool(_doubtful(self._nodes, owner, self.by_view, rate))

    def _make_room(self, count: int) -> None:
        if count > len(self._nodes):
            more = np.zeros(max(64, 2 * count) - len(self._nodes), RECORD)
            self._nodes = np.concatenate((self._nodes, more))


@kernel
def _doubtful(nodes: NDArray[Any], owner: int, by_view: Float64, min_rate: float) -> bool:
    """Whether a node is more likely an error than an object."""
    node = nodes[owner]
    counts = node.finds or node.best_view == WHOLE
    if node.found + node.finds < min_rate * (node.looks + counts):
        return True
    chance = node.chance
    if node.last_ns < node.look_ns:
        chance *= _miss_chance(by_view, node.best_view)
    return bool(chance < ERROR_CHANCE and node.last_ns - node.first_ns < MOMENT_NS)


@kernel
def _miss_chance(by_view: Float64, view: int) -> float:
    return 1.0 - by_view[view, 1] / by_view[view, 0] if view > 0 else 1.0


@kernel
def _look(
    node: Any, by_view: Float64, mean: Float64, camera: Float64, stamp_ns: int, baseline_rad: float
) -> float:
    """Begin another look where the camera has moved on; returns its distance from the node."""
    # A clock that is behind that of an earlier run: what was known then was known before.
    behind_ns = max(0, max(node.last_ns, node.look_ns) - stamp_ns)
    node.first_ns -= behind_ns
    node.last_ns -= behind_ns
    node.look_ns -= behind_ns
    distance = 0.0
    step = 0.0
    for axis in range(3):
        distance += (mean[axis] - camera[axis]) ** 2
        step += (node.camera_world[axis] - camera[axis]) ** 2
    distance, step = math.sqrt(distance), math.sqrt(step)
    node.moving = node.moving or step > STILL_M
    for_a_moment = node.last_ns - node.first_ns < MOMENT_NS
    moved = step > STILL_M and step >= baseline_rad * distance
    if moved and (node.finds or node.best_view == WHOLE):
        node.looks += 1
        node.found += node.finds
    if moved or (for_a_moment and stamp_ns - node.look_ns >= WAIT_NS):
        found = node.last_ns >= node.look_ns
        if not found:
            node.chance *= _miss_chance(by_view, node.best_view)
        if not for_a_moment:
            by_view[node.best_view, 0] += 1
            by_view[node.best_view, 1] += found
        node.best_view = 0
        node.look_ns = stamp_ns
    if moved:
        node.finds = False
        for axis in range(3):
            node.camera_world[axis] = camera[axis]
    return distance


@kernel
def _detected(
    nodes: NDArray[Any],
    by_view: Float64,
    owners: Int64,
    means: Float64,
    scores: Float64,
    camera: Float64,
    stamp_ns: int,
    baseline_rad: float,
) -> None:
    for index in range(len(owners)):
        node = nodes[owners[index]]
        if node.detections == 0:
            node.first_ns = node.look_ns = stamp_ns
            node.chance = 1.0
            for axis in range(3):
                node.camera_world[axis] = camera[axis]
        distance = _look(node, by_view, means[index], camera, stamp_ns, baseline_rad)
        # What was taken for an error may be found by another one.
        if node.chance < ERROR_CHANCE and node.last_ns - node.first_ns < MOMENT_NS:
            node.first_ns = stamp_ns
        node.chance = 1.0
        node.finds = True
        node.detections += 1
        node.last_ns = stamp_ns
        node.reach_m = max(node.reach_m, distance)
        node.best_score = max(node.best_score, scores[index])


@kernel
def _missed(
    nodes: NDArray[Any],
    by_view: Float64,
    owners: Int64,
    views: Int64,
    means: Float64,
    camera: Float64,
    stamp_ns: int,
    baseline_rad: float,
    min_rate: float,
) -> Int64:
    doubted = np.empty(len(owners), np.int64)
    count = 0
    for index in range(len(owners)):
        node = nodes[owners[index]]
        squared = 0.0
        for axis in range(3):
            squared += (means[index, axis] - camera[axis]) ** 2
        if math.sqrt(squared) <= REACH * node.reach_m:
            _look(node, by_view, means[index], camera, stamp_ns, baseline_rad)
            node.best_view = max(node.best_view, views[index])
            if _doubtful(nodes, owners[index], by_view, min_rate):
                doubted[count] = owners[index]
                count += 1
    return doubted[:count]
