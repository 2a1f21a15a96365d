"""Messages of the camera to numpy and back: images, encoded images, camera_info."""

from __future__ import annotations

import array
import contextlib
import re
import sys
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.doctor.frame_checks import Header
from deworldsg_ros.scene.arrays import Float32, UInt8, UInt16
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput

# --- Encoded images (JPEG, PNG, PGM): the size is read from the header before anything is
# decoded.

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


# --- Convert CameraInfo messages to intrinsics.


def intrinsics_from_message(message: Any) -> Intrinsics:
    """Intrinsics from the matrix K of a `sensor_msgs/CameraInfo`.

    Raises:
        RefusedInput: ``invalid_intrinsics`` for a message without K, for a matrix of another size,
            for NaN, or for zeros, which an uncalibrated camera publishes.
    """
    matrix = getattr(message, "k", None)
    if matrix is None:
        matrix = getattr(message, "K", None)  # ROS 1 bags
    if matrix is None:
        kind = type(message).__name__
        raise RefusedInput("invalid_intrinsics", f"camera_info is a {kind}: expected a CameraInfo")
    if len(matrix) != 9:
        raise RefusedInput(
            "invalid_intrinsics", f"camera_info: K has {len(matrix)} values: expected 9"
        )
    return Intrinsics(
        fx=float(matrix[0]),
        fy=float(matrix[4]),
        cx=float(matrix[2]),
        cy=float(matrix[5]),
        width=int(message.width),
        height=int(message.height),
    )


# --- Convert image messages to numpy and back: checked once, without a copy if the layout allows
# it.
#
# A message is any object with the attributes of `sensor_msgs/Image` or
# `sensor_msgs/CompressedImage`; its `data` is any object with the buffer protocol.

# encoding -> (dtype, channels)
LAYOUTS: dict[str, tuple[str, int]] = {
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "mono8": ("u1", 1),
    "mono16": ("u2", 1),
    "16UC1": ("u2", 1),
    "32FC1": ("f4", 1),
}
RGB_ENCODINGS = ("rgb8", "bgr8", "rgba8", "bgra8", "mono8")
DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
MILLIMETRE_M = 1e-3

_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
}

# compressedDepth: an int32 format and two float32 quantisation parameters precede the PNG.
_COMPRESSED_DEPTH_HEADER = np.dtype([("format", "<i4"), ("quantisation", "<f4", (2,))])


def is_compressed(message: Any) -> bool:
    """Whether a message is a CompressedImage."""
    return hasattr(message, "format") and not hasattr(message, "encoding")


def image_view(message: Any, allowed: tuple[str, ...]) -> NDArray[Any]:
    """The pixels of an Image, (H, W) or (H, W, C): a view of its buffer.

    The dtype follows from the encoding, in the byte order of the message; rows may be padded.

    Raises:
        RefusedInput: ``unknown_encoding``, ``empty_image``, ``bad_step`` or ``short_buffer``.
    """
    encoding = str(message.encoding)
    if encoding not in allowed:
        raise RefusedInput(
            "unknown_encoding", f"image encoding is '{encoding}': expected {', '.join(allowed)}"
        )
    kind, channels = LAYOUTS[encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    if height <= 0 or width <= 0:
        raise RefusedInput("empty_image", f"image is {width}x{height}: expected at least one pixel")
    row_bytes = width * channels * dtype.itemsize
    if step < row_bytes or step % dtype.itemsize:
        raise RefusedInput(
            "bad_step",
            f"step of the {width}x{height} {encoding} image is {step} bytes: expected at least "
            f"{row_bytes}, a multiple of {dtype.itemsize}",
        )
    buffer = np.frombuffer(message.data, np.uint8)
    needed = step * (height - 1) + row_bytes
    if len(buffer) < needed:
        raise RefusedInput(
            "short_buffer",
            f"{width}x{height} {encoding} image with step {step} holds {len(buffer)} bytes: "
            f"expected {step * height}",
        )
    shape: tuple[int, ...] = (height, width, channels) if channels > 1 else (height, width)
    strides = (step, channels * dtype.itemsize, dtype.itemsize)[: len(shape)]
    return np.ndarray(shape, dtype, buffer, strides=strides)


def rgb_from_message(message: Any) -> UInt8:
    """(H, W, 3) uint8, RGB order, of an Image or CompressedImage; rgb8 is not copied.

    Raises:
        RefusedInput: as `image_view`, or ``decode_failed``.
    """
    if is_compressed(message):
        bgr = _decode(message.data, cv2.IMREAD_COLOR, str(message.format))
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    pixels = image_view(message, RGB_ENCODINGS)
    if message.encoding == "rgb8":
        return pixels
    return np.asarray(cv2.cvtColor(pixels, _TO_RGB[str(message.encoding)]), np.uint8)


def depth_from_message(message: Any, *, depth_scale_m: float, max_depth_m: float) -> Float32:
    """(H, W) float32 depth in metres of an Image or CompressedImage; 0 = invalid.

    NaN, infinity, negative values and values above `max_depth_m` become 0.

    Args:
        message: 16UC1, mono16, 32FC1, or compressedDepth of them.
        depth_scale_m: metres per unit; 0 = by the encoding: millimetres in 16 bits, metres in
            floats (REP 118).
        max_depth_m: largest valid depth.

    Raises:
        RefusedInput: as `image_view`, ``not_depth`` or ``decode_failed``.
    """
    if is_compressed(message):
        raw = _decode_depth(message)
    elif message.encoding in RGB_ENCODINGS:
        raise _not_depth(str(message.encoding))
    else:
        raw = image_view(message, DEPTH_ENCODINGS)
    depth_m: Float32 = raw.astype(np.float32)
    if depth_scale_m or raw.dtype.kind == "u":
        depth_m *= np.float32(depth_scale_m or MILLIMETRE_M)
    # Also if the limit is infinite, or too large for float32.
    limit_m = np.float32(min(max_depth_m, float(np.finfo(np.float32).max)))
    # The negated comparison also catches NaN.
    depth_m[~((depth_m > 0) & (depth_m <= limit_m))] = 0.0
    return depth_m


def instances_from_message(message: Any) -> UInt16:
    """(H, W) uint16 instance values of a mono16 Image; not copied in native byte order."""
    pixels = image_view(message, ("mono16",))
    return pixels.astype(np.uint16, copy=False)


def fill_image(message: Any, pixels: NDArray[Any], encoding: str) -> None:
    """Write pixels (H, W) or (H, W, C) into an Image; the caller sets the header.

    `array.array` takes all bytes at once; with a numpy array, rclpy checks every element.
    """
    kind, channels = LAYOUTS[encoding]
    found = pixels.shape[2] if pixels.ndim == 3 else 1
    if pixels.dtype != np.dtype(kind) or found != channels:
        raise ValueError(
            f"pixels are {pixels.dtype} with {found} channels: expected {kind} with {channels} "
            f"for {encoding}"
        )
    pixels = np.ascontiguousarray(pixels)
    data = array.array("B")
    data.frombytes(pixels.data.cast("B"))
    message.height, message.width = pixels.shape[:2]
    message.encoding = encoding
    message.is_bigendian = int(sys.byteorder == "big")
    message.step = pixels.strides[0]
    message.data = data


def _decode(data: Any, flags: int, description: str) -> NDArray[Any]:
    content = memoryview(data).cast("B")
    try:
        return decode(content, flags)
    except ValueError as error:
        raise RefusedInput(
            "decode_failed",
            f"compressed image '{description}' of {len(content)} bytes cannot be decoded: {error}; "
            "expected JPEG or PNG",
        ) from error


def _decode_depth(message: Any) -> NDArray[Any]:
    """16-bit counts or float32 metres of a compressedDepth image, or of a plain 16-bit PNG."""
    description = str(message.format)
    data = memoryview(message.data).cast("B")
    if "compressedDepth" not in description:
        pixels = _decode(data, cv2.IMREAD_UNCHANGED, description)
        if pixels.dtype == np.uint8:
            raise _not_depth(f"{description}, 8 bits")
        return _grey16(pixels, description)
    encoding = description.split(";")[0].strip()
    if encoding not in DEPTH_ENCODINGS or "rvl" in description.lower():
        raise RefusedInput(
            "unknown_encoding",
            f"compressed depth is '{description}': expected PNG of {', '.join(DEPTH_ENCODINGS)}",
        )
    size = _COMPRESSED_DEPTH_HEADER.itemsize
    if len(data) <= size:
        raise RefusedInput(
            "short_buffer",
            f"compressed depth '{description}' holds {len(data)} bytes: expected more than the "
            f"header of {size}",
        )
    header = np.frombuffer(data[:size], _COMPRESSED_DEPTH_HEADER)[0]
    counts = _grey16(_decode(data[size:], cv2.IMREAD_UNCHANGED, description), description)
    if encoding != "32FC1":
        return counts
    # Inverse-depth quantisation of image_transport_plugins: count = A / depth + B, 0 = invalid.
    factor, offset = header["quantisation"]
    with np.errstate(divide="ignore"):
        depth_m = factor / (counts.astype(np.float32) - offset)
    return np.where(counts == 0, np.float32(0), depth_m)


def _not_depth(seen: str) -> RefusedInput:
    return RefusedInput(
        "not_depth",
        f"an image on the depth topic is a picture ({seen}): expected distances, 16UC1 or 32FC1",
    )


def _grey16(pixels: NDArray[Any], description: str) -> NDArray[Any]:
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise RefusedInput(
            "decode_failed",
            f"compressed depth '{description}' holds {pixels.dtype} of shape {pixels.shape}: "
            "expected 16-bit grey",
        )
    return pixels


# --- What the first messages of a camera say, for the doctor.


def header_of(
    topic: str, message: Any, camera_info: Any = None, depth_scale_m: float | None = None
) -> Header:
    """What a message of a camera says about itself.

    Args:
        topic: its name.
        message: an image or a camera_info.
        camera_info: of a depth image, that beside it; None = there is none.
        depth_scale_m: of a depth image; None = it is none.
    """
    header = Header(topic, message.header.frame_id.lstrip("/"))
    with contextlib.suppress(RefusedInput):  # it is counted where frames are made
        if hasattr(message, "encoding"):
            size, encoding = (int(message.width), int(message.height)), str(message.encoding)
            header = replace(header, size=size, encoding=encoding)
        elif is_compressed(message):
            header = replace(header, encoding=str(message.format))
        else:
            header = replace(header, intrinsics=intrinsics_from_message(message))
        if camera_info is not None:
            header = replace(header, intrinsics=intrinsics_from_message(camera_info))
        if depth_scale_m is not None:
            depth_m = depth_from_message(
                message, depth_scale_m=depth_scale_m, max_depth_m=float("inf")
            )
            valid = depth_m[depth_m > 0]
            header = replace(header, middle_m=float(np.median(valid)) if len(valid) else None)
    return header


def info_topic(depth_topic: str) -> str:
    """The topic of the camera_info beside depth images, also beside compressed ones."""
    parts = depth_topic.split("/")
    if parts[-1] in ("compressed", "compressedDepth"):
        parts.pop()
    return "/".join([*parts[:-1], "camera_info"])
