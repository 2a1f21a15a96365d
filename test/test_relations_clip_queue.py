"""The queue: bounded, ordered by a function and by nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from relations_support import VOCABULARY

from deworldsg_ros.relations.clip_queue import ClipQueue, QueuedClip, newest_first
from deworldsg_ros.relations.clips import FrameBuffer


def clip(stamp_ns, geo_cost=0.1, rows=(0, 1)):
    box = np.zeros(4)
    return QueuedClip(
        stamp_ns, (stamp_ns,), (0, 0, 1, 1), VOCABULARY, rows, (0, 1), (box, box), geo_cost
    )


clips = st.lists(
    st.builds(clip, st.integers(0, 5), st.sampled_from([0.1, 0.2]), st.just((0, 1))), max_size=12
)


def test_empty_queue_gives_nothing():
    queue = ClipQueue(3)
    assert len(queue) == 0 and queue.pop() is None and queue.clear() == 0


@settings(max_examples=40, deadline=None)
@given(clips, st.integers(1, 5))
def test_keeps_the_best_in_order_and_gives_back_the_rest(items, size):
    queue = ClipQueue(size)
    dropped = [lost for lost in map(queue.put, items) if lost is not None]
    assert len(queue) == min(size, len(items))
    kept = [newest_first(queue.pop()) for _ in range(len(queue))]
    best = sorted(map(newest_first, items), reverse=True)
    assert kept == best[:size]
    assert sorted(map(newest_first, dropped), reverse=True) == best[size:]


def test_worse_than_all_of_a_full_queue_is_itself_dropped():
    queue = ClipQueue(1)
    queue.put(clip(9))
    late = clip(1)
    assert queue.put(late) is late


def test_order_does_not_depend_on_the_order_of_arrival():
    items = [clip(1, rows=(i, j)) for i in range(4) for j in range(i + 1, 4)]
    orders = []
    for arrival in (items, items[::-1]):
        queue = ClipQueue(10)
        for item in arrival:
            queue.put(item)
        orders.append([queue.pop().rows for _ in items])
    assert orders[0] == orders[1] == [item.rows for item in items]


def test_another_order_is_a_function():
    queue = ClipQueue(2, order=lambda item: (item.geo_cost,))
    for item in (clip(1, 0.3), clip(2, 0.1), clip(3, 0.2)):
        queue.put(item)
    assert [queue.pop().stamp_ns, queue.pop().stamp_ns] == [1, 3]


@pytest.mark.parametrize(("kind", "what"), [(ClipQueue, "clips"), (FrameBuffer, "frames")])
def test_room_for_nothing_is_refused(kind, what):
    with pytest.raises(ValueError, match=f"of 0 {what}: wanted at least 1"):
        kind(0)
