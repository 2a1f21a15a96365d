"""A recording as RGB-D frames with poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.recordings.bags.bag import BagSource
from deworldsg_ros.recordings.bags.storage import SALVAGERS, storage_files
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders import detect_dataset, open_dataset
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.folders.registry import expectations
from deworldsg_ros.recordings.messages import Role
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.streams.sync import FrameAssembler

BAG_SUFFIXES = frozenset(SALVAGERS)


class Recording:
    """Frames of a bag or a data set folder.

    Messages are paired and checked by the assembler that the nodes use, so that a replay through
    DDS and a run in one process see the same frames.

    Attributes:
        source: what is underneath.
    """

    def __init__(self, source: Source, inputs: InputsConfig | None = None) -> None:
        self.source = source
        self.reasons: dict[str, str] = {}
        self._assembler = FrameAssembler(
            # Whatever the recording has, its source gives poses.
            msgspec.structs.replace(inputs or InputsConfig(), pose_source="auto"),
            topics={role.value: topic.name for role, topic in source.topics.items()},
            on_drop=self._remember,
        )

    @property
    def name(self) -> str:
        """What to call it."""
        return self.source.name

    @property
    def frame_count(self) -> int:
        """Number of RGB images: the frames, unless some are dropped."""
        return self.source.frame_count

    @property
    def drops(self) -> Counter[str]:
        """Messages and frames left out so far, by reason; `reasons` has an example of each."""
        return self.source.drops + self._assembler.drops

    @property
    def losses(self) -> list[str]:
        """Sentences on data that the recording has lost."""
        return self.source.losses

    def frames(self) -> Iterator[RgbdFrame]:
        """Frames in order of time."""
        add: dict[Role, Any] = {
            Role.RGB: self._assembler.add_rgb,
            Role.DEPTH: self._assembler.add_depth,
            Role.CAMERA_INFO: self._assembler.add_camera_info,
            Role.POSE: self._assembler.add_pose,
        }
        for item in self.source.messages():
            add[item.role](item.message, item.stamp_ns)
            yield from self._assembler.pop_ready(None)
        yield from self._assembler.flush()

    def close(self) -> None:
        """Close the files."""
        self.source.close()

    def _remember(self, reason: str, message: str, number: int) -> None:
        self.reasons.setdefault(reason, message)


def open_source(
    path: Path,
    *,
    kind: str = "auto",
    topics: TopicChoice | None = None,
    inputs: InputsConfig | None = None,
    options: DatasetOptions | None = None,
    need_poses: bool = True,
) -> Source:
    """Open a bag or a data set folder.

    Args:
        path: rosbag2 folder, .mcap or .db3 file, or data set folder.
        kind: name of a data set, ``rosbag2``, or ``auto`` = by looking.
        topics: of a bag, where they are not to be found by name.
        inputs: world frame and pose slop for poses from TF.
        options: of a data set folder.
        need_poses: whether what has no poses is refused or left out; False where they come from
            elsewhere.

    Raises:
        RecordingError: says what was looked for and where.
    """
    if kind == "auto":
        kind = detect_kind(path)
    if kind == "rosbag2":
        return BagSource(path, topics, inputs, need_pose=need_poses)
    if not need_poses:
        options = replace(options or DatasetOptions(), poses_needed=False)
    return open_dataset(kind, path, options)


def open_recording(
    path: Path,
    inputs: InputsConfig | None = None,
    *,
    kind: str = "auto",
    topics: TopicChoice | None = None,
    options: DatasetOptions | None = None,
) -> Recording:
    """`open_source` as frames."""
    source = open_source(path, kind=kind, topics=topics, inputs=inputs, options=options)
    return Recording(source, inputs)


def detect_kind(path: Path) -> str:
    """``rosbag2`` or the name of a data set, by looking; raises RecordingError."""
    if not path.exists():
        raise RecordingError(f"recording {path}: there is no such file or folder")
    if path.is_file():
        if path.suffix in BAG_SUFFIXES:
            return "rosbag2"
        if path.name == "metadata.yaml":
            raise RecordingError(f"recording {path}: give the folder that it is in")
        raise RecordingError(f"recording {path}: wanted a .mcap or .db3 file, or a folder")
    if (path / "metadata.yaml").exists() or storage_files(path):
        return "rosbag2"
    found = detect_dataset(path)
    if found is None:
        raise RecordingError(
            f"recording {path}: neither a rosbag2 folder (metadata.yaml with .mcap or .db3 files) "
            f"nor a data set folder ({expectations()})"
        )
    return found
