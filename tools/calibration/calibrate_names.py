#!/usr/bin/env python3
"""Fit how certain a name is whose best view has a score: `SoftmaxCalibration.certainty`.

    python tools/calibration/calibrate_names.py CAPTURES

CAPTURES is a folder of tools/merging_lab/capture.py with annotated scans, made by the detector that
is calibrated, with its `certainty` set to None. Each published node is one example: the
best score among the detections that have its name, the share of the name among all names that were
seen, and whether it is the name of the object in most of its detections. The probability that it is
right is the share times the certainty. Prints slope and offset of the log odds of the certainty,
and the calibration error of each scan with the constants of the others.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tools" / "merging_lab")]

from captures import read_capture  # noqa: E402
from replay import chosen_paths, read_truth, replay, translate  # noqa: E402

from deworldsg_ros.config import Config, OutputConfig  # noqa: E402
from deworldsg_ros.evaluation.edge_measures import Calibrated, calibration_error  # noqa: E402
from deworldsg_ros.perception.backends.embedded import logit  # noqa: E402


def examples(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the n published nodes of a capture: best scores, shares of the names, whether right."""
    capture = read_capture(path)
    if not capture.layout:
        raise SystemExit(f"{path}: expected a capture of an annotated scan")
    truth = read_truth(capture.root, capture.layout, capture.scan)
    of_object = dict(zip(truth.reference.ids, truth.reference.labels))
    replayed = replay(capture, Config(output=OutputConfig(min_name=0.0)))
    votes: dict[int, Counter[int]] = defaultdict(Counter)
    best: dict[tuple[int, str], float] = defaultdict(float)
    for local, objects, nodes in zip(capture.local_graphs, capture.object_ids, replayed.node_ids):
        names = local.vocabulary.classes
        labels = local.class_probabilities.argmax(axis=1).tolist()
        for node, true, label, score in zip(nodes, objects.tolist(), labels, local.scores):
            votes[node][true] += 1
            best[node, names[label]] = max(best[node, names[label]], float(score))
    translated = translate(replayed.graph, truth.annotations).nodes
    rows = [
        (
            best[node.id, node.label],
            node.classes[0].probability,
            of_object.get(votes[node.id].most_common(1)[0][0]) == other.label,
        )
        for node, other in zip(replayed.graph.nodes, translated)
    ]
    scores, shares, right = np.array(rows, float).T
    return scores, shares, right


def told(constants: np.ndarray, scores: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Probabilities (n,) that names are right."""
    return shares / (1.0 + np.exp(-constants[0] * logit(scores) - constants[1]))


def fit(scores: np.ndarray, shares: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Slope and offset (2,) of the greatest likelihood."""

    def loss(constants: np.ndarray) -> float:
        p = told(constants, scores, shares)
        return -float(np.log(np.where(right > 0, p, 1.0 - p)).sum())

    found: np.ndarray = minimize(loss, np.array([1.0, 0.0]), method="Nelder-Mead").x
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path)
    parser.add_argument("--only", action="append", default=[], help="pattern of names")
    arguments = parser.parse_args()
    scans = {
        path.name: examples(path)
        for path in chosen_paths(arguments.captures, arguments.only or "*")
    }
    for name, (scores, shares, right) in scans.items():
        others = [scan for other, scan in scans.items() if other != name]
        if others:
            constants = fit(*map(np.concatenate, zip(*others)))
            probabilities = told(constants, scores, shares).tolist()
            error = calibration_error(list(map(Calibrated, probabilities, (right > 0).tolist())))
            print(f"{name}: {len(right)} nodes, {right.mean():.2f} right, error {error:.3f}")
    slope, offset = fit(*map(np.concatenate, zip(*scans.values())))
    print(f"certainty=({slope:.2f}, {offset:.2f})")


if __name__ == "__main__":
    main()
