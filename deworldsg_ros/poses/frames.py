"""Streams of frames whose poses come from odometry."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from deworldsg_ros.poses.odometry import RgbdOdometry
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput

OnRefusal = Callable[[RefusedInput], None]


def track_poses(
    frames: Iterable[RgbdFrame],
    T_world_start: Float64 | None = None,
    on_lost: OnRefusal | None = None,
) -> Iterator[RgbdFrame]:
    """Replace the poses of frames by those of RGB-D odometry; lost frames are left out.

    Args:
        frames: their own poses are ignored.
        T_world_start: (4, 4) pose of the first frame; None = level, at the origin.
        on_lost: called with the refusal of each lost frame.
    """
    odometry = RgbdOdometry(T_world_start)
    for frame in frames:
        try:
            T_world_camera = odometry.track(frame.rgb, frame.depth_m, frame.intrinsics)
        except RefusedInput as refusal:
            if on_lost is not None:
                on_lost(refusal)
            continue
        yield replace(frame, T_world_camera=T_world_camera)
