"""A photo of each object, cut from frames of the camera."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose
from deworldsg_ros.wire import messages as wire

# Frames of a recording that are kept: 64 MB, and at least as many as a walk around a room needs.
MOST_BYTES, LEAST_FRAMES = 64 << 20, 8
POINTS_OF_AN_OBJECT = 64
# A point is seen if the depth image has a surface this close to it, and this part of its distance.
NEAR_M, NEAR_PART = 0.05, 0.02
# Of an object that is cut off or covered by more than this, there is no photo.
LEAST_SEEN = 0.5
# Around the object, as a part of the photo.
MARGIN = 0.18


class Album:
    """Keeps frames of a recording, evenly spaced, however long it is."""

    def __init__(self) -> None:
        self.frames: list[RgbdFrame] = []
        self._every = 1
        self._count = 0

    def add(self, frame: RgbdFrame) -> None:
        """Keep a frame, or not."""
        if self._count % self._every == 0:
            size = frame.rgb.nbytes + frame.depth_m.nbytes
            if len(self.frames) >= max(MOST_BYTES // size, LEAST_FRAMES):
                del self.frames[1::2]
                self._every *= 2
            if self._count % self._every == 0:
                self.frames.append(frame)
        self._count += 1


def photos_of(
    graph: wire.SceneGraphMessage, frames: Iterable[RgbdFrame], side_px: int
) -> dict[int, UInt8]:
    """The best photo of each object that a frame shows.

    Args:
        graph: with surface points.
        frames: in the world frame of the graph.
        side_px: sides of the photos.

    Returns:
        (side_px, side_px, 3) uint8 RGB by id of the node. Of an object that no frame shows by at
        least one half, there is none.
    """
    points = {node.id: _sample(surface_points(node)) for node in graph.nodes}
    best: dict[int, tuple[float, RgbdFrame, Float64]] = {}
    for frame in frames:
        for node_id, cloud in points.items():
            if not len(cloud):
                continue
            score, box = _sight(frame, cloud)
            if score > 0 and (node_id not in best or score > best[node_id][0]):
                best[node_id] = score, frame, box
    return {node_id: _cut(frame, box, side_px) for node_id, (_, frame, box) in best.items()}


def _sample(points: Float64) -> Float64:
    return points[:: max(1, len(points) // POINTS_OF_AN_OBJECT)]


def _sight(frame: RgbdFrame, points: Float64) -> tuple[float, Float64]:
    """How well a frame shows an object: 0 = not; and the box x1 y1 x2 y2 around its points."""
    T = invert_pose(frame.T_world_camera)
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    camera = frame.intrinsics
    is_ahead = z > NEAR_M
    depth = np.where(is_ahead, z, 1.0)
    u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    inside = is_ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    if inside.mean() < LEAST_SEEN:
        return 0.0, np.zeros(4)
    seen_m = frame.depth_m[v[inside].astype(int), u[inside].astype(int)]
    share = float((np.abs(seen_m - z[inside]) < NEAR_M + NEAR_PART * z[inside]).sum()) / len(points)
    u, v = u[inside], v[inside]
    box = np.array([u.min(), v.min(), u.max() + 1, v.max() + 1])
    if share < LEAST_SEEN:
        return 0.0, box
    # More pixels are better, but not if the object is covered.
    return share**4 * float(np.sqrt((box[2] - box[0]) * (box[3] - box[1]))), box


def _cut(frame: RgbdFrame, box: Float64, side_px: int) -> UInt8:
    """A square around a box, moved into the image; what is still outside is grey."""
    height, width = frame.rgb.shape[:2]
    side = int(np.ceil(max(box[2] - box[0], box[3] - box[1]) * (1 + 2 * MARGIN)))
    middle = np.array([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2])
    room = np.array([width - side, height - side])
    low = np.where(room >= 0, np.clip(middle - side / 2, 0, np.maximum(room, 0)), room / 2)
    x, y = np.round(low).astype(int).tolist()
    photo = np.full((side, side, 3), 128, np.uint8)
    rows, columns = slice(max(y, 0), y + side), slice(max(x, 0), x + side)
    part = frame.rgb[rows, columns]
    top, left = max(-y, 0), max(-x, 0)
    photo[top : top + part.shape[0], left : left + part.shape[1]] = part
    how = cv2.INTER_AREA if side > side_px else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(photo, (side_px, side_px), interpolation=how))
