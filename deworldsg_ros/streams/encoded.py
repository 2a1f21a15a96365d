"""Encoded images (JPEG, PNG, PGM): the size is read from the header before anything is decoded."""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

# An image of 8K video has 33 million pixels. A PNG of 388 kB can claim a thousand times that.
MAX_PIXELS = 1 << 26
# A progressive JPEG has about ten scans. Each goes over all pixels and may have a few bytes only.
MAX_SCANS = 100

_PNG = b"\x89PNG\r\n\x1a\n"
_PGM = re.compile(rb"P[56](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")
# Start-of-frame markers of JPEG; C4, C8 and CC are others.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# The marker before a scan. It is not within one: there, a zero follows each FF.
_JPEG_SCAN = b"\xff\xda"


def encoded_size(content: bytes | memoryview) -> tuple[int, int]:
    """Width and height of an encoded image; ValueError if it is no JPEG, PNG or PGM."""
    view = memoryview(content)
    if view[:8] == _PNG and view[12:16] == b"IHDR" and len(view) >= 24:
        return int.from_bytes(view[16:20], "big"), int.from_bytes(view[20:24], "big")
    if view[:2] == b"\xff\xd8":
        return _jpeg_size(view)
    header = _PGM.match(bytes(view[:512]))
    if header is not None:
        return int(header[1]), int(header[2])
    raise ValueError("it is no JPEG, PNG or PGM image")


def decode(content: bytes | memoryview, flags: int) -> NDArray[Any]:
    """Pixels of an encoded image, as OpenCV decodes it.

    Args:
        content: the file.
        flags: of cv2.imdecode.

    Raises:
        ValueError: it is no JPEG, PNG or PGM, is larger than `MAX_PIXELS`, has more than
            `MAX_SCANS`, or is damaged.
    """
    width, height = encoded_size(content)
    if width * height > MAX_PIXELS:
        raise ValueError(f"it has {width}x{height} pixels: expected at most {MAX_PIXELS}")
    if content[:2] == b"\xff\xd8" and (scans := bytes(content).count(_JPEG_SCAN)) > MAX_SCANS:
        raise ValueError(f"it has {scans} scans: expected at most {MAX_SCANS}")
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error as error:
        raise ValueError("it is damaged") from error
    if pixels is None:
        raise ValueError("it is damaged")
    return pixels


def _jpeg_size(view: memoryview) -> tuple[int, int]:
    at = 2
    while at + 9 <= len(view):
        if view[at] != 0xFF:
            break
        marker = view[at + 1]
        if marker in _JPEG_FRAMES:
            height = int.from_bytes(view[at + 5 : at + 7], "big")
            return int.from_bytes(view[at + 7 : at + 9], "big"), height
        # Fill bytes and markers without content have no length.
        is_alone = marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD7
        at += 1 if marker == 0xFF else 2
        if not is_alone:
            at += int.from_bytes(view[at : at + 2], "big")
    raise ValueError("it is a JPEG without a size")
