"""Evidence that a node is an object: how often it was detected when it was visible.

Frames from one camera position show one picture, and the errors of a detector in them are one
error. So viewpoints are counted instead of frames. A viewpoint of a node lasts until the camera has
moved by `baseline_deg` as seen from the node. It detected the node if any of its frames did.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.kernels import kernel
from deworldsg_ros.merging.absence import FULL, VISIBILITIES
from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.scene.arrays import Float64, Int64

# A second viewpoint is required for at most this long, so that an object is confirmed well within
# two seconds. A camera that stands still has one viewpoint only and does not wait.
MAX_WAIT_NS = 500_000_000
# The camera stands still if it moves less than this.
STILL_M = 0.001
# Beyond the largest distance of a detection, by this factor, a miss is not counted.
REACH_FACTOR = 1.1
# Without a detection of `confirm_score`, a node needs this many times the observations.
LOW_SCORE_FACTOR = 4
# A false detection lasts for a moment: a reflection, a shadow. If all detections of a node lie
# within MOMENT_NS, it becomes tentative when the probability that an object would have been missed
# ever since falls below MISS_PROBABILITY.
MOMENT_NS = 1_000_000_000
MISS_PROBABILITY = 0.05
# The detection rate of objects is learned. At first, PRIOR_VIEWPOINTS viewpoints count as observed,
# and half of them as having detected the object.
PRIOR_VIEWPOINTS = 10.0

RECORD = np.dtype(
    [
        ("detections", np.int64),
        # Largest distance of a detection, and best score.
        ("reach_m", np.float64),
        ("best_score", np.float64),
        ("first_ns", np.int64),
        ("last_ns", np.int64),
        # Number of past viewpoints, and of those that detected the node.
        ("viewpoints", np.int64),
        ("detecting", np.int64),
        # The present viewpoint: whether it detected the node, its position, its start, and its best
        # visibility of the node.
        ("is_detecting", np.bool_),
        ("camera_world", np.float64, 3),
        ("viewpoint_ns", np.int64),
        ("visibility", np.int64),
        # Probability that an object is missed from all past viewpoints since the last detection.
        ("miss_probability", np.float64),
        # Whether the camera has moved since the first detection.
        ("has_moved", np.bool_),
    ],
    align=True,
)


class Existence:
    """Counts the viewpoints of each owner, and those that detected it.

    Args:
        confirm_observations: detections that confirm a node.
        limits: further conditions.

    Attributes:
        counts_by_visibility: (len(VISIBILITIES), 2) float64, viewpoints of nodes that are known for
            longer than a moment, and those of them that detected the node.
    """

    def __init__(self, confirm_observations: int, limits: LifeCycleLimits) -> None:
        self._confirm_observations = confirm_observations
        self._limits = limits
        self._baseline_rad = math.radians(limits.baseline_deg)
        self._records = np.zeros(0, RECORD)
        prior = (PRIOR_VIEWPOINTS, PRIOR_VIEWPOINTS / 2)
        self.counts_by_visibility = np.full((len(VISIBILITIES), 2), prior)

    def warm_up(self) -> None:
        """Compile the kernels before the first frame."""
        means = np.zeros((1, 3))
        spare = Existence(self._confirm_observations, self._limits)
        spare.add_detections([0], means, np.ones(1), means[0], 0)
        spare.update_visibility([0], np.ones(1, np.int64))
        spare.add_misses([0], np.ones(1, np.int64), means, means[0], 0)

    def add_detections(
        self,
        owners: list[int],
        means_world: Float64,
        scores: Float64,
        camera_world: Float64,
        stamp_ns: int,
    ) -> None:
        """Add the detections (n) of a frame.

        Args:
            owners: n owners.
            means_world: (n, 3) means of the detections, metres.
            scores: (n,) detection scores.
            camera_world: (3,) camera position, metres.
            stamp_ns: of the frame.
        """
        if owners:
            self._make_room(max(owners) + 1)
            _add_detections(
                self._records,
                self.counts_by_visibility,
                np.array(owners, np.int64),
                means_world,
                scores,
                np.ascontiguousarray(camera_world),
                stamp_ns,
                self._baseline_rad,
            )

    def update_visibility(self, owners: list[int], visibilities: Int64) -> None:
        """Add the visibilities (n) of detected owners (n) in a frame."""
        best = self._records["visibility"]
        best[owners] = np.maximum(best[owners], visibilities)

    def add_misses(
        self,
        owners: list[int],
        visibilities: Int64,
        means_world: Float64,
        camera_world: Float64,
        stamp_ns: int,
    ) -> list[int]:
        """Add owners (n) that were visible in a frame but not detected.

        Args:
            owners: n owners.
            visibilities: (n,) how much of each is visible.
            means_world: (n, 3) means of the nodes, metres.
            camera_world: (3,) camera position, metres.
            stamp_ns: of the frame.

        Returns:
            Those of the owners that are more likely an error than an object.
        """
        if not owners:
            return []
        doubtful: list[int] = _add_misses(
            self._records,
            self.counts_by_visibility,
            np.array(owners, np.int64),
            visibilities,
            means_world,
            np.ascontiguousarray(camera_world),
            stamp_ns,
            self._baseline_rad,
            self._limits.min_detection_rate,
        ).tolist()
        return doubtful

    def is_confirmed(self, owner: int) -> bool:
        """Whether there are enough detections, from more than one viewpoint, and few misses."""
        record = self._records[owner]
        has_score = record["best_score"] >= self._limits.confirm_score
        required = self._confirm_observations * (1 if has_score else LOW_SCORE_FACTOR)
        has_waited = record["last_ns"] - record["first_ns"] >= MAX_WAIT_NS
        has_viewpoints = record["viewpoints"] or not record["has_moved"] or has_waited
        enough = has_viewpoints and record["detections"] >= required
        return bool(enough and not self._is_doubtful(owner))

    def records(self, owners: list[int]) -> NDArray[np.void]:
        """The records (n,) of owners (n), for `restore`."""
        return self._records[owners]

    def restore(
        self, owners: list[int], records: NDArray[np.void], counts_by_visibility: Float64
    ) -> None:
        """Continue with the state of an earlier run."""
        self._make_room(max(owners, default=-1) + 1)
        self._records[owners] = records
        self.counts_by_visibility[:] = counts_by_visibility

    def assume_confirmed(self, owner: int, detections: int) -> None:
        """Add a confirmed node by its number of detections; its viewpoints are unknown."""
        self._make_room(owner + 1)
        record = self._records[owner]
        record["detections"], record["best_score"] = detections, 1.0
        record["first_ns"], record["miss_probability"] = -MOMENT_NS, 1.0
        # Its last detection was from another viewpoint than any to come.
        record["is_detecting"] = True
        record["camera_world"] = np.inf

    def merge(self, kept: int, removed: int) -> None:
        """Combine the records of two owners that are one object."""
        record, other = self._records[kept], self._records[removed]
        record["detections"] += other["detections"]
        for name in ("reach_m", "best_score", "last_ns", "miss_probability"):
            record[name] = max(record[name], other[name])
        record["first_ns"] = min(record["first_ns"], other["first_ns"])
        # Both may have missed or detected the object from the same viewpoints, so their numbers are
        # not added: the better rate is kept.
        if other["detecting"] * record["viewpoints"] > record["detecting"] * other["viewpoints"]:
            record["viewpoints"], record["detecting"] = other["viewpoints"], other["detecting"]

    def forget(self, owner: int) -> None:
        """Drop the record of a removed owner."""
        if owner < len(self._records):
            self._records[owner] = np.zeros((), RECORD)

    def _is_doubtful(self, owner: int) -> bool:
        rate = self._limits.min_detection_rate
        return bool(_is_doubtful(self._records, owner, self.counts_by_visibility, rate))

    def _make_room(self, count: int) -> None:
        if count > len(self._records):
            more = np.zeros(max(64, 2 * count) - len(self._records), RECORD)
            self._records = np.concatenate((self._records, more))


@kernel
def _is_doubtful(
    records: NDArray[Any], owner: int, counts_by_visibility: Float64, min_rate: float
) -> bool:
    """Whether a node is more likely an error than an object."""
    record = records[owner]
    is_counted = record.is_detecting or record.visibility == FULL
    if record.detecting + record.is_detecting < min_rate * (record.viewpoints + is_counted):
        return True
    probability = record.miss_probability
    if record.last_ns < record.viewpoint_ns:
        probability *= _miss_probability(counts_by_visibility, record.visibility)
    is_momentary = record.last_ns - record.first_ns < MOMENT_NS
    return bool(probability < MISS_PROBABILITY and is_momentary)


@kernel
def _miss_probability(counts_by_visibility: Float64, visibility: int) -> float:
    """Probability that a viewpoint with this visibility does not detect an object."""
    if visibility == 0:
        return 1.0
    rate = counts_by_visibility[visibility, 1] / counts_by_visibility[visibility, 0]
    return float(1.0 - rate)


@kernel
def _update_viewpoint(
    record: Any,
    counts_by_visibility: Float64,
    mean: Float64,
    camera: Float64,
    stamp_ns: int,
    baseline_rad: float,
) -> float:
    """Begin a new viewpoint if the camera has moved; returns its distance from the node, metres."""
    # The clock may be behind that of an earlier run: stamps of that run move into the past.
    behind_ns = max(0, max(record.last_ns, record.viewpoint_ns) - stamp_ns)
    record.first_ns -= behind_ns
    record.last_ns -= behind_ns
    record.viewpoint_ns -= behind_ns
    distance = 0.0
    step = 0.0
    for axis in range(3):
        distance += (mean[axis] - camera[axis]) ** 2
        step += (record.camera_world[axis] - camera[axis]) ** 2
    distance, step = math.sqrt(distance), math.sqrt(step)
    record.has_moved = record.has_moved or step > STILL_M
    is_momentary = record.last_ns - record.first_ns < MOMENT_NS
    moved = step > STILL_M and step >= baseline_rad * distance
    if moved and (record.is_detecting or record.visibility == FULL):
        record.viewpoints += 1
        record.detecting += record.is_detecting
    # For a momentary node, a camera that stands still gives a viewpoint each MAX_WAIT_NS.
    if moved or (is_momentary and stamp_ns - record.viewpoint_ns >= MAX_WAIT_NS):
        detected = record.last_ns >= record.viewpoint_ns
        if not detected:
            record.miss_probability *= _miss_probability(counts_by_visibility, record.visibility)
        if not is_momentary:
            counts_by_visibility[record.visibility, 0] += 1
            counts_by_visibility[record.visibility, 1] += detected
        record.visibility = 0
        record.viewpoint_ns = stamp_ns
    if moved:
        record.is_detecting = False
        for axis in range(3):
            record.camera_world[axis] = camera[axis]
    return distance


@kernel
def _add_detections(
    records: NDArray[Any],
    counts_by_visibility: Float64,
    owners: Int64,
    means: Float64,
    scores: Float64,
    camera: Float64,
    stamp_ns: int,
    baseline_rad: float,
) -> None:
    for index in range(len(owners)):
        record = records[owners[index]]
        if record.detections == 0:
            record.first_ns = record.viewpoint_ns = stamp_ns
            record.miss_probability = 1.0
            for axis in range(3):
                record.camera_world[axis] = camera[axis]
        distance = _update_viewpoint(
            record, counts_by_visibility, means[index], camera, stamp_ns, baseline_rad
        )
        # A node marked false restarts when it is detected again.
        is_momentary = record.last_ns - record.first_ns < MOMENT_NS
        if record.miss_probability < MISS_PROBABILITY and is_momentary:
            record.first_ns = stamp_ns
        record.miss_probability = 1.0
        record.is_detecting = True
        record.detections += 1
        record.last_ns = stamp_ns
        record.reach_m = max(record.reach_m, distance)
        record.best_score = max(record.best_score, scores[index])


@kernel
def _add_misses(
    records: NDArray[Any],
    counts_by_visibility: Float64,
    owners: Int64,
    visibilities: Int64,
    means: Float64,
    camera: Float64,
    stamp_ns: int,
    baseline_rad: float,
    min_rate: float,
) -> Int64:
    doubtful = np.empty(len(owners), np.int64)
    count = 0
    for index in range(len(owners)):
        record = records[owners[index]]
        squared = 0.0
        for axis in range(3):
            squared += (means[index, axis] - camera[axis]) ** 2
        if math.sqrt(squared) <= REACH_FACTOR * record.reach_m:
            _update_viewpoint(
                record, counts_by_visibility, means[index], camera, stamp_ns, baseline_rad
            )
            record.visibility = max(record.visibility, visibilities[index])
            if _is_doubtful(records, owners[index], counts_by_visibility, min_rate):
                doubtful[count] = owners[index]
                count += 1
    return doubtful[:count]
