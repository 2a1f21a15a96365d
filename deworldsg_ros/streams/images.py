"""Convert image messages to numpy and back: checked once, without a copy if the layout allows it.

A message is any object with the attributes of `sensor_msgs/Image` or `sensor_msgs/CompressedImage`;
its `data` is any object with the buffer protocol.
"""

from __future__ import annotations

import array
import sys
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.scene.arrays import Float32, UInt8, UInt16
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.encoded import decode

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
        message: 16UC1 or mono16 in units of `depth_scale_m`, 32FC1 in metres, or compressedDepth
            of either.
        depth_scale_m: metres per unit of a 16-bit image.
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
    if raw.dtype.kind == "u":
        depth_m *= np.float32(depth_scale_m)
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
