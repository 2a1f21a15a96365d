"""Threads of the nodes: their queues, and the times of updates."""

import threading
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

from deworldsg_ros.ros.threads import RATE_SLACK, UpdateTimes, Worker

LIMIT_S = 30.0


class Held:
    """A worker that notes its items; it does not begin before `begin` is set."""

    def __init__(self, size, **options):
        self.begin, self.done, self.overruns = threading.Event(), [], []
        overrun = self.overruns.append
        self.worker = Worker("test", self._work, size=size, on_overrun=overrun, **options)

    def _work(self, item):
        assert self.begin.wait(LIMIT_S)
        self.done.append(item)

    def submit(self, *items):
        for item in items:
            self.worker.submit(item)

    def submit_first(self):
        self.worker.submit(0)
        while self.worker.waiting:
            time.sleep(0.001)

    def finish(self):
        self.begin.set()
        assert self.worker.wait_idle(LIMIT_S)


def test_a_worker_keeps_the_order_and_drops_the_oldest():
    held = Held(3)
    held.submit_first()
    held.submit(1, 2, 3, 4, 5)
    assert (held.worker.waiting, held.overruns) == (3, [1, 2])
    assert not held.worker.wait_idle(0.0)
    held.finish()
    assert held.done == [0, 3, 4, 5]
    held.begin.clear()
    held.submit_first()
    held.submit(6, 7)
    assert not held.worker.stop(0.01)
    held.begin.set()
    assert held.worker.stop(LIMIT_S)
    assert held.done[4:] in ([], [0])  # what is in its queue does not delay its end


def test_a_worker_calls_again_after_the_time_that_was_asked_for():
    calls, enough = [], threading.Event()

    def after():
        calls.append(len(calls))
        if len(calls) < 3:
            return 0.01
        enough.set()
        return None

    held = Held(1, after=after)
    held.submit(0)
    held.begin.set()
    assert enough.wait(LIMIT_S)
    held.finish()
    assert len(calls) == 3
    assert held.worker.stop(LIMIT_S)


@pytest.mark.parametrize("wait_s", [1e10, 1e308, float("inf")])
def test_a_worker_that_waits_for_ages_takes_the_next_item(wait_s):
    held = Held(2, after=lambda: wait_s)
    for item in range(2):
        held.submit(item)
        held.finish()
    assert held.done == [0, 1]
    assert held.worker.stop(LIMIT_S)


RATE_HZ = 30.0
PERIOD_S = 1 / RATE_HZ


def delays_s(arrivals_s, *, evidence_after_s=np.inf):
    """Delay from each frame's arrival to the update that contains it."""
    times, delays, waiting = UpdateTimes(RATE_HZ), [], []
    events = [(at_s, False) for at_s in arrivals_s]
    events += [(at_s + evidence_after_s, True) for at_s in arrivals_s if evidence_after_s < 1]

    def publish_until(end_s):
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


@pytest.mark.parametrize("rate_hz", [5.0, 29.97, 30.0, 30.5])
def test_frames_up_to_the_rate_do_not_wait(rate_hz):
    rng = np.random.default_rng(0)
    frames_s = np.arange(900) / rate_hz + rng.uniform(0, 0.01, 900)
    assert max(delays_s(frames_s)) < 0.001


def test_evidence_takes_no_place_of_a_frame_and_is_published_soon():
    frames_s = np.arange(300) * PERIOD_S
    assert max(delays_s(frames_s, evidence_after_s=0.004)) < 0.001
    times = UpdateTimes(RATE_HZ)
    assert times.wait_s(0.5) is None  # nothing is due without a change
    times.changed(1.0, 1.0)
    assert times.wait_s(1.0) == 0.0
    assert times.taken() == 1.0
    times.book(1.0)
    times.changed(1.01, 1.01, can_wait=True)
    wait_s = times.wait_s(1.01)
    assert wait_s is not None
    assert PERIOD_S < wait_s < 3 * PERIOD_S


def test_the_mean_rate_of_what_is_published_is_limited():
    times = UpdateTimes(RATE_HZ)
    published = 0
    for now_s in np.arange(0, 10, 0.001):
        times.changed(now_s, now_s)
        if times.wait_s(now_s) == 0.0:
            times.taken()
            times.book(now_s)
            published += 1
    assert 10 * RATE_HZ * 0.95 < published <= 10 * RATE_HZ * RATE_SLACK + 2
    times.book(20.0)
    for now_s in np.arange(20, 20.1, 0.001):  # without `book`, an update takes no place
        times.changed(now_s, now_s)
        assert times.wait_s(now_s) == 0.0
        times.taken()


def test_what_comes_after_a_result_drops_nothing():
    """A replay sends the next frame on a result, maybe before the thread that gave it goes on."""
    done, overruns = [], []

    def work(item):
        if item == 0:
            worker.submit(1)  # a camera does not wait
            worker.submit(2)
            worker.finish()
            worker.submit(3)
        done.append(item)

    worker = Worker("test", work, size=9, on_overrun=overruns.append, max_busy_s=0.0)
    worker.submit(0)
    assert worker.wait_idle(LIMIT_S)
    assert (done, overruns) == ([0, 2, 3], [1])
    assert worker.stop(LIMIT_S)
