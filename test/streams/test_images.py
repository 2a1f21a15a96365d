"""Images: every layout there and back, every refusal with the value seen and expected."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import Image
from support.streams import compressed, compressed_depth, image, png

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
COUNTS = RNG.integers(1, 5000, (5, 7), dtype=np.uint16)
DEPTH = {"depth_scale_m": 0.001, "max_depth_m": 10.0}


def refusal(function, *arguments, **options) -> RefusedInput:
    with pytest.raises(RefusedInput) as caught:
        function(*arguments, **options)
    return caught.value


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[:, :, ::-1]),
        ("rgba8", np.dstack([RGB, RGB[:, :, 0]])),
        ("bgra8", np.dstack([RGB[:, :, ::-1], RGB[:, :, 0]])),
    ],
)
def test_colour_of_every_layout_is_rgb(encoding: str, pixels: np.ndarray) -> None:
    np.testing.assert_array_equal(rgb_from_message(image(pixels, encoding)), RGB)


def test_grey_becomes_three_equal_channels() -> None:
    result = rgb_from_message(image(RGB[:, :, 0], "mono8"))
    np.testing.assert_array_equal(result, np.dstack([RGB[:, :, 0]] * 3))


def test_rgb8_and_instances_are_not_copied() -> None:
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
def test_padding_and_byte_order_do_not_matter(
    encoding: str, height: int, width: int, padding: int, big: bool
) -> None:
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


@pytest.mark.parametrize("encoding", sorted(LAYOUTS))
def test_a_ros_message_round_trip(encoding: str) -> None:
    kind, channels = LAYOUTS[encoding]
    shape = (4, 6, channels) if channels > 1 else (4, 6)
    pixels = RNG.integers(0, 200, shape).astype(kind)
    message = Image()
    fill_image(message, pixels, encoding)
    assert message.step * message.height == len(message.data)
    np.testing.assert_array_equal(image_view(message, (encoding,)), pixels)


def test_fill_image_takes_strided_pixels_and_refuses_another_type() -> None:
    message = Image()
    fill_image(message, RGB[:, :, ::-1], "bgr8")
    np.testing.assert_array_equal(rgb_from_message(message), RGB)
    with pytest.raises(ValueError, match="uint16 with 1 channels: expected u1 with 3"):
        fill_image(message, COUNTS, "rgb8")


def test_depth_in_metres_from_both_encodings() -> None:
    metres = COUNTS.astype(np.float32) * np.float32(0.001)
    np.testing.assert_array_equal(depth_from_message(image(COUNTS, "16UC1"), **DEPTH), metres)
    np.testing.assert_array_equal(depth_from_message(image(COUNTS, "mono16"), **DEPTH), metres)
    np.testing.assert_array_equal(depth_from_message(image(metres, "32FC1"), **DEPTH), metres)


def test_invalid_depth_becomes_zero() -> None:
    values = np.array([[np.nan, np.inf, -np.inf, -1.0, 0.0, 10.0, 10.001]], np.float32)
    result = depth_from_message(image(values, "32FC1"), **DEPTH)
    np.testing.assert_array_equal(result, [[0, 0, 0, 0, 0, 10, 0]])
    assert result.dtype == np.float32
    for limit_m in (np.inf, 1e39):
        far = depth_from_message(image(values, "32FC1"), depth_scale_m=1e-3, max_depth_m=limit_m)
        np.testing.assert_array_equal(far, np.float32([[0, 0, 0, 0, 0, 10, 10.001]]))


def test_depth_does_not_change_the_message() -> None:
    message = image(np.full((2, 2), np.nan, np.float32), "32FC1")
    before = message.data.copy()
    depth_from_message(message, **DEPTH)
    np.testing.assert_array_equal(message.data, before)


def test_compressed_colour() -> None:
    message = compressed(png(RGB[:, :, ::-1]), "rgb8; png compressed bgr8")
    np.testing.assert_array_equal(rgb_from_message(message), RGB)
    smooth = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    jpeg = cv2.imencode(".jpg", smooth[:, :, ::-1])[1].tobytes()
    assert np.abs(rgb_from_message(compressed(jpeg, "jpeg")).astype(int) - smooth).max() < 4


@pytest.mark.parametrize("description", ["16UC1; compressedDepth png", "16UC1; compressedDepth"])
def test_compressed_depth_of_counts(description: str) -> None:
    message = compressed(compressed_depth(COUNTS), description)
    np.testing.assert_array_equal(
        depth_from_message(message, **DEPTH), COUNTS.astype(np.float32) * np.float32(0.001)
    )


def test_plain_png_depth() -> None:
    result = depth_from_message(compressed(png(COUNTS), "png"), **DEPTH)
    np.testing.assert_array_equal(result, COUNTS.astype(np.float32) * np.float32(0.001))


def test_compressed_depth_of_metres_is_quantised_inverse_depth() -> None:
    # As compressed_depth_image_transport encodes: A = q (q + 1), B = 1 - A / max_depth.
    quantisation, largest = 100.0, 10.0
    a = quantisation * (quantisation + 1)
    b = 1 - a / largest
    metres = np.linspace(0.5, 9.5, 35, dtype=np.float32).reshape(5, 7)
    counts = (a / metres + b).astype(np.uint16)
    counts[0, 0] = 0
    data = compressed_depth(counts, a, b)
    result = depth_from_message(compressed(data, "32FC1; compressedDepth png"), **DEPTH)
    assert result[0, 0] == 0
    np.testing.assert_allclose(result.ravel()[1:], metres.ravel()[1:], rtol=2e-3)


@pytest.mark.parametrize(
    ("changes", "reason", "says"),
    [
        ({"encoding": "yuv422"}, "unknown_encoding", "'yuv422': expected rgb8, bgr8"),
        ({"encoding": "16UC1"}, "unknown_encoding", "expected rgb8"),
        ({"height": 0}, "empty_image", "7x0"),
        ({"step": 20}, "bad_step", "20 bytes: expected at least 21"),
        ({"step": 30}, "short_buffer", "holds 105 bytes: expected 150"),
        ({"data": np.zeros(104, np.uint8)}, "short_buffer", "holds 104 bytes: expected 105"),
        ({"data": np.zeros(0, np.uint8)}, "short_buffer", "holds 0 bytes"),
    ],
)
def test_refused_colour(changes: dict, reason: str, says: str) -> None:
    message = image(RGB, "rgb8")
    vars(message).update(changes)
    refused = refusal(rgb_from_message, message)
    assert refused.reason == reason
    assert says in str(refused)


def test_refused_depth() -> None:
    assert refusal(depth_from_message, image(RGB, "rgb8"), **DEPTH).reason == "not_depth"
    odd = image(COUNTS, "16UC1", step=15, data=np.zeros(75, np.uint8))
    refused = refusal(depth_from_message, odd, **DEPTH)
    assert refused.reason == "bad_step"
    assert "a multiple of 2" in str(refused)


@pytest.mark.parametrize(
    ("data", "description", "reason"),
    [
        (b"", "jpeg", "decode_failed"),
        (b"not an image", "jpeg", "decode_failed"),
    ],
)
def test_refused_compressed_colour(data: bytes, description: str, reason: str) -> None:
    assert refusal(rgb_from_message, compressed(data, description)).reason == reason


@pytest.mark.parametrize(
    ("data", "description", "reason"),
    [
        (b"", "16UC1; compressedDepth png", "short_buffer"),
        (bytes(12), "16UC1; compressedDepth png", "short_buffer"),
        (bytes(40), "16UC1; compressedDepth png", "decode_failed"),
        (bytes(40), "16UC1; compressedDepth rvl", "unknown_encoding"),
        (bytes(40), "8UC1; compressedDepth png", "unknown_encoding"),
        (png(RGB), "png", "not_depth"),
        (bytes(12) + png(RGB[:, :, 0]), "16UC1; compressedDepth png", "decode_failed"),
    ],
)
def test_refused_compressed_depth(data: bytes, description: str, reason: str) -> None:
    refused = refusal(depth_from_message, compressed(data, description), **DEPTH)
    assert refused.reason == reason
    assert description in str(refused)
