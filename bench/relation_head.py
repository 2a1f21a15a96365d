"""How often the geometric relation head agrees with the relations of rooms whose truth is known.

    python bench/relation_head.py DATASET [--step 8] [--masks truth|segmenter]

Boxes and classes are the front end's; masks are perfect or the segmenter's. A pair counts in a
frame when it is related in the truth and both ends were detected.
"""

from __future__ import annotations

import argparse
import functools
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
from deworldsg_ros.perception.label_image import label_image
from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.scene.frame_graph import Relations
from deworldsg_ros.scene.vocabularies import REPLICA_SSG_PREDICATES

TOP_RELATIONS = 10


def told(
    relations: Relations, ids: list[int], predicates: tuple[str, ...]
) -> list[tuple[tuple[int, int], str]]:
    """Subject, object and likeliest predicate of each pair."""
    return [
        ((ids[s], ids[o]), predicates[row.argmax()])
        for (s, o), row in zip(relations.pairs, relations.logits)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--step", type=int, default=8, help="every n-th frame")
    parser.add_argument("--masks", choices=["truth", "segmenter"], default="truth")
    parser.add_argument("--no-pose", action="store_true", help="estimate up from the depth")
    parser.add_argument("--verbose", action="store_true", help="name each disagreement")
    arguments = parser.parse_args()
    head = GeometricRelationHead(REPLICA_SSG_PREDICATES)
    segmenter = RgbdSegmenter()
    for scene in sorted(arguments.dataset.glob("data/*")):
        truth = json.loads((scene / "gt.json").read_text())
        related = {(s, o): name for s, o, _, name in truth["relationships"]}
        right: dict[str, list[bool]] = defaultdict(list)
        wrong: Counter[tuple[str, str]] = Counter()
        kept, kept_related, kept_right = 0, 0, 0
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
            instances = label_image(patches, classes, scores, frame.depth_m.shape)
            pose = np.loadtxt(path.with_name(path.name.replace("color.jpg", "pose.txt")))
            up = None if arguments.no_pose else pose[:3, :3].T @ np.array([0.0, 0.0, 1.0])

            relate = functools.partial(
                head.relate,
                frame.depth_m,
                INTRINSICS,
                frame.boxes_xyxy,
                frame.names,
                scores,
                instances,
                up,
            )
            said = dict(told(relate(10_000), ids, head.predicates))
            for s in ids:
                for o in ids:
                    if (s, o) in related:
                        name = related[s, o]
                        answer = said.get((s, o), "nothing")
                        right[name].append(answer == name)
                        if answer != name:
                            wrong[name, answer] += 1
                            if arguments.verbose:
                                pair = frame.names[ids.index(s)], frame.names[ids.index(o)]
                                print(path.stem, *pair, name, "->", answer)
            for pair, name in told(relate(TOP_RELATIONS), ids, head.predicates):
                kept += 1
                kept_related += pair in related
                kept_right += related.get(pair) == name
        total = [ok for rows in right.values() for ok in rows]
        print(
            f"{scene.name}: {np.mean(total):.3f} of {len(total)} related pairs right "
            f"(mean over predicates {np.mean([np.mean(v) for v in right.values()]):.3f}); of the "
            f"top {TOP_RELATIONS} a frame, {kept_related / max(kept, 1):.2f} are related pairs, "
            f"{kept_right / max(kept, 1):.2f} with the right predicate"
        )
        for name, rows in sorted(right.items(), key=lambda item: -len(item[1])):
            missed = ", ".join(f"{b} {n}" for (a, b), n in wrong.most_common() if a == name)
            print(f"  {name}: {np.mean(rows):.2f} of {len(rows)}; otherwise {missed or '-'}")


if __name__ == "__main__":
    main()
