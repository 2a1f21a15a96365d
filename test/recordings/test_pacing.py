"""Pace and window of a replay, without a clock."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deworldsg_ros.recordings.replaying import MAX_UNDECIDED, Pace, Window
from deworldsg_ros.recordings.source import Role


@pytest.mark.parametrize(("rate", "due_s"), [(1.0, 12.0), (2.0, 11.0), (0.5, 14.0)])
def test_pace_scales_recorded_time(rate, due_s):
    pace = Pace(rate)
    assert pace.due_s(7 * 10**18, 10.0) == 10.0
    assert pace.due_s(7 * 10**18 + 2 * 10**9, 10.1) == pytest.approx(due_s)


def test_rate_zero_is_always_due():
    pace = Pace(0.0)
    assert [pace.due_s(time_ns, 3.0) for time_ns in (0, 10**9, 5)] == [3.0] * 3


def test_after_a_pause_the_replay_keeps_its_rate():
    pace = Pace(1.0)
    pace.due_s(0, 100.0)
    pace.late(30.0)
    assert pace.due_s(10**9, 130.0) == pytest.approx(131.0)


def test_an_empty_window_is_not_full_and_zero_is_no_limit():
    assert not Window(1).is_full
    unlimited = Window(0)
    for stamp_ns in range(1000):
        unlimited.publish(stamp_ns)
    assert not unlimited.is_full
    assert unlimited.in_flight == 1000


def test_a_result_ends_the_frames_before_it():
    window = Window(3)
    for stamp_ns in (10, 20, 30):
        window.publish(stamp_ns)
    assert window.is_full
    window.add_result(20)
    assert window.in_flight == 1
    assert not window.is_full
    assert window.results == 1


def test_refused_frames_leave_the_window_and_lost_frames_are_counted():
    window = Window(2)
    window.publish(1)
    window.publish(2)
    window.excuse(2)
    assert not window.is_full
    window.publish(3)
    window.publish(4)
    assert window.is_full
    window.give_up()
    assert window.given_up == 2
    assert window.in_flight == 0


NEEDS = (Role.DEPTH, Role.POSE)


def test_a_frame_is_in_flight_once_every_stream_passed_its_stamp():
    """30 images and 5 poses per second: six images between two poses must not fill a window."""
    window = Window(4, NEEDS)
    for stamp_ns in range(1, 7):
        window.passed(Role.DEPTH, stamp_ns)
        window.publish(stamp_ns)
        assert window.in_flight == 0
    window.passed(Role.POSE, 4)
    assert window.in_flight == 4
    assert window.is_full
    window.add_result(4)
    window.passed(Role.CAMERA_INFO, 9)
    assert window.in_flight == 0
    window.close()
    assert window.in_flight == 2


def test_undecided_frames_are_bounded_and_a_result_ends_them():
    window = Window(4, NEEDS)
    for stamp_ns in range(1, MAX_UNDECIDED + 3):
        window.publish(stamp_ns)
    assert window.in_flight == 2
    window.add_result(MAX_UNDECIDED)
    window.close()
    assert window.in_flight == 2


def test_a_refusal_before_the_result_of_an_earlier_frame_counts():
    window = Window(4)
    for stamp_ns in range(1, 7):
        window.publish(stamp_ns)
    window.excuse(3)  # 2, 3 and 4
    window.add_result(1)
    assert window.in_flight == 2
    window.add_result(5)
    assert window.in_flight == 1


def test_a_refusal_after_the_result_of_a_later_frame_is_not_counted_twice():
    window = Window(4)
    for stamp_ns in range(1, 5):
        window.publish(stamp_ns)
    window.add_result(3)
    window.excuse(2)
    assert window.in_flight == 1


@given(
    size=st.integers(1, 5),
    steps=st.lists(st.sampled_from(["publish", "result", "excuse", "give up"]), max_size=60),
)
def test_never_more_in_flight_than_the_window_allows(size, steps):
    window = Window(size)
    stamp_ns, result_ns = 0, 0
    for step in steps:
        if step == "publish" and not window.is_full:
            stamp_ns += 1
            window.publish(stamp_ns)
        elif step == "result" and result_ns < stamp_ns:
            result_ns += 1
            window.add_result(result_ns)
        elif step == "excuse":
            window.excuse(1)
        elif step == "give up":
            window.give_up()
        assert 0 <= window.in_flight <= stamp_ns - result_ns
    # However it went: answering the newest empties the window.
    window.add_result(stamp_ns)
    assert window.in_flight == 0
