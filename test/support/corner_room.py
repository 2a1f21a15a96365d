"""Exact RGB-D frames of the corner of a room: two textured walls and a floor."""

import numpy as np

from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame, rigid_motion

INTRINSICS = Intrinsics(150.0, 150.0, 79.5, 59.5, 160, 120)
# A level camera that points along +x. The walls are in front and to the left, the floor below.
LEVEL = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
# Axis and position of the walls and the floor, metres.
WALLS = ((0, 3.0), (1, 0.8), (2, -0.4))


def corner_frame(
    T_world_camera: np.ndarray, stamp_ns: int = 0, *, is_tiled: bool = False
) -> RgbdFrame:
    """A frame; its surfaces have soft waves of colour, or tiles of 10 cm, each of its own grey."""
    v, u = np.mgrid[: INTRINSICS.height, : INTRINSICS.width]
    rays = INTRINSICS.back_project(u, v, np.ones(u.shape))
    directions = rays @ T_world_camera[:3, :3].T
    depth = np.full(u.shape, np.inf)
    for axis, position_m in WALLS:
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = (position_m - T_world_camera[axis, 3]) / directions[..., axis]
        depth = np.where((hit > 0.1) & (hit < depth), hit, depth)
    points = T_world_camera[:3, 3] + depth[..., None] * directions
    waves = [np.sin(points @ direction + phase) for direction, phase in WAVES]
    rgb = np.stack([127 + 40 * (waves[i] + waves[i + 1] + waves[i + 2]) for i in range(3)], -1)
    if is_tiled:
        tiles = np.floor(10.0 * points + 0.01).astype(np.int64) @ (73856093, 19349663, 83492791)
        rgb = np.repeat((tiles % 211 + 20.0)[..., None], 3, axis=2)
    return RgbdFrame(
        stamp_ns,
        np.clip(rgb, 0, 255).astype(np.uint8),
        depth.astype(np.float32),
        INTRINSICS,
        T_world_camera,
        "map",
    )


def camera_at(yaw_deg: float, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0) -> np.ndarray:
    """Pose of a level camera, rotated to the left by `yaw_deg` and translated."""
    T = rigid_motion(np.array([x_m, y_m, z_m]), np.array([0.0, 0.0, np.radians(yaw_deg)]))
    return T @ LEVEL


def walk(count: int) -> list[np.ndarray]:
    """Poses of a camera that moves forward and rotates, 2-3 cm and about 1 degree per frame."""
    steps = np.arange(count)
    return [
        camera_at(8 * np.sin(0.15 * k), 0.02 * k, 0.05 * np.sin(0.3 * k), 0.01 * np.sin(0.5 * k))
        for k in steps
    ]


_rng = np.random.default_rng(7)
WAVES = [(_rng.normal(0, 9, 3), _rng.uniform(0, 6)) for _ in range(5)]
