"""Error and time of RGB-D odometry on a recording with true poses.

    python bench/odometry.py RECORDING [--max-frames N]

It compares two methods: colour and depth, and depth alone (the fallback for OpenCV 4). Both process
each frame, one after the other, so the ratio of their times is paired.
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from deworldsg_ros.poses.odometry import RgbdOdometry
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose, rotation_angle_deg
from deworldsg_ros.scene.errors import RefusedInput

Pose = Any


class Tracked:
    """Estimated poses of one method, and the true poses."""

    def __init__(self, method: str, T_world_start: Pose) -> None:
        self.method = method
        self.odometry = RgbdOdometry(T_world_start, depth_only=method == "depth")
        self.pairs: list[tuple[Pose, Pose]] = []
        self.times_ms: list[float] = []

    def track(self, frame: RgbdFrame) -> None:
        """Track a frame."""
        start = time.perf_counter()
        try:
            T = self.odometry.track(frame.rgb, frame.depth_m, frame.intrinsics)
        except RefusedInput:
            return
        finally:
            self.times_ms.append(1e3 * (time.perf_counter() - start))
        self.pairs.append((frame.T_world_camera, T))

    def report(self) -> None:
        """Print errors and times."""
        steps = [
            invert_pose(invert_pose(a) @ b) @ (invert_pose(x) @ y)
            for (a, x), (b, y) in zip(self.pairs, self.pairs[1:])
        ]
        step_mm = 1e3 * np.array([np.linalg.norm(step[:3, 3]) for step in steps])
        rotation_deg = np.array([rotation_angle_deg(step[:3, :3]) for step in steps])
        true = np.array([a[:3, 3] for a, _ in self.pairs])
        off_m = np.array([np.linalg.norm(a[:3, 3] - x[:3, 3]) for a, x in self.pairs])
        path_m = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
        last, estimate = self.pairs[-1]
        print(
            f"{self.method:5}: step {np.median(step_mm):.2f} mm (p95 "
            f"{np.percentile(step_mm, 95):.2f}), {np.median(rotation_deg):.3f} deg; "
            f"drift "
            f"{off_m[-1]:.3f} m and {rotation_angle_deg(last[:3, :3].T @ estimate[:3, :3]):.2f} "
            f"deg after {path_m:.2f} m (maximum {off_m.max():.3f} m); "
            f"{np.median(self.times_ms):.0f} ms per frame; {self.odometry.lost} lost, "
            f"{self.odometry.restarts} restarts"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--max-frames", type=int, default=0, help="0 = all")
    options = parser.parse_args()
    recording = open_recording(options.recording)
    tracked: list[Tracked] = []
    count = 0
    for frame in islice(recording.frames(), options.max_frames or None):
        count += 1
        tracked = tracked or [Tracked(m, frame.T_world_camera) for m in ("rgbd", "depth")]
        for method in tracked:
            method.track(frame)
    print(f"{recording.name}, {count} frames")
    for method in tracked:
        method.report()
    a, b = (np.array(method.times_ms[1:]) for method in tracked)
    print(f"time of rgbd / depth, paired: {np.median(a / b):.2f}")


if __name__ == "__main__":
    main()
