"""Replace the poses of a recording: by a trajectory file, by odometry, or by perturbed poses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from deworldsg_ros.config import Config
from deworldsg_ros.poses.loops import OnRefusal, track_poses
from deworldsg_ros.poses.odometry import ODOMETRY_FRAME
from deworldsg_ros.poses.trajectory import PoseNoise, Trajectory, perturb_poses, read_trajectory
from deworldsg_ros.recordings.folders.sequence import rotated_pose
from deworldsg_ros.recordings.recording import Recording
from deworldsg_ros.recordings.source import (
    POSE_STAMPED,
    RawRoleMessage,
    Role,
    RoleMessage,
    Source,
    UsedTopic,
    pose_stamped_from_matrix,
    serialize,
)
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.streams.poses import JumpGate, pose_from_message

# World frame of a trajectory if the recording has no poses.
TRAJECTORY_FRAME = "world"


@dataclass(frozen=True)
class PoseChoice:
    """Source of the camera poses.

    Attributes:
        trajectory: file or folder of poses; None = the recording's own.
        trajectory_format: tum, kitti, 3rscan, slam or auto.
        odometry: whether odometry estimates the poses from the images; it starts at the recording's
            first pose, if there is one.
        noise: perturbation of the poses.

    Raises:
        ConfigurationError: for both a trajectory and odometry.
    """

    trajectory: Path | None = None
    trajectory_format: str = "auto"
    odometry: bool = False
    noise: PoseNoise = PoseNoise()

    def __post_init__(self) -> None:
        if self.trajectory is not None and self.odometry:
            raise ConfigurationError(
                "poses from a trajectory and from odometry: expected only one of them"
            )

    @property
    def need_poses(self) -> bool:
        """Whether the recording's own poses are used."""
        return self.trajectory is None and not self.odometry


def choose_poses(source: Source, choice: PoseChoice, config: Config) -> Source:
    """The source with the poses of a trajectory, or without poses for odometry.

    `posed_frames` adds odometry and noise.

    Raises:
        TrajectoryError: for a trajectory that cannot be read.
    """
    if choice.trajectory is not None:
        trajectory = read_trajectory(choice.trajectory, choice.trajectory_format)
        slop_s = config.inputs.pose_slop_s
        return TrajectorySource(source, trajectory, slop_s, choice.trajectory.name)
    if choice.odometry:
        return UnposedSource(source, config.inputs.world_frame or ODOMETRY_FRAME)
    return source


def posed_frames(
    recording: Recording, choice: PoseChoice, on_refusal: OnRefusal
) -> Iterator[RgbdFrame]:
    """Frames of a recording over `choose_poses`, with odometry and noise as chosen.

    Args:
        recording: its source comes from `choose_poses`.
        choice: source of the poses.
        on_refusal: called for each frame that odometry or the jump gate refuses.
    """
    frames = recording.frames()
    if isinstance(recording.source, UnposedSource):
        frames = _tracked(frames, recording.source, on_refusal)
    if choice.noise != PoseNoise():
        frames = perturb_poses(frames, choice.noise)
        frames = gate_jumps(frames, on_refusal)
    return frames


def gate_jumps(frames: Iterable[RgbdFrame], on_refusal: OnRefusal) -> Iterator[RgbdFrame]:
    """The frames whose camera did not jump (`JumpGate`)."""
    gate = JumpGate()
    for frame in frames:
        try:
            gate.check(frame.T_world_camera, frame.stamp_ns)
        except RefusedInput as refusal:
            on_refusal(refusal)
            continue
        yield frame


def _tracked(
    frames: Iterator[RgbdFrame], source: UnposedSource, on_refusal: OnRefusal
) -> Iterator[RgbdFrame]:
    for first in frames:  # reading a frame sets source.T_first
        yield from track_poses(chain([first], frames), source.T_first, on_refusal)


class PosedSource(ABC):
    """A `Source` with replaced poses: one before each RGB image, with the stamp of the image.

    An RGB image without a pose is left out and counted as ``no_pose``.

    Args:
        source: the recording; it may be opened with ``need_poses=False``.
        topic: name of the origin of the poses.

    Attributes:
        original: the recording.
        T_first: the recording's own pose (4, 4) at its first RGB image; None if it has none.
    """

    def __init__(self, source: Source, topic: str) -> None:
        self.original = source
        self._frame_id = ""
        self._T_recorded: Float64 | None = None
        self.T_first: Float64 | None = None
        self.name = source.name
        self.frame_count = source.frame_count
        self.drops = source.drops
        self.losses = source.losses
        self.topics = {
            **source.topics,
            Role.POSE: UsedTopic(topic, POSE_STAMPED, source.frame_count),
        }

    @abstractmethod
    def _pose_at(self, stamp_ns: int, index: int) -> Float64 | None:
        """The pose (4, 4) of the index-th RGB image; None if there is none."""

    @property
    def kind(self) -> str:
        """Kind of the recording."""
        return self.original.kind

    def messages(self) -> Iterator[RoleMessage]:
        """Messages in order; the recording's own poses give only the world frame and `T_first`."""
        index = -1
        for item in self.original.messages():
            if item.role is Role.POSE:
                self._note_recorded(item)
                continue
            if item.role is Role.RGB:
                index += 1
                if index == 0:
                    self.T_first = self._T_recorded
                T = self._pose_at(item.stamp_ns, index)
                if T is None:
                    self.drops["no_pose"] += 1
                    continue
                frame_id = self._frame_id or TRAJECTORY_FRAME
                yield pose_stamped_from_matrix(item.stamp_ns, frame_id, T)
            yield item

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """The same messages, serialized."""
        return map(serialize, self.messages())

    def close(self) -> None:
        """Close the files."""
        self.original.close()

    def _note_recorded(self, item: RoleMessage) -> None:
        try:
            T, frame_id = pose_from_message(item.message)
        except RefusedInput:  # the pose itself is not used
            return
        # The first world frame stays.
        self._frame_id = self._frame_id or frame_id
        self._T_recorded = T


class TrajectorySource(PosedSource):
    """A recording with the poses of a trajectory.

    The trajectory contains the poses of the images as stored: if a data set rotates its images, the
    poses are rotated too.

    Args:
        source: the recording.
        trajectory: poses of its colour camera.
        slop_s: maximum time between an image and the poses that are used for it, seconds.
        topic: name of the trajectory.
    """

    def __init__(self, source: Source, trajectory: Trajectory, slop_s: float, topic: str) -> None:
        super().__init__(source, topic)
        self._trajectory = trajectory
        self._slop_ns = round(slop_s * 1e9)
        self._rotated = bool(getattr(source, "rotated", False))
        self._numbers: dict[int, int] = getattr(source, "frame_numbers", {})

    def _pose_at(self, stamp_ns: int, index: int) -> Float64 | None:
        number = self._numbers.get(stamp_ns, index)
        T = self._trajectory.at(stamp_ns, number, index, self._slop_ns)
        return rotated_pose(T) if T is not None and self._rotated else T


class UnposedSource(PosedSource):
    """A recording whose poses are all the identity; odometry replaces them in `posed_frames`.

    Args:
        source: the recording.
        frame_id: world frame if the recording has no poses.
    """

    def __init__(self, source: Source, frame_id: str) -> None:
        super().__init__(source, "odometry")
        self._default_frame_id = frame_id

    def _pose_at(self, stamp_ns: int, index: int) -> Float64:
        self._frame_id = self._frame_id or self._default_frame_id
        return np.eye(4)
