"""Error and time of RGB-D odometry on a recording with true poses.

    python bench/odometry.py RECORDING [--max-frames N]

It compares three trajectories: by odometry from frame to frame, aligned with the map as each frame
came, and after the loops were closed. All begin at the first true pose.
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from deworldsg_ros.poses.loops import LoopOdometry, closings_in_words
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import rotation_angle_deg
from deworldsg_ros.scene.errors import RefusedInput


def report(name: str, poses: Float64, true: Float64) -> None:
    """Print the errors of a trajectory (n, 4, 4)."""
    off_m = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
    turned = [rotation_angle_deg(a[:3, :3].T @ b[:3, :3]) for a, b in zip(poses, true)]
    print(
        f"{name:14}: {100 * off_m[-1]:.1f} cm and {turned[-1]:.2f} deg at the end; mean "
        f"{100 * off_m.mean():.1f} cm, maximum {100 * off_m.max():.1f} cm and {max(turned):.2f} deg"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--max-frames", type=int, default=0, help="0 = all")
    options = parser.parse_args()
    recording = open_recording(options.recording)
    odometry: LoopOdometry | None = None
    stamps_ns, times_ms = list[int](), list[float]()
    true, direct, mapped = (list[Float64]() for _ in range(3))
    corrected = np.zeros((0, 4, 4))
    for frame in islice(recording.frames(), options.max_frames or None):
        odometry = odometry or LoopOdometry(frame.T_world_camera)
        start_s = time.process_time()
        try:
            T, closing = odometry.track(frame.stamp_ns, frame.rgb, frame.depth_m, frame.intrinsics)
        except RefusedInput:
            continue
        times_ms.append(1e3 * (time.process_time() - start_s))
        if closing is not None:
            corrected = closing.at(np.array(stamps_ns)) @ corrected
        corrected = np.append(corrected, T[None], axis=0)
        stamps_ns.append(frame.stamp_ns)
        true.append(frame.T_world_camera)
        direct.append(odometry.direct)
        mapped.append(T)
    assert odometry is not None
    path_m = np.linalg.norm(np.diff(np.array(true)[:, :3, 3], axis=0), axis=1).sum()
    tracking = odometry.odometry
    print(
        f"{recording.name}, {len(true)} frames, {path_m:.1f} m; {tracking.lost} frames lost, "
        f"{tracking.restarts} restarts; {closings_in_words(odometry.closed, odometry.correction_m)}"
    )
    for name, poses in (("frame to frame", direct), ("as it came", mapped)):
        report(name, np.array(poses), np.array(true))
    report("after loops", corrected, np.array(true))
    shares = ", ".join(f"{np.percentile(times_ms[1:], q):.0f}" for q in (50, 95, 100))
    print(f"CPU time of a frame: {shares} ms (median, 95 %, largest)")


if __name__ == "__main__":
    main()
