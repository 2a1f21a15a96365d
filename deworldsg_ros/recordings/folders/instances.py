"""Instance images of the data sets that have them: the object id of each pixel."""

from __future__ import annotations

import cv2
import numpy as np

from deworldsg_ros.recordings.folders.dataset import decode_image, read_file
from deworldsg_ros.recordings.folders.sequence import SequenceDataset
from deworldsg_ros.scene.arrays import UInt16


def read_instances(source: object, stamp_ns: int) -> UInt16 | None:
    """Object ids of a frame's pixels, (H, W) uint16, 0 = none; None without an instance image.

    Raises:
        RecordingError: for an image that cannot be decoded.
    """
    # Instance images are not rotated: they do not fit rotated images.
    if not isinstance(source, SequenceDataset) or source.rotated:
        return None
    if stamp_ns not in source.frame_numbers:
        return None
    path = source.file(source.frame_numbers[stamp_ns], ".instance.png")
    if not path.exists():
        return None
    return np.asarray(decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path), np.uint16)
