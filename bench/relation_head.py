"""Accuracy of the geometric relation head on the annotated relations of rendered rooms.

    python bench/relation_head.py DATASET [--step 8] [--masks truth|segmenter]

Boxes and classes are recorded detections. Masks are perfect, or those of the segmenter. A pair
counts in a frame if it is annotated and both objects are detected.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from segmenter_iou import INTRINSICS, load

from deworldsg_ros.perception.backends.geometric import GeometricRelationHead
from deworldsg_ros.perception.backends.rgbd import RgbdSegmenter
from deworldsg_ros.perception.protocols import SegmentedObjects
from deworldsg_ros.perception.stage import instance_image
from deworldsg_ros.scene.camera import MaskPatch
from deworldsg_ros.scene.frame_graph import Relations
from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES

MAX_RELATIONS = 100
ALL_RELATIONS = 10_000


def best_predicates(
    relations: Relations, ids: list[int], predicates: tuple[str, ...]
) -> list[tuple[tuple[int, int], str]]:
    """Subject, object and most likely predicate of each pair."""
    return [
        ((ids[s], ids[o]), predicates[row.argmax()])
        for (s, o), row in zip(relations.pairs, relations.logits)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--step", type=int, default=8, help="use every N-th frame")
    parser.add_argument("--masks", choices=["truth", "segmenter"], default="truth", help="masks")
    parser.add_argument("--verbose", action="store_true", help="print each wrong predicate")
    arguments = parser.parse_args()
    head = GeometricRelationHead(REPLICA_SSG_PREDICATES)
    segmenter = RgbdSegmenter()
    for scene in sorted(arguments.dataset.glob("data/*")):
        truth = json.loads((scene / "gt.json").read_text())
        related = {(s, o): name for s, o, _, name in truth["relationships"]}
        correct: dict[str, list[bool]] = defaultdict(list)
        wrong: Counter[tuple[str, str]] = Counter()
        kept, kept_related, kept_correct = 0, 0, 0
        for path in sorted((scene / "sequence").glob("frame-*.color.jpg"))[:: arguments.step]:
            frame = load(path)
            text = path.with_name(path.name.replace("color.jpg", "frontend.json")).read_text()
            detections = json.loads(text)["detections"]
            ids = [d["gt_id"] for d in detections]
            scores = np.array([d["score"] for d in detections])
            if len(ids) < 2:
                continue
            if arguments.masks == "truth":
                patches = [MaskPatch(0, 0, mask) for mask in frame.masks]
            else:
                patches = segmenter.segment(frame.rgb, frame.depth_m, INTRINSICS, frame.boxes_xyxy)
            classes = np.array([d["gt_class"] for d in detections])
            instances = instance_image(patches, classes, scores, frame.depth_m.shape)
            pose = np.loadtxt(path.with_name(path.name.replace("color.jpg", "pose.txt")))
            up_camera = pose[:3, :3].T @ np.array([0.0, 0.0, 1.0])
            objects = SegmentedObjects(
                frame.names, scores, None, instances, frame.depth_m, INTRINSICS, up_camera
            )
            found = head.relate(objects, ALL_RELATIONS)
            predicted = dict(best_predicates(found, ids, head.predicates))
            for s in ids:
                for o in ids:
                    if (s, o) in related:
                        name = related[s, o]
                        best = predicted.get((s, o), "nothing")
                        correct[name].append(best == name)
                        if best != name:
                            wrong[name, best] += 1
                            if arguments.verbose:
                                pair = frame.names[ids.index(s)], frame.names[ids.index(o)]
                                print(path.stem, *pair, name, "->", best)
            found = head.relate(objects, MAX_RELATIONS)
            for pair, name in best_predicates(found, ids, head.predicates):
                kept += 1
                kept_related += pair in related
                kept_correct += related.get(pair) == name
        total = [ok for rows in correct.values() for ok in rows]
        print(
            f"{scene.name}: {np.mean(total):.3f} of {len(total)} related pairs correct "
            f"(mean over predicates {np.mean([np.mean(v) for v in correct.values()]):.3f}); of the "
            f"top {MAX_RELATIONS} per frame, {kept_related / max(kept, 1):.2f} are related pairs, "
            f"{kept_correct / max(kept, 1):.2f} with the right predicate"
        )
        for name, rows in sorted(correct.items(), key=lambda item: -len(item[1])):
            missed = ", ".join(f"{b} {n}" for (a, b), n in wrong.most_common() if a == name)
            print(f"  {name}: {np.mean(rows):.2f} of {len(rows)}; instead {missed or '-'}")


if __name__ == "__main__":
    main()
