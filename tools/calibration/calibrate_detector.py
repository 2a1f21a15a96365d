"""Fit the temperature of NanoDet's class distribution, and test it.

    python tools/calibration/calibrate_detector.py DATASET

DATASET is a folder in the layout of ReplicaSSG, with gt.json per scene and bb.txt per frame. A
sample is a detection that matches a labelled object (IoU >= 0.5) with a class that COCO contains.
For each scene, the temperature with the maximum likelihood on the other scenes is tested.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from deworldsg_ros.perception.backends.embedded import (
    CALIBRATION,
    NanoDetDetector,
    SoftmaxCalibration,
    combine,
)
from deworldsg_ros.scene.arrays import pairwise_iou
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

# COCO class of each Replica class that COCO contains.
COCO_OF_REPLICA = {
    "backpack": "backpack",
    "bench": "bench",
    "book": "book",
    "bottle": "bottle",
    "bowl": "bowl",
    "chair": "chair",
    "clock": "clock",
    "cup": "cup",
    "indoor-plant": "potted plant",
    "microwave": "microwave",
    "phone": "cell phone",
    "refrigerator": "refrigerator",
    "sink": "sink",
    "sofa": "couch",
    "stool": "chair",
    "table": "dining table",
    "tv-screen": "tv",
    "vase": "vase",
}
MATCH_IOU = 0.5
SHELL = "shell"  # kind of walls, floor and ceiling


@dataclass
class Samples:
    """Matched detections: sigmoid evidence (n, 80), true class (n,), instance id (n,)."""

    evidence: np.ndarray
    classes: np.ndarray
    instances: np.ndarray


def collect(scene: Path, detector: NanoDetDetector, step: int) -> Samples:
    """The samples of one scene."""
    objects = {o["id"]: o for o in json.loads((scene / "gt.json").read_text())["objects"]}
    evidence, classes, instances = [], [], []
    for path in sorted((scene / "sequence").glob("frame-*.color.jpg"))[::step]:
        rgb = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        rows = [line.split() for line in _beside(path, "bb.txt").read_text().splitlines()]
        truth = [(int(row[0]), [float(v) for v in row[1:5]]) for row in rows if len(row) >= 5]
        truth = [(i, box) for i, box in truth if objects[i]["kind"] != SHELL]
        found = combine(
            *detector.candidates(rgb), detector.default_score_threshold, lambda scores: scores
        )
        if not truth or not len(found):
            continue
        iou = pairwise_iou(found.boxes_xyxy, np.array([box for _, box in truth]))
        for row, best in enumerate(iou.argmax(axis=1)):
            name = COCO_OF_REPLICA.get(objects[truth[best][0]]["label"])
            if iou[row, best] >= MATCH_IOU and name is not None:
                evidence.append(found.class_probabilities[row])
                classes.append(COCO_CLASSES.index(name))
                instances.append(truth[best][0])
    return Samples(np.array(evidence), np.array(classes), np.array(instances))


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name.replace("color.jpg", suffix))


def negative_log_likelihood(probabilities: np.ndarray, classes: np.ndarray) -> float:
    """Mean over samples."""
    return float(-np.log(probabilities[np.arange(len(classes)), classes]).mean())


def expected_calibration_error(probabilities: np.ndarray, classes: np.ndarray) -> float:
    """Mean difference of confidence and accuracy over ten bins of confidence."""
    confidence, correct = probabilities.max(axis=1), probabilities.argmax(axis=1) == classes
    bins = np.minimum((confidence * 10).astype(int), 9)
    return float(
        sum(
            (bins == b).mean() * abs(confidence[bins == b].mean() - correct[bins == b].mean())
            for b in np.unique(bins)
        )
    )


def fit(samples: Samples) -> float:
    """The temperature with the maximum likelihood."""
    grid = np.arange(0.15, 2.0, 0.01)
    losses = [
        negative_log_likelihood(SoftmaxCalibration(t)(samples.evidence), samples.classes)
        for t in grid
    ]
    return float(grid[int(np.argmin(losses))])


def class_distances(probabilities: np.ndarray, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """D_c (Eq. 5) of pairs of detections: of one object, and of two classes."""
    distance = 1.0 - probabilities @ probabilities.T
    upper = np.triu(np.ones_like(distance, dtype=bool), 1)
    same = (samples.instances[:, None] == samples.instances[None, :]) & upper
    different = (samples.classes[:, None] != samples.classes[None, :]) & upper
    return distance[same], distance[different]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path, help="folder in the layout of ReplicaSSG")
    parser.add_argument("--step", type=int, default=1, help="use every N-th frame")
    arguments = parser.parse_args()
    detector = NanoDetDetector()
    scenes = sorted(path.parent for path in arguments.dataset.glob("data/*/gt.json"))
    samples = {scene.name: collect(scene, detector, arguments.step) for scene in scenes}
    print(f"shipped temperature {CALIBRATION.temperature}")
    for name, held in samples.items():
        others = [s for other, s in samples.items() if other != name] or [held]
        temperature = fit(
            Samples(*(np.concatenate([getattr(s, f) for s in others]) for f in vars(held)))
        )
        print(
            f"{name}: {len(held.classes)} detections, temperature {temperature:.2f} "
            "fitted on the other scenes"
        )
        normalised = held.evidence / held.evidence.sum(axis=1, keepdims=True)
        calibrated = SoftmaxCalibration(temperature)(held.evidence)
        for label, p in (("normalised", normalised), ("calibrated", calibrated)):
            same, different = class_distances(p, held)
            print(
                f"  {label}: NLL {negative_log_likelihood(p, held.classes):.3f}, "
                f"ECE {expected_calibration_error(p, held.classes):.3f}, "
                f"accuracy {np.mean(p.argmax(axis=1) == held.classes):.3f}, "
                f"D_c < 0.8: one object {np.mean(same < 0.8):.3f} "
                f"(median {np.median(same):.2f}), "
                f"different classes {np.mean(different < 0.8):.3f}"
            )


if __name__ == "__main__":
    main()
