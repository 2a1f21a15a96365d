#!/usr/bin/env python3
"""Render the demonstration recording of a furnished room, with its ground truth.

    pip install embreex numba numpy scipy opencv-python-headless rosbags
    python tools/demo_room/make_recording.py

The command writes `demo_room/` (rosbag2, MCAP), `demo_room.gt.json` and `demo_room.instances.npz`
into `bags/`. It replaces the recording there. The same seed on the same machine gives the same
recording.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import lzma
import multiprocessing
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))

from scene_room.camera_path import RATE_HZ, STILL_S, camera_poses
from scene_room.ground_truth import (
    SeenSurface,
    camera_record,
    describe_objects,
    find_relations,
)
from scene_room.lighting import bake
from scene_room.materials import build_materials
from scene_room.recording import START_NS, RecordingWriter, depth_png
from scene_room.render import render
from scene_room.room import build_room
from scene_room.scene import Scene, assemble
from scene_room.sensor import DepthNoise, expose, jpeg, sense_depth

BAGS = Path(__file__).resolve().parents[2] / "bags"


@dataclass(frozen=True)
class Encoded:
    """One encoded frame, and its instances and exact depth for the ground truth."""

    picture_bgr: NDArray[np.uint8]
    jpeg: bytes
    depth_png: bytes
    instances: NDArray[np.uint16]
    clean_depth_m: NDArray[np.float32]


@dataclass(frozen=True)
class Renderer:
    """The scene, light, camera path and exposure of all frames."""

    scene: Scene
    light: NDArray[np.float32]
    poses: NDArray[np.float64]
    gains: NDArray[np.float64]
    seed: int
    jpeg_quality: int

    def render(self, index: int) -> Encoded:
        """Render frame `index` and add noise. The noise depends only on the seed and the index."""
        rng = np.random.default_rng([self.seed, index])
        frame = render(self.scene, self.light, self.poses[index], rng)
        picture = expose(frame.radiance, float(self.gains[index]), rng)
        depth_mm = sense_depth(frame, DepthNoise(), rng)
        return Encoded(
            picture,
            jpeg(picture, self.jpeg_quality),
            depth_png(depth_mm),
            frame.instances,
            frame.depth_m,
        )


# The child processes of the pool inherit it.
_renderer: Renderer | None = None


def _render(index: int) -> Encoded:
    assert _renderer is not None
    return _renderer.render(index)


def exposure_gains(count: int, seed: int) -> NDArray[np.float64]:
    """Factor (count,) of the automatic exposure, which varies slowly by about ±6 %."""
    steps = np.random.default_rng([seed, 99]).normal(size=count)
    slow = np.convolve(steps, np.hanning(41), mode="same")
    return 1.05 * np.exp(0.035 * slow / slow.std())


def pack_instances(path: Path, instances: NDArray[np.uint8]) -> None:
    """Save all instance images without loss; bags/README.md shows how to read them."""
    packed = lzma.compress(instances.tobytes(), preset=6)
    shape = np.array(instances.shape)
    np.savez(path, lzma=np.frombuffer(packed, np.uint8), shape=shape)


def parse_arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description="Render the demonstration recording.")
    parser.add_argument("--out", type=Path, default=BAGS, help="output folder (bags/)")
    parser.add_argument("--name", default="demo_room", help="name of the recording")
    parser.add_argument("--seed", type=int, default=7, help="seed of the room and all noise")
    parser.add_argument("--rays", type=int, default=96, help="rays per vertex for indirect light")
    parser.add_argument("--jpeg-quality", type=int, default=75, help="0 to 100")
    parser.add_argument("--jobs", type=int, default=2, help="number of render processes")
    parser.add_argument("--only", help="only save pictures of these frames, as in 0,60,120")
    parser.add_argument("--pictures", type=Path, help="folder for PNG pictures of the frames")
    parser.add_argument("--masks", type=Path, help="folder for uint16 PNG instance masks")
    arguments = parser.parse_args()
    if importlib.util.find_spec("embreex") is None:
        parser.error("embreex, which casts the rays, is not installed; run: pip install embreex")
    return arguments


def main() -> int:
    """Build the room, compute its light, render the frames and write the files."""
    global _renderer
    args = parse_arguments()
    started = time.monotonic()
    cv2.setNumThreads(1)
    objects = build_room(args.seed)
    scene = assemble(objects, build_materials(args.seed))
    print(
        f"{len(objects)} objects, {len(scene.faces)} triangles; computing the light …", flush=True
    )
    light = bake(scene, args.seed, args.rays)
    poses = camera_poses(args.seed)
    gains = exposure_gains(len(poses), args.seed)
    _renderer = Renderer(scene, light, poses, gains, args.seed, args.jpeg_quality)
    print(f"light ready after {time.monotonic() - started:.0f} s", flush=True)
    for folder in (args.pictures, args.masks):
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
    if args.only:
        for index in (int(i) for i in args.only.split(",")):
            path = (args.pictures or Path()) / f"{index:06d}.png"
            cv2.imwrite(str(path), _render(index).picture_bgr)
        return 0

    folder = args.out / args.name
    if folder.exists():
        shutil.rmtree(folder)
    seen = SeenSurface()
    labels = np.zeros((len(poses), *scene_shape()), np.uint8)
    # fork, because the child processes inherit the scene; spawn would build it again.
    pool = multiprocessing.get_context("fork").Pool(args.jobs)
    with pool, RecordingWriter(folder) as writer:
        for index, frame in enumerate(pool.imap(_render, range(len(poses)))):
            writer.write(index, frame.jpeg, frame.depth_png, poses[index])
            seen.add(frame.instances, frame.clean_depth_m, poses[index])
            labels[index] = frame.instances
            if args.pictures:
                cv2.imwrite(str(args.pictures / f"{index:06d}.png"), frame.picture_bgr)
            if args.masks:
                cv2.imwrite(str(args.masks / f"{index:06d}.png"), frame.instances)
            print(f"\rframe {index + 1}/{len(poses)}", end="", flush=True)
    print()
    pack_instances(args.out / f"{args.name}.instances.npz", labels)
    truth = {
        "recording": args.name,
        "synthetic": True,
        "seed": args.seed,
        "frames": len(poses),
        "rate_hz": RATE_HZ,
        "first_stamp_ns": str(START_NS),
        "world_frame": "z up, floor z = 0, metres",
        "standstill_s": list(STILL_S),
        "camera": camera_record(),
        "depth_noise": DepthNoise().as_dict(),
        "objects": describe_objects(objects, seen),
        "relations": find_relations(objects),
    }
    path = args.out / f"{args.name}.gt.json"
    path.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    size = sum(p.stat().st_size for p in folder.iterdir()) / 1e6
    print(f"{folder}: {len(poses)} frames, {size:.1f} MB, {time.monotonic() - started:.0f} s")
    return 0


def scene_shape() -> tuple[int, int]:
    """Rows and columns of a frame."""
    camera = camera_record()
    return int(camera["height"]), int(camera["width"])


if __name__ == "__main__":
    raise SystemExit(main())
