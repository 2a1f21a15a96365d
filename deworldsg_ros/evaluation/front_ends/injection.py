"""Injection of faults into detections: faults of single frames, and faults that persist.

Each fault has its own random generator, seeded with the seed, the object and the frame or spell.
Runs are therefore independent of the order of objects, faults are independent of each other, and
a higher rate of a fault affects a superset of the objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from deworldsg_ros.evaluation.front_ends.assembly import (
    Detection,
    FrameDetections,
    Relation,
    spread,
    visible_box,
)
from deworldsg_ros.evaluation.front_ends.faults import MAX_FALSE_BOXES, Faults
from deworldsg_ros.scene.arrays import Bool, Float64, UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import Vocabulary

# Part of the seed: different faults have independent random numbers.
FRAME, LABEL, BLEED, MERGE, CUT, FALSE = 0, 2, 3, 4, 5, 6
# Width of the strip that a bleeding mask includes.
BLEED_PX = 10
# Two objects have a common border if their pixels are this near: masks may have gaps between them.
BORDER_PX = 3
# Range of the fraction that a cut mask keeps of the width or height of its object.
CUT_KEEPS = (0.4, 0.7)
# False boxes: ranges of the score, of the side in the room and in the image, and speed per second.
# They are as large as household objects and as confident as true detections.
FALSE_SCORE = (0.70, 0.97)
FALSE_SIZE_M = (0.15, 0.6)
FALSE_SIZE_PX = (40.0, 160.0)
FALSE_SPEED_PX_PER_S = 150.0
# Values of false boxes in an instance image: the highest values of 16 bits, unused by objects.
FIRST_FALSE = np.iinfo(np.uint16).max - MAX_FALSE_BOXES + 1


@dataclass(frozen=True)
class FrameFaults:
    """Faults that are independent from frame to frame.

    Attributes:
        flip: fraction of labels that are wrong.
        miss: fraction of detections that are dropped.
        jitter_px: standard deviation of each box edge, pixels.
    """

    flip: float = 0.0
    miss: float = 0.0
    jitter_px: float = 0.0


class Injection:
    """Injects faults into the detections of one frame after another.

    Args:
        vocabulary: classes of the detections.
        room_classes: indices of the classes that occur in the room. They are the labels of false
            boxes, and the wrong labels of detections without second choices.
        frame_faults: faults of single frames.
        faults: faults that persist.
        seed: random seed of all faults.
    """

    def __init__(
        self,
        vocabulary: Vocabulary,
        room_classes: Sequence[int],
        frame_faults: FrameFaults,
        faults: Faults,
        seed: int,
    ) -> None:
        self._class_count = len(vocabulary.classes)
        self._room_classes = sorted(set(room_classes))
        self._frame_faults = frame_faults
        self._faults = faults
        self._seed = seed
        self._anchors: dict[tuple[int, int], Float64] = {}

    def apply(self, seen: FrameDetections, frame: RgbdFrame, number: int) -> FrameDetections:
        """The detections of a frame with all faults; `number` is the number of the frame."""
        stamp_s = 1e-9 * frame.stamp_ns
        seen = self._spoil_masks(seen, stamp_s)
        detections: list[Detection | None] = []
        for item in seen.detections:
            labelled = self._mislabel(item, stamp_s)
            detections.append(self._disturb(labelled, number, frame))
        seen = keep(seen, detections)
        return self._add_false(seen, frame, stamp_s) if self._faults.false else seen

    def _spell(self, kind: int, object_id: int, stamp_s: float, length_s: float) -> int:
        """Number of the spell at this time; the start of spells depends on object and fault."""
        phase = np.random.default_rng([self._seed, kind, object_id]).random()
        return int(stamp_s / length_s + phase)

    def _affected(
        self, kind: int, fraction: float, object_id: int, stamp_s: float
    ) -> np.random.Generator | None:
        """The generator of the spell if the fault affects the object in it, else None."""
        if not fraction:
            return None
        spell = self._spell(kind, object_id, stamp_s, self._faults.spell_s)
        generator = np.random.default_rng([self._seed, kind, object_id, spell])
        return generator if generator.random() < fraction else None

    def _mislabel(self, item: Detection, stamp_s: float) -> Detection:
        generator = self._affected(LABEL, self._faults.label, item.instance, stamp_s)
        if generator is None:
            return item
        probabilities = item.class_probabilities
        best = int(probabilities.argmax())
        # Second choices of the detector: classes above the evenly spread rest of the probability.
        others = np.flatnonzero(probabilities > 1.001 * probabilities.min())
        others = others[others != best]
        if not len(others):
            others = np.array([index for index in self._room_classes if index != best], np.int64)
        return item if not len(others) else relabelled(item, int(generator.choice(others)))

    def _disturb(self, item: Detection, number: int, frame: RgbdFrame) -> Detection | None:
        """The detection with the faults of a single frame; None if it is dropped."""
        generator = np.random.default_rng([self._seed, FRAME, number, item.instance])
        missed, flipped = generator.random(2)
        edges = generator.normal(size=4)
        if missed < self._frame_faults.miss:
            return None
        if flipped < self._frame_faults.flip and self._class_count > 1:
            best = int(item.class_probabilities.argmax())
            other = int(generator.integers(self._class_count - 1))
            item = relabelled(item, other + (other >= best))
        if not self._frame_faults.jitter_px:
            return item
        size = [frame.intrinsics.width - 1.0, frame.intrinsics.height - 1.0] * 2
        box = np.clip(item.box_xyxy + self._frame_faults.jitter_px * edges, 0.0, size)
        return None if (box[2:] - box[:2] < 1.0).any() else replace(item, box_xyxy=box)

    def _spoil_masks(self, seen: FrameDetections, stamp_s: float) -> FrameDetections:
        """Merge, cut and bleed masks."""
        faults = self._faults
        if not (faults.merge or faults.cut or faults.bleed):
            return seen
        image = seen.instance_image.copy()
        ids = [item.instance for item in seen.detections]
        for object_id in sorted(ids):
            if self._affected(MERGE, faults.merge, object_id, stamp_s) is not None:
                neighbour = _neighbour(image, object_id, ids)
                image[image == neighbour] = object_id
        for object_id in sorted(ids):
            generator = self._affected(CUT, faults.cut, object_id, stamp_s)
            if generator is not None:
                _cut(image, object_id, int(generator.integers(4)), generator.uniform(*CUT_KEEPS))
        before = image.copy()
        for object_id in sorted(ids):
            if self._affected(BLEED, faults.bleed, object_id, stamp_s) is not None:
                image[_grown(before == object_id, BLEED_PX)] = object_id
        differs = image != seen.instance_image
        changed = set(np.unique((image[differs], seen.instance_image[differs])).tolist())
        detections: list[Detection | None] = []
        for item in seen.detections:
            box = visible_box(image, item.instance) if item.instance in changed else item.box_xyxy
            detections.append(None if box is None else replace(item, box_xyxy=box))
        return keep(replace(seen, instance_image=image), detections)

    def _add_false(
        self, seen: FrameDetections, frame: RgbdFrame, stamp_s: float
    ) -> FrameDetections:
        """Add false boxes on the background."""
        if not self._room_classes:
            return seen
        image = seen.instance_image.copy()
        background = ~np.isin(image, [item.instance for item in seen.detections])
        background &= frame.depth_m > 0
        detections = list(seen.detections)
        for index in range(MAX_FALSE_BOXES):
            length_s = self._faults.false_s
            spell = self._spell(FALSE, index, stamp_s, length_s)
            generator = np.random.default_rng([self._seed, FALSE, index, spell])
            if generator.random() * MAX_FALSE_BOXES >= self._faults.false:
                continue
            class_index = int(generator.choice(self._room_classes))
            certainty = float(generator.uniform(*FALSE_SCORE))
            age_s = stamp_s - (spell - self._phase(index)) * length_s
            region = (
                self._staying(generator, (index, spell), frame, background)
                if generator.random() < 0.5
                else _moving(generator, age_s, frame)
            )
            if region is None:
                continue
            value = FIRST_FALSE + index
            mask = region & background
            image[mask] = value
            background &= ~mask
            box = visible_box(image, value)
            if box is None:
                continue
            scores = spread({class_index: certainty}, self._class_count)
            detections.append(Detection(box, scores, certainty, value))
        return replace(seen, detections=detections, instance_image=image)

    def _phase(self, index: int) -> float:
        return float(np.random.default_rng([self._seed, FALSE, index]).random())

    def _staying(
        self,
        generator: np.random.Generator,
        key: tuple[int, int],
        frame: RgbdFrame,
        background: Bool,
    ) -> Bool | None:
        """Pixels of a cube fixed in the room, at a surface point of the spell's first frame."""
        camera = frame.intrinsics
        half_m = generator.uniform(*FALSE_SIZE_M) / 2
        rows, columns = np.nonzero(background)
        if not len(rows):
            return None
        if key not in self._anchors:
            pixel = int(generator.integers(len(rows)))
            u, v = columns[[pixel]], rows[[pixel]]
            point = camera.back_project(u, v, frame.depth_m[v, u].astype(np.float64))[0]
            T = frame.T_world_camera
            self._anchors[key] = T[:3, :3] @ point + T[:3, 3]
        T = frame.T_world_camera
        x, y, z = T[:3, :3].T @ (self._anchors[key] - T[:3, 3])
        region = np.zeros(background.shape, bool)
        if z <= half_m:
            return None
        left, right = ((x + d) / z * camera.fx + camera.cx for d in (-half_m, half_m))
        top, bottom = ((y + d) / z * camera.fy + camera.cy for d in (-half_m, half_m))
        region[_span(top, bottom, camera.height), _span(left, right, camera.width)] = True
        return region & (np.abs(frame.depth_m - z) < half_m)


def relabelled(item: Detection, class_index: int) -> Detection:
    """The detection with the probabilities of its best class and of another class swapped."""
    probabilities = item.class_probabilities.copy()
    best = int(probabilities.argmax())
    probabilities[[best, class_index]] = probabilities[[class_index, best]]
    return replace(item, class_probabilities=probabilities)


def keep(seen: FrameDetections, detections: Sequence[Detection | None]) -> FrameDetections:
    """The frame with these detections instead of its own, in the same order; None drops one."""
    kept = [index for index, item in enumerate(detections) if item is not None]
    new_index = {index: new for new, index in enumerate(kept)}
    relations = [
        Relation(new_index[item.subject], new_index[item.object], item.score, item.probabilities)
        for item in seen.relations
        if item.subject in new_index and item.object in new_index
    ]
    return FrameDetections(
        [item for item in detections if item is not None], relations, seen.instance_image
    )


def _neighbour(image: UInt16, object_id: int, ids: Sequence[int]) -> int:
    """The detected object with most pixels at the border of this one; itself if there is none."""
    beside = image[_grown(image == object_id, BORDER_PX)]
    values, counts = np.unique(beside, return_counts=True)
    others = np.isin(values, ids) & (values != object_id)
    return int(values[others][counts[others].argmax()]) if others.any() else object_id


def _grown(mask: Bool, by_px: int) -> Bool:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by_px + 1, 2 * by_px + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _cut(image: UInt16, object_id: int, side: int, kept_fraction: float) -> None:
    """Keep the left, right, upper or lower part of an object's pixels in the image."""
    rows, columns = np.nonzero(image == object_id)
    if not len(rows):
        return
    along = columns if side < 2 else rows
    if side % 2:
        along = -along
    edge = along.min() + kept_fraction * (along.max() - along.min())
    removed = along > edge
    image[rows[removed], columns[removed]] = 0


def _moving(generator: np.random.Generator, age_s: float, frame: RgbdFrame) -> Bool | None:
    """Pixels of a box that moves through the image at constant speed; None outside the image."""
    height, width = frame.depth_m.shape
    centre = generator.random(2) * (width, height)
    heading = 2 * np.pi * generator.random()
    half = generator.uniform(*FALSE_SIZE_PX, size=2) / 2
    centre = centre + FALSE_SPEED_PX_PER_S * age_s * np.array([np.cos(heading), np.sin(heading)])
    (left, top), (right, bottom) = centre - half, centre + half
    region = np.zeros((height, width), bool)
    region[_span(top, bottom, height), _span(left, right, width)] = True
    return region if region.any() else None


def _span(low: float, high: float, size: int) -> slice:
    return slice(int(np.clip(low, 0, size)), int(np.clip(high, 0, size)))
