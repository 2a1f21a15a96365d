"""Where the poses of an evaluation come from, as plain values that travel to another process."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.poses.frames import track_poses
from deworldsg_ros.poses.perturbation import PoseNoise, perturb_poses
from deworldsg_ros.poses.trajectory import read_trajectory
from deworldsg_ros.recordings.folders.sequence import SequenceDataset, rotated_pose
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose
from deworldsg_ros.scene.errors import RefusedInput

Kind = Literal["ground-truth", "slam", "odometry", "perturbed"]
KINDS: tuple[Kind, ...] = ("ground-truth", "slam", "odometry", "perturbed")
# A drift of 2 % and 1 degree a metre with the tremble of a hand: worse than good SLAM.
PERTURBATION = PoseNoise(jitter_m=0.005, jitter_deg=0.2, drift_m_per_m=0.02, drift_deg_per_m=1.0)


@dataclass(frozen=True)
class PoseSource:
    """Poses of the data set, estimated ones, or the data set's made worse.

    Attributes:
        kind: ``ground-truth`` as the data set has them; ``slam`` of the frames' .slam.pose.txt;
            ``odometry`` of the images; ``worse``. All begin at the first true pose.
        noise: of ``worse``.
    """

    kind: Kind = "ground-truth"
    noise: PoseNoise = PERTURBATION

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise EvaluationError(f"--poses {self.kind}: wanted {', '.join(KINDS)}")


def repose(
    frames: Iterator[RgbdFrame],
    choice: PoseSource,
    source: Source,
    drops: Counter[str],
) -> Iterator[RgbdFrame]:
    """The frames with the chosen poses; those without one are left out and counted in `drops`.

    Raises:
        DeWorldSGError: where a trajectory cannot be read.
    """
    if choice.kind == "ground-truth":
        return frames
    if choice.kind == "perturbed":
        return perturb_poses(frames, choice.noise)
    first = next(frames, None)
    if first is None:
        return frames
    again = chain([first], frames)
    if choice.kind == "slam":
        if not isinstance(source, SequenceDataset):
            raise EvaluationError("--poses slam: this recording has no frame-NNNNNN.slam.pose.txt")
        return _of_slam(again, source, drops)

    def lost(refusal: RefusedInput) -> None:
        drops[refusal.reason] += 1

    return track_poses(again, first.T_world_camera, lost)


def _of_slam(
    frames: Iterator[RgbdFrame], dataset: SequenceDataset, drops: Counter[str]
) -> Iterator[RgbdFrame]:
    trajectory = read_trajectory(dataset.sequence, "slam")
    T_truth_slam = None
    for place, frame in enumerate(frames):
        number = dataset.frame_numbers[frame.stamp_ns]
        T_slam_camera = trajectory.at(frame.stamp_ns, number, place, 0)
        if T_slam_camera is None:
            drops["no_slam_pose"] += 1
            continue
        # Trackers see the images as they are stored.
        T_slam_camera = rotated_pose(T_slam_camera) if dataset.rotated else T_slam_camera
        if T_truth_slam is None:
            # Its world is where it began: that is put where the camera truly was.
            T_truth_slam = frame.T_world_camera @ invert_pose(T_slam_camera)
        yield replace(frame, T_world_camera=T_truth_slam @ T_slam_camera)
