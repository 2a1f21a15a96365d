"""Ground truth: the objects, their visible parts and the relations, by fixed rules."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .render import CX, CY, FOCAL_PX, HEIGHT, WIDTH
from .room import PlacedObject

# An object with this many pixels is seen in a frame.
SEEN_PX = 200
# An object with a COCO class that is seen in this many frames is detectable.
DETECTABLE_FRAMES = 5
VOXEL_M = 0.02


class SeenSurface:
    """Counts pixels and frames of each object, and collects its visible 2 cm voxels."""

    def __init__(self) -> None:
        self.frames_seen: dict[int, int] = defaultdict(int)
        self.max_pixels: dict[int, int] = defaultdict(int)
        self._voxels: list[NDArray[np.int32]] = []

    def add(
        self,
        instances: NDArray[np.uint16],
        depth_m: NDArray[np.float32],
        T_world_camera: NDArray[np.float64],
    ) -> None:
        """Add one frame. `depth_m` is without noise, 0 = no value."""
        ids, counts = np.unique(instances, return_counts=True)
        for object_id, count in zip(ids.tolist(), counts.tolist()):
            if object_id == 0:
                continue
            self.max_pixels[object_id] = max(self.max_pixels[object_id], count)
            if count >= SEEN_PX:
                self.frames_seen[object_id] += 1
        rows, columns = np.nonzero(depth_m > 0)
        z = depth_m[rows, columns].astype(float)
        camera = np.stack([(columns - CX) * z / FOCAL_PX, (rows - CY) * z / FOCAL_PX, z], 1)
        world = camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        cells = np.floor(world / VOXEL_M).astype(np.int32)
        self._voxels.append(
            np.unique(np.column_stack([instances[rows, columns].astype(np.int32), cells]), axis=0)
        )

    def centroids(self) -> dict[int, list[float]]:
        """Mean centre of the visible voxels by object id, metres, world."""
        if not self._voxels:
            return {}
        voxels = np.unique(np.concatenate(self._voxels), axis=0)
        ids, starts = np.unique(voxels[:, 0], return_index=True)
        groups = np.split(voxels[:, 1:], starts[1:])
        return {int(i): _rounded((g.mean(0) + 0.5) * VOXEL_M) for i, g in zip(ids, groups) if i > 0}


def describe_objects(objects: list[PlacedObject], seen: SeenSurface) -> list[dict[str, Any]]:
    """One record per object for JSON. Lengths in metres, world frame, z up."""
    centroids = seen.centroids()
    records = []
    for item in objects:
        vertices = np.concatenate([mesh.vertices for mesh, _ in item.parts])
        yaw = np.deg2rad(item.yaw_deg)
        local_centre = (item.local_low + item.local_high) / 2
        c, s = np.cos(yaw), np.sin(yaw)
        centre = np.array(item.position) + [
            c * local_centre[0] - s * local_centre[1],
            s * local_centre[0] + c * local_centre[1],
            local_centre[2],
        ]
        frames = seen.frames_seen.get(item.object_id, 0)
        records.append(
            {
                "id": item.object_id,
                "class": item.class_name,
                "label": item.label,
                "name": item.name,
                "kind": item.kind,
                "aabb": [_rounded(vertices.min(0)), _rounded(vertices.max(0))],
                "obb": {
                    "center": _rounded(centre),
                    "size": _rounded(item.local_high - item.local_low),
                    "yaw_deg": round(float((item.yaw_deg + 180) % 360 - 180), 3),
                },
                "surface_centroid": _rounded(_surface_centroid(item)),
                "visible_centroid": centroids.get(item.object_id),
                "frames_seen": frames,
                "max_pixels": seen.max_pixels.get(item.object_id, 0),
                "detectable": bool(item.class_name) and frames >= DETECTABLE_FRAMES,
            }
        )
    return records


def find_relations(objects: list[PlacedObject]) -> list[dict[str, Any]]:
    """Directed relations. Each ordered pair gets the predicate of the first rule that applies.

    1. in, on, attached to: the direct support of the subject.
    2. against: two pieces of furniture on the floor with a gap of at most 5 cm. They share half of
       the shorter side and 0.3 m of height. The subject is the lower one.
    3. above, under: furniture, screens and objects on the wall (with the 15 cm in front of them).
       The boxes overlap by half of the smaller one, with a vertical gap of −2 cm to 1.2 m. Also
       furniture on the floor inside a table's footprint.
    4. with: a table and a chair within 0.35 m. The chair is near the table.
    5. near: furniture on the floor within 0.5 m, or small objects on one support within 0.1 m. Each
       is one of the two nearest of the other.
    """
    found: dict[tuple[int, int], str] = {}
    by_name = {item.name: item for item in objects}
    boxes = {item.object_id: _aabb(item) for item in objects}

    def say(subject: PlacedObject, predicate: str, other: PlacedObject) -> None:
        found.setdefault((subject.object_id, other.object_id), predicate)

    for item in objects:
        if item.parent and item.predicate:
            say(item, item.predicate, by_name[item.parent])

    floor_pieces = [o for o in objects if o.kind == "furniture" and boxes[o.object_id][0][2] < 0.05]
    taken = set(found)
    for a in floor_pieces:
        for b in floor_pieces:
            low_a, high_a = boxes[a.object_id]
            low_b, high_b = boxes[b.object_id]
            if a is b or high_a[2] > high_b[2] or _linked(taken, a, b):
                continue
            shared = np.minimum(high_a, high_b) - np.maximum(low_a, low_b)
            side = min(0, 1, key=lambda k: shared[k])
            along = 1 - side
            shorter = min(high_a[along] - low_a[along], high_b[along] - low_b[along])
            touching = -0.05 <= shared[side] <= 0.05
            if touching and shared[along] >= 0.5 * shorter and shared[2] >= 0.3:
                say(a, "against", b)

    large = [o for o in objects if o.kind in ("furniture", "wall", "screen")]
    for a in large:
        for b in large:
            if a is b or _linked(taken, a, b):
                continue
            low_a, high_a = _grown(a, boxes)
            low_b, high_b = _grown(b, boxes)
            overlap = np.minimum(high_a, high_b) - np.maximum(low_a, low_b)
            smaller = min(np.prod((high_a - low_a)[:2]), np.prod((high_b - low_b)[:2]))
            if min(overlap[:2]) <= 0 or overlap[0] * overlap[1] < 0.5 * smaller:
                continue
            gap = low_a[2] - high_b[2]
            tucked = "table" in b.name and low_a[2] < 0.05 and high_a[2] < high_b[2]
            if -0.02 <= gap <= 1.2:
                say(a, "above", b)
                say(b, "under", a)
            elif tucked:
                say(a, "under", b)
                say(b, "above", a)

    tables = [o for o in floor_pieces if "table" in o.name]
    for table in tables:
        for seat in floor_pieces:
            if seat.class_name == "chair" and _gap(table, seat, boxes) <= 0.35:
                say(table, "with", seat)
                say(seat, "near", table)

    by_support: dict[tuple[str, int], list[PlacedObject]] = defaultdict(list)
    for item in objects:
        if item.kind == "small" and item.parent:
            height = int(round(boxes[item.object_id][0][2] / 0.02))
            by_support[(item.parent, height)].append(item)
    for group, reach in [(floor_pieces, 0.5), *((g, 0.10) for g in by_support.values())]:
        nearest = {}
        for a in group:
            others = sorted((_gap(a, b, boxes), b.object_id) for b in group if b is not a)
            nearest[a.object_id] = {i for gap, i in others[:2] if gap <= reach}
        for a in group:
            for b in group:
                mutual = b.object_id in nearest[a.object_id] and a.object_id in nearest[b.object_id]
                if mutual and (a.object_id, b.object_id) not in found:
                    say(a, "near", b)

    return [
        {"subject": subject, "predicate": predicate, "object": other}
        for (subject, other), predicate in sorted(found.items())
    ]


def camera_record() -> dict[str, Any]:
    """The intrinsics. Pixel centres have integer coordinates."""
    return {"width": WIDTH, "height": HEIGHT, "fx": FOCAL_PX, "fy": FOCAL_PX, "cx": CX, "cy": CY}


def _linked(taken: set[tuple[int, int]], a: PlacedObject, b: PlacedObject) -> bool:
    pair = (a.object_id, b.object_id)
    return pair in taken or pair[::-1] in taken


def _aabb(item: PlacedObject) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    vertices = np.concatenate([mesh.vertices for mesh, _ in item.parts])
    return vertices.min(0), vertices.max(0)


def _grown(
    item: PlacedObject, boxes: dict[int, tuple[NDArray, NDArray]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = boxes[item.object_id]
    if item.kind != "wall":
        return low, high
    margin = np.array([0.15, 0.15, 0.0])
    return low - margin, high + margin


def _gap(a: PlacedObject, b: PlacedObject, boxes: dict[int, tuple[NDArray, NDArray]]) -> float:
    low_a, high_a = boxes[a.object_id]
    low_b, high_b = boxes[b.object_id]
    apart = np.maximum(np.maximum(low_a - high_b, low_b - high_a)[:2], 0)
    return float(np.linalg.norm(apart))


def _surface_centroid(item: PlacedObject) -> NDArray[np.float64]:
    total, weight = np.zeros(3), 0.0
    for mesh, _ in item.parts:
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        total += ((a + b + c) / 3 * area[:, None]).sum(0)
        weight += float(area.sum())
    return total / weight


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [round(float(v), 4) for v in values]
