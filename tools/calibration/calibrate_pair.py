"""Fit how the embedded detector joins its two networks, and test it on scenes left out.

    python tools/calibration/calibrate_pair.py RECORDING=TRUTH.json ...

RECORDING is a folder of frames; TRUTH has boxes of its objects in the world: `names` (all that are
right) with `centroid_m` and `extent_m`, or `label` with `aabb`. Rooms of one data set, in folders
side by side, are one scene: they are left out together.

A sample is one of the two best names of a box, in a frame after the camera has moved by 20 cm or
10°. The name is right if the surface in the middle of the box lies within 30 cm (rendered rooms:
10 cm) of an object that has it. Each recording counts as much as another. It prints, at one false
box a frame, the views of named objects that get their right name, with the first network alone,
with constants of the other scenes, and with those of all.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from calibrate_detector import COCO_OF_REPLICA

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.perception.backends import embedded
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.arrays import pairwise_iou
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

Floats = NDArray[np.float64]

# A frame is new after this motion.
MOVED_M, TURNED_RAD = 0.2, np.radians(10)
TOLERANCE_M, RENDERED_TOLERANCE_M = 0.3, 0.1
# Prior of the bias of a class: its square counts this much, beside the mean loss.
PRIOR = 0.05
# The part of a box's sides around its middle that is sampled, and the samples along a side.
INNER, SAMPLES = 0.88, 22
# A view shows at least this many pixels of an object.
MIN_PIXELS = 540
STEP = 4  # pixels between the samples of a view
MIN_IOU = 0.3


@dataclass
class Truth:
    """Named boxes (n) in the world, metres: lower and upper corners (n, 3)."""

    names: list[set[int]]
    low: Floats
    high: Floats
    tolerance_m: float

    @classmethod
    def read(cls, path: Path) -> Truth:
        """The boxes of a file."""
        names, low, high, is_rendered = [], [], [], False
        for item in json.loads(path.read_text())["objects"]:
            if item.get("kind") == "shell" or not (item.get("aabb") or item.get("extent_m")):
                continue
            label = item.get("label", "")
            is_rendered |= "frames_detectable" in item
            known = item.get("names") or [COCO_OF_REPLICA.get(label, label)]
            names.append({COCO_CLASSES.index(name) for name in known if name in COCO_CLASSES})
            if item.get("aabb"):
                box = np.array(item["aabb"], float)
            else:
                half = np.array(item["extent_m"], float) / 2
                box = item["centroid_m"] + np.outer([-1, 1], half)
            low.append(box[0])
            high.append(box[1])
        tolerance_m = RENDERED_TOLERANCE_M if is_rendered else TOLERANCE_M
        return cls(names, np.array(low), np.array(high), tolerance_m)

    def names_at(self, point: Floats) -> set[int]:
        """Right names of what lies at a point (3,) of the world."""
        outside = np.maximum(np.maximum(self.low - point, point - self.high), 0)
        near = np.linalg.norm(outside, axis=1) < self.tolerance_m
        return set().union(*(self.names[row] for row in np.flatnonzero(near)))


@dataclass
class Box:
    """A box of the first network with the evidence (80,) for each name, and what is right."""

    box_xyxy: Floats
    evidence: Floats
    right: set[int]


@dataclass
class Picture:
    """A frame: its boxes, alone and joined, and the views of named objects (names, box)."""

    alone: list[Box]
    joined: list[Box]
    views: list[tuple[set[int], Floats]]


def pictures(folder: Path, truth: Truth) -> Iterator[Picture]:
    """The frames of a recording, after each motion."""
    first, second = embedded.NanoDetDetector(), embedded.SsdLite()
    last = None
    source = open_source(folder)
    for frame in Recording(source, InputsConfig()).frames():
        pose = frame.T_world_camera
        if last is not None:
            turn = np.arccos(np.clip((np.trace(pose[:3, :3].T @ last[:3, :3]) - 1) / 2, -1, 1))
            if np.linalg.norm(pose[:3, 3] - last[:3, 3]) < MOVED_M and turn < TURNED_RAD:
                continue
        last = pose
        of_first = first.candidates(frame.rgb)
        rows, scores = embedded.suppress(*of_first, embedded.CANDIDATE_SCORE)
        joined, evidence = embedded.evidence_of(of_first, second.candidates(frame.rgb))
        yield Picture(
            list(boxes(frame, of_first[0][rows], embedded.logit(scores), truth)),
            list(boxes(frame, joined, evidence, truth)),
            list(views(frame, truth)),
        )
    source.close()


def points_of(frame: RgbdFrame, u: NDArray[np.int64], v: NDArray[np.int64]) -> Floats:
    """Points (n, 3) of pixels in the world, metres; NaN without depth."""
    k = frame.intrinsics
    z = frame.depth_m[v, u].astype(float)
    z[~(z > 0)] = np.nan
    points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1)
    return np.asarray(points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3])


def boxes(frame: RgbdFrame, found: Floats, evidence: Floats, truth: Truth) -> Iterator[Box]:
    """The boxes whose middle has depth."""
    height, width = frame.depth_m.shape
    for box, of_names in zip(found, evidence, strict=True):
        along = np.linspace(-INNER / 2, INNER / 2, SAMPLES)
        middle, size = (box[:2] + box[2:]) / 2, box[2:] - box[:2]
        u, v = np.meshgrid(middle[0] + along * size[0], middle[1] + along * size[1])
        u, v = (np.rint(x).astype(int).ravel() for x in (u, v))
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        points = points_of(frame, u[inside], v[inside])
        # Without the background: what lies nearer than the median.
        distance = np.linalg.norm(points - frame.T_world_camera[:3, 3], axis=1)
        if np.isfinite(distance).sum() >= SAMPLES:
            near = distance <= np.nanmedian(distance)
            yield Box(box, of_names, truth.names_at(np.median(points[near], axis=0)))


def views(frame: RgbdFrame, truth: Truth) -> Iterator[tuple[set[int], Floats]]:
    """Names and image boxes of the named objects that a frame shows clearly."""
    height, width = frame.depth_m.shape
    u, v = (x.ravel() for x in np.meshgrid(np.arange(2, width, STEP), np.arange(2, height, STEP)))
    points = points_of(frame, u, v)
    # The smallest box around a point is that of its object: a cup is within a table's box.
    order = np.argsort((truth.high - truth.low).prod(axis=1))
    free = np.ones(len(points), bool)
    for row in order:
        within = free & ((points > truth.low[row]) & (points < truth.high[row])).all(axis=1)
        free &= ~within
        if truth.names[row] and within.sum() * STEP**2 >= MIN_PIXELS:
            low, high = np.percentile(np.stack([u, v])[:, within], [1, 99], axis=1)
            yield truth.names[row], np.concatenate([low, high])


# --- The constants, and what they are worth.

Samples = tuple[Floats, NDArray[np.bool_], NDArray[np.int64]]


def samples(recording: list[Picture]) -> Samples:
    """Evidence, whether the name is right, and the name, of the two best names of each box."""
    rows = [
        (box.evidence[name], name in box.right, name)
        for picture in recording
        for box in picture.joined
        for name in np.argsort(-box.evidence)[:2]
    ]
    evidence, right, names = zip(*rows, strict=True)
    return np.array(evidence), np.array(right), np.array(names)


def fit(recordings: list[list[Picture]], known: set[int]) -> tuple[float, float, Floats]:
    """Scale, bias, and the bias of each class, which is 0 for those that no truth has."""
    parts = [samples(recording) for recording in recordings]
    evidence, right, names = (np.concatenate(column) for column in zip(*parts, strict=True))
    weights = np.concatenate([np.full(len(part[0]), 1 / len(part[0])) for part in parts])

    def loss(values: Floats) -> tuple[float, Floats]:
        z = values[0] * evidence + values[1] + values[2:][names]
        error = weights * (1 / (1 + np.exp(-z)) - right)
        of_class = np.bincount(names, error, len(COCO_CLASSES)) + 2 * PRIOR * values[2:]
        total = (weights * (np.logaddexp(0, z) - right * z)).sum() + PRIOR * (values[2:] ** 2).sum()
        return total, np.concatenate([[(error * evidence).sum(), error.sum()], of_class])

    values = minimize(loss, np.zeros(2 + len(COCO_CLASSES)), jac=True).x
    bias = np.array([values[2 + c] if c in known else 0.0 for c in range(len(COCO_CLASSES))])
    return values[0], values[1], bias


def right_views(
    recording: list[Picture], of: str, score: Callable[[Floats], Floats], per_frame: float
) -> int:
    """Views that get their right name, at so many false boxes a frame."""
    wrong, right = [], []
    for picture in recording:
        found: list[Box] = getattr(picture, of)
        scores = np.array([score(box.evidence) for box in found]).reshape(-1, len(COCO_CLASSES))
        rows, scores = embedded.suppress(
            np.array([box.box_xyxy for box in found]).reshape(-1, 4), scores, 0.02
        )
        kept = [found[row] for row in rows]
        best, names = scores.max(axis=1), scores.argmax(axis=1)
        wrong += [s for s, n, box in zip(best, names, kept, strict=True) if n not in box.right]
        for expected, view in picture.views:
            over = pairwise_iou(view[None], np.array([b.box_xyxy for b in kept]).reshape(-1, 4))[0]
            named = [n in expected for n in names]
            right.append(best[(over >= MIN_IOU) & named].max(initial=0.0))
    limit = np.sort(wrong)[::-1][min(len(wrong) - 1, int(per_frame * len(recording)))]
    return int((np.array(right) > limit).sum())


def temperature(recordings: list[list[Picture]], score: Callable[[Floats], Floats]) -> float:
    """That of the class distribution with the greatest likelihood, of boxes of a score >= 0.4."""

    def loss(value: float) -> float:
        losses = []
        for recording in recordings:
            of_one = []
            for box in (box for picture in recording for box in picture.joined):
                scores = score(box.evidence)
                if box.right and scores.max() >= 0.4:
                    p = embedded.SoftmaxCalibration(value)(scores[None])[0]
                    of_one.append(-np.log(max(p[list(box.right)].sum(), 1e-6)))
            losses.append(np.mean(of_one))
        return float(np.mean(losses))

    return float(min(np.arange(0.3, 2.0, 0.05), key=loss))


def main() -> int:
    if len(sys.argv) < 2:
        print(__doc__, file=sys.stderr)
        return 2
    read, truths, scenes = {}, {}, {}
    for argument in sys.argv[1:]:
        folder, path = map(Path, argument.split("=", 1))
        truths[argument] = Truth.read(path)
        read[argument] = list(pictures(folder, truths[argument]))
        scenes[argument] = path.parent.parent if path.name == "gt.json" else path

    def joined(names: list[str]) -> Callable[[Floats], Floats]:
        known = set().union(*(s for name in names for s in truths[name].names))
        scale, bias, of_class = fit([read[name] for name in names], known)
        return lambda evidence: 1 / (1 + np.exp(-(scale * evidence + bias + of_class)))

    everything = joined(list(read))
    for name, recording in read.items():
        other = [o for o in read if scenes[o] != scenes[name]]
        counts = [
            right_views(recording, of, score, 1.0)
            for of, score in (
                ("alone", lambda logits: 1 / (1 + np.exp(-logits))),
                *([("joined", joined(other))] if other else []),
                ("joined", everything),
            )
        ]
        total = sum(len(picture.views) for picture in recording)
        print(f"{name}: {len(recording)} frames, of {total} views: {counts}", flush=True)
    known = set().union(*(s for truth in truths.values() for s in truth.names))
    scale, bias, of_class = fit(list(read.values()), known)
    print(f"SCALE, BIAS = {scale:.3f}, {bias:.3f}; temperature", end=" ")
    print(f"{temperature(list(read.values()), everything):.2f}")
    for name in sorted(known, key=lambda name: -of_class[name]):
        if abs(of_class[name]) >= 0.03:
            print(f'    "{COCO_CLASSES[name]}": {of_class[name]:.2f},')
    return 0


if __name__ == "__main__":
    sys.exit(main())
