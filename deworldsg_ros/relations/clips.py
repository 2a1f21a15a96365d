"""Clips of object pairs: the last frames, cropped to the union box of the pair.

Frames are kept by reference and cropped when a clip is encoded. A pair that is never encoded costs
no copy.
"""

from __future__ import annotations

import math
from bisect import bisect_right, insort
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.scene.frame_graph import Vocabulary

Rgb = UInt8
CropBox = tuple[int, int, int, int]


@dataclass(frozen=True)
class QueuedClip:
    """A neighbour pair of one frame whose clip may be encoded.

    Attributes:
        stamp_ns: last frame in which both objects were seen.
        frame_stamps_ns: the clip's frames, oldest first; the last is `stamp_ns`.
        crop_xyxy: union box of the two objects in that last frame, whole pixels.
        vocabulary: of the frame's local graph.
        rows: rows of the two objects in that local graph, the smaller first.
        classes: indices of their classes.
        boxes_xyxy: their boxes, each (4,) float64 pixels of the image.
        geo_cost: the geometric cost of Eq. 8.
        pixels: (T, h, w, 3) uint8, the cropped clip; None while its frames are in the frame
            buffer.
        skipped: number of its first frames that are left out.
    """

    stamp_ns: int
    frame_stamps_ns: tuple[int, ...]
    crop_xyxy: CropBox
    vocabulary: Vocabulary
    rows: tuple[int, int]
    classes: tuple[int, int]
    boxes_xyxy: tuple[Float64, Float64]
    geo_cost: float
    pixels: Rgb | None = None
    skipped: int = 0


class FrameBuffer:
    """The last frames of the RGB stream, ordered by stamp, kept by reference.

    Do not change an image after adding it. An image of another size than the stored ones replaces
    them all: the camera has changed, and a clip cannot mix two sizes.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"frame buffer of {capacity} frames: expected at least 1")
        self.capacity = capacity
        self._stamps_ns: list[int] = []
        self._images: dict[int, Rgb] = {}

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, stamp_ns: int, rgb: Rgb) -> None:
        """Keep one image, (H, W, 3) uint8; a full buffer drops its oldest image.

        A full buffer ignores an image older than all of its own. An image whose stamp is already
        here is ignored, too.
        """
        if stamp_ns in self._images:
            return
        if self._stamps_ns and self._images[self._stamps_ns[-1]].shape != rgb.shape:
            self.clear()
        insort(self._stamps_ns, stamp_ns)
        self._images[stamp_ns] = rgb
        if len(self._stamps_ns) > self.capacity:
            del self._images[self._stamps_ns.pop(0)]

    def leaving(self, stamp_ns: int) -> int | None:
        """Stamp of the frame that an image with this stamp would replace; None if none."""
        full = len(self) == self.capacity and stamp_ns not in self._images
        return self._stamps_ns[0] if full and stamp_ns > self._stamps_ns[0] else None

    def window(self, stamp_ns: int, length: int) -> tuple[int, ...]:
        """Stamps of the last `length` frames up to this stamp, or of fewer if there are fewer.

        Empty if the frame with this stamp is not in the buffer.
        """
        if stamp_ns not in self._images:
            return ()
        end = bisect_right(self._stamps_ns, stamp_ns)
        return tuple(self._stamps_ns[max(0, end - length) : end])

    def images(self, stamps_ns: Sequence[int]) -> list[Rgb] | None:
        """The images with these stamps; None if one of them has left the buffer."""
        if not all(stamp_ns in self._images for stamp_ns in stamps_ns):
            return None
        return [self._images[stamp_ns] for stamp_ns in stamps_ns]

    def clear(self) -> None:
        """Drop all frames."""
        self._stamps_ns.clear()
        self._images.clear()


def union_box(box_a_xyxy: Float64, box_b_xyxy: Float64, width: int, height: int) -> CropBox:
    """The smallest rectangle of whole pixels that contains two boxes, clipped to the image.

    Pixel centres are at integers: pixel k reaches from k - 1/2 to k + 1/2.

    Args:
        box_a_xyxy: (4,) float64 pixels.
        box_b_xyxy: likewise.
        width: image width in pixels.
        height: image height in pixels.

    Returns:
        x1, y1, x2, y2, the far edges exclusive; at least one pixel wide and high, even if the boxes
        lie outside of the image.
    """
    left, top = np.minimum(box_a_xyxy[:2], box_b_xyxy[:2]).tolist()
    right, bottom = np.maximum(box_a_xyxy[2:], box_b_xyxy[2:]).tolist()
    x1 = min(max(math.floor(left + 0.5), 0), width - 1)
    y1 = min(max(math.floor(top + 0.5), 0), height - 1)
    x2 = max(min(math.ceil(right + 0.5), width), x1 + 1)
    y2 = max(min(math.ceil(bottom + 0.5), height), y1 + 1)
    return x1, y1, x2, y2


def interval_start(seen: Sequence[bool | None]) -> int:
    """First frame of the valid interval of a clip: since then, both objects were seen in each.

    Args:
        seen: for each frame whether both objects were seen, oldest first; None = not known, which
            does not end the interval. In the last frame both were seen.

    Returns:
        the index of a frame in which both were seen.
    """
    start = last = len(seen) - 1
    for index in range(last - 1, -1, -1):
        if seen[index] is False:
            break
        if seen[index]:
            start = index
    return start


def without_first(clip: Rgb, count: int) -> Rgb:
    """A clip (T, h, w, 3) without its first frames, filled with copies of its last frame."""
    return np.concatenate([clip[count:], np.repeat(clip[-1:], count, axis=0)]) if count else clip


def crop_clip(images: Sequence[Rgb], crop_xyxy: CropBox, length: int) -> Rgb:
    """A clip of fixed length, cropped out of frames.

    Args:
        images: 1 to `length` images (H, W, 3) uint8, oldest first; the last is the most recent
            frame in which both objects were seen.
        crop_xyxy: box of whole pixels in those images, far edges exclusive.
        length: T, frames of the clip; the last image is repeated at the end to fill it.

    Returns:
        (T, h, w, 3) uint8, a copy.

    Raises:
        ValueError: no image, or more than `length`.
    """
    if not 1 <= len(images) <= length:
        raise ValueError(f"clip of {len(images)} frames: expected 1 to {length}")
    x1, y1, x2, y2 = crop_xyxy
    clip = np.empty((length, y2 - y1, x2 - x1, 3), np.uint8)
    for row, image in enumerate(images):
        clip[row] = image[y1:y2, x1:x2]
    clip[len(images) :] = clip[len(images) - 1]
    return clip
