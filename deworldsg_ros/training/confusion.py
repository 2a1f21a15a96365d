"""A confusion matrix as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from deworldsg_ros.scene.arrays import Int64, UInt8

CELL_PX = 44
MARGIN_PX = 12
FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.42
DARK, LIGHT = (40, 40, 40), (255, 255, 255)


def draw_confusion(confusion: Int64, names: Sequence[str]) -> UInt8:
    """Rows are the true predicates, columns the answers; only those that occur are drawn.

    Args:
        confusion: (R, R) counts.
        names: R names.

    Returns:
        (h, w, 3) uint8 BGR.
    """
    places = np.flatnonzero(confusion.sum(axis=0) + confusion.sum(axis=1))
    shown = confusion[np.ix_(places, places)]
    labels = [names[place] for place in places.tolist()]
    widest = max([cv2.getTextSize(label, FONT, FONT_SCALE, 1)[0][0] for label in labels] or [0])
    left = top = widest + 2 * MARGIN_PX
    side = CELL_PX * len(labels)
    picture = np.full((top + side + 3 * MARGIN_PX, left + side + MARGIN_PX, 3), 255, np.uint8)
    shares = shown / np.maximum(shown.sum(axis=1, keepdims=True), 1)
    for row, column in np.ndindex(*shown.shape):
        share = float(shares[row, column])
        corner = (left + column * CELL_PX, top + row * CELL_PX)
        colour = tuple(round(255 - share * (255 - end)) for end in (140, 90, 30))
        cv2.rectangle(picture, corner, (corner[0] + CELL_PX, corner[1] + CELL_PX), colour, -1)
        if shown[row, column]:
            ink = LIGHT if share > 0.5 else DARK
            _text(picture, str(shown[row, column]), corner[0] + 6, corner[1] + 27, ink)
    cv2.rectangle(picture, (left, top), (left + side, top + side), DARK, 1)
    for place, label in enumerate(labels):
        _text(picture, label, MARGIN_PX, top + place * CELL_PX + 27)
        strip = np.full((CELL_PX, top, 3), 255, np.uint8)
        _text(strip, label, MARGIN_PX, 27)
        start = left + place * CELL_PX
        picture[:top, start : start + CELL_PX] = cv2.rotate(strip, cv2.ROTATE_90_COUNTERCLOCKWISE)
    _text(picture, "row: true, column: answer", MARGIN_PX, top + side + 2 * MARGIN_PX)
    return picture


def write_confusion(path: Path, confusion: Int64, names: Sequence[str]) -> None:
    """Write the picture as PNG."""
    _, encoded = cv2.imencode(".png", draw_confusion(confusion, names))
    path.write_bytes(encoded.tobytes())


def _text(picture: UInt8, text: str, x: int, y: int, colour: tuple[int, int, int] = DARK) -> None:
    cv2.putText(picture, text, (x, y), FONT, FONT_SCALE, colour, 1, cv2.LINE_AA)
