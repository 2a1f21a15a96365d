"""Evidence that a node is an object: how often it was detected when it could have been."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.scene.gaussian import Float64

# Another look comes soon where the camera moves, and is waited for this long, so that what it sees
# is found well within two seconds. A camera that stands gives none, and is not waited for.
WAIT_NS = 500_000_000
STILL_M = 0.001
# From further away than a node was ever detected from, by this factor, it need not be.
REACH = 1.1
# Detections that are all as likely wrong as right have to be so many times as frequent.
UNSURE_TIMES = 4

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
        # Whether the present look found it, and where it began.
        ("finds", np.bool_),
        ("camera_world", np.float64, 3),
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
        config: what it takes to be sure.
    """

    def __init__(self, config: MergingConfig) -> None:
        self._config = config
        self._baseline_rad = math.radians(config.baseline_deg)
        self._nodes = np.zeros(0, RECORD)

    def warm_up(self) -> None:
        """Compile now what would else be compiled during the first frame."""
        place = np.zeros((1, 3))
        spare = Existence(self._config)
        spare.detected([0], place, np.ones(1), place[0], 0)
        spare.missed([0], place, place[0])

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
                np.array(owners, np.int64),
                means_world,
                scores,
                np.ascontiguousarray(camera_world),
                stamp_ns,
                self._baseline_rad,
            )

    def missed(self, owners: list[int], means_world: Float64, camera_world: Float64) -> list[int]:
        """Take in nodes (n) that were in full view but not detected; returns those now in doubt."""
        if not owners:
            return []
        fair = _missed(
            self._nodes,
            np.array(owners, np.int64),
            means_world,
            np.ascontiguousarray(camera_world),
            self._baseline_rad,
        )
        return [owner for owner in fair.tolist() if self._doubtful(owner)]

    def sure(self, owner: int) -> bool:
        """Whether a node was detected often and surely enough, and in more than one look."""
        node = self._nodes[owner]
        surely = node["best_score"] >= self._config.confirm_score
        wanted = self._config.confirm_observations * (1 if surely else UNSURE_TIMES)
        waited = node["last_ns"] - node["first_ns"] >= WAIT_NS
        again = node["looks"] or not node["moving"] or waited
        return bool(again and node["detections"] >= wanted and not self._doubtful(owner))

    def records(self, owners: list[int]) -> NDArray[np.void]:
        """What is known of owners (n), as plain values for `restore`."""
        return self._nodes[owners]

    def restore(self, owners: list[int], records: NDArray[np.void]) -> None:
        """Go on from the `records` of an earlier run."""
        self._make_room(max(owners, default=-1) + 1)
        self._nodes[owners] = records

    def presume(self, owner: int, detections: int) -> None:
        """Take in a confirmed node of which only the number of detections is known."""
        self._make_room(owner + 1)
        node = self._nodes[owner]
        node["detections"], node["best_score"] = detections, 1.0
        # What found it was a look from somewhere else.
        node["finds"] = True
        node["camera_world"] = np.inf

    def merge(self, kept: int, gone: int) -> None:
        """Count two owners, which are one object, as one."""
        node, other = self._nodes[kept], self._nodes[gone]
        node["detections"] += other["detections"]
        for name, either in (("reach_m", max), ("best_score", max), ("last_ns", max)):
            node[name] = either(node[name], other[name])
        node["first_ns"] = min(node["first_ns"], other["first_ns"])
        # What one of them missed the other may have found: looks at the same place are not added.
        if other["found"] * node["looks"] > node["found"] * other["looks"]:
            node["looks"], node["found"] = other["looks"], other["found"]

    def forget(self, owner: int) -> None:
        """Drop what is known of an owner that is gone."""
        if owner < len(self._nodes):
            self._nodes[owner] = np.zeros((), RECORD)

    def _doubtful(self, owner: int) -> bool:
        node = self._nodes[owner]
        found, looks = node["found"] + node["finds"], node["looks"] + 1
        return bool(found < self._config.min_detection_rate * looks)

    def _make_room(self, count: int) -> None:
        if count > len(self._nodes):
            more = np.zeros(max(64, 2 * count) - len(self._nodes), RECORD)
            self._nodes = np.concatenate((self._nodes, more))


@njit(cache=True, nogil=True)
def _look(node, mean, camera, baseline_rad):  # type: ignore[no-untyped-def]
    """Begin another look where the camera has moved on; returns its distance from the node."""
    distance = 0.0
    step = 0.0
    for axis in range(3):
        distance += (mean[axis] - camera[axis]) ** 2
        step += (node.camera_world[axis] - camera[axis]) ** 2
    distance, step = math.sqrt(distance), math.sqrt(step)
    if step > STILL_M:
        node.moving = True
        if step >= baseline_rad * distance:
            node.looks += 1
            node.found += node.finds
            node.finds = False
            for axis in range(3):
                node.camera_world[axis] = camera[axis]
    return distance


@njit(cache=True, nogil=True)
def _detected(nodes, owners, means, scores, camera, stamp_ns, baseline_rad):  # type: ignore[no-untyped-def]
    for index in range(len(owners)):
        node = nodes[owners[index]]
        if node.detections == 0:
            node.first_ns = stamp_ns
            for axis in range(3):
                node.camera_world[axis] = camera[axis]
        distance = _look(node, means[index], camera, baseline_rad)
        node.finds = True
        node.detections += 1
        node.last_ns = stamp_ns
        node.reach_m = max(node.reach_m, distance)
        node.best_score = max(node.best_score, scores[index])


@njit(cache=True, nogil=True)
def _missed(nodes, owners, means, camera, baseline_rad):  # type: ignore[no-untyped-def]
    fair = np.empty(len(owners), np.int64)
    count = 0
    for index in range(len(owners)):
        node = nodes[owners[index]]
        squared = 0.0
        for axis in range(3):
            squared += (means[index, axis] - camera[axis]) ** 2
        if math.sqrt(squared) <= REACH * node.reach_m:
            _look(node, means[index], camera, baseline_rad)
            fair[count] = owners[index]
            count += 1
    return fair[:count]
