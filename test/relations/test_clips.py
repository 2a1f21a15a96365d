"""Frames, windows, union boxes and crops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.relations import HEIGHT, WIDTH, picture

from deworldsg_ros.relations.clips import (
    FrameBuffer,
    crop_clip,
    interval_start,
    union_box,
    without_first,
)


def filled(stamps, capacity=32):
    buffer = FrameBuffer(capacity)
    for stamp in stamps:
        buffer.add(stamp, picture(stamp))
    return buffer


@pytest.mark.parametrize(
    ("stamps", "stamp", "window"),
    [
        ([], 5, ()),
        ([5], 5, (5,)),  # the first frame of a stream
        ([1, 2, 3], 2, (1, 2)),  # frames after the last reliable one do not count
        ([1, 2, 3, 4, 5, 6], 6, (3, 4, 5, 6)),
        ([1, 2, 3, 5], 4, ()),  # the frame itself is missing
        ([1, 2, 4, 8], 8, (1, 2, 4, 8)),  # consecutive frames, not consecutive times
        ([3, 1, 2, 4, 2], 4, (1, 2, 3, 4)),  # late and repeated frames
    ],
)
def test_window_is_the_last_frames_up_to_the_stamp(stamps, stamp, window):
    assert filled(stamps).window(stamp, 4) == window


def test_buffer_is_bounded_and_forgets_the_oldest():
    buffer = filled(range(100), capacity=6)
    assert len(buffer) == 6
    assert buffer.images([93]) is None
    assert buffer.images([94, 93]) is None
    (image,) = buffer.images([94])
    assert (image == picture(94)).all()


def test_frame_older_than_a_full_buffer_is_ignored():
    buffer = filled([10, 11, 12], capacity=3)
    buffer.add(1, picture(1))
    assert buffer.window(12, 9) == (10, 11, 12) and buffer.window(1, 9) == ()


def test_another_image_size_starts_anew():
    buffer = filled([1, 2])
    buffer.add(3, np.zeros((10, 10, 3), np.uint8))
    assert buffer.window(3, 4) == (3,)


def test_images_are_kept_by_reference():
    image = picture(1)
    buffer = FrameBuffer(2)
    buffer.add(1, image)
    assert buffer.images([1])[0] is image


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ([1, 2, 3, 4], [1, 2, 3, 4], (1, 2, 4, 5)),  # pixel centres are at integers
        ([1.4, 2.6, 3.1, 4.0], [10, 11, 12.6, 13.4], (1, 3, 14, 14)),  # every pixel touched
        ([-5, -5, 3, 4], [60, 40, 63, 900], (0, 0, WIDTH, HEIGHT)),  # clipped to the image
        ([5, 5, 5, 5], [5, 5, 5, 5], (5, 5, 6, 6)),  # never empty
        ([64, 48, 64, 48], [64, 48, 64, 48], (63, 47, 64, 48)),
        ([-9, -9, -3, -3], [-9, -9, -3, -3], (0, 0, 1, 1)),
    ],
)
def test_union_box(a, b, expected):
    assert union_box(np.array(a, float), np.array(b, float), WIDTH, HEIGHT) == expected
    assert union_box(np.array(b, float), np.array(a, float), WIDTH, HEIGHT) == expected


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_union_box_is_every_pixel_between_the_outer_edges(seed):
    corners = np.random.default_rng(seed).uniform(0, (WIDTH, HEIGHT), (2, 2, 2))
    a, b = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    left, top, right, bottom = min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])
    columns = [k for k in range(WIDTH) if left < k + 0.5 and k - 0.5 < right]
    rows = [k for k in range(HEIGHT) if top < k + 0.5 and k - 0.5 < bottom]
    expected = (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
    assert union_box(a, b, WIDTH, HEIGHT) == expected


def test_clip_is_the_crop_of_each_frame():
    images = [picture(stamp) for stamp in range(4)]
    clip = crop_clip(images, (10, 5, 30, 25), 4)
    assert clip.shape == (4, 20, 20, 3) and clip.dtype == np.uint8
    for frame, image in zip(clip, images):
        assert (frame == image[5:25, 10:30]).all()


@pytest.mark.parametrize("count", [1, 3])
def test_short_clip_repeats_the_most_recent_frame_at_its_end(count):
    images = [picture(stamp) for stamp in range(count)]
    clip = crop_clip(images, (0, 0, WIDTH, HEIGHT), 5)
    for row in range(5):
        assert (clip[row] == images[min(row, count - 1)]).all()


def test_clip_is_a_copy():
    image = picture(0)
    crop_clip([image], (0, 0, 9, 9), 2)[:] = 0
    assert (image == picture(0)).all()


@pytest.mark.parametrize("count", [0, 3])
def test_clip_refuses_no_frames_and_too_many(count):
    with pytest.raises(ValueError, match=f"clip of {count} frames: expected 1 to 2"):
        crop_clip([picture(0)] * count, (0, 0, 9, 9), 2)


@pytest.mark.parametrize(
    "seen, start",
    [
        ([True], 0),
        ([None], 0),
        ([True, True, True], 0),
        ([True, False, True], 2),
        ([True, False, True, True], 2),
        ([False, None, True], 2),  # nothing is known of the frame before
        ([False, True, None, True], 1),
        ([None, None, True], 2),
        ([True, None, None, None], 0),
    ],
)
def test_the_valid_interval_is_the_last_one_in_which_both_objects_are_seen(seen, start):
    assert interval_start(seen) == start


@pytest.mark.parametrize("count, frames", [(0, [0, 1, 2]), (1, [1, 2, 2]), (2, [2, 2, 2])])
def test_first_frames_are_left_out_and_the_last_one_fills(count, frames):
    clip = np.arange(3, dtype=np.uint8).reshape(3, 1, 1, 1) * np.ones((3, 2, 2, 3), np.uint8)
    assert without_first(clip, count)[:, 0, 0, 0].tolist() == frames
