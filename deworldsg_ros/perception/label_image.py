"""Masks of one frame → one label image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.scene.arrays import Float64, Int64, UInt16


def label_image(
    masks: Sequence[MaskPatch], classes: Int64, scores: Float64, shape: tuple[int, int]
) -> UInt16:
    """One label image of masks that may overlap (paper, Section 4.1).

    A pixel that masks of different classes claim is ambiguous and belongs to nobody. Of masks of
    one class, the one with the higher score takes it (equal scores: the one that comes first).

    Args:
        masks: n masks.
        classes: (n,) the likeliest class of each.
        scores: (n,) detection scores.
        shape: H, W of the image.

    Returns:
        (H, W) uint16: 0 = nothing, k + 1 = the object of row k.

    Raises:
        ValueError: more masks than 16 bits can number.
    """
    if len(masks) > np.iinfo(np.uint16).max:
        raise ValueError(f"{len(masks)} masks: wanted at most {np.iinfo(np.uint16).max}")
    labels = np.zeros(shape, dtype=np.uint16)
    ambiguous = np.zeros(shape, dtype=bool)
    # Index 0 is that of the background, and no class.
    class_of_label = np.concatenate(([-1], np.asarray(classes, dtype=np.int64)))
    # Best first, so that a pixel once taken stays with the best of its class.
    for row in np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable"):
        mask = masks[row]
        here = labels[mask.window]
        taken = mask.pixels & (here != 0)
        if taken.any():
            ambiguous[mask.window] |= taken & (class_of_label[here] != classes[row])
        here[mask.pixels & (here == 0)] = row + 1
    labels[ambiguous] = 0
    return labels
