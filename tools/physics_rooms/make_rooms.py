#!/usr/bin/env python3
"""Make simulated rooms with physical truth, in the layout of ReplicaSSG with gt.json.

    pip install mujoco embreex numba numpy scipy opencv-python-headless
    python tools/physics_rooms/make_rooms.py OUT --rooms 24 --seed 0

README.md describes the files and the rules. The same seed on the same machine gives the same rooms.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import multiprocessing
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from physics_room.files import (
    PLY_NAME,
    K,
    SceneWriter,
    Seen,
    check_vocabulary,
    object_record,
    visible_boxes,
    write_annotations,
    write_ply,
)
from physics_room.layout import Room
from physics_room.render import Scene, assemble, render, shell
from physics_room.sensor import DepthSensor, draw_sensor, sense
from physics_room.shapes import Item, turn
from physics_room.simulate import Outcome, settled_room
from physics_room.truth import Judge, relation_rows
from physics_room.walk import plan

from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES, VISUAL_GENOME_CLASSES

RATE_HZ = 10
# Of 24 rooms: 16 to train, 4 to validate, 4 to test; more rooms go on in the same way.
SPLITS = ("train",) * 16 + ("validation",) * 4 + ("test",) * 4


def name_of(index: int) -> str:
    """Name of the scene of a room."""
    return f"phys_{index:03d}"


def vocabulary() -> dict[str, list[str]]:
    """The lists of ReplicaSSG's mapping file."""
    return {
        "VisualGenome_list": list(VISUAL_GENOME_CLASSES),
        "VisualGenome_rel": list(REPLICA_SSG_PREDICATES),
    }


def view_test(scene: Scene):
    """A function that tells which points (n, 3) a camera position sees."""

    def sees(eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        way = np.ascontiguousarray(points - eye, np.float32)
        origins = np.ascontiguousarray(np.broadcast_to(eye, way.shape), np.float32)
        hit = scene.embree.run(origins, way, query="INTERSECT", output=True)
        return (hit["primID"] < 0) | (hit["tfar"] > 1 - 0.08 / np.linalg.norm(way, axis=1))

    return sees


def write_frames(
    writer: SceneWriter,
    scene: Scene,
    poses: np.ndarray,
    sensor: DepthSensor,
    labels: dict[int, str],
    seed: list[int],
) -> Seen:
    """Render and write all frames; returns what was seen."""
    seen = Seen()
    rng = np.random.default_rng([*seed, 2])
    drift = np.convolve(rng.standard_normal(len(poses) + 40), np.hanning(41) / 6.5, "same")[20:-20]
    for index, pose in enumerate(poses):
        frame = render(scene, pose, float(1.1 * np.exp(0.08 * drift[index])), rng)
        depth_mm = sense(frame, sensor, rng)
        boxes = visible_boxes(frame.instances)
        seen.add(frame, pose, boxes)
        found = writer.detections(index, boxes, labels, rng)
        writer.frame(index, frame, depth_mm, pose, found, boxes)
    writer.info(len(poses))
    return seen


def make_room(root: Path, index: int, seed: int) -> dict[str, Any]:
    """Make one room and write all its files; returns its gt.json."""
    cv2.setNumThreads(1)
    room, outcome = settled_room(index, seed)
    rng = np.random.default_rng([seed, index, 1000])
    yaw = float(rng.uniform(-np.pi, np.pi))
    walls = shell(room.size, rng, len(room.items) + 1)
    everything: list[Item] = [*room.items, *walls]
    look_seed = int(rng.integers(1 << 30))
    flat = assemble(everything, room.size, 0.0, np.random.default_rng(look_seed))
    views = plan(room.items, room.size, view_test(flat), rng)
    scene = assemble(everything, room.size, yaw, np.random.default_rng(look_seed))
    spin = turn(yaw)
    poses = views.copy()
    poses[:, :3, :3] = spin @ views[:, :3, :3]
    poses[:, :3, 3] = views[:, :3, 3] @ spin.T
    sensor = draw_sensor(rng)
    writer = SceneWriter(root, name_of(index), vocabulary())
    labels = {i.number: i.label for i in everything}
    seen = write_frames(writer, scene, poses, sensor, labels, [seed, index])
    centroids = seen.centroids()
    objects = [object_record(item, spin, seen, centroids) for item in everything]
    truth = describe(room, objects, outcome, spin)
    truth |= {
        "scan": name_of(index),
        "seed": seed,
        "split": SPLITS[index % len(SPLITS)],
        "room_m": [round(s, 3) for s in room.size],
        "room_yaw_rad": round(yaw, 5),
        "theme": room.theme,
        "K": K,
        "frames": len(poses),
        "hz": RATE_HZ,
        "sensor": sensor.as_dict(),
    }
    write_ply(writer.folder / PLY_NAME, everything, spin)
    (writer.folder / "gt.json").write_text(json.dumps(truth))
    return truth


def describe(
    room: Room, objects: list[dict[str, Any]], outcome: Outcome, spin: np.ndarray
) -> dict[str, Any]:
    """Objects, relations and physics for gt.json."""
    visible = {o["id"] for o in objects if o["detectable"]}
    truth = Judge(room.items, outcome, visible).judge()
    numbers = {i.number for i in room.items}
    for entry in objects:
        entry |= {"parent": None, "parent_rel": None, "physics": None}
        parents = [
            (other, name) for (subject, other), name in truth.relations.items()
            if subject == entry["id"] and name in ("on", "in", "attached to")
        ]  # fmt: skip
        if parents:
            entry["parent"], entry["parent_rel"] = parents[0]
        record = truth.physics.get(entry["id"])
        if record:
            for support in record["supports"]:
                support["normal"] = [round(float(v), 3) for v in spin @ support["normal"]]
        entry["physics"] = record
    return {
        "objects": objects,
        "relationships": relation_rows(truth, numbers),
        "unclear": sorted([list(pair) for pair in truth.unclear]),
    }


def judge_again(root: Path, index: int, seed: int) -> dict[str, Any]:
    """Write gt.json anew with today's rules; the pictures stay."""
    path = root / "data" / name_of(index) / "gt.json"
    truth = json.loads(path.read_text())
    room, outcome = settled_room(index, seed)
    if [o["label"] for o in truth["objects"][: len(room.items)]] != [i.label for i in room.items]:
        raise ValueError(f"{path}: its objects are not those of this seed; make the room again")
    truth |= describe(room, truth["objects"], outcome, turn(truth["room_yaw_rad"]))
    path.write_text(json.dumps(truth))
    return truth


def _job(arguments: tuple[Path, int, int, bool]) -> tuple[str, str]:
    root, index, seed, truth_only = arguments
    started = time.process_time()
    truth = (judge_again if truth_only else make_room)(root, index, seed)
    seconds = time.process_time() - started
    line = (
        f"{name_of(index)} {truth['split']} {len(truth['objects'])} objects, "
        f"{len(truth['relationships'])} relations, {truth['frames']} frames, {seconds:.0f} s CPU"
    )
    return name_of(index), line


def parse_arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description="Make simulated rooms with physical truth.")
    parser.add_argument("out", type=Path, help="folder of the data set")
    parser.add_argument("--rooms", type=int, default=24, help="number of rooms")
    parser.add_argument("--first", type=int, default=0, help="number of the first room")
    parser.add_argument("--seed", type=int, default=0, help="seed of all rooms")
    parser.add_argument("--jobs", type=int, default=1, help="rooms made at the same time")
    parser.add_argument("--truth-only", action="store_true", help="only judge the relations anew")
    arguments = parser.parse_args()
    for module in ("mujoco", "embreex"):
        if importlib.util.find_spec(module) is None:
            parser.error(f"{module} is not installed; run: pip install {module}")
    return arguments


def main() -> int:
    """Make the rooms; READY lists those that are complete."""
    args = parse_arguments()
    words = vocabulary()
    check_vocabulary(words)
    args.out.mkdir(parents=True, exist_ok=True)
    indices = range(args.first, args.first + args.rooms)
    splits: dict[str, list[str]] = {"train": [], "validation": [], "test": []}
    for index in range(indices.stop):
        splits[SPLITS[index % len(SPLITS)]].append(name_of(index))
    jobs = [(args.out, index, args.seed, args.truth_only) for index in indices]
    with multiprocessing.get_context("spawn").Pool(args.jobs) as pool:
        for name, line in pool.imap_unordered(_job, jobs):
            write_annotations(args.out, words, splits)
            with (args.out / "READY").open("a") as ready:
                ready.write(f"{name}\n")
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
