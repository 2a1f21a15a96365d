"""Parts of a frame that come in any order become one view."""

from __future__ import annotations

from itertools import permutations

import pytest

from deworldsg_ros.view.live import camera
from deworldsg_ros.view.live.camera import MOST_WAITING, PARTS, FrameJoiner


@pytest.fixture(autouse=True)
def plain_views(monkeypatch):
    monkeypatch.setattr(camera, "view_of", lambda *parts: parts)


def send(joiner, stamp_ns, parts=PARTS, now_s=0.0, decoded=None):
    def decode(part):
        if decoded is not None:
            decoded.append(part)
        return part

    views = [joiner.add(part, stamp_ns, lambda part=part: decode(part), now_s) for part in parts]
    assert all(view is None for view in views[:-1])
    return views[-1]


@pytest.mark.parametrize("parts", list(permutations(PARTS)))
def test_the_order_does_not_matter(parts):
    assert send(FrameJoiner(0.0), 5, parts) == ("local", "node_ids", "rgb", "instances")


def test_parts_of_different_frames_are_not_mixed():
    joiner = FrameJoiner(0.0)
    assert send(joiner, 1, PARTS[:3]) is None
    assert send(joiner, 2, PARTS[3:]) is None


def test_early_frames_are_left_out_undecoded():
    joiner, decoded = FrameJoiner(0.15), []
    assert send(joiner, 1, now_s=10.0)
    assert send(joiner, 2, now_s=10.1, decoded=decoded) is None and decoded == []
    assert send(joiner, 3, now_s=10.2)


def test_frames_that_stay_incomplete_are_forgotten():
    joiner = FrameJoiner(0.0)
    for stamp_ns in range(MOST_WAITING + 5):
        joiner.add("rgb", stamp_ns, lambda: "rgb", 0.0)
    assert send(joiner, 0, PARTS[1:]) is None
    assert send(joiner, MOST_WAITING + 4, PARTS[1:])
