"""The beliefs on a node: the probability that it is an object, and its class."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.merging.views import VISIBILITIES
from deworldsg_ros.scene.arrays import Float64, Int64

# --- The class of a node: a hidden Markov model, because wrong names come in spells.
#
# A detector that calls a chair a bag calls it so for as long as it sees it from there. So the model
# of a node has two labels: the class of the object, and the name that it has at present. The name
# is drawn again with a time constant of SPELL_S seconds: it is the class, or another label with
# probability WRONG. A frame shows the name, or any label with probability OUTLIERS. Only the LABELS
# most probable labels are considered. The constants gave the most relations with faults of all
# kinds in one room, and no fewer with the detector (tools/merging_lab).

LABELS = 8
SPELL_S = 3.0
WRONG = 0.4
OUTLIERS = 0.4
# Probability of all other labels together.
OTHERS = 0.05

# The part of a node's record that belongs to its name: the labels (-1 = none), and the probability
# of each class (row) with each name (column).
NAME_FIELDS: list[Any] = [
    ("labels", np.int64, LABELS),
    ("joint", np.float64, (LABELS, LABELS)),
    ("named_ns", np.int64),
]


@kernel
def start(record: Any, probabilities: Float64, stamp_ns: int) -> None:
    """Begin with class probabilities (C,)."""
    order = np.argsort(-probabilities)
    count = min(LABELS, len(order))
    for i in range(LABELS):
        record.labels[i] = order[i] if i < count else -1
        for j in range(LABELS):
            share = 1.0 - WRONG if i == j else WRONG / max(count - 1, 1)
            both = i < count and j < count
            record.joint[i, j] = share * probabilities[order[j]] if both else 0.0
    record.named_ns = stamp_ns


@kernel
def observe_names(
    records: NDArray[Any], slots: Int64, seen: Float64, stamp_ns: int, classes: Float64
) -> None:
    """Add class distributions (n, C) of a frame to n known nodes.

    Args:
        records: with `NAME_FIELDS`; those of the slots are updated.
        slots: (n,) index of each node's record.
        seen: (n, C) distributions of the detections.
        stamp_ns: of the frame.
        classes: (n, C), filled with the distributions of the nodes' classes.
    """
    for index in range(len(slots)):
        record = records[slots[index]]
        _consider(record, int(np.argmax(seen[index])))
        known = 0
        for label in record.labels:
            known += int(label >= 0)
        leave = 1.0 - np.exp(-max(stamp_ns - record.named_ns, 0) * 1e-9 / SPELL_S)
        record.named_ns = stamp_ns
        total = 0.0
        for i in range(known):
            belief = record.joint[i].sum()
            for j in range(known):
                drawn = 1.0 - WRONG if i == j else WRONG / max(known - 1, 1)
                shown = (1.0 - OUTLIERS) * seen[index, record.labels[j]]
                shown += OUTLIERS / seen.shape[1]
                moved = (1.0 - leave) * record.joint[i, j] + leave * drawn * belief
                record.joint[i, j] = moved * shown
                total += record.joint[i, j]
        classes[index] = OTHERS / seen.shape[1]
        for i in range(known):
            record.joint[i] /= total
            classes[index, record.labels[i]] += (1.0 - OTHERS) * record.joint[i].sum()


@kernel
def _consider(record: Any, label: int) -> None:
    """Make sure that a label is considered; it takes the place of the least probable one."""
    place = 0
    for i in range(LABELS):
        if record.labels[i] == label:
            return
        if record.labels[i] < 0 or record.joint[i].sum() < record.joint[place].sum():
            place = i
            if record.labels[i] < 0:
                break
    record.labels[place] = label
    for i in range(LABELS):
        record.joint[i, place] = 0.0
    # If the object is this, all names so far were wrong.
    for j in range(LABELS):
        others = 0.0
        for i in range(LABELS):
            others += record.joint[i, j] if i != place else 0.0
        record.joint[place, j] = WRONG / LABELS * others


# --- The probability that a node is an object, from the looks at it.
#
# The frames of one camera position show one picture: the errors of a detector in them are one
# error. So looks are counted instead of frames. A look at a node ends when the camera has moved by
# LOOK_RAD as seen from the node, or after LOOK_NS. It detects the node by the fraction of its
# frames that do; frames in which the node is hidden or out of view do not count.
#
# The log odds of existence are a sum:
#
#     prior + SCORE ln(s / (1 - s)) + LOOKS ln(D) - MISSES ln(1 + M) - MOMENT ln(1 + R)
#
# s is the best detection score. D is the sum of the detected fractions of all looks. M is the
# evidence of the misses: the sum of -(1 - fraction) ln(1 - rate). The rate is the fraction of looks
# that detect an object; the rule learns one rate for each visibility. R is the part of M since the
# last detection. R counts only if all detections lie within MOMENT_NS, because a reflection or a
# shadow lasts for a moment. The prior is learned, too: where many nodes turned out to be errors, a
# new one is less probable (`prior`).
#
# The weights started from a logistic regression on recorded and embedded detections of one rendered
# room and the shipped recording, and were rounded so that a score above 0.5 and a moment in sight
# count the same for all detectors. docs/dev/notebook.md has the calibration.

OFFSET, SCORE, LOOKS, MISSES, MOMENT = 0.2, 1.5, 1.2, 0.35, 1.2
FATES = 0.4
# The fate of a node is known from this probability on, or below one minus it after a clear miss.
# At first, as many objects as errors are known.
SETTLED, CLEAR_MISS, PRIOR_FATES = 0.9, 1.0, 10
# Bounds of the score. False boxes may have high scores: above 0.5, a score says no more.
MIN_SCORE, MAX_SCORE = 0.02, 0.5
# A look and a false box last about half a second (evaluation/injection.py); the angle is
# chosen, not measured.
LOOK_RAD = math.radians(2.0)
LOOK_NS = 500_000_000
MOMENT_NS = 1_000_000_000
# Weight of a frame after a pause: it shows more that is new. At equal weights, nodes of one look
# were true in 90 % of the cases with every tenth frame of the recording, and in 15 to 30 % in video
# with false boxes.
MAX_WEIGHT = 2.0
# Stamps of earlier runs move no further into the past, however often the clock is set back: only
# MOMENT_NS of it counts.
OLDEST_NS = -(2**31) * 10**9
# The camera stands still if it moves less than this. A look that only time has ended shows the same
# picture: it counts as this fraction of a look.
STILL_M = 0.001
STILL_WEIGHT = 0.25
# Beyond the largest distance of a detection, by this factor, a miss is not counted.
REACH_FACTOR = 1.1
# The rates start as if this many looks had been observed, and half of them had detected the object.
PRIOR_LOOKS = 10.0

# The part of a node's record that belongs to its existence.
EXISTENCE_FIELDS: list[Any] = [
    ("best_score", np.float64),
    # D, M and R of the looks that have ended.
    ("looks", np.float64),
    ("missed", np.float64),
    ("missed_since", np.float64),
    # First and last detection, and the largest distance of one.
    ("first_ns", np.int64),
    ("last_ns", np.int64),
    ("reach_m", np.float64),
    # The present look: position and start, frames that detected the node and all frames that show
    # it, its best visibility, and its weight.
    ("camera_world", np.float64, 3),
    ("look_ns", np.int64),
    ("detected", np.float64),
    ("shown", np.float64),
    ("visibility", np.int64),
    ("look_weight", np.float64),
    # Looks since the last detection, by visibility.
    ("pending", np.float64, len(VISIBILITIES)),
    # Whether its fate is known: it is an object, or an error.
    ("is_settled", np.bool_),
]


def first_counts() -> Float64:
    """Looks at objects, and those that detected them, by visibility: (len(VISIBILITIES), 2)."""
    return np.full((len(VISIBILITIES), 2), (PRIOR_LOOKS, PRIOR_LOOKS / 2))


def first_fates() -> Int64:
    """Number of errors, and of objects, among the nodes whose fate is known: (2,)."""
    return np.array([PRIOR_FATES, PRIOR_FATES])


def prior(fates: Int64) -> float:
    """Log odds that a new node is an object: higher where few nodes turned out to be errors."""
    return OFFSET + FATES * math.log(fates[1] / fates[0])


def settle(records: NDArray[Any], fates: Int64, slots: Int64, known: Float64) -> None:
    """Count the nodes that have turned out to be objects, or errors, by probabilities (n,).

    A node is an error only after a clear miss. A new node is improbable, too, if frames come fast.
    """
    is_error = (known < 1.0 - SETTLED) & (records["missed_since"][slots] > CLEAR_MISS)
    is_new = ~records["is_settled"][slots] & ((known > SETTLED) | is_error)
    records["is_settled"][slots[is_new]] = True
    fates += np.bincount(~is_error[is_new], minlength=2)


def frame_weight(step_ns: int | None) -> float:
    """Part of a look that a frame is worth, by the time since the frame before (None = the first).

    An error of a detector lasts for a moment. So frames at a high rate are worth less.
    """
    return MAX_WEIGHT if step_ns is None else min(MAX_WEIGHT, max(step_ns, 1) / LOOK_NS)


class Frame(NamedTuple):
    """A frame as its looks need it.

    Attributes:
        camera_world: (3,) position of the camera, metres.
        stamp_ns: of the frame.
        weight: see `frame_weight`.
    """

    camera_world: Float64
    stamp_ns: int
    weight: float


@kernel
def observe_existence(
    records: NDArray[Any],
    counts: Float64,
    slots: Int64,
    scores: Float64,
    visibilities: Int64,
    means_world: Float64,
    frame: Frame,
) -> None:
    """Add a frame to the looks at n nodes that it shows.

    Args:
        records: of all nodes, with `EXISTENCE_FIELDS`; those of the slots are updated.
        counts: see `first_counts`; updated.
        slots: (n,) index of each node's record.
        scores: (n,) score of its detection; 0 = it was not detected.
        visibilities: (n,) how much of it is visible.
        means_world: (n, 3) means, metres.
        frame: that shows them.
    """
    camera_world, stamp_ns, weight = frame
    for index in range(len(slots)):
        record = records[slots[index]]
        if record.best_score == 0.0:
            record.first_ns = record.last_ns = record.look_ns = stamp_ns
            record.look_weight = 1.0
            for axis in range(3):
                record.camera_world[axis] = camera_world[axis]
        # The clock may be behind that of an earlier run: stamps of that run move into the past.
        behind_ns = max(0, max(record.last_ns, record.look_ns) - stamp_ns)
        record.first_ns = max(record.first_ns - behind_ns, OLDEST_NS)
        record.last_ns = max(record.last_ns - behind_ns, OLDEST_NS)
        record.look_ns = max(record.look_ns - behind_ns, OLDEST_NS)
        distance_m = step_m = 0.0
        for axis in range(3):
            distance_m += (means_world[index, axis] - camera_world[axis]) ** 2
            step_m += (record.camera_world[axis] - camera_world[axis]) ** 2
        distance_m, step_m = math.sqrt(distance_m), math.sqrt(step_m)
        if scores[index] == 0.0 and distance_m > REACH_FACTOR * record.reach_m:
            continue
        has_moved = step_m > max(STILL_M, LOOK_RAD * distance_m)
        if has_moved or stamp_ns - record.look_ns > LOOK_NS:
            # Add the present look to those that have ended, and begin a new one.
            found, missed = _look(record, counts)
            record.looks += found
            record.missed += missed
            record.missed_since += missed
            look = record.look_weight * min(MAX_WEIGHT, record.shown)
            record.pending[record.visibility] += look
            if record.detected > 0:
                # Misses count for the rates if a detection follows: before, it may be no object.
                counts[record.visibility, 1] += look
                for visibility in range(len(counts)):
                    counts[visibility, 0] += record.pending[visibility]
                    record.pending[visibility] = 0.0
            record.detected = record.shown = record.visibility = 0
            record.look_weight = 1.0 if step_m > STILL_M else STILL_WEIGHT
            record.look_ns = stamp_ns
            for axis in range(3):
                record.camera_world[axis] = camera_world[axis]
        record.shown += weight
        record.visibility = max(record.visibility, visibilities[index])
        if scores[index] > 0.0:
            # After a clear miss, a node of a moment starts again: it may be an error that returns.
            if record.missed_since > CLEAR_MISS and record.last_ns - record.first_ns < MOMENT_NS:
                record.first_ns = stamp_ns
            record.detected += weight
            record.missed_since = 0.0
            record.best_score = max(record.best_score, scores[index])
            record.last_ns = stamp_ns
            record.reach_m = max(record.reach_m, distance_m)


@kernel
def _look(record: Any, counts: Float64) -> tuple[float, float]:
    """The summands of the present look for D and M."""
    if record.shown == 0:
        return 0.0, 0.0
    fraction = record.detected / record.shown
    missed = 0.0
    if record.visibility > 0:
        rate = counts[record.visibility, 1] / counts[record.visibility, 0]
        missed = -(1.0 - fraction) * math.log(1.0 - rate)
    weight = record.look_weight * min(MAX_WEIGHT, record.shown)
    return weight * fraction, weight * missed


@kernel
def probabilities(
    records: NDArray[Any], counts: Float64, slots: Int64, prior: float, with_misses: bool
) -> Float64:
    """Probability (n,) that each of n nodes is an object; the prior is that of `prior`.

    Without misses, it is that of a detector that always finds what it sees.
    """
    result = np.empty(len(slots))
    for index in range(len(slots)):
        record = records[slots[index]]
        found, missed = _look(record, counts)
        score = min(max(record.best_score, MIN_SCORE), MAX_SCORE)
        log_odds = prior + SCORE * math.log(score / (1.0 - score))
        log_odds += LOOKS * math.log(max(record.looks + found, 1e-3))
        if with_misses:
            log_odds -= MISSES * math.log1p(record.missed + missed)
            if record.last_ns - record.first_ns < MOMENT_NS:
                since = record.missed_since + (missed if record.detected == 0 else 0.0)
                log_odds -= MOMENT * math.log1p(since)
        result[index] = 1.0 / (1.0 + math.exp(-log_odds))
    return result


def merge(record: Any, other: Any) -> None:
    """Add to a record what was observed of a second node that is the same object."""
    # Both may have been looked at, or missed, from the same positions: the sums are not added.
    for name in ("best_score", "looks", "last_ns", "reach_m"):
        record[name] = max(record[name], other[name])
    for name in ("missed", "missed_since", "first_ns"):
        record[name] = min(record[name], other[name])


def assume(record: Any, observations: int) -> None:
    """Fill the record of a node that has no looks, from its number of observations."""
    record["best_score"], record["looks"] = 0.9, max(observations, 3)
    record["first_ns"] = -MOMENT_NS
    # Its last detection was from another position than any to come.
    record["camera_world"] = np.inf
