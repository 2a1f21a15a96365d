#!/usr/bin/env python3
"""Fit the weights of the RGB-D segmenter to rooms with perfect masks.

    python tools/calibration/fit_segmenter.py DATASET [--step 4] [--scenes 10]

DATASET is a folder of tools/physics_rooms/make_rooms.py; its first scenes are used. Prints
`WEIGHTS` of deworldsg_ros/perception/backends/rgbd.py. Each round is fitted to the beliefs after
the rounds before it. A region counts as its part of the object, at most as the whole object.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from bench.segmenter_iou import INTRINSICS, load
from deworldsg_ros.perception.backends import rgbd
from deworldsg_ros.perception.backends.regions import Regions, find_regions, reduce_frame

ROUNDS = 3
STRIDE = 3
MIN_PIXELS = 400
# Without beliefs of a round before, these say nothing.
NOT_IN_THE_FIRST = ("nearest_colour", "belief")
# Weight of the squares of the standardised weights.
RIDGE = 1.0
STEPS = 30


class Example(NamedTuple):
    """The regions of a frame; boxes in cells (n, 4); cells of each object in each region (n, c)."""

    regions: Regions
    boxes_cells: np.ndarray
    shares: np.ndarray


def read(path: Path) -> Example | None:
    """The example of a `color.jpg`; None without detections."""
    frame = load(path)
    if not len(frame.boxes_xyxy):
        return None
    regions = find_regions(reduce_frame(frame.rgb, frame.depth_m, INTRINSICS, STRIDE))
    regions = regions._replace(strength=regions.strength**rgbd.STRENGTH_POWER)
    height, width = regions.labels.shape
    shares = []
    for mask in frame.masks:
        cells = mask[: height * STRIDE, : width * STRIDE].reshape(height, STRIDE, width, STRIDE)
        weight = cells.mean(axis=(1, 3)).ravel()
        shares.append(np.bincount(regions.labels.ravel(), weight, len(regions.area)))
    limits = np.array([width - 1, height - 1] * 2)
    boxes = np.clip(np.round(frame.boxes_xyxy) // STRIDE, 0, limits).astype(np.int64)
    return Example(regions, boxes, np.array(shares))


def rows(example: Example, weights: list[np.ndarray]) -> list[np.ndarray]:
    """Of each object, the evidence after these rounds, the truth, and the sample weight."""
    regions, boxes, shares = example
    owner = np.full(len(regions.area), -1, dtype=np.int32)
    found = []
    for row in np.argsort((boxes[:, 2:] - boxes[:, :2] + 1).prod(axis=1), kind="stable"):
        candidates = rgbd.find_candidates(regions, boxes[row], owner)
        if candidates is None:
            continue
        for of_round in weights:
            candidates.refine(regions, owner, of_round)
        candidates.weigh(regions, owner)
        members = candidates.members
        truth = shares[row, members] > 0.5 * regions.area[members]
        own = candidates.belief >= 0.5 if weights else truth
        owner[members[own]] = row
        cells = shares[row].sum()
        if cells * STRIDE**2 > MIN_PIXELS:
            sample = np.minimum(regions.area[members] / cells, 1.0)
            found.append(np.column_stack((candidates.evidence, truth, sample)))
    return found


def fit(
    evidence: np.ndarray, truth: np.ndarray, sample: np.ndarray, used: np.ndarray
) -> np.ndarray:
    """Weights (len(EVIDENCE) + 1,) of a logistic regression, by Newton's method."""
    mean, spread = evidence.mean(axis=0), evidence.std(axis=0) + 1e-9
    inputs = np.column_stack(((evidence - mean) / spread, np.ones(len(evidence))))
    kept = np.append(used, True)
    inputs, solution = inputs[:, kept], np.zeros(int(kept.sum()))
    ridge = RIDGE * np.eye(len(solution))
    ridge[-1, -1] = 0.0
    for _ in range(STEPS):
        belief = 1.0 / (1.0 + np.exp(-inputs @ solution))
        slope = inputs.T @ (sample * (belief - truth)) + ridge @ solution
        curve = (inputs * (sample * belief * (1.0 - belief))[:, None]).T @ inputs + ridge
        solution -= np.linalg.solve(curve, slope)
    weights = np.zeros(len(kept))
    weights[kept] = solution
    weights[:-1] /= spread
    weights[-1] -= weights[:-1] @ mean
    return weights


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--step", type=int, default=4, help="use every N-th frame")
    parser.add_argument("--scenes", type=int, default=10, help="use the first N scenes")
    arguments = parser.parse_args()
    scenes = sorted(arguments.dataset.glob("data/*/sequence"))[: arguments.scenes]
    paths = [p for s in scenes for p in sorted(s.glob("frame-*.color.jpg"))[:: arguments.step]]
    examples = [example for example in map(read, paths) if example is not None]
    print(f"{len(scenes)} scenes, {len(examples)} frames", file=sys.stderr)
    weights: list[np.ndarray] = []
    for number in range(ROUNDS):
        table = np.concatenate([row for e in examples for row in rows(e, weights)])
        evidence, truth, sample = table[:, :-2], table[:, -2], table[:, -1]
        used = np.array([number > 0 or name not in NOT_IN_THE_FIRST for name in rgbd.EVIDENCE])
        weights.append(fit(evidence, truth, sample, used))
        wrong = sample @ ((evidence @ weights[-1][:-1] + weights[-1][-1] > 0) != (truth > 0))
        print(f"round {number + 1}: wrong area {wrong / sample.sum():.4f}", file=sys.stderr)
    print(np.array2string(np.array(weights), precision=3, separator=", ", suppress_small=True))


if __name__ == "__main__":
    main()
