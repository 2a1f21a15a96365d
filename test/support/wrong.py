"""Recordings that are made wrong on purpose, from the frames of a right one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from deworldsg_ros.perception.stage import turned
from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.source import RoleMessage, serialize
from deworldsg_ros.recordings.writer import write_mcap
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose

Frames = list[RgbdFrame]

# T_optical_body: the pose of a body whose x axis is the camera's z axis.
OPTICAL_TO_BODY = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def each(change: Callable[[RgbdFrame], RgbdFrame]) -> Callable[[Frames], Frames]:
    return lambda frames: [change(frame) for frame in frames]


def with_depth(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Frames], Frames]:
    return each(lambda frame: replace(frame, depth_m=change(frame.depth_m).astype(np.float32)))


def with_pose(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Frames], Frames]:
    return each(lambda frame: replace(frame, T_world_camera=change(frame.T_world_camera)))


def late(frames: Frames, count: int = 4) -> Frames:
    """Each frame has the pose of some frames earlier."""
    return [
        replace(frame, T_world_camera=before.T_world_camera)
        for frame, before in zip(frames[count:], frames)
    ]


def still(frames: Frames) -> Frames:
    first = frames[0]
    return [replace(first, stamp_ns=frame.stamp_ns) for frame in frames[:30]]


def jumping(frames: Frames) -> Frames:
    jump = np.eye(4)
    jump[0, 3] = 3.0
    return [
        replace(frame, T_world_camera=jump @ frame.T_world_camera) if index % 7 == 3 else frame
        for index, frame in enumerate(frames)
    ]


def frozen_poses(frames: Frames) -> Frames:
    """The poses of a robot that turns on the spot beside a camera that looks elsewhere."""
    angles = np.linspace(0, 2, len(frames))
    poses = []
    for angle in angles:
        T = np.eye(4)
        T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        poses.append(frames[0].T_world_camera @ T)
    return [replace(frame, T_world_camera=T) for frame, T in zip(frames, poses)]


WRONG: dict[str, Callable[[Frames], Frames]] = {
    "right": lambda frames: frames,
    "on its side": each(lambda frame: turned(frame, 1)),
    "depth times 10": with_depth(lambda depth_m: np.where(depth_m * 10 > 60, 0, depth_m * 10)),
    "depth by 5": with_depth(lambda depth_m: depth_m / 5),
    "shifted depth": with_depth(lambda depth_m: np.roll(depth_m, 24, axis=1)),
    "no depth": with_depth(lambda depth_m: depth_m * (depth_m > 4.5)),
    "one frame": lambda frames: frames[:1],
    "still": still,
    "jumping poses": jumping,
    "late poses": late,
    "poses of the body": with_pose(lambda T: T @ OPTICAL_TO_BODY),
    "inverse poses": with_pose(invert_pose),
    "other poses": frozen_poses,
    "dark": each(lambda frame: replace(frame, rgb=frame.rgb // 40)),
}


def messages(frames: Iterable[RgbdFrame]) -> Iterator[RoleMessage]:
    """Messages without loss in the pixels; depth in millimetres."""
    for frame in frames:
        at, camera = frame.stamp_ns, "camera_optical"
        bgr = np.ascontiguousarray(frame.rgb[:, :, ::-1])
        depth_mm = np.rint(1000 * frame.depth_m).astype(np.uint16)
        yield ros.camera_info(at, camera, frame.intrinsics)
        yield ros.pose_stamped_from_matrix(at, "map", frame.T_world_camera)
        yield ros.compressed_depth(at, camera, bytes(cv2.imencode(".png", depth_mm)[1]))
        yield ros.compressed_image(at, camera, bytes(cv2.imencode(".png", bgr)[1]), "png")


def write_wrong(frames: Iterable[RgbdFrame], path: Path) -> Path:
    """Write frames as a bag."""
    write_mcap(map(serialize, messages(frames)), path)
    return path
