"""The beliefs on a node: the probability that it is an object, and its class."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import chain
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.merging.views import VISIBILITIES
from deworldsg_ros.scene.arrays import Float64, Int64

# --- The class of a node: a hidden Markov model, because wrong names come in spells.
#
# A detector that calls a chair a bag calls it so for as long as it sees it from there, and often a
# little further. So the model of a node has two labels: the class of the object, and the name that
# it has at present. At a new viewpoint the name is drawn again with probability DRAWN: it is the
# class, or another label with probability WRONG. A frame shows the name, or any label with
# probability OUTLIERS. A viewpoint that the camera comes back to has said its name. Only the LABELS
# most probable labels count. The constants gave the best calibration of names over known detections
# with and without faults, and about as many relations (tools/merging_lab).

LABELS = 8
DRAWN = 0.5
WRONG = 0.2
OUTLIERS = 0.4
# A detector that is wrong says the same wrong name from all sides. So no number of views makes a
# name surer than the view that was surest of it. All classes evenly share the rest, at least
# OTHERS.
OTHERS = 0.05
# This doubt is smaller for a source that rarely contradicts itself: such sources are also rarely
# wrong on all sides (docs/dev/merging.md). DRAWN * WRONG of the new viewpoints are expected to
# contradict the name of their node, as if PRIOR_VIEWPOINTS had been observed. If fewer do, the
# doubt is the smaller, but LEAST_DOUBT of it stays: what is wrong everywhere contradicts nothing.
PRIOR_VIEWPOINTS = 20.0
LEAST_DOUBT = 0.1

# The part of a node's record that belongs to its name: the labels (-1 = none), the probability
# of each class (row) with each name (column), and the place of the viewpoint that says it (-1 =
# none: the camera has come back to another one).
NAME_FIELDS: list[Any] = [
    ("labels", np.int64, LABELS),
    ("joint", np.float64, (LABELS, LABELS)),
    ("named_from", np.int64),
    # The probability of each label in the view that was most certain of it.
    ("most_certain", np.float64, LABELS),
]


def first_said() -> Int64:
    """Number of new viewpoints that contradicted the name of their node, and of all: (2,)."""
    return np.zeros(2, np.int64)


def doubt(said: Int64) -> float:
    """The factor, from LEAST_DOUBT to 1, of the doubt about names; `said` as in `first_said`."""
    contradictions, viewpoints = said.tolist()
    expected = DRAWN * WRONG
    share: float = (PRIOR_VIEWPOINTS * expected + contradictions) / (PRIOR_VIEWPOINTS + viewpoints)
    return min(1.0, max(LEAST_DOUBT, share / expected))


def most_certain(*records: Any) -> dict[int, float]:
    """The probability of each label in the view of any of these nodes that was surest of it."""
    rows = [zip(one["labels"].tolist(), one["most_certain"].tolist()) for one in records]
    best: dict[int, float] = {}
    for label, probability in chain(*rows):
        best[label] = max(best.get(label, 0.0), probability)
    return best


def start(
    record: Any, probabilities: Float64, certain: Mapping[int, float] = MappingProxyType({})
) -> None:
    """Begin with class probabilities (C,), and what views before were certain of, by label."""
    order = np.argsort(-probabilities, kind="stable")[:LABELS]
    count = len(order)
    drawn = np.full((count, count), WRONG / max(count - 1, 1))
    np.fill_diagonal(drawn, 1.0 - WRONG)
    record["labels"], record["joint"], record["named_from"] = -1, 0.0, 0
    record["labels"][:count] = order
    record["most_certain"] = 0.0
    record["most_certain"][:count] = [
        max(float(probabilities[label]), certain.get(label, 0.0)) for label in order.tolist()
    ]
    joint = drawn * probabilities[order]
    record["joint"][:count, :count] = joint / joint.sum()


@kernel
def observe_names(
    records: NDArray[Any],
    said: Int64,
    doubted: float,
    slots: Int64,
    seen: Float64,
    means_world: Float64,
    camera_world: Float64,
    classes: Float64,
) -> None:
    """Add class distributions (n, C) of a frame to n known nodes.

    Args:
        records: with `NAME_FIELDS` and `EXISTENCE_FIELDS`; those of the slots are updated.
        said: see `first_said`; updated.
        doubted: the `doubt`.
        slots: (n,) index of each node's record.
        seen: (n, C) distributions of the detections.
        means_world: (n, 3) means of the nodes, metres.
        camera_world: (3,) position of the camera, metres.
        classes: (n, C), filled with the distributions of the nodes' classes.
    """
    for index in range(len(slots)):
        record = records[slots[index]]
        place = viewpoint(record.view_camera[: record.views], means_world[index], camera_world)
        is_new = place < 0 or record.view_named[place] == 0
        if place < 0:
            place = record.views % VIEWS  # where `observe_existence` puts it
        # A long look at one node says little of others: the first VIEWS of each count.
        if is_new and 0 < record.views < VIEWS:
            best_label = record.labels[record.joint.sum(axis=1).argmax()]
            said[0] += int(np.argmax(seen[index]) != best_label)
            said[1] += 1
        if is_new or place == record.named_from:
            _name(record, seen[index], is_new)
            record.named_from = place
        else:
            record.named_from = -1
        best, certain = 0.0, 0.0
        for i in range(LABELS):
            if record.labels[i] >= 0:
                belief = record.joint[i].sum()
                record.most_certain[i] = max(record.most_certain[i], seen[index, record.labels[i]])
                if belief > best:
                    best, certain = belief, record.most_certain[i]
        others = doubted * max(OTHERS, 1.0 - certain)
        classes[index] = others / seen.shape[1]
        for i in range(LABELS):
            if record.labels[i] >= 0:
                classes[index, record.labels[i]] += (1.0 - others) * record.joint[i].sum()


@kernel
def _name(record: Any, seen: Float64, is_new: bool) -> None:
    """Add the distribution (C,) of a frame, from a new viewpoint or the same as before."""
    # The best label is considered: it takes a free place, or that of the least probable one.
    label, place, is_known = int(np.argmax(seen)), 0, False
    for i in range(LABELS):
        is_known |= record.labels[i] == label
    for i in range(0 if is_known else LABELS):
        if record.labels[i] < 0 or record.joint[i].sum() < record.joint[place].sum():
            place = i
            if record.labels[i] < 0:
                break
    if not is_known:
        record.labels[place], record.most_certain[place] = label, 0.0
        record.joint[:, place] = 0.0
        # If the object is this, all names so far were wrong.
        for j in range(LABELS):
            others = record.joint[:, j].sum() - record.joint[place, j]
            record.joint[place, j] = WRONG / LABELS * others
    known = 0
    for label in record.labels:
        known += int(label >= 0)
    total = 0.0
    for i in range(known):
        belief = record.joint[i].sum()
        for j in range(known):
            drawn = 1.0 - WRONG if i == j else WRONG / max(known - 1, 1)
            shown = (1.0 - OUTLIERS) * seen[record.labels[j]] + OUTLIERS / len(seen)
            if is_new:
                record.joint[i, j] = (1.0 - DRAWN) * record.joint[i, j] + DRAWN * drawn * belief
            record.joint[i, j] *= shown
            total += record.joint[i, j]
    for i in range(known):
        record.joint[i] /= total


# --- The probability that a node is an object, from the viewpoints at it.
#
# The frames of one viewpoint show one picture: the errors of a detector in them are one error. So
# viewpoints are counted, and neither frames nor seconds. A viewpoint is a direction from the node
# to the camera within VIEW_RAD, and a distance within a factor of VIEW_RATIO. It detects the node
# by the fraction of its frames that do; frames in which the node is hidden do not count.
#
# The log odds of existence are a sum, times SLOPE, which calibrates them:
#
#     prior + SCORE ln(s / (1 - s)) + LOOKS ln(D) - MISSES ln(1 + M) - MOMENT ln(1 + R)
#
# s is the best detection score. D is the sum of min(1, fraction / rate) over all viewpoints: a
# viewpoint counts as one if it detects the node as often as it would detect an object. The rate is
# the fraction of frames that detect an object; the rule learns one for each visibility. M is the
# evidence of the misses: the sum of -(1 - fraction) ln(1 - rate). R is the part of M since the last
# detection. It counts only if no more than MOMENT_VIEWS have detected the node: a reflection or a
# false box lasts for a moment. The prior is learned, too: where many nodes turned out to be errors,
# a new one is less probable (`prior`).
#
# A new node may have been overlooked: frames before that had its place in view from the same
# viewpoint belong to this viewpoint, too.

OFFSET, SCORE, LOOKS, MISSES, MOMENT = 0.2, 1.5, 1.2, 0.35, 1.2
SLOPE = 1.5
MOMENT_VIEWS = 2
FATES = 0.4
# The fate of a node is known from this probability on, or below one minus it after a clear miss.
# At first, as many objects as errors are known.
SETTLED, CLEAR_MISS, PRIOR_FATES = 0.9, 2.0, 10
# Bounds of the score. False boxes may have high scores: above 0.5, a score says no more.
MIN_SCORE, MAX_SCORE = 0.02, 0.5
VIEW_RAD = math.radians(8.0)
VIEW_COS = math.cos(VIEW_RAD)
VIEW_RATIO = 1.2
# Viewpoints of a node that are remembered. Of more, the oldest one counts for good.
VIEWS = 12
# A thing that no detector fires at gets the existence of an object that was detected from two
# viewpoints: 0.82 in a new graph. Nodes that were detected get at least three from `assume`.
THING_LOOKS = 2.0
# Frames of a viewpoint that count, two seconds of video: of more, the older half counts half. A
# camera that stands still may see more than before, when the light changes or a person has gone.
VIEW_FRAMES = 60.0
# Beyond the largest distance of a detection, by this factor, a miss is not counted.
REACH_FACTOR = 1.1
# The rates start as if this many viewpoints had been observed, and half of them had detected the
# object.
PRIOR_LOOKS = 10.0

# The part of a node's record that belongs to its existence.
EXISTENCE_FIELDS: list[Any] = [
    ("best_score", np.float64),
    # The largest distance of a detection.
    ("reach_m", np.float64),
    # Frames that could have detected it from its first viewpoint, before it was there.
    ("before", np.float64),
    # Number of viewpoints so far, and D and M of those that are remembered no more.
    ("views", np.int64),
    ("looks", np.float64),
    ("missed", np.float64),
    # Viewpoints: position of the camera, frames that show the node and that detected it, its best
    # visibility, and whether it has said a name.
    ("view_camera", np.float32, (VIEWS, 3)),
    ("view_shown", np.float32, VIEWS),
    ("view_detected", np.float32, VIEWS),
    ("view_visibility", np.int8, VIEWS),
    ("view_named", np.int8, VIEWS),
    # The viewpoint of the last frame that shows it, and the viewpoints since the last detection, by
    # visibility: misses count for the rates if a detection follows.
    ("current", np.int64),
    ("pending", np.float64, len(VISIBILITIES)),
    # Whether its fate is known: it is an object, or an error.
    ("is_settled", np.bool_),
]


def first_counts() -> Float64:
    """Viewpoints at objects, and those that detected them: (len(VISIBILITIES), 2)."""
    return np.full((len(VISIBILITIES), 2), (PRIOR_LOOKS, PRIOR_LOOKS / 2))


def first_fates() -> Int64:
    """Number of errors, and of objects, among the nodes whose fate is known: (2,)."""
    return np.array([PRIOR_FATES, PRIOR_FATES])


def prior(fates: Int64) -> float:
    """Log odds that a new node is an object: higher where few nodes turned out to be errors."""
    return OFFSET + FATES * math.log(fates[1] / fates[0])


def settle(
    records: NDArray[Any], fates: Int64, slots: Int64, known: Float64, missed: Float64
) -> None:
    """Count the nodes that have turned out to be objects, or errors, by `probabilities` (n,).

    A node is an error only after a clear miss: a new node is improbable, too.
    """
    is_error = (known < 1.0 - SETTLED) & (missed > CLEAR_MISS)
    is_new = ~records["is_settled"][slots] & ((known > SETTLED) | is_error)
    records["is_settled"][slots[is_new]] = True
    fates += np.bincount(~is_error[is_new], minlength=2)


@kernel
def viewpoint(cameras: Any, mean: Float64, camera: Float64) -> int:
    """The nearest viewpoint (k, 3) of a node that a camera position shares; -1 = none."""
    x, y, z = camera[0] - mean[0], camera[1] - mean[1], camera[2] - mean[2]
    distance = math.sqrt(x * x + y * y + z * z) + 1e-9
    best, place = VIEW_COS, -1
    for index in range(len(cameras)):
        a = cameras[index, 0] - mean[0]
        b = cameras[index, 1] - mean[1]
        c = cameras[index, 2] - mean[2]
        other = math.sqrt(a * a + b * b + c * c) + 1e-9
        cosine = (x * a + y * b + z * c) / (distance * other)
        near = distance < VIEW_RATIO * other and other < VIEW_RATIO * distance
        if near and cosine > best:
            best, place = cosine, index
    return place


@kernel
def observe_existence(
    records: NDArray[Any],
    counts: Float64,
    slots: Int64,
    scores: Float64,
    visibilities: Int64,
    means_world: Float64,
    camera_world: Float64,
) -> None:
    """Add a frame to the viewpoints of n nodes that it shows.

    Args:
        records: of all nodes, with `EXISTENCE_FIELDS`; those of the slots are updated.
        counts: see `first_counts`; updated.
        slots: (n,) index of each node's record.
        scores: (n,) score of its detection; 0 = it was not detected.
        visibilities: (n,) how much of it is visible.
        means_world: (n, 3) means, metres.
        camera_world: (3,) position of the camera, metres.
    """
    for index in range(len(slots)):
        record = records[slots[index]]
        distance_m = 0.0
        for axis in range(3):
            distance_m += (means_world[index, axis] - camera_world[axis]) ** 2
        distance_m = math.sqrt(distance_m)
        if scores[index] == 0.0 and distance_m > REACH_FACTOR * record.reach_m:
            continue
        place = viewpoint(record.view_camera[: record.views], means_world[index], camera_world)
        if place < 0:
            if record.views:
                # The camera leaves a viewpoint for a new one: learn the rates from it.
                left = record.current
                visibility = record.view_visibility[left]
                record.pending[visibility] += 1.0
                if record.view_detected[left] > 0:
                    fraction = record.view_detected[left] / record.view_shown[left]
                    counts[visibility, 1] += fraction
                    for other in range(len(counts)):
                        counts[other, 0] += record.pending[other]
                        record.pending[other] = 0.0
            place = record.views % VIEWS
            if record.views >= VIEWS:
                found, missed = _view(record, counts, place)
                record.looks += found
                record.missed += missed
            record.views += 1
            for axis in range(3):
                record.view_camera[place, axis] = camera_world[axis]
            # A new node begins with the frames before that did not detect it from here.
            record.view_shown[place] = record.before if record.views == 1 else 0.0
            record.view_detected[place] = 0.0
            record.view_visibility[place] = record.view_named[place] = 0
        record.current = place
        if record.view_shown[place] >= VIEW_FRAMES:
            record.view_shown[place] *= 0.5
            record.view_detected[place] *= 0.5
        record.view_shown[place] += 1.0
        best = max(np.int64(record.view_visibility[place]), visibilities[index])
        record.view_visibility[place] = best
        if scores[index] > 0.0:
            record.view_detected[place] += 1.0
            record.view_named[place] = 1
            record.best_score = max(record.best_score, scores[index])
            record.reach_m = max(record.reach_m, distance_m)


@kernel
def _view(record: Any, counts: Float64, place: int) -> tuple[float, float]:
    """The summands of a viewpoint for D and M."""
    fraction = record.view_detected[place] / record.view_shown[place]
    visibility, missed = record.view_visibility[place], 0.0
    rate = counts[visibility, 1] / counts[visibility, 0]
    if visibility > 0:
        missed = -(1.0 - fraction) * math.log(1.0 - rate)
    return min(1.0, fraction / rate), missed


@kernel
def probabilities(
    records: NDArray[Any], counts: Float64, slots: Int64, prior: float, with_misses: bool
) -> tuple[Float64, Float64]:
    """Probability (n,) that each of n nodes is an object, and M; the prior is that of `prior`.

    Without misses, it is that of a detector that always finds what it sees.
    """
    result, misses = np.empty(len(slots)), np.empty(len(slots))
    for index in range(len(slots)):
        record = records[slots[index]]
        found, missed, since, detecting = record.looks, record.missed, 0.0, record.looks
        first = max(0, record.views - VIEWS)
        for view in range(first, record.views):
            more, less = _view(record, counts, view % VIEWS)
            found += more if with_misses else math.ceil(more)
            missed += less
            since = 0.0 if more > 0.0 else since + less
            detecting += more > 0.0
        score = min(max(record.best_score, MIN_SCORE), MAX_SCORE)
        log_odds = prior + SCORE * math.log(score / (1.0 - score))
        log_odds += LOOKS * math.log(max(found, 1e-3))
        if with_misses:
            log_odds -= MISSES * math.log1p(missed)
            if detecting <= MOMENT_VIEWS:
                log_odds -= MOMENT * math.log1p(since)
        result[index], misses[index] = 1.0 / (1.0 + math.exp(-SLOPE * log_odds)), missed
    return result, misses


def merge(record: Any, other: Any, mean_world: Float64) -> None:
    """Add to a record what was observed of a second node that is the same object, at (3,) metres.

    From a viewpoint that both know, either node may have had the detections of a frame.
    """
    more, fewer = (other, record) if other["views"] > record["views"] else (record, other)
    fewer = fewer.copy()
    merged = {name: max(record[name], other[name]) for name in ("best_score", "looks", "reach_m")}
    # Both may have been missed from the same positions: the sums are not added.
    merged["missed"] = min(record["missed"], other["missed"])
    for name, *_ in EXISTENCE_FIELDS:
        record[name] = merged.get(name, more[name])
    for place in range(min(fewer["views"], VIEWS)):
        camera = fewer["view_camera"][place].astype(np.float64)
        known = record["view_camera"][: record["views"]].astype(np.float64)
        to = viewpoint(known, mean_world, camera)
        if to < 0 and record["views"] >= VIEWS:
            continue
        if to < 0:
            to = record["views"]
            record["views"] += 1
            record["view_camera"][to] = camera
            for name in ("view_shown", "view_detected", "view_visibility", "view_named"):
                record[name][to] = 0
        for name in ("view_shown", "view_visibility", "view_named"):
            record[name][to] = max(record[name][to], fewer[name][place])
        detected = record["view_detected"][to] + fewer["view_detected"][place]
        record["view_detected"][to] = min(detected, record["view_shown"][to])


def assume(record: Any, looks: float) -> None:
    """Fill the record of a node without viewpoints, as if `looks` viewpoints had detected it."""
    record["best_score"], record["looks"] = 0.9, looks
