"""The whole stage on real Kinect frames of a kitchen."""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np
import pytest

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception import build_perception
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame

INTRINSICS = Intrinsics(528.408586, 528.408586, 320.3179, 236.720192, 640, 480)


@pytest.fixture(scope="module")
def perceived(shared_dir):
    folder = shared_dir / "data" / "redkitchen"
    if not folder.is_dir():
        pytest.skip("no recording of the kitchen")
    perception = build_perception(PerceptionConfig())
    result = []
    for number in range(240, 500, 20):
        path = folder / f"frame-{number:06d}"
        depth_mm = cv2.imread(f"{path}.depth.png", cv2.IMREAD_UNCHANGED)
        frame = RgbdFrame(
            number,
            cv2.cvtColor(cv2.imread(f"{path}.color.jpg"), cv2.COLOR_BGR2RGB),
            depth_mm.astype(np.float32) / 1000,
            INTRINSICS,
            np.loadtxt(f"{path}.pose.txt"),
        )
        result.append((frame, perception.perceive(frame)))
    return result


def names(frame_graph):
    return [frame_graph.vocabulary.classes[k] for k in frame_graph.class_probabilities.argmax(1)]


def test_the_objects_of_the_kitchen_are_found(perceived):
    counts = Counter(name for _, found in perceived for name in set(names(found.frame_graph)))
    for name in ("chair", "dining table", "cup", "tv"):
        assert counts[name] >= 3, counts
    # And little that is not there.
    there = {"chair", "dining table", "cup", "tv", "book", "sink", "bottle", "bowl", "remote"}
    invented = sum(n for name, n in counts.items() if name not in there)
    assert invented <= 0.1 * sum(counts.values()), counts


def test_the_mask_of_a_cup_excludes_the_table(perceived):
    checked = 0
    for frame, found in perceived:
        for row, name in enumerate(names(found.frame_graph)):
            if name != "cup":
                continue
            mask = (found.instances == row + 1) & (frame.depth_m > 0)
            if mask.sum() > 100:
                low, high = np.percentile(frame.depth_m[mask], [10, 90])
                assert high - low < 0.15
                checked += 1
    assert checked >= 5


def test_cups_are_on_the_table(perceived):
    counts = Counter()
    for _, found in perceived:
        graph = found.frame_graph
        called = names(graph)
        for (s, o), logits in zip(graph.relations.pairs, graph.relations.logits):
            if (called[s], called[o]) == ("cup", "dining table"):
                counts[graph.vocabulary.predicates[logits.argmax()]] += 1
    assert counts["on"] >= 3 and counts.most_common(1)[0][0] == "on", counts
