"""Injection of faults into detections, and their assembly into the output of perception."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from deworldsg_ros.perception.stage import Perceived, instance_image
from deworldsg_ros.poses.trajectory import parse_numbers
from deworldsg_ros.scene.arrays import Bool, Float64, UInt16
from deworldsg_ros.scene.camera import MaskPatch, RgbdFrame
from deworldsg_ros.scene.errors import EvaluationError
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary

# --- Faults of detections that persist over frames, as picklable values.

FRACTIONS = ("label", "bleed", "merge", "cut")
# Maximum number of false detections at once.
MAX_FALSE_BOXES = 8


@dataclass(frozen=True)
class Faults:
    """Persistent faults of detections, and their rates.

    Time is divided into spells of equal length, whose start depends on object and fault. A fault
    affects an object during whole spells.

    Attributes:
        label: fraction of spells in which an object has the same wrong class throughout.
        false: mean number of false boxes in view. Half of them stay at a position in the room, half
            move through the image.
        bleed: fraction of spells in which a mask includes a strip around the object.
        merge: fraction of spells in which a mask includes the neighbour with the longest common
            border, which is then not detected.
        cut: fraction of spells in which a mask covers only a part of its object.
        spell_s: length of a spell, seconds.
        false_s: duration of a false box, seconds.

    Raises:
        EvaluationError: a value is out of range.
    """

    label: float = 0.0
    false: float = 0.0
    bleed: float = 0.0
    merge: float = 0.0
    cut: float = 0.0
    spell_s: float = 2.0
    false_s: float = 0.5

    def __post_init__(self) -> None:
        for name in FRACTIONS:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise EvaluationError(f"fault {name}={getattr(self, name):g}: expected 0 to 1")
        if not 0.0 <= self.false <= MAX_FALSE_BOXES:
            raise EvaluationError(f"fault false={self.false:g}: expected 0 to {MAX_FALSE_BOXES}")
        for name in ("spell_s", "false_s"):
            # A shorter spell is shorter than a frame of any camera.
            if not 1e-3 <= getattr(self, name) < math.inf:
                raise EvaluationError(
                    f"fault {name}={getattr(self, name):g}: expected at least 0.001 seconds"
                )

    def describe(self) -> str:
        """Values other than the defaults, e.g. ``label 0.1 spell_s 1``; empty without faults."""
        names = [field.name for field in fields(self)]
        changed = [name for name in names if getattr(self, name) != getattr(Faults, name)]
        return " ".join(f"{name} {getattr(self, name):g}" for name in changed)


def parse_faults(text: str) -> Faults:
    """Faults of ``name=number,name=number,…``; raises ConfigurationError, EvaluationError."""
    return Faults(**parse_numbers(text, [field.name for field in fields(Faults)], "fault"))


# --- Assembly of detections into the output of perception.

# Probabilities are clipped this far from 0 and 1: the logits stay finite (within ±13.8).
LOGIT_MARGIN = 1e-6
# An object is detected from this size on: visible pixels, and both sides of its box.
# bags/README.md counts an object as visible from the same number of pixels on.
MIN_VISIBLE_PX = 200
MIN_BOX_SIDE_PX = 10


@dataclass(frozen=True)
class Detection:
    """One object in the image, before selection.

    Attributes:
        box_xyxy: (4,) pixels.
        class_probabilities: (C,) float64, sums to one.
        score: confidence of the detector.
        instance: value of the object in the instance image of the frame.
    """

    box_xyxy: Float64
    class_probabilities: Float64
    score: float
    instance: int


@dataclass(frozen=True)
class Relation:
    """One relation between two detections.

    Attributes:
        subject, object: indices of the detections.
        score: confidence of the relation.
        probabilities: (R,) float64, of every predicate.
    """

    subject: int
    object: int
    score: float
    probabilities: Float64


@dataclass(frozen=True)
class FrameDetections:
    """Detections and relations of one frame.

    Attributes:
        detections: the detections.
        relations: relations between them, by index.
        instance_image: (H, W) uint16, value of the object of each pixel.
    """

    detections: Sequence[Detection]
    relations: Sequence[Relation]
    instance_image: UInt16


def logits(probabilities: Float64) -> Float64:
    """log(p / (1 - p)) of each probability, clipped to [`LOGIT_MARGIN`, 1 - `LOGIT_MARGIN`]."""
    inside = np.clip(probabilities, LOGIT_MARGIN, 1.0 - LOGIT_MARGIN)
    return np.asarray(np.log(inside / (1.0 - inside)))


def spread(stated: Mapping[int, float], count: int) -> Float64:
    """Distribution (count,) with the stated probabilities; the rest is spread evenly."""
    others = count - len(stated)
    left = max(0.0, 1.0 - sum(stated.values()))
    distribution = np.full(count, left / others if others else 0.0)
    for index, probability in stated.items():
        distribution[index] = probability
    return np.asarray(distribution / distribution.sum())


def visible_box(instances: UInt16, object_id: int) -> Float64 | None:
    """Box x1, y1, x2, y2 of an object's pixels; None if too few of them are visible."""
    mask = instances == object_id
    if int(np.count_nonzero(mask)) < MIN_VISIBLE_PX:
        return None
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    box = np.array([columns[0], rows[0], columns[-1], rows[-1]], np.float64)
    return None if (box[2:] - box[:2] < MIN_BOX_SIDE_PX).any() else box


def assemble(
    frame: RgbdFrame, vocabulary: Vocabulary, seen: FrameDetections, top_relations: int
) -> Perceived:
    """The frame graph and label image of a frame.

    A mask is the pixels of the instance image with the value of the object, inside the box.
    Detections are ordered by score. The `top_relations` relations with the highest score are kept.
    """
    detections, relations = seen.detections, seen.relations
    order = sorted(range(len(detections)), key=lambda index: -detections[index].score)
    row_of = {index: row for row, index in enumerate(order)}
    chosen = [detections[index] for index in order]
    width, height = frame.intrinsics.width, frame.intrinsics.height
    boxes = np.array([item.box_xyxy for item in chosen], np.float64).reshape(-1, 4)
    boxes = np.clip(boxes, 0.0, [width - 1.0, height - 1.0] * 2)
    classes = np.array([item.class_probabilities for item in chosen], np.float64)
    classes = classes.reshape(-1, len(vocabulary.classes))
    scores = np.array([item.score for item in chosen], np.float64)
    masks = [_cut_mask(seen.instance_image, item.instance, box) for item, box in zip(chosen, boxes)]
    kept = sorted(relations, key=lambda item: -item.score)[:top_relations]
    pairs = [(row_of[item.subject], row_of[item.object]) for item in kept]
    predicates = np.array([item.probabilities for item in kept], np.float64)
    graph = FrameGraph(
        stamp_ns=frame.stamp_ns,
        frame_id="camera_rgb_optical_frame",
        width=width,
        height=height,
        vocabulary=vocabulary,
        boxes_xyxy=boxes,
        class_probabilities=classes,
        scores=scores,
        relations=Relations(
            np.array(pairs, np.int64).reshape(-1, 2),
            logits(predicates.reshape(-1, len(vocabulary.predicates))),
            np.array([item.score for item in kept], np.float64),
        ),
    )
    instances = instance_image(masks, classes.argmax(axis=1), scores, (height, width))
    empty = sum(not mask.pixels.any() for mask in masks)
    return Perceived(graph, instances, {"empty_mask": empty} if empty else {})


def _cut_mask(instance_image: UInt16, value: int, box_xyxy: Float64) -> MaskPatch:
    # All pixels that the box touches.
    left, top = np.floor(box_xyxy[:2]).astype(int).tolist()
    right, bottom = np.ceil(box_xyxy[2:]).astype(int).tolist()
    patch = instance_image[top : bottom + 1, left : right + 1]
    return MaskPatch(top, left, patch == value)


# --- Injection of faults into detections: faults of single frames, and faults that persist.
#
# Each fault has its own random generator, seeded with the seed, the object and the frame or spell.
# Runs are therefore independent of the order of objects, faults are independent of each other, and
# a higher rate of a fault affects a superset of the objects.

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
                _cut_side(
                    image, object_id, int(generator.integers(4)), generator.uniform(*CUT_KEEPS)
                )
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


def _cut_side(image: UInt16, object_id: int, side: int, kept_fraction: float) -> None:
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
