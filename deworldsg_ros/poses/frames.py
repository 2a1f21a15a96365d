"""Streams of posed frames with other poses than they came with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from deworldsg_ros.config import OdometryConfig
from deworldsg_ros.poses.odometry import RgbdOdometry
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput

OnRefusal = Callable[[RefusedInput], None]


def track_poses(
    frames: Iterable[RgbdFrame],
    config: OdometryConfig,
    T_world_start: Float64 | None = None,
    on_lost: OnRefusal | None = None,
) -> Iterator[RgbdFrame]:
    """The frames with the poses that RGB-D odometry finds; those that it loses are left out.

    Args:
        frames: their own poses are not looked at.
        config: of the odometry.
        T_world_start: (4, 4) pose of the first frame; None = level, at the origin.
        on_lost: called with the refusal of each frame that is left out.
    """
    odometry = RgbdOdometry(config, T_world_start)
    for frame in frames:
        try:
            T_world_camera = odometry.track(frame.rgb, frame.depth_m, frame.intrinsics)
        except RefusedInput as refusal:
            if on_lost is not None:
                on_lost(refusal)
            continue
        yield replace(frame, T_world_camera=T_world_camera)
