"""The queue: bounded, and ordered only by the policy."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.relations import VOCABULARY, config

from deworldsg_ros.relations import clips
from deworldsg_ros.relations.clips import (
    ClipPolicy,
    ClipQueue,
    FrameBuffer,
    PairKey,
    QueuedClip,
    Rank,
)


def clip(stamp_ns, geo_cost=0.1, rows=(0, 1)):
    box = np.zeros(4)
    return QueuedClip(
        stamp_ns, (stamp_ns,), (0, 0, 10, 10), VOCABULARY, rows, (0, 1), (box, box), geo_cost
    )


def queue_of(size, policy=None):
    dropped = Counter()

    def drop(reason):
        dropped[reason] += 1

    return ClipQueue(size, policy or ClipPolicy(config()), drop), dropped


def taken(queue):
    """Every clip that the queue gives, in order."""
    return list(iter(queue.take, None))


class ByPair(ClipPolicy):
    """Every clip belongs to the pair of its rows."""

    def judge(self, clips):
        return [Rank((clip.stamp_ns,), PairKey(clip.rows, clip.classes)) for clip in clips]


QUEUES = st.lists(
    st.builds(clip, st.integers(0, 5), st.sampled_from([0.1, 0.2]), st.just((0, 1))), max_size=12
)


def test_empty_queue_gives_nothing():
    queue, _ = queue_of(3)
    assert len(queue) == 0 and queue.take() is None and queue.ready() == 0 and queue.clear() == 0


@given(QUEUES, st.integers(1, 5))
def test_keeps_the_best_in_order_and_counts_the_rest(items, size):
    queue, dropped = queue_of(size)
    for item in items:
        queue.put([item])
    assert len(queue) == queue.ready() == min(size, len(items))
    kept = [(item.stamp_ns, -item.geo_cost) for item in taken(queue)]
    best = sorted(((item.stamp_ns, -item.geo_cost) for item in items), reverse=True)
    assert kept == best[:size] and len(queue) == 0
    assert dropped["queue_full"] == len(best[size:]) == dropped.total()


def test_order_does_not_depend_on_the_order_of_arrival():
    items = [clip(1, rows=(i, j)) for i in range(4) for j in range(i + 1, 4)]
    for arrival in (items, items[::-1]):
        queue, _ = queue_of(10)
        queue.put(arrival)
        assert [item.rows for item in taken(queue)] == [item.rows for item in items]


def test_only_the_newest_clip_of_a_pair_waits():
    queue, dropped = queue_of(10, ByPair(config()))
    queue.put([clip(1), clip(2), clip(1, rows=(0, 2))])
    queue.put([clip(3, rows=(0, 2))])
    assert [(item.stamp_ns, item.rows) for item in taken(queue)] == [(3, (0, 2)), (2, (0, 1))]
    assert dropped == {"superseded": 2}


def test_clips_of_known_pairs_are_cut_before_their_frames_leave_and_others_become_stale():
    frames = FrameBuffer(2)
    image = np.arange(300, dtype=np.uint8).reshape(10, 10, 3)
    frames.add(1, image)
    known, lost = queue_of(10, ByPair(config()))
    unknown, stale = queue_of(10)
    for queue in (known, unknown):
        queue.put([clip(1)])
        queue.cut(1, frames, 4)
    item = known.take()
    assert item.pixels.shape == (4, 10, 10, 3) and (item.pixels == image).all() and not lost
    assert len(unknown) == 0 and stale == {"stale": 1}


def test_cut_clips_have_bounded_memory_and_the_lowest_ranks_are_dropped(monkeypatch):
    monkeypatch.setattr(clips, "MAX_CUT_BYTES", 2 * 4 * 300)
    frames = FrameBuffer(3)
    queue, dropped = queue_of(10, ByPair(config()))
    for stamp in (1, 2, 3):
        frames.add(stamp, np.zeros((10, 10, 3), np.uint8))
        queue.put([clip(stamp, rows=(0, stamp))])
    queue.cut(3, frames, 4)
    assert [item.stamp_ns for item in taken(queue)] == [3, 2] and dropped == {"stale": 1}


@pytest.mark.parametrize("size", [0, -1])
def test_a_size_below_one_is_refused(size):
    with pytest.raises(ValueError, match=f"of size {size}: expected at least 1"):
        queue_of(size)
    with pytest.raises(ValueError, match=f"of {size} frames: expected at least 1"):
        FrameBuffer(size)
