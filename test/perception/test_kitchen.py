"""The whole stage on real Kinect frames of a kitchen."""

from collections import Counter

import cv2
import numpy as np
import pytest

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception import build_perception
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame

INTRINSICS = Intrinsics(528.408586, 528.408586, 320.3179, 236.720192, 640, 480)


def frame(path):
    rgb = cv2.cvtColor(cv2.imread(f"{path}.color.jpg"), cv2.COLOR_BGR2RGB)
    depth_m = cv2.imread(f"{path}.depth.png", cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
    return RgbdFrame(0, rgb, depth_m, INTRINSICS, np.loadtxt(f"{path}.pose.txt"))


def test_the_objects_of_the_kitchen_and_cups_on_the_table_are_found(shared_dir):
    folder = shared_dir / "data" / "redkitchen"
    if not folder.is_dir():
        pytest.skip("no recording of the kitchen")
    perception = build_perception(PerceptionConfig())
    frames_with, cups, predicates = Counter(), 0, Counter()
    for number in range(240, 500, 20):
        seen = frame(folder / f"frame-{number:06d}")
        found = perception.perceive(seen)
        graph = found.frame_graph
        names = [graph.vocabulary.classes[k] for k in graph.class_probabilities.argmax(1)]
        frames_with.update(set(names))
        for row, name in enumerate(names):
            mask = (found.instances == row + 1) & (seen.depth_m > 0)
            # The mask of a cup excludes the table.
            if name == "cup" and mask.sum() > 100:
                low, high = np.percentile(seen.depth_m[mask], [10, 90])
                assert high - low < 0.15
                cups += 1
        for (s, o), logits in zip(graph.relations.pairs, graph.relations.logits):
            if (names[s], names[o]) == ("cup", "dining table"):
                predicates[graph.vocabulary.predicates[logits.argmax()]] += 1
    for name in ("chair", "dining table", "cup", "tv"):
        assert frames_with[name] >= 3, frames_with
    # And little that is not there.
    there = {"chair", "dining table", "cup", "tv", "book", "sink", "bottle", "bowl", "remote"}
    invented = sum(count for name, count in frames_with.items() if name not in there)
    assert invented <= 0.1 * frames_with.total(), frames_with
    assert cups >= 5
    assert predicates["on"] >= 3 and predicates.most_common(1)[0][0] == "on", predicates
