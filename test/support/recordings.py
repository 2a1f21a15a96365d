"""Small recordings of a moving camera: bags and folders in all layouts."""

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.bags.storage import RawBag, RawMessage
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.recording import Recording, open_recording
from deworldsg_ros.recordings.source import typestore
from deworldsg_ros.scene.camera import (
    Intrinsics,
    RgbdFrame,
    pose_from_quaternion,
    quaternion_from_rotation,
)

WIDTH, HEIGHT = 64, 48
INTRINSICS = Intrinsics(60.0, 61.0, 31.5, 23.5, WIDTH, HEIGHT)
STEP_NS = 100_000_000
T0_NS = 5_000_000_000
CAMERA, WORLD = "camera_optical", "map"
STRING = "std_msgs/msg/String"


def stamp_ns(index: int) -> int:
    return T0_NS + index * STEP_NS


def rgb_pixels(index: int) -> np.ndarray:
    """A smooth image, so that JPEG changes it little."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([rows * 4, columns * 3, np.full_like(rows, 40 + index)], axis=2).astype(
        np.uint8
    )


def depth_mm(index: int) -> np.ndarray:
    depth = np.full((HEIGHT, WIDTH), 1000 + 7 * index, np.uint16)
    depth[:5] = 0
    return depth


def pose(index: float) -> np.ndarray:
    quat = np.array([0.01 * index, 0.2, -0.1, 0.9])
    return pose_from_quaternion(np.array([0.05 * index, 0.1, 1.2]), quat / np.linalg.norm(quat))


def encoded(pixels: np.ndarray, suffix: str = ".png") -> bytes:
    return bytes(cv2.imencode(suffix, pixels)[1])


SCAN = b"\xff\xda"  # begins a scan of a JPEG


def many_scans(jpeg: bytes, number: int) -> bytes:
    """A JPEG whose last scan is repeated until it has this number of scans."""
    last, end = jpeg.rindex(SCAN), len(jpeg) - 2
    return jpeg[:end] + jpeg[last:end] * (number - jpeg.count(SCAN)) + jpeg[end:]


def raw_image(time_ns: int, pixels: np.ndarray, encoding: str) -> Any:
    pixels = np.ascontiguousarray(pixels)
    return typestore().types[ros.IMAGE](
        header=ros.header(time_ns, CAMERA),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=np.frombuffer(pixels.tobytes(), np.uint8),
    )


def pose_message(time_ns: int, T: np.ndarray) -> Any:
    return ros.pose_stamped_from_matrix(time_ns, WORLD, T).message


def odometry(time_ns: int, T: np.ndarray, child: str = CAMERA) -> Any:
    types = typestore().types
    at = pose_message(time_ns, T)
    zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    return types[ros.ODOMETRY](
        header=at.header,
        child_frame_id=child,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=at.pose, covariance=np.zeros(36)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=zero, angular=zero),
            covariance=np.zeros(36),
        ),
    )


def tf(time_ns: int, *edges: tuple[str, str, np.ndarray]) -> Any:
    """Transforms: parent, child and the pose of the child."""
    types = typestore().types
    transforms = []
    for parent, child, T in edges:
        at = pose_message(time_ns, T).pose
        place = types["geometry_msgs/msg/Vector3"](at.position.x, at.position.y, at.position.z)
        moved = types["geometry_msgs/msg/Transform"](place, at.orientation)
        stamped = types["geometry_msgs/msg/TransformStamped"]
        transforms.append(stamped(ros.header(time_ns, parent), child, moved))
    return types[ros.TF_MESSAGE](transforms)


Item = tuple[str, str, int, Any]


def camera_items(count: int, *, compressed: bool = True, with_pose: bool = True) -> list[Item]:
    """(topic, type, log time, message) of a camera. Raw depth is in metres."""
    items: list[Item] = []
    for index in range(count):
        time_ns = stamp_ns(index)
        info = ros.camera_info(time_ns, CAMERA, INTRINSICS).message
        items.append(("/camera/color/camera_info", ros.CAMERA_INFO, time_ns, info))
        if with_pose:
            items.append(
                ("/camera/pose", ros.POSE_STAMPED, time_ns, pose_message(time_ns, pose(index)))
            )
        bgr = np.ascontiguousarray(rgb_pixels(index)[:, :, ::-1])
        if compressed:
            depth = ros.compressed_depth(time_ns, CAMERA, encoded(depth_mm(index))).message
            rgb = ros.compressed_image(time_ns, CAMERA, encoded(bgr), "png").message
            items += [
                ("/camera/depth/image_raw/compressedDepth", ros.COMPRESSED_IMAGE, time_ns, depth),
                ("/camera/color/image_raw/compressed", ros.COMPRESSED_IMAGE, time_ns, rgb),
            ]
        else:
            metres = (depth_mm(index) * np.float32(1e-3)).astype(np.float32)
            items += [
                (
                    "/camera/depth/image_raw",
                    ros.IMAGE,
                    time_ns,
                    raw_image(time_ns, metres, "32FC1"),
                ),
                ("/camera/color/image_raw", ros.IMAGE, time_ns, raw_image(time_ns, bgr, "bgr8")),
            ]
    return items


def write_bag(
    folder: Path,
    items: Iterable[Item],
    storage: str = "mcap",
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Write a rosbag2 folder. The messages of the items may be serialized."""
    connections: dict[tuple[str, str], Any] = {}
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression is not CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        for topic, msgtype, time_ns, message in items:
            key = topic, msgtype
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=typestore())
            if not isinstance(message, bytes):
                message = bytes(typestore().serialize_cdr(message, msgtype))
            writer.write(connections[key], time_ns, message)
    return folder


def text_items(texts: Iterable[tuple[int, str]]) -> list[Item]:
    """Texts on the topic /s, with their times."""
    made = typestore().types[STRING]
    return [("/s", STRING, time_ns, made(data=text)) for time_ns, text in texts]


def read_bag(path: Path, topic: str | None = None) -> tuple[list[RawMessage], list[str]]:
    """Messages of one topic or of all, and notes, such as what was lost."""
    with closing(RawBag(path)) as bag:
        keys = [item.key for item in bag.topics if topic in (None, item.name)]
        return list(bag.messages(keys)), bag.losses


def write_seven_scenes(folder: Path, count: int) -> Path:
    """Write a folder in the layout of 7-Scenes with registered depth. Every 4th frame exists."""
    folder.mkdir(parents=True)
    K = INTRINSICS.matrix
    (folder / "camera-intrinsics.txt").write_text("\n".join(" ".join(map(str, r)) for r in K))
    for index in range(count):
        stem = folder / f"frame-{4 * index:06d}"
        bgr = np.ascontiguousarray(rgb_pixels(index)[:, :, ::-1])
        stem.with_suffix(".color.jpg").write_bytes(encoded(bgr, ".jpg"))
        stem.with_suffix(".depth.png").write_bytes(encoded(depth_mm(index)))
        np.savetxt(stem.with_suffix(".pose.txt"), pose(index), "%.9g")
    return folder


TUM_T0_NS = 1305031102175304000  # more digits than a float64 has


def write_tum(
    folder: Path,
    count: int = 4,
    *,
    depth_offset_ns: int = 5_000_000,
    pose_step_ns: int = 50_000_000,
) -> Path:
    """Write a folder in the layout of TUM. Poses are not at the times of the images."""
    rows: dict[str, list[tuple[int, str]]] = {"rgb": [], "depth": [], "groundtruth": []}
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for index in range(count):
        depth = np.full((HEIGHT, WIDTH), 5000 + 50 * index, np.uint16)
        depth[0] = 0
        time_ns = TUM_T0_NS + index * STEP_NS
        bgr = np.ascontiguousarray(rgb_pixels(index)[:, :, ::-1])
        images = (("rgb", bgr, time_ns), ("depth", depth, time_ns + depth_offset_ns))
        for name, pixels, at_ns in images:
            (folder / name / f"{index}.png").write_bytes(encoded(pixels))
            rows[name].append((at_ns, f"{name}/{index}.png"))
    for number in range(-1, 2 * count + 2):
        time_ns = TUM_T0_NS + number * pose_step_ns + 20_000_000
        T = pose((time_ns - TUM_T0_NS) / STEP_NS)
        values = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        rows["groundtruth"].append((time_ns, " ".join(f"{value:.9f}" for value in values)))
    for name, lines in rows.items():
        text = [f"{ns // 10**9}.{ns % 10**9:09d} {content}" for ns, content in lines]
        (folder / f"{name}.txt").write_text("\n".join(["# timestamp and content", *text]) + "\n")
    return folder


def frames_of(path: Path, inputs: Any = None, **options: Any) -> tuple[list[RgbdFrame], Recording]:
    with closing(open_recording(path, inputs, options=DatasetOptions(**options))) as recording:
        return list(recording.frames()), recording
