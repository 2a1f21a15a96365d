"""Frames, windows, union boxes and crops; and the queue of clips, ordered only by the policy."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.relations import HEIGHT, VOCABULARY, WIDTH, config, picture

from deworldsg_ros.relations import clips
from deworldsg_ros.relations.clips import (
    ClipPolicy,
    ClipQueue,
    FrameBuffer,
    PairKey,
    QueuedClip,
    Rank,
    clip_regions,
    crop_clip,
    union_box,
)

# --- frames --------------------------------------------------------------------------------------


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
    assert buffer.images([93]) is None and buffer.images([94, 93]) is None
    image = picture(200)
    buffer.add(200, image)
    assert buffer.images([200])[0] is image
    buffer.add(1, picture(1))  # older than a full buffer: ignored
    assert buffer.window(200, 9) == (95, 96, 97, 98, 99, 200) and buffer.window(1, 9) == ()
    buffer.add(201, np.zeros((10, 10, 3), np.uint8))  # another size starts anew
    assert buffer.window(201, 4) == (201,)


# --- crops ---------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("count", [1, 3, 5])
def test_a_clip_is_the_crop_of_each_frame_and_the_last_one_fills_it(count):
    images = [picture(stamp) for stamp in range(count)]
    clip = crop_clip(images, [(10, 5, 30, 25)] * count, 5)
    assert clip.shape == (5, 20, 20, 3) and clip.dtype == np.uint8
    for row in range(5):
        assert (clip[row] == images[min(row, count - 1)][5:25, 10:30]).all()
    clip[:] = 0
    assert (images[0] == picture(0)).all()  # it is a copy
    for wrong in (0, 6):
        with pytest.raises(ValueError, match=f"clip of {wrong} frames: expected 1 to 5"):
            crop_clip([picture(0)] * wrong, [(0, 0, 9, 9)] * wrong, 5)


def test_a_clip_has_the_region_of_its_last_frame_of_all_or_each_its_own():
    """The first object moves by 10 pixels a frame, the second is not seen in the middle frame."""
    a = [np.array([10.0 * n, 0, 10 * n + 5, 5]) for n in range(3)]
    b = [np.array([0.0, 8, 5, 12]), None, np.array([2.0, 20, 9, 30])]
    pairs = list(zip(a, b))
    own = ((0, 0, 6, 13), (2, 0, 16, 31), (2, 0, 26, 31))
    assert clip_regions(pairs, "last_frame", WIDTH, HEIGHT) == own[-1:] * 3
    assert clip_regions(pairs, "clip_union", WIDTH, HEIGHT) == ((0, 0, 26, 31),) * 3
    assert clip_regions(pairs, "each_frame", WIDTH, HEIGHT) == own
    clip = crop_clip([picture(n) for n in range(3)], own, 4)
    assert clip.shape == (4, 31, 24, 3) and (clip[2:] == picture(2)[:31, 2:26]).all()
    # A region is resized to that of the last frame.
    flat = [np.full((HEIGHT, WIDTH, 3), 40 * n, np.uint8) for n in range(3)]
    assert (crop_clip(flat, own, 3)[:, 0, 0, 0] == [0, 40, 80]).all()


# --- the queue -----------------------------------------------------------------------------------


def queued(stamp_ns, geo_cost=0.1, rows=(0, 1)):
    box = np.zeros(4)
    return QueuedClip(
        stamp_ns, (stamp_ns,), ((0, 0, 10, 10),), VOCABULARY, rows, (0, 1), (box, box), geo_cost
    )


class ByPair(ClipPolicy):
    """Every clip belongs to the pair of its rows."""

    def judge(self, clips):
        return [Rank((clip.stamp_ns,), PairKey(clip.rows, clip.classes)) for clip in clips]


def queue_of(size=10, policy=ClipPolicy):
    dropped = Counter()
    return ClipQueue(size, policy(config()), lambda reason: dropped.update([reason])), dropped


def taken(queue):
    """Every clip that the queue gives, in order."""
    return list(iter(queue.take, None))


QUEUES = st.lists(
    st.builds(queued, st.integers(0, 5), st.sampled_from([0.1, 0.2]), st.just((0, 1))), max_size=12
)


@given(QUEUES, st.integers(1, 5))
def test_keeps_the_best_in_order_and_counts_the_rest(items, size):
    queue, dropped = queue_of(size)
    assert queue.take() is None and len(queue) == queue.ready() == queue.clear() == 0
    for item in items:
        queue.put([item])
    assert len(queue) == queue.ready() == min(size, len(items))
    kept = [(item.stamp_ns, -item.geo_cost) for item in taken(queue)]
    best = sorted(((item.stamp_ns, -item.geo_cost) for item in items), reverse=True)
    assert kept == best[:size] and len(queue) == 0
    assert dropped["queue_full"] == len(best[size:]) == dropped.total()


def test_only_the_newest_clip_of_a_pair_waits():
    queue, dropped = queue_of(policy=ByPair)
    queue.put([queued(1), queued(2), queued(1, rows=(0, 2))])
    queue.put([queued(3, rows=(0, 2))])
    assert [(item.stamp_ns, item.rows) for item in taken(queue)] == [(3, (0, 2)), (2, (0, 1))]
    assert dropped == {"superseded": 2}


def test_cut_clips_have_bounded_memory_and_the_lowest_ranks_are_dropped(monkeypatch):
    monkeypatch.setattr(clips, "MAX_CUT_BYTES", 2 * 4 * 300)
    frames = FrameBuffer(3)
    queue, dropped = queue_of(policy=ByPair)
    for stamp in (1, 2, 3):
        frames.add(stamp, np.zeros((10, 10, 3), np.uint8))
        queue.put([queued(stamp, rows=(0, stamp))])
    queue.cut(3, frames, 4)
    assert [item.stamp_ns for item in taken(queue)] == [3, 2] and dropped == {"stale": 1}
