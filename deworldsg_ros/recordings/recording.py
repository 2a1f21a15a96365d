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
from deworldsg_ros.recordings.bags.topics import EXPECTED, TopicChoice
from deworldsg_ros.recordings.folders.dataset import (
    DatasetOptions,
    detect_dataset,
    expectations,
    open_dataset,
)
from deworldsg_ros.recordings.folders.frame_files import FrameFiles
from deworldsg_ros.recordings.source import Role, Source
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RecordingError
from deworldsg_ros.streams.detections import read_detections
from deworldsg_ros.streams.frames import FrameAssembler

BAG_SUFFIXES = frozenset(SALVAGERS)


class Recording:
    """Frames of a bag or a data set folder.

    The assembler of the nodes joins and checks the messages: a replay through DDS and a run in one
    process give the same frames.

    Args:
        source: the messages.
        inputs: how they are joined.
        with_detections: whether each frame needs the detections that were recorded.

    Raises:
        RecordingError: there are none.

    Attributes:
        source: the messages.
        reasons: one example for each reason of `drops`, if there is one.
    """

    def __init__(
        self,
        source: Source,
        inputs: InputsConfig | None = None,
        *,
        with_detections: bool = False,
    ) -> None:
        if with_detections and Role.DETECTIONS not in source.topics:
            raise RecordingError(
                f"recording {source.name}: perception.detector is 'topic', but it has no "
                f"detections: expected {EXPECTED[Role.DETECTIONS]}"
            )
        self.source = source
        self._with_detections = with_detections
        self.reasons: dict[str, str] = {}
        self._assembler = FrameAssembler(
            # The source has chosen the poses already.
            msgspec.structs.replace(inputs or InputsConfig(), pose_source="auto"),
            topics={role.value: topic.name for role, topic in source.topics.items()},
            on_drop=self._remember,
            with_detections=with_detections,
            sparse=isinstance(source, FrameFiles) and source.are_sparse(),
        )

    @property
    def name(self) -> str:
        """Name of the bag or folder."""
        return self.source.name

    @property
    def frame_count(self) -> int:
        """Number of RGB images: of frames, if none is dropped."""
        return self.source.frame_count

    @property
    def drops(self) -> Counter[str]:
        """Messages and frames left out so far, by reason."""
        return self.source.drops + self._assembler.drops

    @property
    def losses(self) -> list[str]:
        """Sentences about data that the recording has lost."""
        return self.source.losses

    def frames(self) -> Iterator[RgbdFrame]:
        """Frames in order of time."""
        add: dict[Role, Any] = {
            Role.RGB: self._assembler.add_rgb,
            Role.DEPTH: self._assembler.add_depth,
            Role.CAMERA_INFO: self._assembler.add_camera_info,
            Role.POSE: self._assembler.add_pose,
        }
        if self._with_detections:
            add[Role.DETECTIONS] = lambda message, _: self._assembler.add_detections(
                read_detections(message)
            )
            add[Role.DETECTION_INSTANCES] = self._assembler.add_detection_instances
        for item in self.source.messages():
            if item.role not in add:
                continue
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
        kind: name of a data set or ``rosbag2``; ``auto`` = detect.
        topics: topics of a bag that the user named; the others are found by type and name.
        inputs: transport, pose source, and for TF the world frame and pose slop.
        options: of a data set folder; for a bag, the intrinsics replace its CameraInfo.
        need_poses: whether a bag without poses is refused, and a frame without a pose left out;
            False if the poses come from elsewhere.

    Raises:
        RecordingError: names the path, the content seen and the expected one.
    """
    if kind == "auto":
        kind = detect_kind(path)
    if kind == "rosbag2":
        intrinsics = options.intrinsics if options else None
        return BagSource(path, topics, inputs, need_pose=need_poses, intrinsics=intrinsics)
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
    """Open a bag or a data set folder as frames; arguments and errors as `open_source`."""
    source = open_source(path, kind=kind, topics=topics, inputs=inputs, options=options)
    return Recording(source, inputs)


def detect_kind(path: Path) -> str:
    """``rosbag2`` or the name of a data set, from the files of the path; raises RecordingError."""
    if not path.exists():
        raise RecordingError(f"recording {path}: there is no such file or folder")
    if path.is_file():
        if path.suffix in BAG_SUFFIXES:
            return "rosbag2"
        if path.name == "metadata.yaml":
            raise RecordingError(
                f"recording {path}: this is a part of a bag; give its folder, {path.parent}"
            )
        raise RecordingError(f"recording {path}: expected a .mcap or .db3 file, or a folder")
    if (path / "metadata.yaml").exists() or storage_files(path):
        return "rosbag2"
    found = detect_dataset(path)
    if found is None:
        raise RecordingError(
            f"recording {path}: unknown content; expected a rosbag2 folder (metadata.yaml with "
            f".mcap or .db3 files) or a data set folder ({expectations()})"
        )
    return found
