"""Right recordings, and recordings that are made wrong on purpose, for the doctor."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from support.recordings import Item, odometry, raw_image

from deworldsg_ros.recordings import source as ros
from deworldsg_ros.scene.camera import (
    Intrinsics,
    RgbdFrame,
    invert_pose,
    pose_from_quaternion,
    quaternion_from_rotation,
    rigid_motion,
    turned,
)

Frames = list[RgbdFrame]
COLOUR, DEPTH = "camera_color_optical_frame", "camera_depth_optical_frame"
# The pose of a body whose x axis is the camera's z axis; and of a camera of OpenGL and ARKit.
OPTICAL_TO_BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
OPTICAL_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def items(
    frames: Frames,
    *,
    unit_m: float = 0.001,
    floats: bool = False,
    depth_encoding: str = "",
    depth_topic: str = "/camera/aligned_depth_to_color/image_raw",
    depth_frame: str = COLOUR,
    depth_late_s: float = 0.0,
    depth_step: int = 1,
    rgb_every: int = 1,
    depth_info: Intrinsics | None = None,
    rgb_encoding: str = "",
    info: Intrinsics | None = None,
    with_info: bool = True,
    pose_late_s: float = 0.0,
    pose_every: int = 1,
    pose_frames: Sequence[str] = ("map",),
    as_odometry: bool = False,
) -> list[Item]:
    """(topic, type, time, message) of frames, as a driver would record them.

    Args:
        frames: what the camera saw.
        unit_m: metres per unit of the depth images.
        floats: whether depth is 32FC1, else 16UC1.
        depth_encoding: a wrong name of it.
        depth_topic: of the depth images.
        depth_frame: their frame.
        depth_late_s: by how much their stamps are later than those of colour.
        depth_step: every n-th pixel of depth is recorded.
        rgb_every: every n-th frame has a colour image.
        depth_info: camera_info beside them; None = there is none.
        rgb_encoding: a wrong name of it.
        info: camera_info of colour; None = the right one.
        with_info: whether there is one.
        pose_late_s: by how much the stamps of the poses are later than they should be.
        pose_every: every n-th frame has a pose.
        pose_frames: world frames of the poses, in turn.
        as_odometry: whether the poses are an Odometry.
    """
    made: list[Item] = []
    for number, frame in enumerate(frames):
        at = frame.stamp_ns
        rgb = raw_image(at, np.ascontiguousarray(frame.rgb), "rgb8")
        rgb.header.frame_id, rgb.encoding = COLOUR, rgb_encoding or rgb.encoding
        depth_at = at + round(1e9 * depth_late_s)
        units = frame.depth_m[::depth_step, ::depth_step] / unit_m
        pixels = units.astype(np.float32) if floats else np.rint(units).clip(0, 65535).astype("u2")
        depth = raw_image(depth_at, pixels, "32FC1" if floats else "16UC1")
        depth.header.frame_id = depth_frame
        depth.encoding = depth_encoding or depth.encoding
        if number % pose_every == 0:
            stamp = at + round(1e9 * pose_late_s)
            make = odometry if as_odometry else pose_message
            pose = make(stamp, frame.T_world_camera)
            pose.header.frame_id = pose_frames[number % len(pose_frames)]
            if as_odometry:
                pose.child_frame_id = COLOUR
            kind = ros.ODOMETRY if as_odometry else ros.POSE_STAMPED
            made.append(("/odom" if as_odometry else "/camera/pose", kind, at, pose))
        if with_info:
            message = ros.camera_info(at, COLOUR, info or frame.intrinsics).message
            made.append(("/camera/color/camera_info", ros.CAMERA_INFO, at, message))
        if depth_info is not None:
            message = ros.camera_info(depth_at, depth_frame, depth_info).message
            beside = depth_topic.rsplit("/", 1)[0] + "/camera_info"
            made.append((beside, ros.CAMERA_INFO, at, message))
        made.append((depth_topic, ros.IMAGE, at, depth))
        if number % rgb_every == 0:
            made.append(("/camera/color/image_raw", ros.IMAGE, at, rgb))
    return made


def pose_message(stamp_ns: int, T: np.ndarray) -> Any:
    return ros.pose_stamped_from_matrix(stamp_ns, "map", T).message


# --- Changes of frames.


def depths(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Frames], Frames]:
    return lambda frames: [replace(it, depth_m=np.float32(change(it.depth_m))) for it in frames]


def poses(change: Callable[[np.ndarray, int], np.ndarray]) -> Callable[[Frames], Frames]:
    """`change` gets the pose, and the number of the frame."""
    return lambda frames: [
        replace(it, T_world_camera=change(it.T_world_camera, n)) for n, it in enumerate(frames)
    ]


def positions(factor: float) -> Callable[[Frames], Frames]:
    def change(T: np.ndarray, _: int) -> np.ndarray:
        scaled = T.copy()
        scaled[:3, 3] = T[:3, 3] * factor
        return scaled

    return poses(change)


def focal(factor: float, frame: RgbdFrame) -> Intrinsics:
    i = frame.intrinsics
    return replace(i, fx=factor * i.fx, fy=factor * i.fy)


def unregistered(factor: float) -> Callable[[Frames], Frames]:
    """Depth of a camera with another focal length, 15 mm beside."""

    def change(frame: RgbdFrame) -> RgbdFrame:
        i, depth_m = frame.intrinsics, frame.depth_m
        zoom = np.array([[factor, 0, i.cx * (1 - factor)], [0, factor, i.cy * (1 - factor)]])
        zoom[0, 2] += factor * i.fx * 0.015 / 2.0
        size = depth_m.shape[::-1]
        return replace(frame, depth_m=cv2.warpAffine(depth_m, zoom, size, flags=cv2.INTER_NEAREST))

    return lambda frames: [change(frame) for frame in frames]


def trembling(frames: Frames) -> Frames:
    rng = np.random.default_rng(0)
    return poses(lambda T, _: T @ rigid_motion(rng.normal(0, 0.05, 3), rng.normal(0, 0.05, 3)))(
        frames
    )


def on_the_spot(frames: Frames) -> Frames:
    """The poses of a robot that turns on the spot beside a camera that looks elsewhere."""
    return poses(
        lambda _, n: frames[0].T_world_camera @ rigid_motion(np.zeros(3), np.array([0, 0, n / 30]))
    )(frames)


def quaternion_swapped(T: np.ndarray, _: int) -> np.ndarray:
    """A rotation whose quaternion was read as w, x, y, z."""
    x, y, z, w = quaternion_from_rotation(T[:3, :3])
    return pose_from_quaternion(T[:3, 3], np.array([w, x, y, z]))


def still(frames: Frames) -> Frames:
    return [replace(frames[0], stamp_ns=it.stamp_ns) for it in frames]


def standing_poses(frames: Frames) -> Frames:
    return poses(lambda *_: frames[0].T_world_camera)(frames)


JUMP = rigid_motion(np.array([3.0, 0.0, 0.0]), np.zeros(3))
# World axes: y up, and x up.
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
X_UP = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])


# --- The matrix.


@dataclass(frozen=True)
class Case:
    """A recording, and the code of what the doctor has to say first.

    Attributes:
        what: in words, for the table of the docs.
        code: None = nothing is off.
        change: of the frames.
        options: of `items`; a function of the first frame.
        number: of frames.
        refused: words of the error, if it cannot be opened.
    """

    what: str
    code: str | None
    change: Callable[[Frames], Frames] = list
    options: Callable[[RgbdFrame], dict[str, Any]] = lambda _: {}
    number: int = 60
    refused: str = ""


def given(**options: Any) -> Callable[[RgbdFrame], dict[str, Any]]:
    return lambda _: options


UNALIGNED = {"depth_topic": "/camera/depth/image_rect_raw"}
OTHER_FRAME = {"depth_frame": DEPTH, **UNALIGNED}

RIGHT = (
    Case("16UC1 in millimetres", None),
    Case("32FC1 in metres", None, options=given(floats=True, unit_m=1.0)),
    Case(
        "registered depth in its own frame, with the camera_info of colour",
        None,
        options=lambda f: {"depth_frame": DEPTH, "depth_info": f.intrinsics},
    ),
    Case("registered depth in a frame of its own", None, options=given(depth_frame=DEPTH)),
    Case("colour at half the rate of depth", None, options=given(rgb_every=2)),
    Case("odometry", None, options=given(as_odometry=True)),
    Case("poses at a third of the rate", None, options=given(pose_every=3)),
    Case("y is up", None, change=poses(lambda T, _: Y_UP @ T)),
    Case("x is up", None, change=poses(lambda T, _: X_UP @ T)),
    Case("a camera on its side", None, change=lambda frames: [turned(it, 1) for it in frames]),
)

WRONG = (
    # the unit
    Case("16UC1 in 0.1 mm", "depth_unit", options=given(unit_m=1e-4)),
    Case("16UC1 of TUM, 0.2 mm", "depth_unit", options=given(unit_m=2e-4)),
    Case("16UC1 in centimetres", "depth_unit", options=given(unit_m=1e-2)),
    Case("32FC1 in millimetres", "depth_unit", options=given(floats=True)),
    Case("32FC1 in centimetres", "depth_unit", options=given(floats=True, unit_m=1e-2)),
    Case("depth times 0.75", "depth_unit", change=depths(lambda d: 0.75 * d)),
    Case("depth times 0.9", "depth_unit", change=depths(lambda d: 0.9 * d)),
    Case("depth times 1.1", "depth_unit", change=depths(lambda d: 1.1 * d)),
    Case("depth times 1.33", "depth_unit", change=depths(lambda d: 1.33 * d)),
    Case("positions of the poses times 0.1", "depth_unit", change=positions(0.1)),
    Case("positions of the poses times 2", "depth_unit", change=positions(2.0)),
    Case("positions in millimetres", "pose_jumps", change=positions(1000.0)),
    # the registration
    Case("a colour topic as depth", None, options=given(depth_encoding="rgb8"), refused="--depth"),
    Case("depth drawn for people", None, options=given(depth_encoding="mono8"), refused="--depth"),
    Case("depth moved by 24 columns", "not_registered", depths(lambda d: np.roll(d, 24, axis=1))),
    Case("depth moved by 16 rows", "not_registered", depths(lambda d: np.roll(d, 16, axis=0))),
    Case(
        "depth of the other camera, with its camera_info",
        "not_registered",
        unregistered(0.63),
        lambda f: {**OTHER_FRAME, "depth_info": focal(0.63, f)},
    ),
    Case(
        "depth of the other camera, in the frame of colour",
        "not_registered",
        unregistered(0.8),
        lambda f: {**UNALIGNED, "depth_info": focal(0.8, f)},
    ),
    Case(
        "depth of the other camera, in its own frame",
        "not_registered",
        unregistered(0.63),
        given(**OTHER_FRAME),
    ),
    Case("depth of the other camera, and nothing tells it", "not_registered", unregistered(0.63)),
    Case("depth of 1.3 times the focal length", "not_registered", unregistered(1.3)),
    Case("depth of half the size", "not_registered", options=given(depth_step=2)),
    # the intrinsics
    Case(
        "camera_info of 1280 x 720",
        "other_intrinsics",
        options=lambda f: {"info": replace(focal(1.5, f), width=1280, height=720)},
    ),
    Case("focal length times 0.7", "other_intrinsics", options=lambda f: {"info": focal(0.7, f)}),
    Case("focal length times 0.9", "other_intrinsics", options=lambda f: {"info": focal(0.9, f)}),
    Case("focal length times 1.4", "other_intrinsics", options=lambda f: {"info": focal(1.4, f)}),
    Case("no camera_info", None, options=given(with_info=False), refused="--intrinsics"),
    # the stamps
    Case("poses 0.4 s late", "late_poses", options=given(pose_late_s=0.4)),
    Case("poses 0.2 s early", "late_poses", options=given(pose_late_s=-0.2)),
    Case("poses of another clock", "late_poses", options=given(pose_late_s=5000.0)),
    Case("a pose every second", "late_poses", options=given(pose_every=10)),
    Case("depth 50 ms late", "no_depth", options=given(depth_late_s=0.05)),
    # the poses
    Case("poses of the body", "poses_of_the_body", poses(lambda T, _: T @ OPTICAL_TO_BODY)),
    Case("poses of OpenGL or ARKit", "poses_of_opengl", poses(lambda T, _: T @ OPTICAL_TO_OPENGL)),
    Case("poses inverted", "poses_inverted", poses(lambda T, _: invert_pose(T))),
    Case("poses of a robot that turns beside", "poses_do_not_fit", on_the_spot),
    Case("poses that tremble", "poses_do_not_fit", trembling),
    Case("poses that stand still", "poses_do_not_fit", standing_poses),
    Case("poses with quaternions of w, x, y, z", "poses_do_not_fit", poses(quaternion_swapped)),
    Case("poses that jump", "pose_jumps", poses(lambda T, n: JUMP @ T if n % 7 == 3 else T)),
    Case("poses in two frames in turn", "other_frame", options=given(pose_frames=("map", "odom"))),
    # the pictures
    Case("no depth", "little_depth", depths(lambda d: 0 * d)),
    Case("yuv422 as colour", "unknown_encoding", options=given(rgb_encoding="yuv422")),
    Case("one frame", "few_frames", number=1),
    Case("a camera that stands still", "still_camera", still),
)


def table() -> str:
    """The matrix, for the docs."""
    rows = [f"| {case.what} | – |" for case in RIGHT]
    for case in WRONG:
        said = f"it cannot be opened: use {case.refused}" if case.refused else f"`{case.code}`"
        rows.append(f"| {case.what} | {said} |")
    return "\n".join(["| recording | named first |", "|---|---|", *rows])
