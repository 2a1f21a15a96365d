"""Folders with a few files per frame: frame-NNNNNN.color.jpg, .pose.txt and so on.

A frame with a missing file, an invalid pose or an unreadable image is left out and counted.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

import numpy as np

from deworldsg_ros.base.words import MAX_STAMP_S
from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.folders.dataset import CAMERA_FRAME, WORLD_FRAME, Dataset, read_text
from deworldsg_ros.recordings.source import RawRoleMessage, Role, RoleMessage, UsedTopic, serialize
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import (
    Intrinsics,
    check_pose,
    pose_from_quaternion,
    quaternion_from_rotation,
)
from deworldsg_ros.scene.errors import RecordingError, RefusedInput
from deworldsg_ros.streams.poses import unlikely_motion

# Stamp of frame 0: many programs read a ROS time of zero as "unset".
FIRST_STAMP_NS = 10**9
# A 4x4 matrix has a few hundred.
MAX_POSE_BYTES = 65_536
# Single pictures have more steps than this that are too wide for video.
WIDE_FRACTION = 0.2
COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(?:jpg|jpeg|png)\Z")


class FrameFiles(Dataset):
    """A data set of numbered frames, each in its own files.

    Attributes:
        intrinsics: of the images in the messages.
        depth_suffix: ending of the depth files.
        pose_suffix: ending of the pose files.
        frame_numbers: number in the file names of each frame, by its stamp in nanoseconds.
    """

    intrinsics: Intrinsics
    depth_suffix: str
    pose_suffix: ClassVar[str] = ".pose.txt"

    def _set_frames(
        self, colors: dict[int, Path], stamps_ns: list[int], camera_info_name: str
    ) -> None:
        """Set the frames.

        Args:
            colors: colour image of each frame, by its number.
            stamps_ns: stamp of each of them.
            camera_info_name: origin of the intrinsics, e.g. a file name.
        """
        if stamps_ns and max(stamps_ns) >= MAX_STAMP_S * 10**9:
            raise RecordingError(
                f"{self.path}: the stamp of frame {max(colors)} is {max(stamps_ns) // 10**9} s: "
                "expected less than 2^31 s"
            )
        self._colors = colors
        self.frame_numbers = dict(zip(stamps_ns, colors))
        self.frame_count = len(colors)
        first = next(iter(colors.values()))
        self.topics = {
            role: UsedTopic(name, msgtype, self.frame_count)
            for role, name, msgtype in (
                (Role.RGB, f"frame-*.color{first.suffix}", ros.COMPRESSED_IMAGE),
                (Role.DEPTH, f"frame-*{self.depth_suffix}", ros.COMPRESSED_IMAGE),
                (Role.CAMERA_INFO, camera_info_name, ros.CAMERA_INFO),
                (Role.POSE, f"frame-*{self.pose_suffix}", ros.POSE_STAMPED),
            )
        }

    @abstractmethod
    def _images(self, color_path: Path, depth_path: Path, stored: bool) -> tuple[bytes, str, bytes]:
        """Colour image file, its format (jpeg or png), and depth as 16-bit PNG in millimetres.

        Args:
            color_path: of the frame.
            depth_path: of the frame.
            stored: whether PNG files that are encoded here stay uncompressed.

        Raises:
            RecordingError: for a file that cannot be read.
        """

    def are_sparse(self) -> bool:
        """Whether the frames are pictures rather than video: they have no stamps, and at the
        assumed rate more than `WIDE_FRACTION` of the steps are faster than a camera moves.
        """
        if self.options.rate_hz or not self.options.poses_needed:
            return False
        before, wide = None, 0
        for stamp_ns, number in self.frame_numbers.items():
            with suppress(RefusedInput):
                now = stamp_ns, read_pose(self._beside(number, self.pose_suffix))
                wide += before is not None and unlikely_motion(before, now) != ""
                before = now
        if wide <= WIDE_FRACTION * self.frame_count:
            return False
        self.losses.append(
            f"{wide} of {self.frame_count} steps are too wide for video of the assumed rate: the "
            "frames count as single pictures; --rate says when they were taken, where things move"
        )
        return True

    def _beside(self, number: int, suffix: str) -> Path:
        color_path = self._colors[number]
        return color_path.with_name(color_path.name.split(".")[0] + suffix)

    def _camera_pose(self, T_world_file: Float64) -> Float64:
        """Pose (4, 4) of the colour camera of the messages, from the pose of the file."""
        return T_world_file

    def messages(self) -> Iterator[RoleMessage]:
        """camera_info, pose, depth and RGB of each frame; incomplete frames are left out."""
        # Uncompressed: these images are decoded at once, and compression is half of the time.
        return self._messages(stored=True)

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """The same messages, serialized; their images are compressed."""
        return map(serialize, self._messages(stored=False))

    def _messages(self, *, stored: bool) -> Iterator[RoleMessage]:
        for stamp_ns, number in self.frame_numbers.items():
            color_path = self._colors[number]
            depth_path = self._beside(number, self.depth_suffix)
            pose_path = self._beside(number, self.pose_suffix)
            needed = (depth_path, pose_path) if self.options.poses_needed else (depth_path,)
            missing = next((file for file in needed if not file.exists()), None)
            if missing is not None:
                self.drops["missing_file"] += 1
                self.losses.append(f"{missing.name} is missing: its frame is left out")
                continue
            pose = []
            try:
                T = self._camera_pose(read_pose(pose_path))
                pose = [ros.pose_stamped_from_matrix(stamp_ns, WORLD_FRAME, T)]
            except RefusedInput as refusal:
                if self.options.poses_needed:
                    self.drops[refusal.reason] += 1
                    continue
            try:
                color, color_format, depth = self._images(color_path, depth_path, stored)
            except RecordingError as error:
                self.drops["decode_failed"] += 1
                self.losses.append(f"{error}: its frame is left out")
                continue
            yield ros.camera_info(stamp_ns, CAMERA_FRAME, self.intrinsics)
            yield from pose
            yield ros.compressed_depth(stamp_ns, CAMERA_FRAME, depth)
            yield ros.compressed_image(stamp_ns, CAMERA_FRAME, color, color_format)


def color_files(folder: Path) -> dict[int, Path]:
    """Colour images of a folder by the number in their names, sorted by name."""
    return {
        int(match[1]): file
        for file in sorted(folder.iterdir())
        if (match := COLOR_NAME.match(file.name))
    }


def read_pose(path: Path) -> Float64:
    """The (4, 4) matrix of a pose file; raises RefusedInput ``invalid_pose``."""
    try:
        T = np.array(read_text(path, MAX_POSE_BYTES).split(), np.float64).reshape(4, 4)
    except (RecordingError, ValueError) as error:
        raise RefusedInput("invalid_pose", f"{path}: {error}; expected a 4x4 matrix") from error
    check_pose(T)
    # The printed decimals are only nearly a rotation. The message has a quaternion, so use it here.
    return pose_from_quaternion(T[:3, 3], quaternion_from_rotation(T[:3, :3]))
