"""Updates are published at once, and on average at most at the rate."""

from __future__ import annotations

import numpy as np
import pytest

from deworldsg_ros.ros.threads import RATE_SLACK, UpdateTimes

RATE_HZ = 30.0
PERIOD_S = 1 / RATE_HZ


def delays_s(arrivals_s: list[float], *, evidence_after_s: float | None = None) -> list[float]:
    """Delay from each frame's arrival to the update that contains it."""
    times = UpdateTimes(RATE_HZ)
    events = [(at_s, False) for at_s in arrivals_s]
    if evidence_after_s is not None:
        events += [(at_s + evidence_after_s, True) for at_s in arrivals_s]
    delays: list[float] = []
    waiting: list[float] = []

    def publish_until(end_s: float) -> None:
        due_s = 0.0
        while (wait_s := times.wait_s(due_s)) is not None and due_s + wait_s <= end_s:
            due_s += wait_s
            times.taken()
            times.book(due_s)
            delays.extend(due_s - at_s for at_s in waiting)
            waiting.clear()

    for at_s, can_wait in sorted(events):
        publish_until(at_s)
        times.changed(at_s, at_s, can_wait=can_wait)
        if not can_wait:
            waiting.append(at_s)
        publish_until(at_s)
    publish_until(np.inf)
    return delays


def test_nothing_is_due_without_a_change() -> None:
    assert UpdateTimes(RATE_HZ).wait_s(5.0) is None


@pytest.mark.parametrize("rate_hz", [5.0, 29.97, 30.0, 30.5])
def test_frames_up_to_the_rate_do_not_wait(rate_hz: float) -> None:
    rng = np.random.default_rng(0)
    frames_s = np.arange(900) / rate_hz + rng.uniform(0, 0.01, 900)
    assert max(delays_s(frames_s.tolist())) < 0.001


def test_evidence_takes_no_place_of_a_frame() -> None:
    frames_s = (np.arange(300) * PERIOD_S).tolist()
    assert max(delays_s(frames_s, evidence_after_s=0.004)) < 0.001


def test_evidence_alone_is_published_soon() -> None:
    times = UpdateTimes(RATE_HZ)
    times.changed(1.0, 1.0)
    assert times.wait_s(1.0) == 0.0
    assert times.taken() == 1.0
    times.book(1.0)
    times.changed(1.01, 1.01, can_wait=True)
    wait_s = times.wait_s(1.01)
    assert wait_s is not None
    assert PERIOD_S < wait_s < 3 * PERIOD_S


def test_the_mean_rate_is_limited() -> None:
    times = UpdateTimes(RATE_HZ)
    published = 0
    for now_s in np.arange(0, 10, 0.001):
        times.changed(now_s, now_s)
        if times.wait_s(now_s) == 0.0:
            times.taken()
            times.book(now_s)
            published += 1
    assert 10 * RATE_HZ * 0.95 < published <= 10 * RATE_HZ * RATE_SLACK + 2


def test_what_is_not_published_takes_no_place() -> None:
    times = UpdateTimes(RATE_HZ)
    times.book(1.0)
    for part in range(100):
        now_s = 1.0 + 0.001 * part
        times.changed(now_s, now_s)
        assert times.wait_s(now_s) == 0.0
        times.taken()
