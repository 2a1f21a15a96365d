"""Images: every layout there and back, every refusal with its reason."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import Image
from support.recordings import encoded as png
from support.streams import compressed, compressed_depth, image

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.images import (
    LAYOUTS,
    depth_from_message,
    fill_image,
    image_view,
    instances_from_message,
    rgb_from_message,
)

RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)
GREY = RGB[:, :, 0]
COUNTS = RNG.integers(1, 5000, (5, 7), dtype=np.uint16)
METRES = COUNTS.astype(np.float32) * np.float32(0.001)


def depth_of(message: SimpleNamespace, max_depth_m: float = 10.0) -> np.ndarray:
    return depth_from_message(message, depth_scale_m=0.0, max_depth_m=max_depth_m)


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[:, :, ::-1], RGB),
        ("rgba8", np.dstack([RGB, GREY]), RGB),
        ("bgra8", np.dstack([RGB[:, :, ::-1], GREY]), RGB),
        ("mono8", GREY, np.dstack([GREY] * 3)),
    ],
)
def test_colour_of_every_layout_is_rgb(encoding, pixels, expected):
    np.testing.assert_array_equal(rgb_from_message(image(pixels, encoding)), expected)


def test_rgb8_and_instances_are_not_copied():
    colour, labels = image(RGB, "rgb8"), image(COUNTS, "mono16")
    assert np.shares_memory(rgb_from_message(colour), colour.data)
    assert np.shares_memory(instances_from_message(labels), labels.data)


@given(
    st.sampled_from(sorted(LAYOUTS)),
    st.integers(1, 9),
    st.integers(1, 9),
    st.integers(0, 3),
    st.booleans(),
)
def test_padding_and_byte_order_do_not_matter(encoding, height, width, padding, big):
    kind, channels = LAYOUTS[encoding]
    dtype = np.dtype(kind).newbyteorder(">" if big else "<")
    shape = (height, width, channels) if channels > 1 else (height, width)
    pixels = RNG.integers(0, 200, shape).astype(dtype)
    rows = np.frombuffer(pixels.tobytes(), np.uint8).reshape(height, -1)
    padded = np.pad(rows, ((0, 0), (0, padding * dtype.itemsize)), constant_values=255)
    message = image(
        pixels, encoding, data=padded.ravel(), step=padded.shape[1], is_bigendian=int(big)
    )
    np.testing.assert_array_equal(image_view(message, (encoding,)), pixels)
    filled = Image()
    fill_image(filled, pixels.astype(kind), encoding)
    assert filled.step * filled.height == len(filled.data)
    np.testing.assert_array_equal(image_view(filled, (encoding,)), pixels)


def test_fill_image_takes_strided_pixels_and_refuses_another_type():
    message = Image()
    fill_image(message, RGB[:, :, ::-1], "bgr8")
    np.testing.assert_array_equal(rgb_from_message(message), RGB)
    with pytest.raises(ValueError, match="uint16 with 1 channels"):
        fill_image(message, COUNTS, "rgb8")


@pytest.mark.parametrize(
    "message",
    [
        image(COUNTS, "16UC1"),
        image(COUNTS, "mono16"),
        image(METRES, "32FC1"),
        compressed(compressed_depth(COUNTS), "16UC1; compressedDepth png"),
        compressed(compressed_depth(COUNTS), "16UC1; compressedDepth"),
        compressed(png(COUNTS), "png"),
    ],
)
def test_depth_is_in_metres(message):
    np.testing.assert_array_equal(depth_of(message), METRES)


@pytest.mark.parametrize(("pixels", "encoding"), [(COUNTS, "16UC1"), (COUNTS * 1.0, "32FC1")])
def test_a_scale_is_that_of_every_encoding(pixels, encoding):
    message = image(pixels.astype("f4") if encoding == "32FC1" else pixels, encoding)
    depth_m = depth_from_message(message, depth_scale_m=0.0005, max_depth_m=10.0)
    np.testing.assert_allclose(depth_m, METRES / 2, rtol=1e-6)


@pytest.mark.parametrize("limit_m", [10.0, np.inf, 1e39])
def test_invalid_depth_becomes_zero_and_the_message_stays(limit_m):
    values = np.array([[np.nan, np.inf, -np.inf, -1.0, 0.0, 10.0, 10.001]], np.float32)
    message = image(values, "32FC1")
    before = message.data.copy()
    farthest_m = 0 if limit_m == 10.0 else 10.001
    result = depth_of(message, limit_m)
    np.testing.assert_array_equal(result, np.float32([[0, 0, 0, 0, 0, 10, farthest_m]]))
    assert result.dtype == np.float32
    np.testing.assert_array_equal(message.data, before)


def test_compressed_colour():
    message = compressed(png(RGB[:, :, ::-1]), "rgb8; png compressed bgr8")
    np.testing.assert_array_equal(rgb_from_message(message), RGB)
    smooth = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    jpeg = cv2.imencode(".jpg", smooth[:, :, ::-1])[1].tobytes()
    assert np.abs(rgb_from_message(compressed(jpeg, "jpeg")).astype(int) - smooth).max() < 4


def test_compressed_depth_of_metres_is_quantised_inverse_depth():
    # As compressed_depth_image_transport encodes: A = q (q + 1), B = 1 - A / max_depth.
    a = 100.0 * 101.0
    b = 1 - a / 10.0
    metres = np.linspace(0.5, 9.5, 35, dtype=np.float32).reshape(5, 7)
    counts = (a / metres + b).astype(np.uint16)
    counts[0, 0] = 0
    message = compressed(compressed_depth(counts, a, b), "32FC1; compressedDepth png")
    result = depth_of(message)
    assert result[0, 0] == 0
    np.testing.assert_allclose(result.ravel()[1:], metres.ravel()[1:], rtol=2e-3)


PNG_DEPTH = "16UC1; compressedDepth png"


@pytest.mark.parametrize(
    ("read", "message", "reason", "offender"),
    [
        (rgb_from_message, image(RGB, "rgb8", step=30), "short_buffer", "105 bytes"),
        (rgb_from_message, image(RGB, "rgb8", data=RGB.ravel()[:104]), "short_buffer", "104 bytes"),
        (rgb_from_message, compressed(b"", "jpeg"), "decode_failed", ""),
        (rgb_from_message, compressed(b"not an image", "jpeg"), "decode_failed", ""),
        (depth_of, compressed(b"", PNG_DEPTH), "short_buffer", PNG_DEPTH),
        (depth_of, compressed(bytes(12), PNG_DEPTH), "short_buffer", PNG_DEPTH),
        (depth_of, compressed(bytes(40), PNG_DEPTH), "decode_failed", PNG_DEPTH),
        (depth_of, compressed(bytes(40), "16UC1; compressedDepth rvl"), "unknown_encoding", "rvl"),
        (depth_of, compressed(bytes(40), "8UC1; compressedDepth png"), "unknown_encoding", "8UC1"),
        (depth_of, compressed(png(RGB), "png"), "not_depth", "png"),
        (depth_of, compressed(bytes(12) + png(GREY), PNG_DEPTH), "decode_failed", PNG_DEPTH),
    ],
)
def test_what_is_no_image_is_refused_with_its_reason(read, message, reason, offender):
    """Other raw images are in the table of abnormal inputs."""
    with pytest.raises(RefusedInput) as caught:
        read(message)
    assert caught.value.reason == reason
    assert offender in str(caught.value)
