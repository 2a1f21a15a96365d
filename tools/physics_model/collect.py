#!/usr/bin/env python3
"""Run the pipeline with true boxes on rooms with ground truth, and keep each graph as a map.

    python tools/physics_model/collect.py ROOT OUT [SCENE ...]

ROOT has the layout of rendered rooms (tools/physics_rooms). OUT/SCENE.npz is a map file with
surfaces, classes and votes; tools/physics_model/train.py reads it.
"""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path

import msgspec

from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.front_ends import FrontEndChoice, build_front_end
from deworldsg_ros.evaluation.recorded_room import open_annotations
from deworldsg_ros.map_file import write_map
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.recording import Recording, open_source


def collect(
    annotations: Annotations, scene: str, out: Path, choice: FrontEndChoice, every: int = 1
) -> Path:
    """Run one scene, of which every n-th frame, and write its map; returns its path."""
    source = open_source(annotations.scan_folder(scene))
    config = Config()
    config = msgspec.structs.replace(
        config, perception=msgspec.structs.replace(config.perception, max_relations=1000)
    )
    pipeline = Pipeline(config, build_front_end(choice, annotations, scene, source, config))
    for frame in islice(Recording(source).frames(), 0, None, every):
        pipeline.process(frame)
    assert pipeline.builder is not None
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{scene}.npz"
    write_map(pipeline.builder, path)
    return path


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--layout", default="replica")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    annotations = open_annotations(arguments.root, arguments.layout)
    for scene in arguments.scenes or annotations.scans():
        choice = FrontEndChoice("boxes", seed=arguments.seed)
        print(collect(annotations, scene, arguments.out, choice), flush=True)


if __name__ == "__main__":
    main()
