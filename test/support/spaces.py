"""What a camera sees of a room of boxes: depth images of rays, as a graph keeps them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.scene.arrays import Bool, Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

HEIGHT, WIDTH, FOCAL_PX = 60, 80, 60.0
CAMERA = np.array([FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2])
# A room of 4 m by 3 m, 2.5 m high, and a block in it: two corners each.
ROOM = ((-2.0, -1.5, 0.0), (2.0, 1.5, 2.5))
BLOCK = ((0.5, -0.3, 0.0), (1.1, 0.3, 0.8))
FLOOR_RGB, BLOCK_RGB = (90, 90, 90), (200, 30, 30)
# A board, as of a table, and a box on it.
BOARD = ((-0.6, -0.4, 0.7), (0.6, 0.4, 0.75))
ON_BOARD = ((0.1, -0.1, 0.75), (0.22, 0.04, 0.93))


def looking(position: Sequence[float], degrees: float, down: float = 20.0) -> Float64:
    """T_world_camera (4, 4) at a position, z towards an angle in plan, and down by degrees."""
    angle, pitch = np.deg2rad(degrees), np.deg2rad(down)
    ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
    z = np.cos(pitch) * ahead - np.sin(pitch) * np.array([0.0, 0.0, 1.0])
    x = np.array([np.sin(angle), -np.cos(angle), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = position
    return T


def _entry(start: Float64, rays: Float64, box: object) -> tuple[Float64, Float64]:
    low, high = np.asarray(box)
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.sort(np.stack([(low - start) / rays, (high - start) / rays]), axis=0)
    return sides[0].max(axis=-1), sides[1].min(axis=-1)


def depth_of(T_world_camera: Float64, *blocks: object) -> tuple[Float64, Bool]:
    """Depth (h, w) of the room with blocks in it, metres, and where a block is seen."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(columns - 40) / FOCAL_PX, (rows - 30) / FOCAL_PX, np.ones_like(rows)], axis=2)
    rays = rays @ T_world_camera[:3, :3].T
    start = T_world_camera[:3, 3]
    depth = room = _entry(start, rays, ROOM)[1]
    for block in blocks:
        near, far = _entry(start, rays, block)
        depth = np.where((near < far) & (near > 0) & (near < depth), near, depth)
    return depth, depth < room


def walk_round(*blocks: object, steps: int = 72, part: float = 1.0) -> list[LocalGraph]:
    """Frames without detections, of a camera that goes round the middle of the room.

    The depth has noise of 3 mm. `part` = 0.5: it goes half of the way.
    """
    from support.merging import VOCABULARY, local_graph  # needs more than other tests have

    rng, frames = np.random.default_rng(0), []
    nothing = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, len(VOCABULARY.classes)))
    camera = Intrinsics(*(8.0 * CAMERA).tolist(), 8 * WIDTH, 8 * HEIGHT)
    for number, angle in enumerate(np.arange(steps) * 360.0 * part / steps):
        at = 1.2 * np.cos(np.deg2rad(angle)), 1.2 * np.sin(np.deg2rad(angle)), 1.5
        T = looking(at, angle + 180.0, 35.0)
        depth = depth_of(T, *blocks)[0] + rng.normal(0.0, 0.003, (HEIGHT, WIDTH))
        grid = DepthGrid(np.round(1000 * depth).astype(np.uint16), 8, camera)
        frames.append(
            local_graph(10**8 * (number + 1), *nothing, depth_grid=grid, T_world_camera=T)
        )
    return frames


def add_view(
    space: SeenSpace, T_world_camera: Float64, stamp_ns: int, block: object = BLOCK
) -> None:
    """Add what a camera in the room sees."""
    depth, hit = depth_of(T_world_camera, *([] if block is None else [block]))
    rgb = np.full((HEIGHT, WIDTH, 3), FLOOR_RGB, np.uint8)
    rgb[hit] = BLOCK_RGB
    depth_mm = np.round(1000 * depth).astype(np.uint16)
    space.depths_mm = np.concatenate([space.depths_mm.reshape(-1, HEIGHT, WIDTH), depth_mm[None]])
    space.colours = np.concatenate([space.colours.reshape(-1, HEIGHT, WIDTH, 3), rgb[None]])
    space.poses = np.concatenate([space.poses, T_world_camera[None]])
    space.cameras = np.concatenate([space.cameras, CAMERA[None]])
    space.stamps_ns = np.append(space.stamps_ns, stamp_ns)


def seen_room(block: object = BLOCK) -> SeenSpace:
    """A room that a camera at its middle, 1.2 m high, has seen on all sides."""
    space = SeenSpace()
    for number, degrees in enumerate(range(0, 360, 30)):
        add_view(space, looking((-0.5, 0.0, 1.2), degrees), 10**9 * (number + 1), block)
    return space
