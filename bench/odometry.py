"""Error and time of RGB-D odometry on a recording with true poses.

    python bench/odometry.py RECORDING [--max-frames N] [--then OTHER ...]

It compares three trajectories: by odometry from frame to frame, aligned with the map as each frame
came, and after the loops were closed. All begin at the first true pose.

With --then, the camera is carried from the recording to other places, one at a time: all loops
between both are false. One place more is the recording itself in a mirror: the same walls, floors
and things at other angles. A try is a frame that is lost, or a keyframe, and is compared with what
was seen in the first place.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from deworldsg_ros.poses.loops import LoopOdometry, closings_in_words
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import RgbdFrame, rotation_angle_deg
from deworldsg_ros.scene.errors import RefusedInput


def report(name: str, poses: Float64, true: Float64) -> None:
    """Print the errors of a trajectory (n, 4, 4)."""
    off_m = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
    turned = [rotation_angle_deg(a[:3, :3].T @ b[:3, :3]) for a, b in zip(poses, true)]
    print(
        f"{name:14}: {100 * off_m[-1]:.1f} cm and {turned[-1]:.2f} deg at the end; mean "
        f"{100 * off_m.mean():.1f} cm, maximum {100 * off_m.max():.1f} cm and {max(turned):.2f} deg"
    )


def mirrored(frames: Iterable[RgbdFrame]) -> Iterator[RgbdFrame]:
    """The frames in a mirror; their poses are not changed."""
    for frame in frames:
        camera = frame.intrinsics
        yield replace(
            frame,
            rgb=np.ascontiguousarray(frame.rgb[:, ::-1]),
            depth_m=np.ascontiguousarray(frame.depth_m[:, ::-1]),
            intrinsics=replace(camera, cx=camera.width - 1 - camera.cx),
        )


def false_loops(odometry: LoopOdometry, frames: Iterable[RgbdFrame]) -> tuple[int, int]:
    """Tries, and false loops, of a camera that is carried to another place.

    Args:
        odometry: of the first place; not changed.
        frames: of the other one.
    """
    odometry, tries = deepcopy(odometry), 0
    last_ns = odometry.keyframes_ns[-1]
    for number, frame in enumerate(frames, start=1):
        known, stamp_ns = len(odometry.keyframes_ns), last_ns + number * 10**8
        try:
            odometry.track(stamp_ns, frame.rgb, frame.depth_m, frame.intrinsics)
        except RefusedInput:
            tries += 1
            continue
        tries += len(odometry.keyframes_ns) > known
    return tries, sum(a <= last_ns < b for a, b in odometry.loops_ns)


def report_strangers(first: Path, others: list[Path], most: int) -> None:
    """Print the false loops between a recording and others."""
    odometry: LoopOdometry | None = None
    for frame in islice(open_recording(first).frames(), most):
        odometry = odometry or LoopOdometry(frame.T_world_camera)
        try:
            odometry.track(frame.stamp_ns, frame.rgb, frame.depth_m, frame.intrinsics)
        except RefusedInput:
            continue
    assert odometry is not None
    for other in [first, *others]:
        frames = islice(open_recording(other).frames(), most)
        tries, found = false_loops(odometry, mirrored(frames) if other == first else frames)
        name = "a mirror" if other == first else other
        print(f"{first}, then {name}: {tries} tries, {found} false loops", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--max-frames", type=int, default=0, help="0 = all")
    parser.add_argument("--then", type=Path, nargs="+", help="other places: count false loops")
    options = parser.parse_args()
    if options.then:
        report_strangers(options.recording, options.then, options.max_frames or sys.maxsize)
        return
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
