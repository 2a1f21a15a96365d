"""Masks of one frame → its instance image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.scene.arrays import Float64, Int64, UInt16


def instance_image(
    masks: Sequence[MaskPatch], classes: Int64, scores: Float64, shape: tuple[int, int]
) -> UInt16:
    """The instance image of masks that may overlap (paper, Section 4.1).

    A pixel in masks of different classes is ambiguous and belongs to no object. A pixel in several
    masks of one class belongs to the one with the highest score, or the first of equal scores.

    Args:
        masks: n masks.
        classes: (n,) most likely class of each.
        scores: (n,) detection scores.
        shape: H, W of the image.

    Returns:
        (H, W) uint16: k + 1 on the pixels of row k, else 0.

    Raises:
        ValueError: more masks than uint16 can number.
    """
    if len(masks) > np.iinfo(np.uint16).max:
        raise ValueError(f"{len(masks)} masks, expected at most {np.iinfo(np.uint16).max}")
    labels = np.zeros(shape, dtype=np.uint16)
    ambiguous = np.zeros(shape, dtype=bool)
    # The class of each label; label 0 is the background and has none.
    class_of_label = np.concatenate(([-1], np.asarray(classes, dtype=np.int64)))
    # Best first: a later mask takes only free pixels.
    for row in np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable"):
        mask = masks[row]
        here = labels[mask.window]
        taken = mask.pixels & (here != 0)
        if taken.any():
            ambiguous[mask.window] |= taken & (class_of_label[here] != classes[row])
        here[mask.pixels & (here == 0)] = row + 1
    labels[ambiguous] = 0
    return labels
