"""Sources of the camera poses of an evaluation, as picklable values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal

from deworldsg_ros.poses.odometry import track_poses
from deworldsg_ros.poses.trajectory import PoseNoise, perturb_poses, read_trajectory
from deworldsg_ros.recordings.folders.sequence import SequenceDataset, rotated_pose
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose
from deworldsg_ros.scene.errors import EvaluationError, RefusedInput

Kind = Literal["ground-truth", "slam", "odometry", "perturbed"]
KINDS: tuple[Kind, ...] = ("ground-truth", "slam", "odometry", "perturbed")
# Drift of 2 % and 1 degree per metre, and jitter of a hand-held camera: worse than good SLAM.
PERTURBATION = PoseNoise(jitter_m=0.005, jitter_deg=0.2, drift_m_per_m=0.02, drift_deg_per_m=1.0)


@dataclass(frozen=True)
class PoseSource:
    """A source of poses. All sources start at the first ground-truth pose.

    Attributes:
        kind: ``ground-truth`` of the data set, ``slam`` from the .slam.pose.txt of the frames,
            ``odometry`` from the images, or ``perturbed`` ground truth.
        noise: noise of ``perturbed``.

    Raises:
        EvaluationError: an unknown kind.
    """

    kind: Kind = "ground-truth"
    noise: PoseNoise = PERTURBATION

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise EvaluationError(f"--poses {self.kind}: expected {', '.join(KINDS)}")


def repose(
    frames: Iterator[RgbdFrame],
    poses: PoseSource,
    source: Source,
    drops: Counter[str],
) -> Iterator[RgbdFrame]:
    """The frames with the chosen poses. Frames without a pose are dropped and counted in `drops`.

    Raises:
        DeWorldSGError: a trajectory cannot be read.
    """
    if poses.kind == "ground-truth":
        return frames
    if poses.kind == "perturbed":
        return perturb_poses(frames, poses.noise)
    first = next(frames, None)
    if first is None:
        return frames
    again = chain([first], frames)
    if poses.kind == "slam":
        if not isinstance(source, SequenceDataset):
            raise EvaluationError(
                "--poses slam: the recording has no frame-NNNNNN.slam.pose.txt; use other poses"
            )
        return _of_slam(again, source, drops)

    def lost(refusal: RefusedInput) -> None:
        drops[refusal.reason] += 1

    return track_poses(again, first.T_world_camera, lost)


def _of_slam(
    frames: Iterator[RgbdFrame], dataset: SequenceDataset, drops: Counter[str]
) -> Iterator[RgbdFrame]:
    trajectory = read_trajectory(dataset.sequence, "slam")
    T_truth_slam = None
    for index, frame in enumerate(frames):
        number = dataset.frame_numbers[frame.stamp_ns]
        T_slam_camera = trajectory.at(frame.stamp_ns, number, index, 0)
        if T_slam_camera is None:
            drops["no_slam_pose"] += 1
            continue
        # Trackers process the images as stored; `rotated` data sets rotate them when they are read.
        T_slam_camera = rotated_pose(T_slam_camera) if dataset.rotated else T_slam_camera
        if T_truth_slam is None:
            # The SLAM world starts at its first camera: align that pose with the ground truth.
            T_truth_slam = frame.T_world_camera @ invert_pose(T_slam_camera)
        yield replace(frame, T_world_camera=T_truth_slam @ T_slam_camera)
