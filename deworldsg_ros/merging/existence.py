"""Evidence that a node is an object: how often it was detected when it could have been."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.scene.gaussian import Float64

Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

# Another look comes soon where the camera moves, and is waited for this long, so that what it sees
# is found well within two seconds. A camera that stands gives none, and is not waited for.
WAIT_NS = 500_000_000
STILL_M = 0.001
# From further away than a node was ever detected from, by this factor, it need not be.
REACH = 1.1
# Detections that are all as likely wrong as right have to be so many times as frequent.
UNSURE_TIMES = 4


class Existence:
    """Counts, by owner, the looks at a node and those in which it was detected.

    Frames from one place show one picture, and the detector's errors in them are one error. A look
    is all that was seen of a node from about one place; it found the node if any of its frames did.

    Args:
        config: what it takes to be sure.
    """

    def __init__(self, config: MergingConfig) -> None:
        self._config = config
        self._detections: Int64 = np.zeros(0, np.int64)
        # Furthest distance of a detection, and its best score.
        self._reach_m: Float64 = np.zeros(0)
        self._best_score: Float64 = np.zeros(0)
        self._first_ns: Int64 = np.zeros(0, np.int64)
        self._last_ns: Int64 = np.zeros(0, np.int64)
        # Looks that are over, those of them that found the node, and the present one.
        self._looks: Int64 = np.zeros(0, np.int64)
        self._found: Int64 = np.zeros(0, np.int64)
        self._finds: Bool = np.zeros(0, np.bool_)
        self._moving: Bool = np.zeros(0, np.bool_)
        self._camera_world: Float64 = np.zeros((0, 3))

    def detected(
        self,
        owners: list[int],
        means_world: Float64,
        scores: Float64,
        camera_world: Float64,
        stamp_ns: int,
    ) -> None:
        """Take in the objects (n) of a frame, by owner, seen from a camera position (3,)."""
        if not owners:
            return
        self._make_room(max(owners) + 1)
        new = [owner for owner in owners if not self._detections[owner]]
        self._first_ns[new] = stamp_ns
        self._camera_world[new] = camera_world
        distances_m = np.linalg.norm(means_world - camera_world, axis=1)
        self._look(np.array(owners, np.int64), distances_m, camera_world)
        self._finds[owners] = True
        self._detections[owners] += 1
        self._last_ns[owners] = stamp_ns
        self._reach_m[owners] = np.maximum(self._reach_m[owners], distances_m)
        self._best_score[owners] = np.maximum(self._best_score[owners], scores)

    def missed(self, owners: list[int], means_world: Float64, camera_world: Float64) -> list[int]:
        """Take in nodes (n) that were in full view but not detected; returns those now in doubt."""
        distances_m = np.linalg.norm(means_world - camera_world, axis=1)
        fair = distances_m <= REACH * self._reach_m[owners]
        missed = np.array(owners, np.int64)[fair]
        self._look(missed, distances_m[fair], camera_world)
        return [owner for owner in missed.tolist() if self._doubtful(owner)]

    def sure(self, owner: int) -> bool:
        """Whether a node was detected often and surely enough, and in more than one look."""
        surely = self._best_score[owner] >= self._config.confirm_score
        wanted = self._config.confirm_observations * (1 if surely else UNSURE_TIMES)
        waited = self._last_ns[owner] - self._first_ns[owner] >= WAIT_NS
        again = self._looks[owner] or not self._moving[owner] or waited
        return bool(again and self._detections[owner] >= wanted and not self._doubtful(owner))

    def restore(self, owner: int, detections: int) -> None:
        """Take in a node of a graph that was loaded."""
        self._make_room(owner + 1)
        self._detections[owner] = detections
        self._best_score[owner] = 1.0
        self._looks[owner] = self._found[owner] = 1
        self._camera_world[owner] = np.inf

    def merge(self, kept: int, gone: int) -> None:
        """Count two owners, which are one object, as one."""
        self._detections[kept] += self._detections[gone]
        self._reach_m[kept] = max(self._reach_m[kept], self._reach_m[gone])
        self._best_score[kept] = max(self._best_score[kept], self._best_score[gone])
        self._first_ns[kept] = min(self._first_ns[kept], self._first_ns[gone])
        self._last_ns[kept] = max(self._last_ns[kept], self._last_ns[gone])
        # What one of them missed the other may have found: looks at the same place are not added.
        if self._found[gone] * self._looks[kept] > self._found[kept] * self._looks[gone]:
            self._looks[kept], self._found[kept] = self._looks[gone], self._found[gone]

    def forget(self, owner: int) -> None:
        """Drop what is known of an owner that is gone."""
        if owner < len(self._detections):
            for column in (self._detections, self._looks, self._found):
                column[owner] = 0
            self._reach_m[owner] = self._best_score[owner] = 0.0
            self._finds[owner] = self._moving[owner] = False

    def _look(self, owners: Int64, distances_m: Float64, camera_world: Float64) -> None:
        """Begin another look at those nodes from which the camera has turned far enough."""
        steps_m = np.linalg.norm(camera_world - self._camera_world[owners], axis=1)
        baselines_m = math.radians(self._config.baseline_deg) * distances_m
        moving = steps_m > STILL_M
        self._moving[owners] |= moving
        over = owners[moving & (steps_m >= baselines_m)]
        self._looks[over] += 1
        self._found[over] += self._finds[over]
        self._finds[over] = False
        self._camera_world[over] = camera_world

    def _doubtful(self, owner: int) -> bool:
        looks = self._looks[owner] + 1
        found = self._found[owner] + self._finds[owner]
        return bool(found < self._config.min_detection_rate * looks)

    def _make_room(self, count: int) -> None:
        if count <= len(self._detections):
            return
        more = max(64, 2 * count) - len(self._detections)
        self._detections = np.pad(self._detections, (0, more))
        self._reach_m = np.pad(self._reach_m, (0, more))
        self._best_score = np.pad(self._best_score, (0, more))
        self._first_ns = np.pad(self._first_ns, (0, more))
        self._last_ns = np.pad(self._last_ns, (0, more))
        self._looks = np.pad(self._looks, (0, more))
        self._found = np.pad(self._found, (0, more))
        self._finds = np.pad(self._finds, (0, more))
        self._moving = np.pad(self._moving, (0, more))
        self._camera_world = np.pad(self._camera_world, ((0, more), (0, 0)))
