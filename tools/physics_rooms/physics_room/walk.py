"""Path of a hand-held camera: overviews, and every loaded surface from two or more sides."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d

from .plane import Rect, rect_of
from .shapes import Item

CELL_M = 0.1
# What is higher than this blocks the camera.
TALL_M = 1.05
STEP_M, STEP_RAD = 0.16, np.deg2rad(9)

View = tuple[NDArray[np.float64], NDArray[np.float64]]


class FloorMap:
    """Where the camera can be, as a grid of the floor."""

    def __init__(self, items: list[Item], size: tuple[float, float, float]) -> None:
        self.low = -np.array(size[:2]) / 2
        shape = np.ceil(np.array(size[:2]) / CELL_M).astype(int)
        xs, ys = (self.low[k] + (np.arange(shape[k]) + 0.5) * CELL_M for k in range(2))
        grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1)
        blocked = np.zeros(shape, bool)
        occupied = np.zeros(shape, bool)
        for item in items:
            rect = rect_of(item)
            if item.anchor == "free" and item.kind != "screen":
                continue
            local = np.abs((grid - rect.centre) @ rect.axes().T)
            inside = (local <= rect.half + 0.02).all(-1)
            occupied |= inside & (rect.low < 1.0)
            blocked |= inside & (rect.high > TALL_M) & (rect.low < 1.8)
        border = np.ones(shape, bool)
        border[1:-1, 1:-1] = False
        self.clear = distance_transform_edt(~(blocked | border)) * CELL_M
        self.open = distance_transform_edt(~(occupied | border)) * CELL_M

    def cell(self, place: NDArray[np.float64]) -> tuple[int, int]:
        """Cell of a place on the floor."""
        index = np.clip(
            ((place[:2] - self.low) / CELL_M).astype(int), 0, np.array(self.clear.shape) - 1
        )
        return int(index[0]), int(index[1])

    def place(self, cell: tuple[int, int]) -> NDArray[np.float64]:
        """Middle of a cell."""
        return self.low + (np.array(cell) + 0.5) * CELL_M

    def route(
        self, start: NDArray[np.float64], goal: NDArray[np.float64]
    ) -> list[NDArray[np.float64]]:
        """Short way between two places that keeps away from tall things and prefers free floor."""
        first, last = self.cell(start), self.cell(goal)
        queue, cost, back = [(0.0, first)], {first: 0.0}, {}
        while queue:
            _, here = heapq.heappop(queue)
            if here == last:
                break
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
                there = here[0] + dx, here[1] + dy
                if not (
                    0 <= there[0] < self.clear.shape[0] and 0 <= there[1] < self.clear.shape[1]
                ):
                    continue
                if self.clear[there] < 0.2:
                    continue
                new = cost[here] + np.hypot(dx, dy) * (1.0 + 1.5 * (self.open[there] < 0.12))
                if new < cost.get(there, np.inf):
                    cost[there] = new
                    back[there] = here
                    ahead = np.hypot(there[0] - last[0], there[1] - last[1])
                    heapq.heappush(queue, (new + ahead, there))
        cells = [last]
        while cells[-1] in back:
            cells.append(back[cells[-1]])
        return [self.place(cell) for cell in cells[::-1]]


def plan(
    items: list[Item],
    size: tuple[float, float, float],
    sees,
    rng: np.random.Generator,
    longest: int = 150,
) -> NDArray[np.float64]:
    """T_room_camera (n, 4, 4) of all frames.

    Args:
        items: with their final poses.
        size: of the room, m.
        sees: function of a camera position and points (n, 3), which of them it sees: (n,) bool.
        rng: random numbers.
        longest: most frames.
    """
    floor = FloorMap(items, size)
    views = _overviews(floor, size, rng)
    for item in sorted(items, key=lambda i: -_load(i, items)):
        if _load(item, items) or item.kind == "furn":
            views += _views_of(item, items, floor, sees, rng)
    while True:
        poses = _walk(_ordered(views), floor, rng)
        if len(poses) <= longest or len(views) < 8:
            return poses[:longest]
        # Leave out the last views: they show the least loaded pieces.
        views = views[: max(7, int(len(views) * min(0.93, longest / len(poses))))]


def _load(item: Item, items: list[Item]) -> int:
    """Number of small things over an item's footprint and near its height."""
    if item.kind not in ("furn", "wallm"):
        return 0
    rect = rect_of(item)
    return sum(
        o.anchor == "free"
        and o.kind in ("small", "screen")
        and _within(rect, o.position)
        and o.position[2] > rect.low - 0.01
        for o in items
    )


def _within(rect: Rect, place: NDArray[np.float64]) -> bool:
    return bool((np.abs(rect.axes() @ (place[:2] - rect.centre)) <= rect.half + 0.02).all())


def _overviews(
    floor: FloorMap, size: tuple[float, float, float], rng: np.random.Generator
) -> list[View]:
    """Looks across the room from near three corners."""
    views = []
    for sx, sy in rng.permutation([(1, 1), (1, -1), (-1, 1), (-1, -1)])[:3]:
        wanted = np.array([sx, sy]) * np.array(size[:2]) / 2 * 0.7
        cells = np.argwhere(floor.clear > 0.3)
        places = np.array([floor.place(tuple(c)) for c in cells])
        place = places[np.linalg.norm(places - wanted, axis=1).argmin()]
        target = np.array(
            [-sx * rng.uniform(0.1, 0.6), -sy * rng.uniform(0.1, 0.6), rng.uniform(0.4, 0.8)]
        )
        views.append((np.array([*place, rng.uniform(1.4, 1.7)]), target))
    return views


def _views_of(
    item: Item, items: list[Item], floor: FloorMap, sees, rng: np.random.Generator
) -> list[View]:
    """Two or three views of what an item carries, from directions at least 40 degrees apart."""
    rect = rect_of(item)
    load = _load(item, items)
    carried = [
        o.position + [0, 0, 0.03] for o in items if o.anchor == "free" and _within(rect, o.position)
    ]
    middle = np.array([*rect.centre, min(rect.high, 1.5) if rect.high < 1.3 else 0.5 * rect.high])
    points = np.array(carried) if carried else middle[None]
    target = 0.5 * points.mean(0) + 0.5 * middle if carried else middle
    cells = np.argwhere(floor.clear > 0.25)
    places = np.array([floor.place(tuple(c)) for c in cells])
    reach = np.linalg.norm(places - rect.centre, axis=1)
    close = rng.random() < 0.3
    low, high = (0.6, 1.0) if close else (0.9, 1.9)
    keep = (reach > low + 0.6 * rect.half.min()) & (reach < high + rect.half.max())
    places = places[keep]
    if not len(places):
        return []
    chosen: list[View] = []
    for k in rng.permutation(len(places))[:24]:
        height = np.clip(target[2] + rng.uniform(0.35, 0.95), 1.05, 1.8)
        eye = np.array([*places[k], height])
        share = float(np.mean(sees(eye, points)))
        if share < 0.5:
            continue
        around = [np.arctan2(*(e - target)[1::-1]) for e, _ in chosen]
        own = np.arctan2(*(eye - target)[1::-1])
        if all(abs(np.angle(np.exp(1j * (own - a)))) > np.deg2rad(38) for a in around):
            chosen.append((eye, target + rng.normal(0, 0.06, 3)))
        if len(chosen) >= (1 if not load else 2 if load < 7 else 3):
            break
    return chosen


def _ordered(views: list[View]) -> list[View]:
    """Each next view is near the last one, in place and direction."""
    left = list(views[1:])
    path = [views[0]]
    while left:
        eye, target = path[-1]
        cost = [np.linalg.norm(e - eye) + 0.5 * np.linalg.norm(t - target) for e, t in left]
        path.append(left.pop(int(np.argmin(cost))))
    return path


def _walk(views: list[View], floor: FloorMap, rng: np.random.Generator) -> NDArray[np.float64]:
    """Frames along the views, with limited speed and a tremor."""
    eyes, targets = [], []
    for (eye, target), (goal, aim) in zip(views, views[1:]):
        route = floor.route(eye, goal)
        way = np.array([eye[:2], *route[1:-1], goal[:2]])
        length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        turn = _angle(target - eye, aim - goal)
        count = max(2, int(np.ceil(max(length[-1] / STEP_M, turn / STEP_RAD))))
        t = np.linspace(0, 1, count, endpoint=False)
        s = t * length[-1]
        place = np.column_stack([np.interp(s, length, way[:, k]) for k in range(2)])
        eyes.append(np.column_stack([place, eye[2] + t * (goal[2] - eye[2])]))
        targets.append(target + t[:, None] * (aim - target))
        if rng.random() < 0.25:
            eyes.append(np.repeat(goal[None], 2, 0))
            targets.append(np.repeat(aim[None], 2, 0))
    eye = gaussian_filter1d(np.concatenate(eyes), 0.9, axis=0, mode="nearest")
    target = gaussian_filter1d(np.concatenate(targets), 0.9, axis=0, mode="nearest")
    tremor = gaussian_filter1d(rng.standard_normal((len(eye), 6)), 1.0, axis=0, mode="nearest")
    eye = eye + tremor[:, :3] * 0.006
    return np.array(
        [_look(e, t, shake) for e, t, shake in zip(eye, target, np.deg2rad(tremor[:, 3:]))]
    )


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    cosine = a @ b / (np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.arccos(np.clip(cosine, -1, 1)))


def _look(
    eye: NDArray[np.float64], target: NDArray[np.float64], shake: NDArray[np.float64]
) -> NDArray[np.float64]:
    forward = target - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    x, y, z = shake
    small = np.array([[1, -z, y], [z, 1, -x], [-y, x, 1.0]])
    u, _, vt = np.linalg.svd(small)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward]) @ (u @ vt)
    pose[:3, 3] = eye
    return pose
